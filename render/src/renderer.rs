//! What takes pictures of Gaussians, whatever it runs on.

use crate::camera::View;
use crate::raster::{Channels, CpuRasterizer, Loaded, Motion, Picture, RasterError, RasterStats, Splats};

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

    /// Keeps Gaussians, with how they move when they do, for [`draw`](Self::draw). Whatever neither time nor view changes
    /// is worked out here, once. The name is good until the next `load` or `render`.
    ///
    /// # Errors
    /// Arrays that do not fit together, too much for the device, or a device that failed.
    fn load(&mut self, splats: &Splats, motion: Option<&Motion>) -> Result<Loaded, RenderError>;

    /// Renders loaded Gaussians where they are at `time_sec` (paper eq. 1; any time for those that do not move), with the
    /// channels named: fewer channels, less work.
    ///
    /// Pictures end with the Gaussians. What the paper puts behind and over them, the sky by direction and then each
    /// camera's affine exposure, is one pass over the finished pixels of any renderer (`storm_model::scene::Scene`).
    ///
    /// # Errors
    /// Gaussians that are not loaded any more, channels they do not have, a time that is not finite, or as `render`.
    fn draw(
        &mut self,
        loaded: Loaded,
        time_sec: f32,
        channels: &Channels,
        views: &[View],
    ) -> Result<Vec<Picture>, RenderError>;

    /// What it runs on, in one line.
    fn describe(&self) -> String;

    /// Counts of the last successful `render` or `draw`. `pairs` depends on the renderer's own tiles.
    fn stats(&self) -> RasterStats;
}

impl Renderer for CpuRasterizer {
    fn render(&mut self, splats: &Splats, views: &[View]) -> Result<Vec<Picture>, RenderError> {
        Ok(CpuRasterizer::render(self, splats, views)?)
    }

    fn load(&mut self, splats: &Splats, motion: Option<&Motion>) -> Result<Loaded, RenderError> {
        Ok(CpuRasterizer::load(self, splats, motion)?)
    }

    fn draw(
        &mut self,
        loaded: Loaded,
        time_sec: f32,
        channels: &Channels,
        views: &[View],
    ) -> Result<Vec<Picture>, RenderError> {
        Ok(CpuRasterizer::draw(self, loaded, time_sec, channels, views)?)
    }

    fn describe(&self) -> String {
        format!("CPU ({}, {} threads)", std::env::consts::ARCH, rayon::current_num_threads())
    }

    fn stats(&self) -> RasterStats {
        CpuRasterizer::stats(self)
    }
}
