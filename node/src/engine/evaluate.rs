//! The paper's protocol on procedural drives (section 4): 20 frames at 10 Hz, frames 0, 5, 10 and 15 are context, all others are
//! held out; flow and motion masks are scored on the context frames.

use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result};
use glam::Vec3;
use storm_model::metrics::flow::{FlowEvaluation, FlowFrame};
use storm_model::metrics::image::ImageScores;
use storm_model::metrics::mask::{foreground_ari, iou};
use storm_model::scene::{Scene, Want};
use storm_render::Intrinsics;
use storm_render::raster::CpuRasterizer;
use storm_render::world::{Drive, DriveOptions, WorldFrame};

use crate::config::WindowConfig;
use crate::pipeline::sink::motion_mask;
use crate::source::Frame;
use crate::source::world::posed_set;
use crate::window::{PosedSet, Window, WindowBuilder};

use super::score::{Figures, TruthAt, unit};
use super::{Engine, views_of};

/// Frames of a clip.
pub const CLIP_FRAMES: usize = 20;
/// Frames per second of a clip.
pub const CLIP_HZ: f64 = 10.0;
/// Seeds of the held-out suite; training never sees 10,000 to 19,999.
pub const HELD_OUT_SEEDS: std::ops::Range<u64> = 10_000..10_020;

/// One clip: its window, and every frame with ground truth.
pub struct Clip {
    /// The context, as the network sees it.
    pub window: Window<Frame>,
    /// All frames in order with their ground truth per camera.
    pub frames: Vec<(Arc<PosedSet<Frame>>, Vec<WorldFrame>)>,
    /// Cameras.
    pub cameras: Vec<Intrinsics>,
}

impl Clip {
    /// The clip of a seed, three cameras, at the network's picture size.
    pub fn of_seed(seed: u64, (width, height): (usize, usize)) -> Result<Self> {
        let seconds = CLIP_FRAMES as f64 / CLIP_HZ;
        let options =
            DriveOptions { seed, seconds, cameras: 3, width, height, rate_hz: CLIP_HZ, ..DriveOptions::default() };
        let drive = Drive::new(&options)?;
        // Exactly frames 0, 5, 10 and 15: no tolerance.
        let config = WindowConfig { stride_tolerance: 0.01, ..WindowConfig::default() };
        let mut builder = WindowBuilder::new(&config, 1);
        let mut window = None;
        let mut frames = Vec::with_capacity(CLIP_FRAMES);
        for i in 0..CLIP_FRAMES {
            let (set, truth) = posed_set(&drive, i);
            let built = builder.push(set.clone());
            window = window.or(built);
            frames.push((Arc::new(set), truth));
        }
        let window = window.context("the drive gave no window")?;
        Ok(Self { window, frames, cameras: drive.cameras().iter().map(|c| c.intrinsics).collect() })
    }

    fn is_context(&self, set: &PosedSet<Frame>) -> bool {
        self.window.steps.iter().any(|s| s.stamp_ns == set.stamp_ns)
    }

    fn time_sec(&self, set: &PosedSet<Frame>) -> f32 {
        let first_ns = self.window.steps.first().map_or(set.stamp_ns, |s| s.stamp_ns);
        (set.stamp_ns.saturating_sub(first_ns) as f64 * 1e-9) as f32
    }
}

/// Scores of one method over many clips.
#[derive(Default)]
pub struct Tally {
    images: Vec<ImageScores>,
    flow: FlowEvaluation,
    ari: Vec<f64>,
    moving_iou: Vec<f64>,
    ms: Vec<f64>,
}

impl Tally {
    /// Means over everything scored.
    pub fn figures(&self) -> Figures {
        let flow = self.flow.means();
        let mean = |x: &[f64]| (!x.is_empty()).then(|| x.iter().sum::<f64>() / x.len() as f64);
        Figures {
            epe3d: flow.epe3d,
            acc5: flow.acc5,
            acc10: flow.acc10,
            theta: flow.theta,
            fg_ari: mean(&self.ari),
            moving_iou: mean(&self.moving_iou),
            ms: mean(&self.ms),
            ..Figures::of_images(&self.images)
        }
    }

    /// Held-out frames drawn from `scene`, then flow and masks on the context frames.
    fn scene(&mut self, clip: &Clip, scene: &Scene, raster: &mut CpuRasterizer) -> Result<()> {
        let anchor = &clip.window.map_from_anchor;
        let map_from_anchor = anchor.rotation.as_quat();
        for (set, truth) in &clip.frames {
            let targets = views_of(set, anchor, &clip.cameras);
            let context = clip.is_context(set);
            let views = scene.render(raster, &targets, clip.time_sec(set), Want { flow: context, motion: context })?;
            let (mut pred, mut label, mut depth) = (Vec::new(), Vec::new(), Vec::new());
            let (mut groups, mut true_groups) = (Vec::new(), Vec::new());
            for ((view, t), frame) in views.iter().zip(truth).zip(&set.frames) {
                if !context {
                    let at = TruthAt::of_frame(t);
                    let seen = unit(&frame.item.rgb.data);
                    self.images.push(at.compare(&unit(&view.rgb8()), &seen, Some(&view.depth))?);
                    continue;
                }
                let flow = view.flow.iter().flatten();
                pred.extend(flow.map(|&f| (map_from_anchor * Vec3::from(f)).to_array()));
                label.extend_from_slice(&t.flow);
                depth.extend_from_slice(&t.depth);
                groups.extend(motion_mask(view).into_iter().map(u32::from));
                true_groups
                    .extend(t.instance.iter().zip(&t.moving).map(|(&i, &m)| if m != 0 { u32::from(i) } else { 0 }));
            }
            if context {
                self.flow.add(&[FlowFrame { pred: &pred, truth: &label, depth: &depth, ground: None }])?;
                self.ari.extend(foreground_ari(&groups, &true_groups, 0)?);
                let moves = |g: &[u32]| g.iter().map(|&g| g != 0).collect::<Vec<bool>>();
                self.moving_iou.extend(iou(&moves(&groups), &moves(&true_groups), None)?);
            }
        }
        Ok(())
    }

    /// Held-out frames answered with the nearest context picture of the same camera.
    fn nearest(&mut self, clip: &Clip) -> Result<()> {
        for (set, truth) in clip.frames.iter().filter(|(set, _)| !clip.is_context(set)) {
            let nearest = clip.window.steps.iter().min_by_key(|s| s.stamp_ns.abs_diff(set.stamp_ns));
            let Some(nearest) = nearest else { continue };
            for ((from, to), t) in nearest.frames.iter().zip(&set.frames).zip(truth) {
                let (pred, seen) = (unit(&from.item.rgb.data), unit(&to.item.rgb.data));
                self.images.push(TruthAt::of_frame(t).compare(&pred, &seen, None)?);
            }
        }
        Ok(())
    }
}

/// Every method over the same clips.
#[derive(Default)]
pub struct Evaluation {
    /// This network.
    pub storm: Tally,
    /// This network with all velocities set to zero: what modelling motion is worth.
    pub still: Tally,
    /// The nearest context picture.
    pub nearest_context: Tally,
}

impl Evaluation {
    /// Adds one clip.
    pub fn add(&mut self, clip: &Clip, engine: &mut Engine, raster: &mut CpuRasterizer) -> Result<()> {
        let start = Instant::now();
        let mut scene = engine.step(&clip.window, &clip.cameras)?;
        let ms = start.elapsed().as_secs_f64() * 1e3;
        self.storm.ms.push(ms);
        self.still.ms.push(ms);
        self.storm.scene(clip, &scene, raster)?;
        scene.gaussians.velocity_backward.fill([0.0; 3]);
        scene.gaussians.velocity_forward.fill([0.0; 3]);
        self.still.scene(clip, &scene, raster)?;
        self.nearest_context.nearest(clip)
    }
}
