//! Error figures of a run: frames that were not context are drawn at their own time and pose and compared with what the
//! camera saw; where the recording has ground truth, depth and flow are compared too.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use anyhow::Result;
use serde::Serialize;
use storm_model::metrics::flow::{FlowEvaluation, FlowFrame};
use storm_model::metrics::image::ImageScores;
use storm_model::scene::Want;
use storm_render::Intrinsics;
use storm_render::raster::{CpuRasterizer, RasterSettings};

use crate::engine::views_of;
use crate::pipeline::front::TruthImage;
use crate::pipeline::step::Step;
use crate::source::Frame;
use crate::source::topics::TruthKind;
use crate::window::{PosedFrame, PosedSet};

use super::figures::Figures;
use super::truth::{TruthAt, unit};

/// Sets and ground truth are kept this long beyond the oldest window that still waits to be scored, seconds.
const KEEP_SEC: f64 = 2.0;

/// Error figures of a run.
#[derive(Debug, Clone, Serialize, PartialEq)]
pub struct Scores {
    /// Images compared.
    pub images: u64,
    /// This program.
    pub storm: Figures,
    /// Showing the same camera's nearest context image instead: what a network has to beat.
    pub nearest_context: Figures,
}

impl Scores {
    /// Name, unit, higher is better, and both methods' values; what neither has is left out.
    pub fn rows(&self) -> Vec<(&'static str, &'static str, bool, [Option<f64>; 2])> {
        let both = self.storm.rows().into_iter().zip(self.nearest_context.rows());
        both.map(|((name, unit, a), (_, _, b))| (name, unit, !matches!(unit, "m" | "m/s" | "rad" | "ms"), [a, b]))
            .filter(|(_, _, _, values)| values.iter().any(Option::is_some))
            .collect()
    }

    /// One line for the terminal.
    pub fn line(&self) -> String {
        let text = |x: Option<f64>| x.map_or("-".to_string(), |x| format!("{x:.2}"));
        let mut line = format!(
            "held-out images: {}; PSNR {} dB (nearest context image {} dB), SSIM {}",
            self.images,
            text(self.storm.psnr),
            text(self.nearest_context.psnr),
            text(self.storm.ssim),
        );
        // Figures that want ground truth are left out where there is none.
        for (name, value, unit) in [("depth RMSE", self.storm.depth_rmse, "m"), ("EPE3D", self.storm.epe3d, "m/s")] {
            if let Some(value) = value {
                line += &format!(", {name} {value:.2} {unit}");
            }
        }
        line
    }
}

/// Scores steps as they come, each one step late, so that ground truth recorded after its images has arrived.
pub struct Scorer {
    raster: CpuRasterizer,
    cameras: Vec<Intrinsics>,
    frames_per_step: usize,
    sets: VecDeque<Arc<PosedSet<Frame>>>,
    truth: BTreeMap<(i64, usize, TruthKind), TruthImage>,
    waiting: Option<Arc<Step>>,
    ours: Vec<ImageScores>,
    flow: FlowEvaluation,
    nearest: Vec<ImageScores>,
}

impl Scorer {
    /// Draws with `settings`, at most `frames_per_step` held-out sets per step.
    pub fn new(settings: RasterSettings, cameras: Vec<Intrinsics>, frames_per_step: usize) -> Result<Self> {
        Ok(Self {
            raster: CpuRasterizer::new(settings)?,
            cameras,
            frames_per_step,
            sets: VecDeque::new(),
            truth: BTreeMap::new(),
            waiting: None,
            ours: Vec::new(),
            flow: FlowEvaluation::default(),
            nearest: Vec::new(),
        })
    }

    /// A set that may be held out of later windows.
    pub fn set(&mut self, set: Arc<PosedSet<Frame>>) {
        self.sets.push_back(set);
    }

    /// Ground truth.
    pub fn truth(&mut self, camera: usize, stamp_ns: i64, kind: TruthKind, image: TruthImage) {
        self.truth.insert((stamp_ns, camera, kind), image);
    }

    /// A step; scores the one before it.
    pub fn step(&mut self, step: Arc<Step>) -> Result<()> {
        if let Some(before) = self.waiting.replace(step) {
            self.score(&before)?;
            self.forget(before.window.steps.first().map_or(i64::MIN, |s| s.stamp_ns));
        }
        Ok(())
    }

    /// Scores what waits; `None` when nothing could be compared.
    pub fn finish(mut self) -> Result<Option<Scores>> {
        if let Some(last) = self.waiting.take() {
            self.score(&last)?;
        }
        let flow = self.flow.means();
        if self.ours.is_empty() && flow.timesteps == 0 {
            return Ok(None);
        }
        let storm = Figures {
            epe3d: flow.epe3d,
            acc5: flow.acc5,
            acc10: flow.acc10,
            theta: flow.theta,
            ..Figures::of_images(&self.ours)
        };
        let nearest_context = Figures::of_images(&self.nearest);
        Ok(Some(Scores { images: self.ours.len() as u64, storm, nearest_context }))
    }

    fn forget(&mut self, oldest_ns: i64) {
        let limit = oldest_ns.saturating_sub((KEEP_SEC * 1e9) as i64);
        while self.sets.front().is_some_and(|s| s.stamp_ns < limit) {
            self.sets.pop_front();
        }
        self.truth = self.truth.split_off(&(limit, 0, TruthKind::Depth));
    }

    fn score(&mut self, step: &Step) -> Result<()> {
        let window = &step.window;
        let (Some(first), Some(last)) = (window.steps.first(), window.steps.last()) else { return Ok(()) };
        let context = |stamp: i64| window.steps.iter().any(|s| s.stamp_ns == stamp);
        let inside: Vec<Arc<PosedSet<Frame>>> = self
            .sets
            .iter()
            .filter(|s| s.epoch == window.epoch && s.stamp_ns > first.stamp_ns && s.stamp_ns < last.stamp_ns)
            .filter(|s| !context(s.stamp_ns))
            .cloned()
            .collect();
        for set in spread(&inside, self.frames_per_step, step.index) {
            self.score_set(step, set)?;
        }
        self.score_flow(step)
    }

    fn score_set(&mut self, step: &Step, set: &PosedSet<Frame>) -> Result<()> {
        let first_ns = step.window.steps.first().map_or(set.stamp_ns, |s| s.stamp_ns);
        for (camera, target) in views_of(set, &step.window.map_from_anchor, &self.cameras).into_iter().enumerate() {
            let stamp_ns = set.frames[camera].stamp_ns;
            // Each camera at its own stamp.
            let time_sec = (stamp_ns.saturating_sub(first_ns) as f64 * 1e-9) as f32;
            let views =
                step.scene.render(&mut self.raster, &[target], time_sec, Want { flow: false, motion: false })?;
            let Some(view) = views.first() else { continue };
            let size = (view.width, view.height);
            let true01 = unit(&set.frames[camera].item.rgb.data);
            let truth = self.truth_at(camera, &set.frames[camera], size);
            self.ours.push(truth.compare(&unit(&view.rgb8()), &true01, Some(&view.depth))?);
            if let Some(nearest) = nearest_context(step, camera, stamp_ns) {
                self.nearest.push(truth.compare(&unit(nearest), &true01, None)?);
            }
        }
        Ok(())
    }

    /// Rendered flow of the newest context frames against the truth, all cameras pooled, by the paper's rules.
    fn score_flow(&mut self, step: &Step) -> Result<()> {
        let Some(newest) = step.window.steps.last() else { return Ok(()) };
        let map_from_anchor = step.window.map_from_anchor.rotation.as_quat();
        let (mut pred, mut truth, mut depth) = (Vec::new(), Vec::new(), Vec::new());
        for (camera, view) in step.views.iter().enumerate() {
            let at = self.truth_at(camera, &newest.frames[camera], (view.width, view.height));
            let (Some(flow), Some(true_flow), Some(true_depth)) = (&view.flow, at.flow, at.depth) else { continue };
            pred.extend(flow.iter().map(|&f| (map_from_anchor * glam::Vec3::from(f)).to_array()));
            truth.extend(true_flow);
            depth.extend(true_depth);
        }
        if !truth.is_empty() {
            self.flow.add(&[FlowFrame { pred: &pred, truth: &truth, depth: &depth, ground: None }])?;
        }
        Ok(())
    }

    /// Ground truth of what a frame shows at `size`, sampled at pixel centres.
    fn truth_at(&self, camera: usize, frame: &PosedFrame<Frame>, size: (usize, usize)) -> TruthAt {
        let mut at = TruthAt::none(size);
        for kind in TruthKind::ALL {
            if let Some(image) = self.truth.get(&(frame.stamp_ns, camera, kind)) {
                at.set(kind, image);
            }
        }
        at.seen(frame.item.valid.as_ref())
    }
}

/// At most `limit` of `sets`, evenly spread; which ones turns with the step, so that a run covers all phases.
fn spread(sets: &[Arc<PosedSet<Frame>>], limit: usize, step: u64) -> impl Iterator<Item = &PosedSet<Frame>> {
    let n = sets.len();
    let want = limit.min(n);
    let shift = if n > 0 { step as usize % n } else { 0 };
    (0..want).map(move |i| &*sets[(shift + i * n / want) % n])
}

/// The picture of `camera` in the window nearest in time.
fn nearest_context(step: &Step, camera: usize, stamp_ns: i64) -> Option<&[u8]> {
    let frames = step.window.steps.iter().filter_map(|s| s.frames.get(camera));
    frames.min_by_key(|f| f.stamp_ns.abs_diff(stamp_ns)).map(|f| f.item.rgb.data.as_slice())
}
