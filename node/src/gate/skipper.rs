//! Between window and network: computes, or takes the last result again.

use std::sync::Arc;

use glam::Vec3;
use serde::Serialize;
use storm_model::scene::{RenderedView, Scene};

use crate::config::SkipConfig;
use crate::engine::select;
use crate::overlap::Agreement;
use crate::pipeline::demand::Demand;
use crate::source::Frame;
use crate::window::{PosedSet, Window};

use super::contract::{Contract, ContractCounts, Difference, Verdict};
use super::same;

/// Surfaces faster than this count as moving in the comparison, m/s (drawn flow is gated by the network's own).
const MOVING_MPS: f32 = 0.5;
/// Velocities are compared over the mean speed, and at least over this, m/s: where next to nothing moves, next to nothing may
/// differ.
const SPEED_FLOOR_MPS: f64 = 0.05;
/// Moving masks are compared over their union, and at least over this part of the pixels.
const MASK_FLOOR: f64 = 0.01;

/// Of results that cannot be compared.
const UNLIKE: Difference = Difference { psnr_loss_db: f64::INFINITY, flow: f64::INFINITY, mask: 1.0 };

/// What a step gives that can be taken again.
#[derive(Clone)]
pub struct Computed {
    /// What the network saw.
    pub window: Window<Frame>,
    /// What it said.
    pub scene: Arc<Scene>,
    /// The newest cameras' views.
    pub views: Arc<[RenderedView]>,
    /// How far it agreed with the windows before.
    pub agreement: Arc<Agreement>,
    /// What was worked out.
    pub demand: Demand,
}

/// What to do with a window.
pub enum Plan {
    /// It shows what this one showed.
    Reuse(Computed),
    /// Run the network; `check` belongs to [`Skipper::computed`].
    Compute {
        /// The result is to be compared with the one that would have been taken.
        check: bool,
    },
}

/// Counts of what was skipped and why not.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct SkipCounts {
    /// Steps not computed because nothing had changed.
    pub still: u64,
    /// Full steps that checked skipped ones, and those that found more difference than agreed.
    #[serde(flatten)]
    pub contract: ContractCounts,
}

/// Decides, window by window.
pub struct Skipper {
    config: SkipConfig,
    contract: Contract,
    last: Option<Computed>,
    still: u64,
}

impl Skipper {
    /// Nothing computed yet.
    pub fn new(config: &SkipConfig) -> Self {
        Self { config: config.clone(), contract: Contract::new(config), last: None, still: 0 }
    }

    /// What to do with this window, of which this is wanted.
    pub fn plan(&mut self, window: &Window<Frame>, demand: Demand) -> Plan {
        let compute = Plan::Compute { check: false };
        let Some(last) = self.last.as_ref().filter(|last| self.config.still && last.demand.covers(demand)) else {
            return compute;
        };
        if same(&self.config, &last.window, window).is_err() {
            return compute;
        }
        match self.contract.decide() {
            Verdict::Skip => {
                self.still += 1;
                Plan::Reuse(last.clone())
            }
            Verdict::Check => Plan::Compute { check: true },
            Verdict::Full => compute,
        }
    }

    /// A window was computed as planned. What comes after it is compared with it.
    pub fn computed(&mut self, now: &Computed, check: bool) {
        if let Some(last) = self.last.as_ref().filter(|_| check) {
            self.contract.checked(if now.views.is_empty() || last.views.is_empty() {
                difference_undrawn(&now.scene, &last.scene)
            } else {
                let pictures = &now.window.steps[now.window.steps.len() - 1];
                difference(pictures, &now.views, &last.views)
            });
        }
        self.last = Some(now.clone());
    }

    /// Forgets: the next window is computed.
    pub fn reset(&mut self) {
        self.last = None;
    }

    /// So far.
    pub fn counts(&self) -> SkipCounts {
        SkipCounts { still: self.still, contract: self.contract.counts() }
    }

    /// Skips allowed between two checks at present; 0: none.
    pub fn level(&self) -> u64 {
        self.contract.level()
    }
}

/// How `skipped` would have compared with `full` on these pictures.
pub fn difference(pictures: &PosedSet<Frame>, full: &[RenderedView], skipped: &[RenderedView]) -> Difference {
    let unlike = full.len() != skipped.len()
        || full.iter().zip(skipped).any(|(a, b)| (a.width, a.height) != (b.width, b.height));
    if unlike {
        return UNLIKE;
    }
    let (mut full_error, mut skipped_error, mut samples) = (0.0, 0.0, 0usize);
    let mut flow = FlowGap::default();
    for (k, (a, b)) in full.iter().zip(skipped).enumerate() {
        if let Some(frame) = pictures.frames.get(k) {
            let truth = &frame.item.rgb.data;
            let error = |view: &RenderedView| -> f64 {
                view.rgb8().iter().zip(truth).map(|(&x, &y)| (f64::from(x) - f64::from(y)).powi(2)).sum()
            };
            full_error += error(a);
            skipped_error += error(b);
            samples += truth.len();
        }
        a.flow.iter().flatten().zip(b.flow.iter().flatten()).for_each(|(v, w)| flow.add(*v, *w));
    }
    // The loss of PSNR is the ratio of the squared errors; pictures that are exact cannot be told apart below a level.
    let floor = samples.max(1) as f64 / 12.0;
    let psnr_loss_db = 10.0 * ((skipped_error + floor) / (full_error + floor)).log10();
    Difference { psnr_loss_db, ..flow.difference() }
}

/// As [`difference`], where no pictures were asked for: of the newest pixels' own velocities, which are what is published.
fn difference_undrawn(full: &Scene, skipped: &Scene) -> Difference {
    if full.shape != skipped.shape {
        return UNLIKE;
    }
    let mut flow = FlowGap::default();
    for i in select::from_step(full, full.shape.timesteps - 1) {
        if full.gaussians.opacities[i] >= select::SURFACE_OPACITY {
            flow.add(full.gaussians.velocity_forward[i], skipped.gaussians.velocity_forward[i]);
        }
    }
    flow.difference()
}

/// Sums over pixels of two flows.
#[derive(Default)]
struct FlowGap {
    apart_mps: f64,
    speed_mps: f64,
    pixels: usize,
    /// Pixels that move in one of the two, and in at least one.
    differ: usize,
    either: usize,
}

impl FlowGap {
    fn add(&mut self, full: [f32; 3], skipped: [f32; 3]) {
        let (v, w) = (Vec3::from(full), Vec3::from(skipped));
        self.apart_mps += f64::from(v.distance(w));
        self.speed_mps += f64::from(v.length());
        self.pixels += 1;
        let (one, other) = (v.length() > MOVING_MPS, w.length() > MOVING_MPS);
        self.differ += usize::from(one != other);
        self.either += usize::from(one || other);
    }

    fn difference(&self) -> Difference {
        let pixels = self.pixels.max(1) as f64;
        Difference {
            psnr_loss_db: 0.0,
            flow: self.apart_mps / pixels / (self.speed_mps / pixels).max(SPEED_FLOOR_MPS),
            mask: self.differ as f64 / (self.either as f64).max(MASK_FLOOR * pixels),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::decode::RgbPicture;
    use crate::rigid::Rigid;
    use crate::window::PosedFrame;

    fn view(level: f32, moving: usize, speed: f32) -> RenderedView {
        let n = 16 * 8;
        RenderedView {
            width: 16,
            height: 8,
            color: vec![[level; 3]; n],
            alpha: vec![1.0; n],
            depth: vec![5.0; n],
            flow: Some((0..n).map(|i| if i < moving { [speed, 0.0, 0.0] } else { [0.0; 3] }).collect()),
            motion_id: None,
        }
    }

    fn pictures(value: u8) -> PosedSet<Frame> {
        let rgb = RgbPicture { width: 16, height: 8, data: vec![value; 16 * 8 * 3] };
        let frame = PosedFrame {
            stamp_ns: 0,
            map_from_camera: Rigid::new(glam::DQuat::IDENTITY, glam::DVec3::ZERO),
            item: Frame { rgb: Arc::new(rgb) },
        };
        PosedSet { stamp_ns: 0, epoch: 0, frames: vec![frame] }
    }

    #[test]
    fn equal_views_differ_by_nothing() {
        let v = [view(0.1, 10, 5.0)];
        assert_eq!(difference(&pictures(140), &v, &v), Difference::default());
    }

    #[test]
    fn each_figure_sees_its_own() {
        // 20 and 40 levels off: 6 dB.
        let d = difference(&pictures(128), &[view(20.5 / 127.5, 0, 0.0)], &[view(40.5 / 127.5, 0, 0.0)]);
        assert!((d.psnr_loss_db - 6.0).abs() < 0.2 && d.flow == 0.0 && d.mask == 0.0, "{d:?}");
        // A tenth slower.
        let d = difference(&pictures(128), &[view(0.0, 20, 10.0)], &[view(0.0, 20, 9.0)]);
        assert!((d.flow - 0.1).abs() < 1e-6 && d.mask == 0.0 && d.psnr_loss_db == 0.0, "{d:?}");
        // A mover that is not there: all of the mask, all of the flow.
        let d = difference(&pictures(128), &[view(0.0, 20, 10.0)], &[view(0.0, 0, 0.0)]);
        assert!((d.mask - 1.0).abs() < 1e-9 && (d.flow - 1.0).abs() < 1e-6, "{d:?}");
        // Less work for no pictures at all: never a reason to skip.
        assert!(difference(&pictures(128), &[view(0.0, 0, 0.0)], &[]).mask == 1.0);
    }
}
