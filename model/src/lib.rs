//! STORM (Spatio-Temporal Reconstruction Model, ICLR 2025): the network, its weights, its kernels and its error figures.
//!
//! Modules mirror the paper's parts and the names in the authors' checkpoints, so a weight file reads like the code.

pub mod kernels;
pub mod metrics;
pub mod ops;
pub mod plain;
