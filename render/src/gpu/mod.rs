//! Splatting through wgpu: the forward rasteriser of [`raster`](crate::raster) in WGSL, on any Vulkan, Metal, DirectX 12
//! or GLES device, without a window.
//!
//! The data's way: `scene` (upload, usable Gaussians; where they are at a time) -> per view in `frame`: project -> `sort` (visible splats by depth,
//! their tiles by number) -> `blend` (16x16 tiles, front to back) -> `readback`. The shaders lie in `render/shaders`;
//! each says its algorithm, bindings and equation. Buffers stay on the device and grow when needed. Only the limits of
//! WebGPU are asked for, and no subgroup operations.

mod adapter;
mod blend;
mod buffers;
mod device;
mod error;
mod fallback;
mod frame;
mod params;
mod pipelines;
mod readback;
mod scene;
mod shaders;
mod sort;
mod timings;

pub use adapter::GpuOptions;
pub use error::{GpuError, SOFTWARE_ADAPTER};
pub use fallback::{GpuOrCpu, OnLost};
pub use timings::GpuTimings;

use crate::camera::View;
use crate::raster::{
    Channels, CpuRasterizer, Loaded, MAX_VIEWS, Motion, Picture, RasterError, RasterSettings, RasterStats, Splats,
    validate_time,
};
use crate::renderer::{RenderError, Renderer};
use device::Gpu;
use frame::{Frame, Work};
use pipelines::Pipelines;
use readback::{BATCH_VIEWS, Outcome, Staging, batch_len};
use scene::Scene;
use std::ops::Range;
use timings::Clock;

/// The forward rasteriser on a device; owns the device and its buffers.
pub struct GpuRasterizer {
    gpu: Gpu,
    kernels: Pipelines,
    scene: Scene,
    work: Work,
    staging: Staging,
    clock: Option<Clock>,
    settings: RasterSettings,
    /// Judges settings, splats and views, so that both rasterisers refuse the same in the same words.
    judge: CpuRasterizer,
    stats: RasterStats,
    timings: GpuTimings,
    /// Name of what is on the device, while it may be drawn by it.
    loaded: Option<Loaded>,
}

impl GpuRasterizer {
    /// Opens the best adapter of this machine that the options and the environment (`WGPU_BACKEND`,
    /// `WGPU_ADAPTER_NAME`) allow; [`describe`](Renderer::describe) says which one it is.
    ///
    /// # Errors
    /// Settings without meaning, no usable adapter (the message lists what was found), or a device that does not open.
    pub fn new(settings: RasterSettings, options: &GpuOptions) -> Result<Self, RenderError> {
        let judge = CpuRasterizer::new(settings)?;
        let gpu = Gpu::open(options)?;
        let kernels = Pipelines::new(&gpu)?;
        let (scene, work, staging) = (Scene::new(&gpu), Work::new(&gpu)?, Staging::new(&gpu));
        let clock = Clock::new(&gpu, BATCH_VIEWS);
        gpu.check()?;
        let (stats, timings) = (RasterStats::default(), GpuTimings::default());
        Ok(Self { gpu, kernels, scene, work, staging, clock, settings, judge, stats, timings, loaded: None })
    }

    /// The settings in use.
    pub fn settings(&self) -> &RasterSettings {
        &self.settings
    }

    /// Follows other settings from now on; device, shaders and uploaded splats stay.
    ///
    /// # Errors
    /// Settings without meaning; the old ones stay.
    pub fn set_settings(&mut self, settings: RasterSettings) -> Result<(), RenderError> {
        self.judge = CpuRasterizer::new(settings)?;
        self.settings = settings;
        Ok(())
    }

    /// Device time of the last render by stage; `None` when the adapter has no timestamps.
    pub fn timings(&self) -> Option<GpuTimings> {
        self.clock.is_some().then_some(self.timings)
    }

    /// Copies splats to the device, where they stay for [`render_uploaded`](Self::render_uploaded).
    ///
    /// # Errors
    /// Arrays that do not fit together or do not fit the device, or a device that failed or is lost.
    pub fn upload(&mut self, splats: &Splats) -> Result<(), RenderError> {
        self.take_over(splats, None)
    }

    fn take_over(&mut self, splats: &Splats, motion: Option<&Motion>) -> Result<(), RenderError> {
        splats.validate()?;
        motion.map_or(Ok(()), |motion| motion.validate(splats.len()))?;
        self.gpu.check()?;
        self.loaded = None;
        Ok(self.scene.upload(&self.gpu, &self.kernels, splats, motion)?)
    }

    /// Renders views of the splats uploaded last, with all their channels, where they were put last.
    ///
    /// # Errors
    /// Cameras that cannot take a picture, views too large for the device, or a device that failed or is lost.
    pub fn render_uploaded(&mut self, views: &[View]) -> Result<Vec<Picture>, RenderError> {
        self.render_channels(0..self.scene.channels as usize, views)
    }

    fn render_channels(&mut self, channels: Range<usize>, views: &[View]) -> Result<Vec<Picture>, RenderError> {
        self.judge_views(channels.len(), views)?;
        self.gpu.check()?;
        let mut stats = RasterStats { splats: self.scene.splats as usize, ..RasterStats::default() };
        let mut timings = GpuTimings::default();
        let mut pictures = Vec::with_capacity(views.len());
        let mut rest = views;
        while !rest.is_empty() {
            let (batch, after) = rest.split_at(batch_len(rest, channels.len() as u32));
            let (outcomes, invalid) = self.render_batch(&channels, batch, &mut timings)?;
            stats.invalid = invalid as usize;
            for outcome in outcomes {
                stats.visible += outcome.visible as usize;
                stats.pairs += outcome.pairs as usize;
                pictures.push(outcome.picture);
            }
            rest = after;
        }
        stats.culled = ((stats.splats - stats.invalid.min(stats.splats)) * views.len()).saturating_sub(stats.visible);
        (self.stats, self.timings) = (stats, timings);
        Ok(pictures)
    }

    /// Renders one batch; once more with larger tile lists when a view needs them.
    fn render_batch(
        &mut self,
        channels: &Range<usize>,
        views: &[View],
        timings: &mut GpuTimings,
    ) -> Result<(Vec<Outcome>, u32), GpuError> {
        let mut pairs = 0;
        loop {
            self.work.reserve(&self.gpu, &self.scene, channels, views, pairs)?;
            self.work.write_params(&self.gpu, &self.settings, &self.scene, views)?;
            self.staging.reserve(&self.gpu, views, channels.len() as u32)?;
            self.submit(views);
            let before = *timings;
            let (outcomes, invalid) = self.staging.read(&self.gpu, views, &self.work.plan, timings)?;
            pairs = outcomes.iter().map(|o| u64::from(o.pairs)).max().unwrap_or(0);
            if pairs <= u64::from(self.work.capacity) {
                return Ok((outcomes, invalid));
            }
            *timings = before;
        }
    }

    /// Hands the commands of a batch to the device.
    fn submit(&self, views: &[View]) {
        let mut encoder = self.gpu.device.create_command_encoder(&Default::default());
        let mut end = 0;
        for (index, camera) in views.iter().enumerate() {
            let frame = Frame {
                gpu: &self.gpu,
                kernels: &self.kernels,
                settings: &self.settings,
                scene: &self.scene,
                work: &self.work,
                camera,
                index,
            };
            frame.encode(&mut encoder, self.clock.as_ref());
            end = self.staging.copy(&mut encoder, &self.work, camera, end);
        }
        self.staging.copy_shared(
            &mut encoder,
            [&self.scene.invalid, &self.scene.lost],
            self.clock.as_ref(),
            views.len(),
            end,
        );
        self.gpu.queue.submit([encoder.finish()]);
    }

    fn judge_views(&self, feature_count: usize, views: &[View]) -> Result<(), RasterError> {
        if views.len() > MAX_VIEWS {
            return Err(RasterError::TooMany { name: "views", value: views.len(), limit: MAX_VIEWS });
        }
        let nothing = Splats { means: &[], quats: &[], scales: &[], opacities: &[], features: &[], feature_count };
        for (index, view) in views.iter().enumerate() {
            self.judge.project(&nothing, view).map_err(|error| match error {
                RasterError::View { what, .. } => RasterError::View { view: index, what },
                other => other,
            })?;
        }
        Ok(())
    }
}

impl Renderer for GpuRasterizer {
    fn render(&mut self, splats: &Splats, views: &[View]) -> Result<Vec<Picture>, RenderError> {
        self.upload(splats)?;
        self.render_uploaded(views)
    }

    fn load(&mut self, splats: &Splats, motion: Option<&Motion>) -> Result<Loaded, RenderError> {
        self.take_over(splats, motion)?;
        let name = Loaded::new();
        self.loaded = Some(name);
        Ok(name)
    }

    fn draw(
        &mut self,
        loaded: Loaded,
        time_sec: f32,
        channels: &Channels,
        views: &[View],
    ) -> Result<Vec<Picture>, RenderError> {
        if self.loaded != Some(loaded) {
            return Err(RasterError::NotLoaded.into());
        }
        channels.validate(self.scene.channels as usize)?;
        validate_time(time_sec)?;
        self.judge_views(channels.0.len(), views)?;
        self.gpu.check()?;
        self.scene.place(&self.gpu, &self.kernels, time_sec)?;
        self.render_channels(channels.0.clone(), views)
    }

    fn describe(&self) -> String {
        self.gpu.name.clone()
    }

    fn stats(&self) -> RasterStats {
        self.stats
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Intrinsics;
    use glam::Affine3A;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    /// A device; none, after saying SKIPPED, where there is none and none is required.
    fn opened() -> Option<GpuRasterizer> {
        match GpuRasterizer::new(RasterSettings::default(), &GpuOptions::default()) {
            Ok(gpu) => Some(gpu),
            Err(error) => {
                let required = std::env::var("REQUIRE_GPU_ADAPTER").is_ok_and(|value| value == "1");
                assert!(!required, "REQUIRE_GPU_ADAPTER=1, but: {error}");
                println!("SKIPPED: no wgpu adapter ({error})");
                None
            }
        }
    }

    /// The device is lost while Gaussians are loaded: their name stays good, the pictures are the CPU's, and it is said once.
    #[test]
    fn a_lost_device_falls_back_to_the_cpu_with_one_warning() {
        let Some(gpu) = opened() else { return };
        let splats = Splats {
            means: &[[0.0, 0.0, 5.0], [0.3, 0.1, 4.0]],
            quats: &[[1.0, 0.0, 0.0, 0.0]; 2],
            scales: &[[0.2; 3]; 2],
            opacities: &[0.5, 0.8],
            features: &[0.25, 0.75],
            feature_count: 1,
        };
        let (still, ahead) = ([[0.0; 3]; 2], [[0.5, 0.0, 0.0], [0.0; 3]]);
        let motion = Motion { velocity_backward: &still, velocity_forward: &ahead, time_sec: &[0.0; 2] };
        let view = View { camera_from_world: Affine3A::IDENTITY, intrinsics: Intrinsics::from_fov(60.0, 16, 16) };
        let mut cpu = CpuRasterizer::new(RasterSettings::default()).unwrap();
        let on_cpu = cpu.load(&splats, Some(&motion)).unwrap();
        let wanted = cpu.draw(on_cpu, 0.5, &Channels(0..1), &[view]).unwrap();
        let told = Arc::new(AtomicUsize::new(0));
        let count = told.clone();
        let on_lost = Box::new(move |e: &GpuError| {
            assert!(matches!(e, GpuError::DeviceLost { .. }), "{e}");
            count.fetch_add(1, Ordering::Relaxed);
        });
        let mut both = GpuOrCpu::new(gpu, on_lost).unwrap();
        let name = both.load(&splats, Some(&motion)).unwrap();
        let before = both.draw(name, 0.5, &Channels(0..1), &[view]).unwrap();
        let near = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(x, y)| (x - y).abs() < 1e-4);
        assert!(near(&before[0].features, &wanted[0].features) && told.load(Ordering::Relaxed) == 0);
        both.gpu().unwrap().gpu.device.destroy();
        for _ in 0..3 {
            let after = both.draw(name, 0.5, &Channels(0..1), &[view]).unwrap();
            assert_eq!(after, wanted);
        }
        assert!(both.gpu().is_none() && both.describe().starts_with("CPU"));
        // A name of something else is still refused, and new things can be loaded.
        assert!(both.draw(Loaded::new(), 0.5, &Channels(0..1), &[view]).is_err());
        let again = both.load(&splats, None).unwrap();
        assert!(both.draw(again, 0.0, &Channels(0..1), &[view]).is_ok());
        assert!(both.draw(name, 0.5, &Channels(0..1), &[view]).is_err(), "its name ended with the next load");
        assert!(both.render(&splats, &[view]).is_ok());
        assert_eq!(told.load(Ordering::Relaxed), 1);
    }

    #[test]
    fn a_lost_device_is_an_error_to_act_on() {
        let Some(mut gpu) = opened() else { return };
        let splats = Splats {
            means: &[[0.0, 0.0, 5.0]],
            quats: &[[1.0, 0.0, 0.0, 0.0]],
            scales: &[[0.1; 3]],
            opacities: &[0.5],
            features: &[],
            feature_count: 0,
        };
        let view = View { camera_from_world: Affine3A::IDENTITY, intrinsics: Intrinsics::from_fov(60.0, 16, 16) };
        assert!(gpu.render(&splats, &[view]).is_ok());
        gpu.gpu.device.destroy();
        // Whether the loss is noticed before or after the upload: every later call says so, and none panics.
        for _ in 0..2 {
            let error = gpu.render(&splats, &[view]).unwrap_err();
            println!("{error}");
            assert!(matches!(error, RenderError::Gpu(GpuError::DeviceLost { .. })), "{error}");
        }
        assert!(matches!(gpu.render_uploaded(&[view]), Err(RenderError::Gpu(GpuError::DeviceLost { .. }))));
        drop(gpu);
        assert!(opened().unwrap().render(&splats, &[view]).is_ok(), "opened again");
    }
}
