//! The network under test beside its f64 twin, and windows to put through both.

use std::sync::Arc;

use anyhow::{Context, Result};
use candle_core::{DType, Device};
use storm_model::scene::{RenderedView, Scene, Want};
use storm_model::weights::{self, SHIPPED_NAME, Tensors};
use storm_model::{ClipBatch, ModelConfig, ModelError, Stages, Storm};
use storm_render::world::{Drive, DriveOptions};
use storm_render::{Intrinsics, View};

use super::{Finding, worst};
use crate::config::{ModelConfigSection, WindowConfig};
use crate::decode::RgbPicture;
use crate::engine::{Engine, ModelSource, views_of};
use crate::pipeline::step::newest_time_sec;
use crate::source::Frame;
use crate::source::world::posed_set;
use crate::window::{PosedSet, Window, WindowBuilder};

/// How much is put through.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Size {
    /// The preset's own cameras and pictures.
    Full,
    /// One camera, two timesteps, small pictures: for tests.
    Reduced,
}

/// Drive the windows come from.
const SEED: u64 = 424_243;
/// The network's clock.
const TIMESPAN_SEC: f64 = 2.0;
/// A velocity difference of this size counts as much as a position that is off by its own depth, m/s.
const SPEED_UNIT_MPS: f64 = 10.0;

/// The shipped network in f32 and f64.
pub struct Subject {
    pub config: ModelConfig,
    pub tensors: Tensors,
    engine: Engine,
    exact: Storm,
    pub cameras: Vec<Intrinsics>,
    /// As the drive gives them, a stride apart.
    pub sets: Vec<PosedSet<Frame>>,
    reference: usize,
    size: Size,
}

impl Subject {
    pub fn new(size: Size) -> Result<Self> {
        let (config, tensors) = weights::shipped(&Device::Cpu)?;
        Self::with(size, &config, &tensors)
    }

    /// As [`Subject::new`], with other weights.
    pub fn with(size: Size, config: &ModelConfig, tensors: &Tensors) -> Result<Self> {
        let (cameras, timesteps, width, height) = match size {
            Size::Full => (3, 4, config.image_width, config.image_height),
            Size::Reduced => (1, 2, 48, 32),
        };
        let drive =
            Drive::new(&DriveOptions { seed: SEED, seconds: 2.0, cameras, width, height, ..DriveOptions::default() })
                .context("the drive of the stress suite")?;
        let stride = (WindowConfig::default().stride_sec * drive.options().rate_hz).round() as usize;
        let sets = (0..timesteps).map(|k| posed_set(&drive, k * stride).0).collect();
        let source = ModelSource::Loaded {
            config: Box::new(config.clone()),
            tensors: tensors.clone(),
            name: SHIPPED_NAME.into(),
        };
        let engine = Engine::new(source, &ModelConfigSection::default(), cameras, TIMESPAN_SEC)?;
        Ok(Self {
            exact: Storm::in_f64(config, tensors)?,
            config: config.clone(),
            tensors: tensors.clone(),
            engine,
            cameras: drive.cameras().iter().map(|c| c.intrinsics).collect(),
            sets,
            reference: cameras / 2,
            size,
        })
    }

    /// How much is put through.
    pub fn size(&self) -> Size {
        self.size
    }

    /// The f32 network on the drive's own window, keeping what `stages` asks for.
    pub fn stages(&self, stages: &mut Stages) -> Result<()> {
        let batch = self.engine.clip(&self.plain_window()?, &self.cameras)?;
        Storm::new(&self.config, &self.tensors)?.forward_stages(&batch, stages)?;
        Ok(())
    }

    /// The window of sets whose stamps are `stride_sec` apart.
    pub fn window(&self, sets: &[PosedSet<Frame>], stride_sec: f64) -> Result<Window<Frame>> {
        let config = WindowConfig { stride_sec, timesteps: sets.len(), ..WindowConfig::default() };
        let mut builder = WindowBuilder::new(&config, self.reference);
        sets.iter().filter_map(|set| builder.push(set.clone())).last().context("these sets make no window")
    }

    /// The drive's own window.
    pub fn plain_window(&self) -> Result<Window<Frame>> {
        self.window(&self.sets, WindowConfig::default().stride_sec)
    }

    /// The network and its pictures in f32.
    pub fn step(&mut self, window: &Window<Frame>, cameras: &[Intrinsics]) -> Result<(Scene, Vec<RenderedView>)> {
        let scene = self.engine.step(window, cameras)?;
        let targets: Vec<(View, Option<usize>)> =
            views_of(&window.steps[window.steps.len() - 1], &window.map_from_anchor, cameras);
        let want = Want { flow: true, motion: true };
        let views = self.engine.render(&scene, &targets, newest_time_sec(window), want)?;
        Ok((scene, views))
    }

    /// The network in f32 against f64 on one window.
    pub fn compare(&mut self, window: &Window<Frame>, cameras: &[Intrinsics]) -> Finding {
        let batch = match self.engine.clip(window, cameras) {
            Ok(batch) => batch,
            Err(e) => return refused(&e),
        };
        match self.step(window, cameras) {
            Ok((scene, views)) => {
                let nonfinite = nonfinite(&scene, &views);
                match self.exactly(&batch) {
                    Ok(exact) => Finding { worst_error: apart(&scene, &exact), nonfinite, refused: None },
                    Err(e) => refused(&e),
                }
            }
            Err(e) => refused(&e),
        }
    }

    fn exactly(&self, batch: &ClipBatch) -> Result<Scene> {
        Ok(self.exact.forward(&batch.to_dtype(DType::F64)?)?.scene(0)?)
    }
}

/// An error as a finding: refusing is right or wrong by case, never non-finite.
pub fn refused(error: &anyhow::Error) -> Finding {
    Finding { refused: Some(format!("{error:#}")), ..Finding::default() }
}

/// As [`refused`], for the network's own errors.
pub fn refused_by_model(error: ModelError) -> Finding {
    refused(&error.into())
}

/// Numbers of a result that are not finite.
pub fn nonfinite(scene: &Scene, views: &[RenderedView]) -> u64 {
    let g = &scene.gaussians;
    let triples = |x: &[[f32; 3]]| x.iter().flatten().filter(|x| !x.is_finite()).count();
    let singles = |x: &[f32]| x.iter().filter(|x| !x.is_finite()).count();
    let of_scene = triples(&g.means) + triples(&g.scales) + triples(&g.colors) + singles(&g.opacities);
    let of_motion = triples(&g.velocity_backward) + triples(&g.velocity_forward) + singles(&g.motion_weights);
    let of_quats = g.quats.iter().flatten().filter(|x| !x.is_finite()).count();
    let of_view = |v: &RenderedView| {
        triples(&v.color) + singles(&v.alpha) + singles(&v.depth) + v.flow.as_deref().map_or(0, triples)
    };
    (of_scene + of_motion + of_quats + views.iter().map(of_view).sum::<usize>()) as u64
}

/// Largest difference of two scenes of one window: positions over 1 m + depth, velocities over 10 m/s + speed, scales
/// over themselves + 1 cm, colours and opacities as they are (their ranges are about 1).
pub fn apart(a: &Scene, b: &Scene) -> f64 {
    let (g, h) = (&a.gaussians, &b.gaussians);
    if a.shape != b.shape {
        return f64::INFINITY;
    }
    let length = |x: &[f32; 3]| x.iter().map(|&x| f64::from(x) * f64::from(x)).sum::<f64>().sqrt();
    let gap = |x: &[f32; 3], y: &[f32; 3]| length(&[x[0] - y[0], x[1] - y[1], x[2] - y[2]]);
    let mut largest = 0.0;
    for i in 0..g.len() {
        let depth = f64::from(b.depths[i].abs());
        for error in [
            gap(&g.means[i], &h.means[i]) / (1.0 + depth),
            gap(&g.velocity_forward[i], &h.velocity_forward[i]) / (SPEED_UNIT_MPS + length(&h.velocity_forward[i])),
            gap(&g.velocity_backward[i], &h.velocity_backward[i]) / (SPEED_UNIT_MPS + length(&h.velocity_backward[i])),
            gap(&g.scales[i], &h.scales[i]) / (0.01 + length(&h.scales[i])),
            gap(&g.colors[i], &h.colors[i]),
            f64::from((g.opacities[i] - h.opacities[i]).abs()),
        ] {
            largest = worst(largest, error);
        }
    }
    largest
}

/// The sets with their pictures changed: camera, timestep, old values.
pub fn repainted(sets: &[PosedSet<Frame>], change: impl Fn(usize, usize, &[u8]) -> Vec<u8>) -> Vec<PosedSet<Frame>> {
    let mut sets = sets.to_vec();
    for (t, set) in sets.iter_mut().enumerate() {
        for (c, frame) in set.frames.iter_mut().enumerate() {
            let old = &frame.item.rgb;
            let data = change(c, t, &old.data);
            frame.item.rgb = Arc::new(RgbPicture { width: old.width, height: old.height, data });
        }
    }
    sets
}
