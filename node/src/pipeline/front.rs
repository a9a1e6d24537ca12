//! From events to windows: synchronise, pose, window. Plain values in, plain values out; message time is the only clock.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use tracing::warn;

use crate::config::Config;
use crate::extrinsics;
use crate::rigid::Rigid;
use crate::source::Rig;
use crate::source::event::{Event, Frame, Truth};
use crate::source::topics::TruthKind;
use crate::sync::clock::{seconds_between, unsigned_ns};
use crate::sync::{DropCounts, DropReason, Synchronizer};
use crate::window::{PosedSet, Window, WindowBuilder, WindowCounts};

use super::guard::caught;
use super::posed::{PoseStage, PoseStore};

/// So long after the first image the program says where most images go, seconds of message time.
const EARLY_VERDICT_SEC: f64 = 5.0;

/// One ground-truth image with its size.
#[derive(Debug, Clone)]
pub struct TruthImage {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Values.
    pub data: Arc<Truth>,
}

/// What the front half hands on.
#[derive(Debug)]
pub enum FrontOutput {
    /// A synchronized, posed set (every one, whether or not it makes a window).
    Set(Arc<PosedSet<Frame>>),
    /// A window for the network.
    Window(Window<Frame>),
    /// Ground truth of a camera at a stamp.
    Truth {
        /// Which camera.
        camera: usize,
        /// Stamp, nanoseconds.
        stamp_ns: i64,
        /// What it holds.
        kind: TruthKind,
        /// The image.
        image: TruthImage,
    },
}

/// The stages in front of the engine.
pub struct Front {
    sync: Synchronizer<Frame>,
    posed: PoseStage<Frame>,
    window: WindowBuilder<Frame>,
    lost: DropCounts,
    messages_lost: u64,
    /// Newest stamp of the present time base; none before the first message.
    now_ns: Option<i64>,
    jump_forward_ns: u64,
    epoch: u32,
    starved: bool,
    names: Vec<String>,
    /// Which cameras of the rig there are.
    active: Vec<usize>,
    each_set: bool,
    /// Sets kept since the last window was asked for.
    fresh: u64,
    superseded: u64,
    /// Images in sets that were handed on.
    used: u64,
    panics: u64,
    /// Poses come ahead of the images they are for, so that images alone say what time it is.
    poses_ahead: bool,
    /// By reason, what the newest message lost before synchronisation said.
    lost_detail: BTreeMap<DropReason, String>,
    /// Stamp of the first image; none once the early verdict was given.
    watched_since_ns: Option<i64>,
    early_verdict: bool,
}

impl Front {
    /// For the cameras of `rig` and poses from `store`; a window for every set that ends one. For recordings: poses come before
    /// the images they are for (as [`crate::source::bag::BagSource::events`] gives them), so images alone say what time it is.
    pub fn new(config: &Config, rig: &Rig, store: PoseStore) -> Self {
        Self {
            sync: Synchronizer::new(rig.cameras.len(), &config.sync, &config.input.image_time_offset_sec),
            posed: PoseStage::new(store, rig, &config.sync),
            window: WindowBuilder::new(&config.window, rig.reference).with_prior(config.model.sweep_prior_sec),
            lost: DropCounts::default(),
            messages_lost: 0,
            now_ns: None,
            jump_forward_ns: unsigned_ns(config.sync.jump_forward_sec),
            epoch: 0,
            starved: false,
            names: rig.cameras.iter().map(|c| c.topic.clone()).collect(),
            active: (0..rig.cameras.len()).collect(),
            each_set: true,
            fresh: 0,
            superseded: 0,
            used: 0,
            panics: 0,
            poses_ahead: true,
            lost_detail: BTreeMap::new(),
            watched_since_ns: None,
            early_verdict: false,
        }
    }

    /// The same, but windows are given only when [`Front::newest_window`] asks: what cannot keep up takes the newest.
    pub fn on_demand(config: &Config, rig: &Rig, store: PoseStore) -> Self {
        Self { each_set: false, poses_ahead: false, ..Self::new(config, rig, store) }
    }

    /// Goes on with `active` cameras of the rig alone, in rising order. When all of them were there before, windows go on
    /// at once; else the window fills anew. Images of the other cameras are dropped as incomplete.
    pub fn with_cameras(self, config: &Config, rig: &Rig, active: &[usize]) -> Self {
        let offsets: Vec<f64> =
            active.iter().map(|&c| config.input.image_time_offset_sec.get(c).copied().unwrap_or(0.0)).collect();
        let places: Vec<Rigid> = active.iter().map(|&c| rig.cameras[c].base_from_camera).collect();
        let mounts = active.iter().map(|&c| rig.cameras[c].mount.clone()).collect();
        let reference = active
            .iter()
            .position(|&c| c == rig.reference)
            .or_else(|| extrinsics::reference_camera(&places))
            .unwrap_or(0);
        let place = |c: &usize| self.active.iter().position(|a| a == c);
        let kept: Option<Vec<usize>> = active.iter().map(place).collect();
        Self {
            sync: self.sync.with_cameras(active.len(), &config.sync, &offsets),
            posed: self.posed.with_cameras(mounts, &config.sync),
            window: self.window.with_cameras(reference, kept.as_deref()),
            names: active.iter().map(|&c| rig.cameras[c].topic.clone()).collect(),
            active: active.to_vec(),
            ..self
        }
    }

    /// Starts anew, as after a clock jump: sync, window and poses are empty.
    pub fn reset(&mut self) {
        self.sync.reset();
        self.window.reset();
        self.posed.clear();
        self.superseded += std::mem::take(&mut self.fresh);
        (self.now_ns, self.epoch) = (None, self.sync.epoch());
    }

    /// Least time between two windows from now on, seconds.
    pub fn set_hop(&mut self, hop_sec: f64) {
        self.window.set_hop(hop_sec);
    }

    /// The cameras of the rig there are, in the order of a window's frames.
    pub fn active(&self) -> &[usize] {
        &self.active
    }

    /// Takes one event and gives what became ready, in order. A panic on the way starts sync, window and poses anew; what they
    /// held is counted as lost to it.
    pub fn take(&mut self, event: Event, out: &mut VecDeque<FrontOutput>) {
        let Err(what) = caught(|| self.take_in(event, out)) else { return };
        self.panics += 1;
        warn!("synchronisation panicked ({what}) and starts anew; this is a fault of the program, please report it");
        self.reset();
        let known = self.used + self.drops().total() + (self.sync.pending() + self.posed.pending()) as u64;
        self.lost.add(DropReason::Panic, self.images_in().saturating_sub(known));
    }

    fn take_in(&mut self, event: Event, out: &mut VecDeque<FrontOutput>) {
        #[cfg(test)]
        tests::fail(&event);
        match event {
            Event::Image { camera, stamp_ns, frame } => match self.active.iter().position(|&c| c == camera) {
                Some(camera) => {
                    self.watched_since_ns.get_or_insert(stamp_ns);
                    self.sync.push(camera, stamp_ns, frame);
                    if self.sync.epoch() == self.epoch {
                        self.heard(stamp_ns);
                    } else {
                        // The clock has jumped: what was the newest stamp is of a time that is over.
                        (self.now_ns, self.epoch) = (Some(stamp_ns), self.sync.epoch());
                    }
                }
                None => self.lost.add(DropReason::Incomplete, 1),
            },
            Event::Pose { stamp_ns, .. } => {
                self.heard_pose(stamp_ns);
                self.posed.take_pose(&event);
            }
            Event::Transform(ref t) => {
                self.heard_pose(t.header.stamp_ns);
                self.posed.take_pose(&event);
            }
            Event::StaticTransform(_) => self.posed.take_pose(&event),
            Event::Truth { camera, stamp_ns, kind, width, height, data } => {
                let image = TruthImage { width, height, data };
                out.push_back(FrontOutput::Truth { camera, stamp_ns, kind, image });
                return;
            }
            Event::Lost { camera, reason, detail } => {
                // Only images are counted by reason: what came in is then what was used plus what was dropped.
                match camera {
                    Some(camera) => {
                        self.lost.add(reason, 1);
                        self.lost_detail.insert(reason, detail);
                        if let Some(place) = self.active.iter().position(|&c| c == camera) {
                            self.sync.unreadable(place);
                        }
                    }
                    None => self.messages_lost += 1,
                }
            }
        }
        if let Some(now_ns) = self.now_ns {
            self.sync.advance(now_ns);
            self.report_starvation(now_ns);
        }
        self.drain(out);
        self.judge_early();
    }

    fn heard_pose(&mut self, stamp_ns: i64) {
        if !self.poses_ahead {
            self.heard(stamp_ns);
        }
    }

    /// Says after the first seconds where most images go, so that nobody waits for the end of a run that gives nothing.
    fn judge_early(&mut self) {
        let (Some(since_ns), Some(now_ns), false) = (self.watched_since_ns, self.now_ns, self.early_verdict) else {
            return;
        };
        if seconds_between(since_ns, now_ns).abs() >= EARLY_VERDICT_SEC {
            self.early_verdict = true;
            if let Some(verdict) = self.verdict() {
                warn!("{verdict}");
            }
        }
    }

    /// When more than half of the images went one way: which, and in one sentence why, with the key that may change it.
    pub fn verdict(&self) -> Option<String> {
        let (all, drops) = (self.images_in(), self.drops());
        let (reason, n) = drops.iter().find(|(_, n)| n.saturating_mul(2) > all)?;
        Some(format!("{n} of {all} images were dropped ({reason}): {}", self.why(reason)))
    }

    fn why(&self, reason: DropReason) -> String {
        if let Some(detail) = self.lost_detail.get(&reason) {
            return format!("the last one was {detail}");
        }
        match reason {
            DropReason::NoPose | DropReason::PoseGap => {
                self.posed.why(reason).unwrap_or_else(|| "no pose came: check the pose topic (input.pose)".into())
            }
            DropReason::Incomplete | DropReason::Surplus => self.sync.why_incomplete(&self.names),
            DropReason::Edge => {
                "they lie before the first pose or after the last one: the recording is too short".into()
            }
            DropReason::Late => {
                "they are recorded after images that are newer by more than sync.slop_sec: raise it".into()
            }
            DropReason::Duplicate => {
                "each stamp came twice: the images are in the recording doubly, nothing is lost".into()
            }
            DropReason::ClockJump => {
                "their stamps jump back and forth: sync.jump_back_sec and sync.jump_forward_sec say what is a jump"
                    .into()
            }
            DropReason::NoCalibration => "their camera has no intrinsics or no mounting".into(),
            DropReason::Overflow => "they wait too long for other cameras or poses: see sync.max_pending".into(),
            DropReason::Decode | DropReason::Panic => "they cannot be read".into(),
        }
    }

    /// A message with this stamp came in. A stamp far ahead moves the time on only when it is an image's and the next one
    /// agrees (then the synchronizer starts a new epoch): a single wrong stamp must not make everything else too old.
    fn heard(&mut self, stamp_ns: i64) {
        match self.now_ns {
            Some(now_ns) if stamp_ns > now_ns && stamp_ns.abs_diff(now_ns) > self.jump_forward_ns => {}
            Some(now_ns) => self.now_ns = Some(now_ns.max(stamp_ns)),
            None => self.now_ns = Some(stamp_ns),
        }
    }

    /// The window that ends at the newest set, if there is one and it was not given yet.
    pub fn newest_window(&mut self) -> Option<Window<Frame>> {
        let fresh = std::mem::take(&mut self.fresh);
        if fresh == 0 || self.window.history() == 0 {
            self.superseded += fresh;
            return None;
        }
        // Every set but the newest goes without, whether or not the newest ends a window; that one the builder counts.
        self.superseded += fresh - 1;
        self.window.newest()
    }

    /// The input has ended: whatever can still be emitted is.
    pub fn finish(&mut self, out: &mut VecDeque<FrontOutput>) {
        self.sync.flush();
        self.drain(out);
        self.posed.flush();
        // Nobody will ask for a window any more.
        self.superseded += std::mem::take(&mut self.fresh);
    }

    fn drain(&mut self, out: &mut VecDeque<FrontOutput>) {
        while let Some(set) = self.sync.pop() {
            self.starved = false;
            self.posed.push_set(set);
        }
        while let Some(set) = self.now_ns.and_then(|now_ns| self.posed.pop(now_ns)) {
            self.used += set.frames.len() as u64;
            // Pictures are shared, so the copy is cheap.
            out.push_back(FrontOutput::Set(Arc::new(set.clone())));
            if !self.each_set {
                self.fresh += u64::from(self.window.keep(set));
            } else if let Some(window) = self.window.push(set) {
                out.push_back(FrontOutput::Window(window));
            }
        }
    }

    fn report_starvation(&mut self, now_ns: i64) {
        if self.starved {
            return;
        }
        if let Some(report) = self.sync.starvation(now_ns) {
            self.starved = true;
            warn!("no synchronized set: {}", report.describe(&self.names));
        }
    }

    /// Images that arrived, readable or not.
    pub fn images_in(&self) -> u64 {
        self.sync.images_in() + self.lost.total()
    }

    /// Images in the sets that were handed on.
    pub fn images_used(&self) -> u64 {
        self.used
    }

    /// Everything dropped so far, by reason, over all stages.
    pub fn drops(&self) -> DropCounts {
        let mut all = self.sync.drops().clone();
        all.merge(self.posed.drops());
        all.merge(&self.lost);
        all
    }

    /// Poses, transforms and ground truth that could not be read.
    pub fn messages_lost(&self) -> u64 {
        self.messages_lost
    }

    /// Poses refused.
    pub fn poses_rejected(&self) -> u64 {
        self.posed.rejected()
    }

    /// What became of the sets that might have made a window.
    pub fn window_counts(&self) -> WindowCounts {
        self.window.counts()
    }

    /// Sets that got no window of their own because a newer one was there when the last step had ended.
    pub fn superseded(&self) -> u64 {
        self.superseded
    }

    /// Times a stage of it panicked and started anew.
    pub fn panics(&self) -> u64 {
        self.panics
    }

    /// The number of clock jumps and resets so far.
    pub fn epoch(&self) -> u32 {
        self.epoch
    }

    /// The pose stage, for turning camera poses into vehicle poses.
    pub fn base_pose(&self, camera: usize, stamp_ns: i64, map_from_camera: &Rigid) -> Rigid {
        self.posed.base_pose(camera, stamp_ns, map_from_camera)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::decode::RgbPicture;
    use crate::source::world::posed_set;
    use storm_render::world::{Drive, DriveOptions};

    /// What a test sends to have the stage panic.
    const FAIL: &str = "fail";

    pub(super) fn fail(event: &Event) {
        if let Event::Lost { detail, .. } = event {
            assert_ne!(detail, FAIL);
        }
    }

    #[test]
    fn a_panic_loses_what_waited_and_every_image_is_accounted_for() {
        let options = DriveOptions { seconds: 1.0, cameras: 1, width: 16, height: 8, ..DriveOptions::default() };
        let rig = crate::pipeline::live::tests::rig(2);
        let config = Config::default();
        let mut front = Front::new(&config, &rig, PoseStore::nothing(&config.sync));
        let (set, _) = posed_set(&Drive::new(&options).unwrap(), 0);
        let map_from_base = set.frames[0].map_from_camera;
        let frame = Frame::whole(RgbPicture { width: 1, height: 1, data: vec![0; 3] });
        let mut out = VecDeque::new();
        let mut feed = |front: &mut Front, range: std::ops::Range<i64>, cameras: &[usize]| {
            for i in range {
                let stamp_ns = i * 100_000_000;
                front.take(Event::Pose { stamp_ns, map_from_base }, &mut out);
                for &camera in cameras {
                    front.take(Event::Image { camera, stamp_ns, frame: frame.clone() }, &mut out);
                }
            }
            std::mem::take(&mut out).iter().filter(|o| matches!(o, FrontOutput::Set(_))).count() as u64
        };
        let mut sets = feed(&mut front, 0..5, &[0, 1]);
        // Camera 1's picture is missing: camera 0's waits when the stage panics.
        sets += feed(&mut front, 5..6, &[0]);
        let detail = FAIL.to_owned();
        front.take(Event::Lost { camera: None, reason: DropReason::Decode, detail }, &mut VecDeque::new());
        assert_eq!((front.panics(), front.epoch()), (1, 1));
        sets += feed(&mut front, 6..12, &[0, 1]);
        let mut rest = VecDeque::new();
        front.finish(&mut rest);
        assert_eq!((sets, front.images_in()), (11, 23));
        assert_eq!(front.drops().total(), 1, "{}", front.drops());
    }
}
