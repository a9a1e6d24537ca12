//! A device that is lost in the middle of a run (driver reset, unplugged) is no reason to stop: the same pictures are taken
//! on the CPU from then on.

use super::GpuRasterizer;
use super::error::GpuError;
use crate::camera::View;
use crate::raster::{Channels, CpuRasterizer, Loaded, Motion, Picture, RasterStats, Splats};
use crate::renderer::{RenderError, Renderer};

/// Told, once, why the CPU goes on.
pub type OnLost = Box<dyn FnMut(&GpuError) + Send>;

/// Draws on a device for as long as it is there, then on the CPU.
pub struct GpuOrCpu {
    /// None once it was lost.
    gpu: Option<GpuRasterizer>,
    cpu: CpuRasterizer,
    on_lost: OnLost,
    kept: Option<Kept>,
}

/// Velocity backward and forward (m/s) and time (s) of every Gaussian.
type OwnedMotion = (Vec<[f32; 3]>, Vec<[f32; 3]>, Vec<f32>);

/// What was loaded, to load it again elsewhere.
struct Kept {
    /// The name the caller knows.
    name: Loaded,
    /// Its name on the CPU, once it is there.
    on_cpu: Option<Loaded>,
    means: Vec<[f32; 3]>,
    quats: Vec<[f32; 4]>,
    scales: Vec<[f32; 3]>,
    opacities: Vec<f32>,
    features: Vec<f32>,
    feature_count: usize,
    motion: Option<OwnedMotion>,
}

impl Kept {
    fn of(name: Loaded, splats: &Splats, motion: Option<&Motion>) -> Self {
        let owned = |m: &Motion| (m.velocity_backward.to_vec(), m.velocity_forward.to_vec(), m.time_sec.to_vec());
        Self {
            name,
            on_cpu: None,
            means: splats.means.to_vec(),
            quats: splats.quats.to_vec(),
            scales: splats.scales.to_vec(),
            opacities: splats.opacities.to_vec(),
            features: splats.features.to_vec(),
            feature_count: splats.feature_count,
            motion: motion.map(owned),
        }
    }

    /// Its name on the CPU, where it is loaded the first time.
    fn on(&mut self, cpu: &mut CpuRasterizer) -> Result<Loaded, RenderError> {
        if let Some(name) = self.on_cpu {
            return Ok(name);
        }
        let splats = Splats {
            means: &self.means,
            quats: &self.quats,
            scales: &self.scales,
            opacities: &self.opacities,
            features: &self.features,
            feature_count: self.feature_count,
        };
        let motion = self.motion.as_ref().map(|(backward, forward, time_sec)| Motion {
            velocity_backward: backward,
            velocity_forward: forward,
            time_sec,
        });
        let name = cpu.load(&splats, motion.as_ref())?;
        self.on_cpu = Some(name);
        Ok(name)
    }
}

impl GpuOrCpu {
    /// Goes on with the CPU when `gpu` is lost; `on_lost` is then told why.
    ///
    /// # Errors
    /// None that opening `gpu` would not have met.
    pub fn new(gpu: GpuRasterizer, on_lost: OnLost) -> Result<Self, RenderError> {
        let cpu = CpuRasterizer::new(*gpu.settings())?;
        Ok(Self { gpu: Some(gpu), cpu, on_lost, kept: None })
    }

    /// The device, while there is one.
    pub fn gpu(&self) -> Option<&GpuRasterizer> {
        self.gpu.as_ref()
    }

    /// Asks the device, while there is one; none when the CPU has to.
    fn on_gpu<T>(
        &mut self,
        ask: impl FnOnce(&mut GpuRasterizer) -> Result<T, RenderError>,
    ) -> Option<Result<T, RenderError>> {
        match ask(self.gpu.as_mut()?) {
            Err(RenderError::Gpu(e @ GpuError::DeviceLost { .. })) => {
                (self.on_lost)(&e);
                self.gpu = None;
                None
            }
            other => Some(other),
        }
    }
}

impl Renderer for GpuOrCpu {
    fn render(&mut self, splats: &Splats, views: &[View]) -> Result<Vec<Picture>, RenderError> {
        self.kept = None;
        match self.on_gpu(|gpu| gpu.render(splats, views)) {
            Some(done) => done,
            None => Ok(self.cpu.render(splats, views)?),
        }
    }

    fn load(&mut self, splats: &Splats, motion: Option<&Motion>) -> Result<Loaded, RenderError> {
        self.kept = None;
        match self.on_gpu(|gpu| gpu.load(splats, motion)) {
            Some(name) => {
                let name = name?;
                self.kept = Some(Kept::of(name, splats, motion));
                Ok(name)
            }
            None => Ok(self.cpu.load(splats, motion)?),
        }
    }

    fn draw(
        &mut self,
        loaded: Loaded,
        time_sec: f32,
        channels: &Channels,
        views: &[View],
    ) -> Result<Vec<Picture>, RenderError> {
        if let Some(done) = self.on_gpu(|gpu| gpu.draw(loaded, time_sec, channels, views)) {
            return done;
        }
        let name = match &mut self.kept {
            Some(kept) if kept.name == loaded => kept.on(&mut self.cpu)?,
            _ => loaded,
        };
        Ok(self.cpu.draw(name, time_sec, channels, views)?)
    }

    fn describe(&self) -> String {
        self.gpu.as_ref().map_or_else(|| Renderer::describe(&self.cpu), Renderer::describe)
    }

    fn stats(&self) -> RasterStats {
        self.gpu.as_ref().map_or_else(|| Renderer::stats(&self.cpu), Renderer::stats)
    }
}
