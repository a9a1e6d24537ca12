//! The long-horizon map: static Gaussians merged in voxels.
