//! Gaussians to pixels, cameras, and the procedural drive with ground truth.
//!
//! The room below the network: no ROS, no candle. Everything here is `f32` in a local frame (metres, right-handed);
//! the caller keeps the `f64` transform that ties that frame to the map.

pub mod camera;
pub mod gaussians;
#[cfg(feature = "wgpu")]
pub mod gpu;
pub mod raster;
pub mod renderer;
pub mod world;

pub use camera::{Intrinsics, View};
pub use gaussians::Gaussians;
pub use renderer::{RenderError, Renderer};
