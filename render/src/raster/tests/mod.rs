//! Tests of the whole rasteriser: goldens, the reference, hostile input, threads and instruction sets.

mod conventions;
mod degenerate;
mod differences;
mod golden;
mod gradients;
mod loaded;
mod properties;
mod scenes;
