//! Error figures of a run: frames that were not context are drawn at their own time and pose and compared with what the
//! camera saw; where the recording has ground truth, depth and flow are compared too.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use anyhow::Result;
use serde::Serialize;
use storm_model::metrics::flow::{FlowEvaluation, FlowFrame};
use storm_model::metrics::image::{Held, Image, ImageScores};
use storm_model::scene::Want;
use storm_render::Intrinsics;
use storm_render::raster::{CpuRasterizer, RasterSettings};
use storm_render::world::WorldFrame;

use crate::engine::views_of;
use crate::pipeline::front::TruthImage;
use crate::pipeline::step::Step;
use crate::source::Frame;
use crate::source::event::Truth;
use crate::source::topics::TruthKind;
use crate::window::PosedSet;

/// Sets and ground truth are kept this long beyond the oldest window that still waits to be scored, seconds.
const KEEP_SEC: f64 = 2.0;

/// Figures of one method; `None` where nothing could be compared. Definitions: `storm_model::metrics`.
#[derive(Debug, Clone, Default, Serialize, PartialEq)]
pub struct Figures {
    /// dB, mean over images, without sky where the sky is known.
    pub psnr: Option<f64>,
    /// dB, moving pixels only.
    pub psnr_dynamic: Option<f64>,
    /// Structural similarity, without sky where the sky is known.
    pub ssim: Option<f64>,
    /// Structural similarity, moving pixels only.
    pub ssim_dynamic: Option<f64>,
    /// z-depth, metres.
    pub depth_rmse: Option<f64>,
    /// z-depth of moving pixels, metres.
    pub depth_rmse_dynamic: Option<f64>,
    /// End-point error of the flow on the newest context frames, m/s.
    pub epe3d: Option<f64>,
    /// Share of points within 0.05 m/s or 5 %, 0 to 1.
    pub acc5: Option<f64>,
    /// Share of points within 0.1 m/s or 10 %, 0 to 1.
    pub acc10: Option<f64>,
    /// Mean angle between true and predicted flow of moving points, radians.
    pub theta: Option<f64>,
    /// Foreground adjusted Rand index of the motion masks on context frames.
    pub fg_ari: Option<f64>,
    /// Intersection over union of moving pixels on context frames, 0 to 1.
    pub moving_iou: Option<f64>,
    /// Milliseconds per window.
    pub ms: Option<f64>,
}

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
        format!(
            "held-out images: {}; PSNR {} dB (nearest context image {} dB), SSIM {}, depth RMSE {} m, EPE3D {} m/s",
            self.images,
            text(self.storm.psnr),
            text(self.nearest_context.psnr),
            text(self.storm.ssim),
            text(self.storm.depth_rmse),
            text(self.storm.epe3d),
        )
    }
}

impl Figures {
    /// Name, unit and value of each.
    pub fn rows(&self) -> [(&'static str, &'static str, Option<f64>); 13] {
        [
            ("PSNR", "dB", self.psnr),
            ("PSNR, moving", "dB", self.psnr_dynamic),
            ("SSIM", "", self.ssim),
            ("SSIM, moving", "", self.ssim_dynamic),
            ("depth RMSE", "m", self.depth_rmse),
            ("depth RMSE, moving", "m", self.depth_rmse_dynamic),
            ("EPE3D", "m/s", self.epe3d),
            ("Acc5", "", self.acc5),
            ("Acc10", "", self.acc10),
            ("angle", "rad", self.theta),
            ("foreground ARI", "", self.fg_ari),
            ("moving IoU", "", self.moving_iou),
            ("run time", "ms", self.ms),
        ]
    }

    /// Means over images, without sky where the sky is known.
    pub(super) fn of_images(scores: &[ImageScores]) -> Self {
        let m = ImageScores::mean(scores);
        Self {
            psnr: m.psnr_occupied.or(m.psnr),
            psnr_dynamic: m.psnr_dynamic,
            ssim: m.ssim_occupied.or(m.ssim),
            ssim_dynamic: m.ssim_dynamic,
            depth_rmse: m.depth_rmse,
            depth_rmse_dynamic: m.depth_rmse_dynamic,
            ..Self::default()
        }
    }
}

/// Ground truth of one picture, at the picture's size.
pub(super) struct TruthAt {
    size: (usize, usize),
    depth: Option<Vec<f32>>,
    flow: Option<Vec<[f32; 3]>>,
    moving: Option<Vec<u16>>,
    sky: Option<Vec<u16>>,
}

impl TruthAt {
    /// Of a drawn frame, at its own size.
    pub(super) fn of_frame(frame: &WorldFrame) -> Self {
        let mask = |m: &[u8]| Some(m.iter().map(|&x| u16::from(x)).collect());
        Self {
            size: (frame.width, frame.height),
            depth: Some(frame.depth.clone()),
            flow: None,
            moving: mask(&frame.moving),
            sky: mask(&frame.sky),
        }
    }

    /// Scores of a picture against what the camera saw; `depth` is the prediction, where the method has one.
    pub(super) fn compare(&self, pred01: &[f32], true01: &[f32], depth: Option<&[f32]>) -> Result<ImageScores> {
        let image = |values| Image { values, width: self.size.0, height: self.size.1, channels: 3 };
        let flags = |mask: &Option<Vec<u16>>| mask.as_ref().map(|m| m.iter().map(|&x| x != 0).collect::<Vec<bool>>());
        let (sky, dynamic) = (flags(&self.sky), flags(&self.moving));
        let held = Held {
            pred: image(pred01),
            truth: image(true01),
            depth: depth.zip(self.depth.as_deref()),
            sky: sky.as_deref(),
            dynamic: dynamic.as_deref(),
        };
        Ok(held.scores()?)
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
            let truth = self.truth_at(camera, stamp_ns, size);
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
            let at = self.truth_at(camera, newest.frames[camera].stamp_ns, (view.width, view.height));
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

    /// Ground truth at `size`, sampled at pixel centres.
    fn truth_at(&self, camera: usize, stamp_ns: i64, size: (usize, usize)) -> TruthAt {
        let mut at = TruthAt { size, depth: None, flow: None, moving: None, sky: None };
        for kind in [TruthKind::Depth, TruthKind::Flow, TruthKind::Moving, TruthKind::Sky] {
            let Some(image) = self.truth.get(&(stamp_ns, camera, kind)) else { continue };
            match (&*image.data, kind) {
                (Truth::Depth(d), _) => at.depth = sample(d, image, size),
                (Truth::Flow(f), _) => at.flow = sample(f, image, size),
                (Truth::Mask(m), TruthKind::Moving) => at.moving = sample(m, image, size),
                (Truth::Mask(m), _) => at.sky = sample(m, image, size),
            }
        }
        at
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

/// 8-bit values as 0 to 1.
pub(super) fn unit(bytes: &[u8]) -> Vec<f32> {
    bytes.iter().map(|&b| b as f32 / 255.0).collect()
}

/// `data` at the centres of a `width x height` picture's pixels; `None` when its length does not fit its size.
pub(crate) fn sample<T: Copy>(data: &[T], image: &TruthImage, (width, height): (usize, usize)) -> Option<Vec<T>> {
    if data.len() != image.width * image.height || data.is_empty() {
        return None;
    }
    let at = |i: usize, from: usize, to: usize| ((2 * i + 1) * from / (2 * to)).min(from - 1);
    let pixel = |k: usize| data[at(k / width, image.height, height) * image.width + at(k % width, image.width, width)];
    Some((0..width * height).map(pixel).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn truth_is_sampled_at_pixel_centres() {
        let image = TruthImage { width: 4, height: 2, data: Arc::new(Truth::Mask(Vec::new())) };
        assert_eq!(sample(&[0, 1, 2, 3, 4, 5, 6, 7], &image, (2, 1)), Some(vec![5, 7]));
        assert_eq!(sample(&[0, 1, 2, 3, 4, 5, 6, 7], &image, (4, 2)), Some(vec![0, 1, 2, 3, 4, 5, 6, 7]));
        assert_eq!(sample(&[0, 1], &image, (4, 2)), None);
    }
}
