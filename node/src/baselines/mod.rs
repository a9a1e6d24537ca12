//! What the network is compared with: per-scene optimisation, scene flow fitted to point clouds, and ceilings that use the
//! ground truth. Plain numbers in and out; `engine::evaluate` feeds and scores them.

mod adam;

pub mod gs3d;
pub mod nearest;
pub mod nsfp;
