//! The renderers under test, with how exact each has to be.

use storm_render::raster::{CpuRasterizer, RasterSettings};
use storm_render::renderer::Renderer;

/// A renderer and its tolerances.
pub struct Backend<'a> {
    pub renderer: &'a mut dyn Renderer,
    /// Colour and alpha where no decision is close. CPU: f32 rounding of a few hundred weights. Device: its projection
    /// is in f32 as well.
    pub color_tolerance: f32,
    /// Depth there, metres: depths reach 400 m, f32 has 7 digits.
    pub depth_tolerance: f32,
}

/// Runs `check` on every renderer there is.
pub fn each(settings: RasterSettings, mut check: impl FnMut(&mut Backend)) {
    let mut cpu = CpuRasterizer::new(settings).unwrap();
    check(&mut Backend { renderer: &mut cpu, color_tolerance: 2e-5, depth_tolerance: 1e-3 });
    #[cfg(feature = "wgpu")]
    with_device(settings, |gpu| {
        check(&mut Backend { renderer: gpu, color_tolerance: 2e-4, depth_tolerance: 4e-3 });
    });
}

/// Runs `check` on the device all tests share, one at a time; not at all when there is none.
#[cfg(feature = "wgpu")]
pub fn with_device(settings: RasterSettings, check: impl FnOnce(&mut storm_render::gpu::GpuRasterizer)) {
    use std::sync::{Mutex, OnceLock, PoisonError};
    use storm_render::gpu::{GpuOptions, GpuRasterizer};
    static SHARED: OnceLock<Result<Mutex<GpuRasterizer>, String>> = OnceLock::new();
    let shared = SHARED.get_or_init(|| match GpuRasterizer::new(settings, &GpuOptions::default()) {
        Ok(gpu) => {
            println!("device: {}", gpu.describe());
            Ok(Mutex::new(gpu))
        }
        Err(error) => {
            let required = std::env::var("REQUIRE_GPU_ADAPTER").is_ok_and(|value| value == "1");
            assert!(!required, "REQUIRE_GPU_ADAPTER=1, but: {error}");
            Err(error.to_string())
        }
    });
    match shared {
        // A test that failed leaves nothing half done that the next could see: every render starts anew.
        Ok(gpu) => {
            let mut gpu = gpu.lock().unwrap_or_else(PoisonError::into_inner);
            gpu.set_settings(settings).unwrap();
            check(&mut gpu);
        }
        Err(error) => println!("SKIPPED: no wgpu adapter ({error})"),
    }
}
