//! Splatting: forward rasterisation of 3D Gaussians on the CPU.
