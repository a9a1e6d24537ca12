//! Sources, sync, window, engine, map, tracks and outputs around the STORM network.
//!
//! Data flows one way: `source -> decode -> sync -> window -> engine -> step result -> outputs`, with the map and the
//! tracks hanging off the step result. Stages are plain values in, plain values out, without threads or clocks.

pub mod bag;
pub mod baselines;
pub mod cdr;
pub mod cmd;
pub mod config;
pub mod decode;
pub mod dice;
pub mod engine;
pub mod error_line;
pub mod extrinsics;
pub mod gate;
pub mod map;
pub mod msg;
pub mod objects;
pub mod output;
pub mod overlap;
pub mod pipeline;
pub mod poses;
pub mod refine;
pub mod rigid;
pub mod ros;
pub mod saved;
pub mod soak;
pub mod source;
pub mod stress;
pub mod sync;
pub mod synth;
pub mod tf;
pub mod tracks;
pub mod window;
