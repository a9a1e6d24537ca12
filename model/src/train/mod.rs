//! Training: losses, optimiser, data from procedural drives, checkpoints.

pub mod losses;
mod perceptual;

pub use perceptual::structure_loss;
