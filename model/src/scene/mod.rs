//! One window's result as plain numbers: no tensor library from here on.

mod affine;
mod affine_fit;
mod render;
mod sky;

use std::sync::Arc;

pub use affine::Affine;
pub use affine_fit::AffineFit;
pub(crate) use render::fade_weights;
pub use render::{RenderedView, Want};
pub use sky::SkyModel;
use storm_render::Gaussians;

use crate::config::ModelConfig;

/// How a scene's Gaussians are laid out: one per pixel, ordered (timestep, camera, row, column), column fastest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SceneShape {
    /// Timesteps of the window.
    pub timesteps: usize,
    /// Cameras of the window.
    pub cameras: usize,
    /// Rows of each picture.
    pub height: usize,
    /// Columns of each picture.
    pub width: usize,
}

impl SceneShape {
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.timesteps * self.cameras * self.height * self.width
    }

    /// True when there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The Gaussians of one picture.
    pub fn picture(&self, timestep: usize, camera: usize) -> std::ops::Range<usize> {
        let pixels = self.height * self.width;
        let start = (timestep * self.cameras + camera) * pixels;
        start..start + pixels
    }
}

/// One window: Gaussians that move, the sky behind them and each camera's exposure. Every number is finite.
#[derive(Debug, Clone)]
pub struct Scene {
    /// The Gaussians, in the window's world.
    pub gaussians: Gaussians,
    /// Which pixel each came from.
    pub shape: SceneShape,
    /// Depth per Gaussian, metres; what it measures is `config.depth_meaning`.
    pub depths: Vec<f32>,
    /// Whether the camera saw the pixel each came from; what it did not see has opacity 0 and is no sky. Empty: it saw all.
    pub valid: Vec<bool>,
    /// The sky; none without a sky token.
    pub sky: Option<SkyModel>,
    /// Exposure per camera of the window; empty without affine tokens.
    pub affine: Vec<Affine>,
    /// Velocity bases, one row of 3 or 6 numbers per motion token, m/s as the network states them.
    pub motion_bases: Vec<Vec<f32>>,
    /// The configuration of the network that made it.
    pub config: Arc<ModelConfig>,
}

impl Scene {
    /// Whether the camera saw the pixel that Gaussian `i` came from.
    pub fn is_valid(&self, i: usize) -> bool {
        self.valid.get(i).copied().unwrap_or(true)
    }
}
