//! The live node: ROS 2 messages in and out. Translates and nothing more; what happens between is [`crate::pipeline::live`].
//!
//! One thread spins ROS and never waits for a step. r2r hands messages over in channels of ten and loses the newest when
//! one is full, so every stream is emptied after every spin, into rings of our own that lose the oldest and count it.

mod convert;
mod describe;
mod diagnostics;
mod map_output;
mod names;
mod node;
mod outputs;
mod parameters;
mod publisher;
mod qos;
mod services;
mod streams;
mod topics;

pub use node::run;
