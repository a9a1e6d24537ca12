//! Gives every synchronized image the pose of its camera at its own stamp.

use tracing::warn;

use crate::config::{Config, SyncConfig};
use crate::poses::{PoseBuffer, PoseGate, PoseLookup, PoseMissing, PoseTiming};
use crate::rigid::Rigid;
use crate::source::Event;
use crate::source::Rig;
use crate::source::bag::BagSource;
use crate::source::mount::Mount;
use crate::source::topics::PoseTopic;
use crate::sync::clock::seconds_between;
use crate::sync::{DropCounts, DropReason, FrameSet};
use crate::tf::{TfLookup, TfProblem, TfTree};
use crate::window::PosedSet;

/// Images and poses farther apart than this are stamped by two clocks, seconds.
const TWO_CLOCKS_SEC: f64 = 60.0;

/// Rejected poses that are logged one by one; the rest is only counted.
const LOGGED_REJECTS: u64 = 5;

/// Where poses are looked up.
pub enum PoseStore {
    /// A topic of poses of the vehicle.
    Buffer(PoseBuffer),
    /// The transform tree: `fixed` from `base`.
    Tree {
        /// All transforms.
        tree: TfTree,
        /// Fixed frame.
        fixed: String,
        /// Vehicle frame.
        base: String,
    },
    /// A topic of poses of the vehicle, beside a tree that has the cameras' joints or the frame the poses are given in.
    Both {
        /// The poses.
        poses: PoseBuffer,
        /// All transforms.
        tree: TfTree,
        /// Fixed frame, and the frame the poses are given in; `None` when they are one.
        fixed_and_given: Option<(String, String)>,
        /// Vehicle frame.
        base: String,
    },
}

impl PoseStore {
    /// Empty, for the pose topic a bag was planned with; a tree starts from the bag's static transforms.
    pub fn of_bag(source: &BagSource, rig: &Rig, config: &Config) -> Self {
        match source.plan().pose {
            PoseTopic::Message(_) => Self::of_messages(rig, config, || source.statics()),
            PoseTopic::Tf => Self::of_tree(rig, source.statics()),
        }
    }

    /// Empty, for a pose topic; `statics` gives the tree where one is needed.
    pub fn of_messages(rig: &Rig, config: &Config, statics: impl FnOnce() -> TfTree) -> Self {
        let poses = PoseBuffer::new(&config.sync);
        if !rig.needs_tree() {
            return Self::Buffer(poses);
        }
        let fixed_and_given = rig.pose_frame.clone().map(|given| (rig.map_frame.clone(), given));
        Self::Both { poses, tree: statics(), fixed_and_given, base: rig.base_frame.clone() }
    }

    /// The vehicle's pose comes from the tree itself.
    pub fn of_tree(rig: &Rig, tree: TfTree) -> Self {
        Self::Tree { tree, fixed: rig.map_frame.clone(), base: rig.base_frame.clone() }
    }

    /// Empty.
    pub fn nothing(config: &SyncConfig) -> Self {
        Self::Buffer(PoseBuffer::new(config))
    }

    /// `map_from_base` at a stamp.
    pub fn lookup(&self, stamp_ns: i64) -> PoseLookup {
        match self {
            Self::Buffer(poses) => poses.lookup(stamp_ns),
            Self::Tree { tree, fixed, base } => tree.lookup(fixed, base, stamp_ns).to_pose(),
            Self::Both { poses, tree, fixed_and_given, .. } => match (poses.lookup(stamp_ns), fixed_and_given) {
                (PoseLookup::At(given_from_base), Some((fixed, given))) => {
                    match tree.lookup(fixed, given, stamp_ns).to_pose() {
                        PoseLookup::At(fixed_from_given) => PoseLookup::At(fixed_from_given * given_from_base),
                        other => other,
                    }
                }
                (found, _) => found,
            },
        }
    }

    fn poses(&mut self) -> Option<&mut PoseBuffer> {
        match self {
            Self::Buffer(poses) | Self::Both { poses, .. } => Some(poses),
            Self::Tree { .. } => None,
        }
    }

    fn tree(&mut self) -> Option<&mut TfTree> {
        match self {
            Self::Tree { tree, .. } | Self::Both { tree, .. } => Some(tree),
            Self::Buffer(_) => None,
        }
    }

    /// A camera's mounting at a stamp.
    fn mount(&self, mount: &Mount, stamp_ns: i64) -> PoseLookup {
        match (&mount.joint, self) {
            (Some(frame), Self::Tree { tree, base, .. } | Self::Both { tree, base, .. }) => {
                match tree.lookup(base, frame, stamp_ns).to_pose() {
                    PoseLookup::At(base_from_frame) => PoseLookup::At(base_from_frame * mount.frame_from_view),
                    other => other,
                }
            }
            _ => PoseLookup::At(mount.base_from_camera()),
        }
    }

    /// When the newest pose came and how often they come.
    pub fn timing(&self) -> PoseTiming {
        match self {
            Self::Buffer(poses) | Self::Both { poses, .. } => poses.timing(),
            Self::Tree { tree, fixed, base } => tree.timing(fixed, base),
        }
    }

    /// Takes a pose or a transform, of the kind this store holds.
    ///
    /// # Errors
    /// It is refused; the text says which and why.
    pub fn take(&mut self, event: &Event) -> Result<(), String> {
        match event {
            Event::Pose { stamp_ns, map_from_base } => {
                let Some(poses) = self.poses() else { return Ok(()) };
                let taken = poses.push(*stamp_ns, *map_from_base);
                taken.map(|_| ()).map_err(|e| format!("pose at {stamp_ns} ns refused: {e}"))
            }
            Event::Transform(t) | Event::StaticTransform(t) => {
                let Some(tree) = self.tree() else { return Ok(()) };
                let taken = tree.insert(t, matches!(event, Event::StaticTransform(_)));
                taken.map(|_| ()).map_err(|e| format!("transform at {} ns refused: {e}", t.header.stamp_ns))
            }
            _ => Ok(()),
        }
    }

    /// In one sentence why there is no pose at a stamp, with the key that may change it; `gap_sec`: `sync.pose_gap_sec`.
    pub fn why_not(&self, stamp_ns: i64, gap_sec: f64) -> String {
        if let Self::Tree { tree, fixed, base } = self
            && let TfLookup::Wait(problem @ (TfProblem::UnknownFrame { .. } | TfProblem::NotConnected { .. })) =
                tree.lookup(fixed, base, stamp_ns)
        {
            return format!(
                "{problem}: set input.map_frame ({fixed}) and input.base_frame ({base}) to frames of one tree"
            );
        }
        let latest_ns = self.timing().latest_ns;
        match (self.lookup(stamp_ns), latest_ns) {
            (PoseLookup::Never(PoseMissing::GapTooWide { gap_sec: between_sec }), _) => {
                let every = self.timing().interval_sec.filter(|&sec| sec >= gap_sec);
                let what = every.map_or_else(
                    || format!("poses are missing for {} s around them", seconds(between_sec)),
                    |sec| format!("poses come every {} s", seconds(sec)),
                );
                let enough = between_sec.ceil();
                format!(
                    "{what}, sync.pose_gap_sec is {gap_sec}: set sync.pose_gap_sec={enough} to interpolate across that"
                )
            }
            (PoseLookup::Never(PoseMissing::BeforeFirst { first_ns }), _) => {
                apart(stamp_ns, first_ns, "earlier", "the first pose")
            }
            (PoseLookup::Wait, Some(latest_ns)) => apart(latest_ns, stamp_ns, "later", "the newest pose"),
            (PoseLookup::Wait, None) => "no pose came: check the pose topic (input.pose)".into(),
            (PoseLookup::At(_), _) => "their poses come later than that: raise sync.pose_wait_sec".into(),
        }
    }
}

/// That images and poses lie apart in time, and which keys bring them together.
fn apart(earlier_ns: i64, later_ns: i64, way: &str, than: &str) -> String {
    let sec = seconds_between(earlier_ns, later_ns);
    let text = format!("images are stamped {} s {way} than {than}", seconds(sec));
    match sec > TWO_CLOCKS_SEC {
        true => format!("{text}: two clocks; set input.stamps=recorded, or input.image_time_offset_sec"),
        false => format!("{text}: set input.image_time_offset_sec if one of them is off"),
    }
}

/// Seconds for people: `1,699,999,000`, `12.3`, `0.25`.
pub fn seconds(sec: f64) -> String {
    if sec.abs() < 100.0 {
        let text = format!("{sec:.2}");
        return text.strip_suffix('0').map_or_else(|| text.clone(), str::to_owned);
    }
    let digits = format!("{:.0}", sec.abs());
    let mut grouped = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            grouped.push(',');
        }
        grouped.push(digit);
    }
    if sec < 0.0 { format!("-{grouped}") } else { grouped }
}

/// The stage: a pose store, the cameras' mountings, and the sets that wait.
pub struct PoseStage<T> {
    store: PoseStore,
    gate: PoseGate<T>,
    mounts: Vec<Mount>,
    epoch: u32,
    rejected: u64,
    gap_sec: f64,
    /// That poses are rarer than `sync.pose_gap_sec` was said.
    rare_said: bool,
}

impl<T> PoseStage<T> {
    /// A stage for the cameras of `rig`.
    pub fn new(store: PoseStore, rig: &Rig, config: &SyncConfig) -> Self {
        let mounts = rig.cameras.iter().map(|c| c.mount.clone()).collect();
        let (gate, gap_sec) = (PoseGate::new(config), config.pose_gap_sec);
        Self { store, gate, mounts, epoch: 0, rejected: 0, gap_sec, rare_said: false }
    }

    /// A pose or a transform; one that cannot be used is counted and said.
    pub fn take_pose(&mut self, event: &Event) {
        let Err(what) = self.store.take(event) else { return };
        self.rejected += 1;
        if self.rejected <= LOGGED_REJECTS {
            warn!("{what}");
        }
    }

    /// Poses refused because they were not finite or not a rotation.
    pub fn rejected(&self) -> u64 {
        self.rejected
    }

    /// A synchronized set.
    pub fn push_set(&mut self, set: FrameSet<T>) {
        if set.epoch != self.epoch {
            self.epoch = set.epoch;
            if let Some(poses) = self.store.poses() {
                poses.follow_clock(set.stamp_ns);
            }
            if let Some(tree) = self.store.tree() {
                tree.follow_clock(set.stamp_ns);
            }
        }
        self.gate.push(set);
    }

    /// The next set with poses, if it is ready; `now_ns` is the newest stamp seen.
    pub fn pop(&mut self, now_ns: i64) -> Option<PosedSet<T>> {
        if self.gate.pending() == 0 {
            return None;
        }
        let timing = self.store.timing();
        self.gate.follow(timing);
        let (store, mounts) = (&self.store, &self.mounts);
        let set = self.gate.poll(now_ns, |camera, stamp_ns| match (store.lookup(stamp_ns), mounts.get(camera)) {
            (PoseLookup::At(map_from_base), Some(mount)) => match store.mount(mount, stamp_ns) {
                PoseLookup::At(base_from_camera) => PoseLookup::At(map_from_base * base_from_camera),
                other => other,
            },
            (other, _) => other,
        });
        if set.is_some() {
            self.say_rare(timing);
        }
        set
    }

    /// Says once how far images are from the nearest pose where poses come slower than `sync.pose_gap_sec`.
    fn say_rare(&mut self, timing: PoseTiming) {
        let Some(interval_sec) = timing.interval_sec.filter(|&sec| sec > self.gap_sec && !self.rare_said) else {
            return;
        };
        self.rare_said = true;
        warn!(
            "poses come every {} s, sync.pose_gap_sec is {}: images between them get interpolated poses, up to {} s from the \
             nearest one",
            seconds(interval_sec),
            self.gap_sec,
            seconds(interval_sec / 2.0)
        );
    }

    /// In one sentence why sets were dropped for `reason`; none when no set was.
    pub fn why(&self, reason: DropReason) -> Option<String> {
        Some(self.store.why_not(self.gate.dropped_ns(reason)?, self.gap_sec))
    }

    /// Forgets all poses (transforms that hold at all times stay) and drops the sets that wait.
    pub fn clear(&mut self) {
        if let Some(poses) = self.store.poses() {
            poses.clear();
        }
        if let Some(tree) = self.store.tree() {
            tree.clear_moving();
        }
        self.gate.flush();
    }

    /// The input has ended: sets that still wait are dropped.
    pub fn flush(&mut self) {
        self.gate.follow(self.store.timing());
        self.gate.flush();
    }

    /// The vehicle's pose a camera pose at a stamp stands for.
    pub fn base_pose(&self, camera: usize, stamp_ns: i64, map_from_camera: &Rigid) -> Rigid {
        let Some(mount) = self.mounts.get(camera) else { return *map_from_camera };
        let base_from_camera = match self.store.mount(mount, stamp_ns) {
            PoseLookup::At(at) => at,
            _ => mount.base_from_camera(),
        };
        *map_from_camera * base_from_camera.inverse()
    }

    /// The same poses for other cameras with these mountings. Sets that wait go, since they are not of these cameras; they
    /// are counted as incomplete.
    pub fn with_cameras(self, mounts: Vec<Mount>, config: &SyncConfig) -> Self {
        let mut drops = self.gate.drops().clone();
        drops.add(DropReason::Incomplete, self.gate.pending() as u64);
        Self { gate: PoseGate::after(config, drops), mounts, ..self }
    }

    /// Images that wait.
    pub fn pending(&self) -> usize {
        self.gate.pending()
    }

    /// Images dropped here, by reason.
    pub fn drops(&self) -> &DropCounts {
        self.gate.drops()
    }
}

#[cfg(test)]
#[path = "posed_tests.rs"]
mod tests;
