//! Gives every synchronized image the pose of its camera at its own stamp.

use tracing::warn;

use crate::config::{Config, SyncConfig};
use crate::msg::TransformStamped;
use crate::poses::{PoseBuffer, PoseGate, PoseLookup};
use crate::rigid::Rigid;
use crate::source::Rig;
use crate::source::bag::BagSource;
use crate::source::mount::Mount;
use crate::source::topics::PoseTopic;
use crate::sync::{DropCounts, DropReason, FrameSet};
use crate::tf::TfTree;
use crate::window::PosedSet;

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

    fn lookup(&self, stamp_ns: i64) -> PoseLookup {
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
}

/// The stage: a pose store, the cameras' mountings, and the sets that wait.
pub struct PoseStage<T> {
    store: PoseStore,
    gate: PoseGate<T>,
    mounts: Vec<Mount>,
    epoch: u32,
    rejected: u64,
}

impl<T> PoseStage<T> {
    /// A stage for the cameras of `rig`.
    pub fn new(store: PoseStore, rig: &Rig, config: &SyncConfig) -> Self {
        let mounts = rig.cameras.iter().map(|c| c.mount.clone()).collect();
        Self { store, gate: PoseGate::new(config), mounts, epoch: 0, rejected: 0 }
    }

    /// A pose of the vehicle; one that cannot be used is counted and said.
    pub fn push_pose(&mut self, stamp_ns: i64, map_from_base: Rigid) {
        if let Some(poses) = self.store.poses()
            && let Err(e) = poses.push(stamp_ns, map_from_base)
        {
            self.reject(&format!("pose at {stamp_ns} ns refused: {e}"));
        }
    }

    /// A transform of the tree; `is_static`: it holds at all times.
    pub fn push_transform(&mut self, transform: &TransformStamped, is_static: bool) {
        if let Some(tree) = self.store.tree()
            && let Err(e) = tree.insert(transform, is_static)
        {
            self.reject(&format!("transform at {} ns refused: {e}", transform.header.stamp_ns));
        }
    }

    fn reject(&mut self, what: &str) {
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
        let (store, mounts) = (&self.store, &self.mounts);
        self.gate.poll(now_ns, |camera, stamp_ns| match (store.lookup(stamp_ns), mounts.get(camera)) {
            (PoseLookup::At(map_from_base), Some(mount)) => match store.mount(mount, stamp_ns) {
                PoseLookup::At(base_from_camera) => PoseLookup::At(map_from_base * base_from_camera),
                other => other,
            },
            (other, _) => other,
        })
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
