//! One window in, one scene out: the network and the renderer behind plain values.

pub mod evaluate;
pub mod figures;
mod reuse;
pub mod score;
pub mod select;
mod sky;
#[cfg(test)]
mod tests;
pub mod truth;

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result};
use candle_core::Device;
use storm_model::config::ModelConfig;
use storm_model::kernels::Isa;
use storm_model::scene::{RenderedView, Scene, Want};
use storm_model::weights::{self, Tensors};
use storm_model::{ClipBatch, ModelError, PixelLayout, Precision, Shortcuts, Storm, ViewInput};
use storm_render::raster::{CpuRasterizer, RasterSettings};
use storm_render::{Intrinsics, View};
use tracing::warn;

use crate::config::{ModelConfigSection, SkipConfig};
use crate::rigid::Rigid;
use crate::source::Frame;
use crate::sync::clock::seconds_between;
use crate::window::{PosedSet, Window, relative};
use reuse::{Left, Reuse};
use sky::SkyPatches;

/// How the weights a run used are called in metrics.json and the report when there are none.
pub const UNTRAINED: &str = "untrained";

/// The preset whose weights ship.
pub const SHIPPED_PRESET: &str = "tiny";

/// The architecture and, if there are any, the weights: known before the cameras are.
pub enum ModelSource {
    /// Read from a file, or shipped.
    Loaded {
        /// The architecture.
        config: Box<ModelConfig>,
        /// The weights.
        tensors: Tensors,
        /// The file, or what the shipped weights are called.
        name: String,
    },
    /// Seeded random weights, made once the number of cameras is known.
    Untrained {
        /// The architecture.
        config: Box<ModelConfig>,
        /// The seed.
        seed: u64,
    },
}

impl ModelSource {
    /// Reads the weights file of the configuration; without one takes the weights that ship, where the preset has any, else
    /// settles on the preset with random weights.
    pub fn open(section: &ModelConfigSection) -> Result<Self> {
        let device = device(&section.device)?;
        let named = !section.weights.is_empty() && section.weights != UNTRAINED;
        let ((config, tensors), name) = if named {
            let path = Path::new(&section.weights);
            let loaded =
                weights::load(path, None, &device).with_context(|| format!("cannot use weights {}", path.display()))?;
            let name = path.file_name().map_or_else(|| section.weights.clone(), |n| n.to_string_lossy().into_owned());
            (loaded, name)
        } else if section.weights.is_empty() && section.preset == SHIPPED_PRESET {
            (weights::shipped(&device)?, weights::SHIPPED_NAME.to_string())
        } else {
            let config = ModelConfig::preset(&section.preset).map_err(|e| crate::cmd::UsageError(e.to_string()))?;
            return Ok(Self::Untrained { config: Box::new(config), seed: section.untrained_seed });
        };
        Ok(Self::Loaded { config: Box::new(config), tensors, name })
    }

    /// How long before each timestep the network's sweep has one more image, seconds; 0: there is no sweep, or it is not asked for.
    pub fn prior_sec(&self, section: &ModelConfigSection) -> f64 {
        if self.config().sweep_after_block > 0 { section.sweep_prior_sec } else { 0.0 }
    }

    /// The architecture.
    pub fn config(&self) -> &ModelConfig {
        match self {
            Self::Loaded { config, .. } | Self::Untrained { config, .. } => config,
        }
    }

    /// Width and height of the pictures the network takes: the configured ones, else what the weights were made for.
    pub fn picture_size(&self, section: &ModelConfigSection) -> Result<(usize, usize)> {
        let config = self.config();
        let pick = |wanted: usize, own: usize| if wanted == 0 { own } else { wanted };
        let size = (pick(section.image_width, config.image_width), pick(section.image_height, config.image_height));
        for (key, x) in [("model.image_width", size.0), ("model.image_height", size.1)] {
            if x == 0 || x % config.patch_size != 0 {
                let message = format!("{key} = {x}: wants a multiple of the patch size {}", config.patch_size);
                return Err(crate::cmd::UsageError(message).into());
            }
        }
        Ok(size)
    }
}

fn device(name: &str) -> Result<Device> {
    let unavailable = |e: candle_core::Error| {
        crate::cmd::UsageError(format!("model.device = {name}: {e}; this build may lack the feature '{name}', use cpu"))
    };
    Ok(match name {
        "cuda" => Device::new_cuda(0).map_err(unavailable)?,
        "metal" => Device::new_metal(0).map_err(unavailable)?,
        _ => Device::Cpu,
    })
}

/// The network, the rasteriser and their buffers.
pub struct Engine {
    model: Storm,
    raster: CpuRasterizer,
    device: Device,
    timespan_sec: f64,
    weights: String,
    shortcuts: Shortcuts,
    sky: SkyPatches,
    reuse: Reuse,
}

impl Engine {
    /// Ready for windows of `cameras` cameras. `timespan_sec` is what the network's clock is divided by.
    pub fn new(source: ModelSource, section: &ModelConfigSection, cameras: usize, timespan_sec: f64) -> Result<Self> {
        let device = device(&section.device)?;
        // Every step takes and frees the same some tens of megabytes.
        storm_model::ops::keep_freed_memory();
        let (model, weights) = match source {
            ModelSource::Loaded { mut config, mut tensors, name } => {
                weights::for_cameras(&mut config, &mut tensors, cameras)?;
                (Storm::new(&config, &tensors)?, name)
            }
            ModelSource::Untrained { mut config, seed } => {
                config.num_cams = config.num_cams.max(cameras);
                (Storm::untrained(&config, seed, &device)?, UNTRAINED.to_string())
            }
        };
        let raster = CpuRasterizer::new(model.config().raster_settings())?;
        let shortcuts = Shortcuts { precision: section.precision.parse()?, ..Shortcuts::default() };
        if shortcuts.precision == Precision::Bf16 && Isa::detect() != Isa::Amx {
            warn!(
                "model.precision = bf16 without AMX tile units rounds in f32 arithmetic: it is no faster than f32; use int16"
            );
        }
        let sky = SkyPatches::new(&SkipConfig::default(), model.config().patch_size);
        let reuse = Reuse::new(0);
        Ok(Self { model, raster, device, timespan_sec, weights, shortcuts, sky, reuse })
    }

    /// The same, leaving out what the configuration allows.
    #[must_use]
    pub fn with_skips(mut self, skip: &SkipConfig) -> Self {
        self.shortcuts.kv_pool = skip.kv_pool;
        self.shortcuts.merge = skip.merge as f32;
        self.shortcuts.newest_only = skip.newest_only;
        self.sky = SkyPatches::new(skip, self.model.config().patch_size);
        self.reuse = Reuse::new(skip.reuse);
        self
    }

    /// What steps leave out or round at present; with `skip.sky` each step has a `keep` of its own besides.
    pub fn shortcuts(&self) -> &Shortcuts {
        &self.shortcuts
    }

    /// Makes anew all that a step changes: the rasteriser and its buffers, what was seen of the sky, what steps left for later
    /// ones. The network only ever reads its weights.
    ///
    /// # Errors
    /// None that [`Engine::new`] would not have met.
    pub fn restart(&mut self) -> Result<()> {
        self.raster = CpuRasterizer::new(self.model.config().raster_settings())?;
        self.sky.forget();
        self.reuse.forget();
        Ok(())
    }

    /// Whether a step over this window would leave anything out or round anything.
    pub fn approximates(&self, window: &Window<Frame>, cameras: &[Intrinsics]) -> bool {
        !self.shortcuts.exact() || self.sky.enabled() || self.reuse.at_hand(window, cameras).is_some()
    }

    /// The network's configuration.
    pub fn model_config(&self) -> &ModelConfig {
        self.model.config()
    }

    /// How scenes of this network are drawn.
    pub fn raster_settings(&self) -> RasterSettings {
        *self.raster.settings()
    }

    /// Name of the weights file, what the shipped ones are called, or [`UNTRAINED`].
    pub fn weights(&self) -> &str {
        &self.weights
    }

    /// Runs the network on one window: Gaussians in the window's anchor frame, sky and exposure.
    pub fn step(&mut self, window: &Window<Frame>, cameras: &[Intrinsics]) -> Result<Scene> {
        let mut scenes = self.steps(&[window], cameras)?;
        scenes.pop().context("the network gave no scene")?
    }

    /// As [`Engine::step`], with all that may be left out: where older timesteps are at hand the newest alone is computed, and
    /// the scene is in the frame of the anchor they were computed in, which comes with it. The clock is the window's own.
    pub fn shortest_step(&mut self, window: &Window<Frame>, cameras: &[Intrinsics]) -> Result<(Rigid, Scene)> {
        let Some(left) = self.reuse.take(window, cameras) else {
            return Ok((window.map_from_anchor, self.step(window, cameras)?));
        };
        let window = left.placed(window);
        let (output, kept) =
            self.model.forward_reusing(&self.clip(&window, cameras)?, &left.kept, self.shortcuts.precision)?;
        let mut scene = output.scene(0)?;
        scene.gaussians.time_sec.iter_mut().for_each(|t| *t -= left.lead_sec(&window) as f32);
        let map_from_anchor = window.map_from_anchor;
        self.reuse.leave(left.followed_by(window, kept));
        Ok((map_from_anchor, scene))
    }

    /// The same as [`Engine::step`], leaving nothing out and rounding nothing.
    pub fn exact_step(&mut self, window: &Window<Frame>, cameras: &[Intrinsics]) -> Result<Scene> {
        let mut scenes = self.exact_steps(&[window], cameras)?;
        scenes.pop().context("the network gave no scene")?
    }

    /// [`Engine::steps`], leaving nothing out and rounding nothing.
    ///
    /// # Errors
    /// As there.
    pub fn exact_steps(&mut self, windows: &[&Window<Frame>], cameras: &[Intrinsics]) -> Result<Vec<Result<Scene>>> {
        self.run(windows, cameras, true)
    }

    /// Runs the network on several windows in one forward pass. One result per window: a window whose result is not
    /// finite does not spoil the others.
    ///
    /// # Errors
    /// Windows whose shapes differ or that the network does not take.
    pub fn steps(&mut self, windows: &[&Window<Frame>], cameras: &[Intrinsics]) -> Result<Vec<Result<Scene>>> {
        self.run(windows, cameras, false)
    }

    fn run(&mut self, windows: &[&Window<Frame>], cameras: &[Intrinsics], exact: bool) -> Result<Vec<Result<Scene>>> {
        let shortcuts = if exact { Shortcuts::default() } else { self.shortcuts.clone() };
        let clips = windows.iter().map(|w| self.clip(w, cameras)).collect::<Result<Vec<_>>>()?;
        let output = match (clips.as_slice(), windows) {
            ([], _) => return Ok(Vec::new()),
            ([one], [window]) => {
                if self.reuse.enabled() {
                    let (output, kept) = self.model.forward_keeping(one, shortcuts.precision)?;
                    let scene = self.judged(window, output.scene(0), None);
                    // Nothing goes on from what is not finite.
                    if scene.is_ok() {
                        self.reuse.leave(Left::new((*window).clone(), cameras.to_vec(), kept));
                    }
                    return Ok(vec![scene]);
                }
                let keep = if exact { None } else { self.sky.keep(window, cameras) };
                let shortcuts = Shortcuts { keep, ..shortcuts };
                let scene = self.model.forward_with(one, &shortcuts)?.scene(0);
                return Ok(vec![self.judged(window, scene, shortcuts.keep.as_deref())]);
            }
            // What is left out differs from window to window: of several at once all patches are computed.
            (several, _) => self.model.forward_with(&ClipBatch::stack(several)?, &shortcuts)?,
        };
        Ok((0..clips.len()).map(|i| Ok(output.scene(i)?)).collect())
    }

    fn judged(
        &mut self,
        window: &Window<Frame>,
        scene: Result<Scene, ModelError>,
        keep: Option<&[bool]>,
    ) -> Result<Scene> {
        let scene = scene?;
        self.sky.judge(window, &scene, keep);
        Ok(scene)
    }

    /// One window as the network takes it.
    pub fn clip(&self, window: &Window<Frame>, cameras: &[Intrinsics]) -> Result<ClipBatch> {
        let all: Vec<&PosedSet<Frame>> = window.steps.iter().map(Arc::as_ref).collect();
        let mut clip = self.batch(window, &all, cameras)?;
        if self.model.config().sweep_after_block > 0 && window.priors() > 0 {
            // A timestep without a prior set is its own: no time passes, and the sweep leaves it out.
            let prior = |(own, prior): (&Arc<PosedSet<Frame>>, &Option<Arc<PosedSet<Frame>>>)| {
                Arc::clone(prior.as_ref().filter(|p| p.frames.len() == own.frames.len()).unwrap_or(own))
            };
            let prior: Vec<_> = window.steps.iter().zip(&window.prior).map(prior).collect();
            clip.prior =
                Some(Box::new(self.batch(window, &prior.iter().map(Arc::as_ref).collect::<Vec<_>>(), cameras)?));
        }
        Ok(clip)
    }

    /// Sets of a window's clock and anchor as a batch of one.
    fn batch(&self, window: &Window<Frame>, sets: &[&PosedSet<Frame>], cameras: &[Intrinsics]) -> Result<ClipBatch> {
        let pictures: Vec<Vec<Vec<f32>>> =
            sets.iter().map(|set| set.frames.iter().map(|f| network_colors(&f.item.rgb.data)).collect()).collect();
        let views: Vec<Vec<ViewInput>> = (0..sets.len())
            .map(|t| {
                let view = |c: usize| ViewInput {
                    rgb: &pictures[t][c],
                    intrinsics: cameras[c],
                    world_from_camera: relative(&window.map_from_anchor, &sets[t].frames[c].map_from_camera)
                        .snapped()
                        .to_f32(),
                    time_sec: (window.time_sec[t][c]
                        + seconds_between(window.steps[t].frames[c].stamp_ns, sets[t].frames[c].stamp_ns))
                        as f32,
                    valid: sets[t].frames[c].item.valid.as_deref(),
                };
                (0..cameras.len().min(pictures[t].len())).map(view).collect()
            })
            .collect();
        Ok(ClipBatch::from_views(&views, PixelLayout::Hwc, self.timespan_sec, &self.device)?)
    }

    /// Draws a scene: `targets` are camera index (for its exposure) and view in the anchor frame.
    pub fn render(
        &mut self,
        scene: &Scene,
        targets: &[(View, Option<usize>)],
        time_sec: f32,
        want: Want,
    ) -> Result<Vec<RenderedView>> {
        Ok(scene.render(&mut self.raster, targets, time_sec, want)?)
    }
}

/// 8-bit colours as the network takes them, -1 to 1.
fn network_colors(rgb: &[u8]) -> Vec<f32> {
    rgb.iter().map(|&x| x as f32 / 127.5 - 1.0).collect()
}

/// The views of a set's cameras in the window's anchor frame, with their exposure's index.
pub fn views_of(set: &PosedSet<Frame>, map_from_anchor: &Rigid, cameras: &[Intrinsics]) -> Vec<(View, Option<usize>)> {
    let view = |camera: usize| {
        let pose = relative(map_from_anchor, &set.frames[camera].map_from_camera).snapped().to_f32();
        (View::from_pose(pose, cameras[camera]), Some(camera))
    };
    (0..cameras.len().min(set.frames.len())).map(view).collect()
}
