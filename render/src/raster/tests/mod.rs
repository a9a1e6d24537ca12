//! Tests of the whole rasteriser: goldens, the reference, hostile input, threads and instruction sets.

mod conventions;
mod degenerate;
mod golden;
mod gradients;
mod properties;
mod scenes;
