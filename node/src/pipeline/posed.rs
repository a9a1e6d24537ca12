//! Gives every synchronized image the pose of its camera at its own stamp.

use tracing::warn;

use crate::config::{Config, SyncConfig};
use crate::msg::TransformStamped;
use crate::poses::{PoseBuffer, PoseGate, PoseLookup};
use crate::rigid::Rigid;
use crate::source::Rig;
use crate::source::bag::BagSource;
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
}

impl PoseStore {
    /// Empty, for the pose topic a bag was planned with; a tree starts from the bag's static transforms.
    pub fn of_bag(source: &BagSource, rig: &Rig, config: &Config) -> Self {
        match source.plan().pose {
            PoseTopic::Message(_) => Self::Buffer(PoseBuffer::new(&config.sync)),
            PoseTopic::Tf => Self::Tree {
                tree: source.statics(),
                fixed: config.input.map_frame.clone(),
                base: rig.base_frame.clone(),
            },
        }
    }

    /// Empty.
    pub fn nothing(config: &SyncConfig) -> Self {
        Self::Buffer(PoseBuffer::new(config))
    }

    fn lookup(&self, stamp_ns: i64) -> PoseLookup {
        match self {
            Self::Buffer(poses) => poses.lookup(stamp_ns),
            Self::Tree { tree, fixed, base } => tree.lookup(fixed, base, stamp_ns).to_pose(),
        }
    }
}

/// The stage: a pose store, the cameras' mountings, and the sets that wait.
pub struct PoseStage<T> {
    store: PoseStore,
    gate: PoseGate<T>,
    base_from_camera: Vec<Rigid>,
    epoch: u32,
    rejected: u64,
}

impl<T> PoseStage<T> {
    /// A stage for the cameras of `rig`.
    pub fn new(store: PoseStore, rig: &Rig, config: &SyncConfig) -> Self {
        let base_from_camera = rig.cameras.iter().map(|c| c.base_from_camera).collect();
        Self { store, gate: PoseGate::new(config), base_from_camera, epoch: 0, rejected: 0 }
    }

    /// A pose of the vehicle; one that cannot be used is counted and said.
    pub fn push_pose(&mut self, stamp_ns: i64, map_from_base: Rigid) {
        if let PoseStore::Buffer(poses) = &mut self.store
            && let Err(e) = poses.push(stamp_ns, map_from_base)
        {
            self.reject(&format!("pose at {stamp_ns} ns refused: {e}"));
        }
    }

    /// A transform of the tree; `is_static`: it holds at all times.
    pub fn push_transform(&mut self, transform: &TransformStamped, is_static: bool) {
        if let PoseStore::Tree { tree, .. } = &mut self.store
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
            match &mut self.store {
                PoseStore::Buffer(poses) => poses.follow_clock(set.stamp_ns),
                PoseStore::Tree { tree, .. } => tree.follow_clock(set.stamp_ns),
            }
        }
        self.gate.push(set);
    }

    /// The next set with poses, if it is ready; `now_ns` is the newest stamp seen.
    pub fn pop(&mut self, now_ns: i64) -> Option<PosedSet<T>> {
        let (store, mounts) = (&self.store, &self.base_from_camera);
        self.gate.poll(now_ns, |camera, stamp_ns| match (store.lookup(stamp_ns), mounts.get(camera)) {
            (PoseLookup::At(map_from_base), Some(mount)) => PoseLookup::At(map_from_base * *mount),
            (other, _) => other,
        })
    }

    /// Forgets all poses (transforms that hold at all times stay) and drops the sets that wait.
    pub fn clear(&mut self) {
        match &mut self.store {
            PoseStore::Buffer(poses) => poses.clear(),
            PoseStore::Tree { tree, .. } => tree.clear_moving(),
        }
        self.gate.flush();
    }

    /// The input has ended: sets that still wait are dropped.
    pub fn flush(&mut self) {
        self.gate.flush();
    }

    /// The vehicle's pose a camera pose stands for.
    pub fn base_pose(&self, camera: usize, map_from_camera: &Rigid) -> Rigid {
        self.base_from_camera.get(camera).map_or(*map_from_camera, |m| *map_from_camera * m.inverse())
    }

    /// The same poses for other cameras: `base_from_camera` are their mountings. Sets that wait go, since they are not
    /// of these cameras; they are counted as incomplete.
    pub fn with_cameras(self, base_from_camera: Vec<Rigid>, config: &SyncConfig) -> Self {
        let mut drops = self.gate.drops().clone();
        drops.add(DropReason::Incomplete, self.gate.pending() as u64);
        Self { gate: PoseGate::after(config, drops), base_from_camera, ..self }
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
