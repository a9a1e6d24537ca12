//! Between window and network: computes, takes the last result again, or moves it on.

use std::sync::Arc;

use glam::{DQuat, Quat, Vec3};
use serde::Serialize;
use storm_model::scene::{RenderedView, Scene};
use tracing::debug;

use crate::config::SkipConfig;
use crate::engine::select;
use crate::overlap::Agreement;
use crate::pipeline::demand::Demand;
use crate::source::Frame;
use crate::window::{PosedSet, Window};

use super::contract::{Contract, Difference, Notch, NotchCounts, Verdict};
use super::predict::in_reach;
use super::same;

/// Surfaces faster than this count as moving in the comparison, m/s (drawn flow is gated by the network's own).
const MOVING_MPS: f32 = 0.5;
/// Velocities are compared over the mean speed, and at least over this, m/s: where next to nothing moves, next to nothing may
/// differ.
const SPEED_FLOOR_MPS: f64 = 0.05;
/// Moving masks are compared over their union, and at least over this part of the pixels.
const MASK_FLOOR: f64 = 0.01;
/// Most windows that go by, after predictions that explained nothing, without another being drawn.
const MOST_WAIT: u64 = 16;

/// Of results that cannot be compared.
pub const UNLIKE: Difference = Difference { psnr_loss_db: f64::INFINITY, flow: f64::INFINITY, mask: 1.0 };

/// What a step gives that can be taken again.
#[derive(Clone)]
pub struct Computed {
    /// What the network saw.
    pub window: Window<Frame>,
    /// What it said.
    pub scene: Arc<Scene>,
    /// The newest cameras' views; none where nobody needs them.
    pub views: Arc<[RenderedView]>,
    /// How far it agreed with the windows before.
    pub agreement: Arc<Agreement>,
    /// What was worked out.
    pub demand: Demand,
    /// Whether the network approximated.
    pub approximate: bool,
}

/// A result that a notch would have given, to be compared with the full step's of the same window.
#[derive(Clone)]
pub struct Shadow {
    /// The notch that answers for it.
    pub notch: Notch,
    /// Whether it rests on approximations as well.
    pub approximate: bool,
    /// Its Gaussians.
    pub scene: Arc<Scene>,
    /// Its views.
    pub views: Arc<[RenderedView]>,
    /// Rotation of its anchor in the map.
    pub map_from_anchor: DQuat,
}

impl Shadow {
    /// Of a computed step that would have been taken again.
    fn of(last: &Computed) -> Self {
        Self {
            notch: Notch::Still,
            approximate: last.approximate,
            scene: Arc::clone(&last.scene),
            views: Arc::clone(&last.views),
            map_from_anchor: last.window.map_from_anchor.rotation,
        }
    }
}

/// What to do with a window.
pub enum Plan {
    /// It shows what this one showed.
    Reuse(Computed),
    /// This one, moved on, may explain it: draw it, and say whether it does ([`Skipper::explained`], [`Skipper::unexplained`]).
    Predict(Computed),
    /// Run the network.
    Compute {
        /// To be compared with the result, by [`Skipper::computed`].
        shadow: Option<Shadow>,
    },
}

/// Counts of what was skipped and why not.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct SkipCounts {
    /// Steps not computed because nothing had changed.
    pub still: u64,
    /// Steps not computed because the last computed Gaussians, moved on, explained the pictures.
    pub predicted: u64,
    /// Steps computed with approximations.
    pub approximate: u64,
    /// Predictions that did not explain the pictures.
    pub unexplained: u64,
    /// Full steps that checked any of these.
    pub checks: u64,
    /// Checks that found more difference than agreed.
    pub broken: u64,
    /// The highest notch in force, from exact to approximate: 0 none, 1 still, 2 predicted, 3 approximate.
    pub level: usize,
    /// Each notch by itself, in that order.
    pub notches: [NotchCounts; 3],
}

impl SkipCounts {
    /// Steps that the network was not run for.
    pub fn skipped(&self) -> u64 {
        self.still + self.predicted
    }
}

/// Decides, window by window.
pub struct Skipper {
    config: SkipConfig,
    still: Contract,
    predicted: Contract,
    approximate: Contract,
    last: Option<Computed>,
    unexplained: u64,
    /// Windows still to go without a prediction, and how many after the next that explains nothing.
    wait: u64,
    patience: u64,
}

impl Skipper {
    /// Nothing computed yet.
    pub fn new(config: &SkipConfig) -> Self {
        Self {
            config: config.clone(),
            still: Contract::new(config, true),
            predicted: Contract::new(config, false),
            approximate: Contract::new(config, false),
            last: None,
            unexplained: 0,
            wait: 0,
            patience: 1,
        }
    }

    /// What to do with this window, of which this is wanted.
    pub fn plan(&mut self, window: &Window<Frame>, demand: Demand) -> Plan {
        let compute = Plan::Compute { shadow: None };
        let Some(last) = self.last.as_ref().filter(|last| last.demand.covers(demand)) else { return compute };
        if self.config.still {
            match same(&self.config, &last.window, window) {
                Err(why) => debug!("the step at {} ns shows something new: {why:?}", window.stamp_ns),
                Ok(()) => {
                    return match self.still.decide() {
                        Verdict::Skip => Plan::Reuse(last.clone()),
                        Verdict::Check => Plan::Compute { shadow: Some(Shadow::of(last)) },
                        Verdict::Full => compute,
                    };
                }
            }
        }
        if !self.config.predict || last.views.is_empty() || !in_reach(&self.config, &last.window, window) {
            return compute;
        }
        if self.predicted.rests() {
            self.predicted.pass();
            return compute;
        }
        if self.wait > 0 {
            self.wait -= 1;
            return compute;
        }
        Plan::Predict(last.clone())
    }

    /// A prediction explains its window: what to do.
    pub fn explained(&mut self) -> Verdict {
        self.patience = 1;
        self.predicted.decide()
    }

    /// A prediction does not explain its window, which is computed; so are the next ones, more of them every time.
    pub fn unexplained(&mut self) {
        self.unexplained += 1;
        self.wait = self.patience;
        self.patience = (2 * self.patience).min(MOST_WAIT);
    }

    /// Whether views of the newest cameras are of use to the gate, although nobody asked for them.
    pub fn wants_views(&self) -> bool {
        self.config.predict && !self.predicted.rests()
    }

    /// For a window that is computed by a network that can approximate: whether it may.
    pub fn may_approximate(&mut self) -> Verdict {
        self.approximate.decide()
    }

    /// How approximations compared with the exact step of the same window.
    pub fn approximated(&mut self, difference: Difference) {
        self.approximate.checked(difference);
    }

    /// A window was computed as planned. What comes after it is compared with it.
    pub fn computed(&mut self, now: &Computed, shadow: Option<&Shadow>) {
        if let Some(shadow) = shadow {
            let found = if now.views.is_empty() || shadow.views.is_empty() {
                difference_undrawn(&now.scene, &shadow.scene)
            } else {
                let pictures = &now.window.steps[now.window.steps.len() - 1];
                let turn = now.window.map_from_anchor.rotation.conjugate() * shadow.map_from_anchor;
                difference(pictures, &now.views, &shadow.views, turn.as_quat())
            };
            debug!("check of a {} step: {found:?}", shadow.notch.name());
            match shadow.notch {
                Notch::Still => self.still.checked(found),
                Notch::Predicted => self.predicted.checked(found),
                Notch::Approximate => true,
            };
            if shadow.approximate {
                self.approximate.checked(found);
            }
        }
        self.last = Some(now.clone());
    }

    /// Forgets: the next window is computed.
    pub fn reset(&mut self) {
        self.last = None;
    }

    /// So far.
    pub fn counts(&self) -> SkipCounts {
        let mut notches = [&self.still, &self.predicted, &self.approximate].map(Contract::counts);
        if !self.config.still {
            notches[0].level = 0;
        }
        let [still, predicted, approximate] = notches;
        SkipCounts {
            still: still.steps,
            predicted: predicted.steps,
            approximate: approximate.steps,
            unexplained: self.unexplained,
            checks: notches.iter().map(|n| n.checks).sum(),
            broken: notches.iter().map(|n| n.broken).sum(),
            level: notches.iter().rposition(|n| n.level > 0).map_or(0, |k| k + 1),
            notches,
        }
    }
}

/// How `skipped` would have compared with `full` on these pictures; `turn` takes its velocities to the other's axes.
pub fn difference(
    pictures: &PosedSet<Frame>,
    full: &[RenderedView],
    skipped: &[RenderedView],
    turn: Quat,
) -> Difference {
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
                let gaps = view.rgb8().into_iter().zip(truth).enumerate();
                let seen = gaps.filter(|(i, _)| frame.item.is_valid(i / 3));
                seen.map(|(_, (x, &y))| (f64::from(x) - f64::from(y)).powi(2)).sum()
            };
            full_error += error(a);
            skipped_error += error(b);
            samples += match &frame.item.valid {
                Some(valid) => 3 * valid.iter().filter(|valid| **valid).count(),
                None => truth.len(),
            };
        }
        let shown = |i: usize| pictures.frames.get(k).is_none_or(|frame| frame.item.is_valid(i));
        let velocities = a.flow.iter().flatten().zip(b.flow.iter().flatten()).enumerate();
        velocities.filter(|(i, _)| shown(*i)).for_each(|(_, (v, w))| flow.add(*v, (turn * Vec3::from(*w)).to_array()));
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
            item: Frame::whole(rgb),
        };
        PosedSet { stamp_ns: 0, epoch: 0, frames: vec![frame] }
    }

    #[test]
    fn equal_views_differ_by_nothing() {
        let v = [view(0.1, 10, 5.0)];
        assert_eq!(difference(&pictures(140), &v, &v, Quat::IDENTITY), Difference::default());
    }

    #[test]
    fn each_figure_sees_its_own() {
        // 20 and 40 levels off: 6 dB.
        let d =
            difference(&pictures(128), &[view(20.5 / 127.5, 0, 0.0)], &[view(40.5 / 127.5, 0, 0.0)], Quat::IDENTITY);
        assert!((d.psnr_loss_db - 6.0).abs() < 0.2 && d.flow == 0.0 && d.mask == 0.0, "{d:?}");
        // A tenth slower.
        let d = difference(&pictures(128), &[view(0.0, 20, 10.0)], &[view(0.0, 20, 9.0)], Quat::IDENTITY);
        assert!((d.flow - 0.1).abs() < 1e-6 && d.mask == 0.0 && d.psnr_loss_db == 0.0, "{d:?}");
        // A mover that is not there: all of the mask, all of the flow.
        let d = difference(&pictures(128), &[view(0.0, 20, 10.0)], &[view(0.0, 0, 0.0)], Quat::IDENTITY);
        assert!((d.mask - 1.0).abs() < 1e-9 && (d.flow - 1.0).abs() < 1e-6, "{d:?}");
        // The same flow in turned axes is the same flow.
        let mut turned = view(0.0, 20, 10.0);
        let quarter = Quat::from_rotation_z(std::f32::consts::FRAC_PI_2);
        turned.flow.iter_mut().flatten().for_each(|v| *v = (quarter.conjugate() * Vec3::from(*v)).to_array());
        let d = difference(&pictures(128), &[view(0.0, 20, 10.0)], &[turned], quarter);
        assert!(d.flow < 1e-6 && d.mask == 0.0, "{d:?}");
        // Less work for no pictures at all: never a reason to skip.
        assert!(difference(&pictures(128), &[view(0.0, 0, 0.0)], &[], Quat::IDENTITY).mask == 1.0);
    }
}
