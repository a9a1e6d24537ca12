//! What takes pictures of Gaussians, whatever it runs on.

use crate::camera::View;
use crate::raster::{CpuRasterizer, Picture, RasterError, RasterStats, Splats};

/// Why no picture was taken.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RenderError {
    /// The request has a fault; every renderer refuses it.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// The device has; another renderer may succeed.
    #[cfg(feature = "wgpu")]
    #[error(transparent)]
    Gpu(#[from] crate::gpu::GpuError),
}

/// A forward rasteriser: the same splats and views give the same pictures on each, up to rounding.
pub trait Renderer: Send {
    /// Renders every view; splats with non-finite numbers are skipped and counted, everything returned is finite.
    ///
    /// # Errors
    /// Arrays that do not fit together, cameras that cannot take a picture, too much at once, or a device that failed.
    fn render(&mut self, splats: &Splats, views: &[View]) -> Result<Vec<Picture>, RenderError>;

    /// What it runs on, in one line.
    fn describe(&self) -> String;

    /// Counts of the last successful `render`. `pairs` depends on the renderer's own tiles.
    fn stats(&self) -> RasterStats;
}

impl Renderer for CpuRasterizer {
    fn render(&mut self, splats: &Splats, views: &[View]) -> Result<Vec<Picture>, RenderError> {
        Ok(CpuRasterizer::render(self, splats, views)?)
    }

    fn describe(&self) -> String {
        format!("CPU ({}, {} threads)", std::env::consts::ARCH, rayon::current_num_threads())
    }

    fn stats(&self) -> RasterStats {
        CpuRasterizer::stats(self)
    }
}
