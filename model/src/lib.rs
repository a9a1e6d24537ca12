//! STORM (Spatio-Temporal Reconstruction Model, ICLR 2025): the network, its weights, its kernels and its error figures.
//!
//! Modules mirror the paper's parts and the names in the authors' checkpoints, so a weight file reads like the code.

pub mod clip;
pub mod config;
mod error;
pub mod kernels;
pub mod metrics;
pub mod network;
pub mod ops;
pub mod plain;
mod rays;
pub mod scene;
pub mod train;
pub mod weights;

pub use clip::{ClipBatch, PixelLayout, ViewInput};
pub use config::ModelConfig;
pub use error::ModelError;
pub use network::{ClipOutput, Kept, Shortcuts, Stages, Storm};
pub use ops::Precision;
pub use scene::Scene;
