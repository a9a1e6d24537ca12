//! Synchronized sets wait here until every image has a pose at its own stamp.

use std::collections::{BTreeMap, VecDeque};

use super::{MAX_FOLLOWED_GAP_SEC, PoseLookup, PoseMissing};
use crate::config::SyncConfig;
use crate::sync::clock::signed_ns;
use crate::sync::{DropCounts, DropReason, FrameSet};
use crate::window::{PosedFrame, PosedSet};

/// Most sets that wait for poses at once. At camera rates it is several times what `pose_wait_sec` lets wait; it bounds
/// memory when message time stands still.
const MAX_WAITING_SETS: usize = 64;

/// What the poses say about how long to wait for the next one.
#[derive(Debug, Clone, Copy, Default)]
pub struct PoseTiming {
    /// The newest pose's stamp, nanoseconds; none without poses.
    pub latest_ns: Option<i64>,
    /// How often poses come, seconds; none with fewer than two.
    pub interval_sec: Option<f64>,
}

/// Gives sets their poses, in order, with a bounded wait.
#[derive(Debug)]
pub struct PoseGate<T> {
    wait_ns: i64,
    gap_ns: i64,
    timing: PoseTiming,
    /// By reason, the stamp of the newest set dropped for it.
    dropped_ns: BTreeMap<DropReason, i64>,
    waiting: VecDeque<FrameSet<T>>,
    drops: DropCounts,
}

impl<T> PoseGate<T> {
    /// Sets wait at most `pose_wait_sec` after their newest image, or as long as one pose takes to come.
    pub fn new(config: &SyncConfig) -> Self {
        Self {
            wait_ns: signed_ns(config.pose_wait_sec),
            gap_ns: signed_ns(config.pose_gap_sec),
            timing: PoseTiming::default(),
            dropped_ns: BTreeMap::new(),
            waiting: VecDeque::new(),
            drops: DropCounts::default(),
        }
    }

    /// Tells it how the poses come, so that it waits for slow ones, and knows where they begin and end.
    pub fn follow(&mut self, timing: PoseTiming) {
        self.timing = timing;
    }

    /// The time between two poses that is waited for and interpolated across at least, nanoseconds.
    fn followed_ns(&self) -> i64 {
        signed_ns(self.timing.interval_sec.unwrap_or(0.0).min(MAX_FOLLOWED_GAP_SEC))
    }

    /// True when so little lies between an image and the nearest pose, which is the first or the last one, that the image only
    /// marks where the recording begins or ends.
    fn at_edge(&self, between_ns: i64) -> bool {
        between_ns <= self.gap_ns.max(self.followed_ns())
    }

    /// The stamp of the newest set that was dropped for `reason`.
    pub fn dropped_ns(&self, reason: DropReason) -> Option<i64> {
        self.dropped_ns.get(&reason).copied()
    }

    /// One that goes on counting where another stopped.
    pub fn after(config: &SyncConfig, drops: DropCounts) -> Self {
        Self { drops, ..Self::new(config) }
    }

    /// Takes the next set; beyond the bound the oldest one that waits is dropped.
    pub fn push(&mut self, set: FrameSet<T>) {
        self.waiting.push_back(set);
        if self.waiting.len() > MAX_WAITING_SETS {
            self.drop_front(DropReason::Overflow);
        }
    }

    /// The next set with all its poses; none when the oldest one still waits, or none is left.
    ///
    /// `now_ns` is message time (the newest stamp of any input); `map_from_camera` gives the camera's pose at a stamp.
    pub fn poll(
        &mut self,
        now_ns: i64,
        mut map_from_camera: impl FnMut(usize, i64) -> PoseLookup,
    ) -> Option<PosedSet<T>> {
        while let Some(front) = self.waiting.front() {
            let poses: Vec<_> = front.frames.iter().enumerate().map(|(c, (s, _))| map_from_camera(c, *s)).collect();
            let never = poses.iter().zip(&front.frames).find_map(|(p, (stamp_ns, _))| match p {
                PoseLookup::Never(PoseMissing::BeforeFirst { first_ns }) => {
                    let edge = self.at_edge(first_ns.saturating_sub(*stamp_ns));
                    Some(if edge { DropReason::Edge } else { DropReason::NoPose })
                }
                PoseLookup::Never(PoseMissing::GapTooWide { .. }) => Some(DropReason::PoseGap),
                _ => None,
            });
            if let Some(reason) = never {
                self.drop_front(reason);
                continue;
            }
            let poses: Vec<_> =
                poses.into_iter().filter_map(|p| if let PoseLookup::At(t) = p { Some(t) } else { None }).collect();
            if poses.len() == front.frames.len() {
                let set = self.waiting.pop_front()?;
                let frames = set.frames.into_iter().zip(poses);
                let frames = frames
                    .map(|((stamp_ns, item), map_from_camera)| PosedFrame { stamp_ns, map_from_camera, item })
                    .collect();
                return Some(PosedSet { stamp_ns: set.stamp_ns, epoch: set.epoch, frames });
            }
            let newest_ns = front.frames.iter().map(|(s, _)| *s).max().unwrap_or(front.stamp_ns);
            if self.waiting.back().is_some_and(|b| b.epoch != front.epoch) {
                // The clock has jumped since: the poses this set waits for belong to a time that is over.
                self.drop_front(DropReason::ClockJump);
            } else if now_ns > newest_ns.saturating_add(self.wait_ns.max(self.followed_ns())) {
                self.drop_front(self.without_pose(newest_ns));
            } else {
                return None;
            }
        }
        None
    }

    /// End of the recording: drops what still waits.
    pub fn flush(&mut self) {
        while let Some(front) = self.waiting.front() {
            let newest_ns = front.frames.iter().map(|(s, _)| *s).max().unwrap_or(front.stamp_ns);
            self.drop_front(self.without_pose(newest_ns));
        }
    }

    /// What a set is dropped for whose newest image has this stamp and whose pose did not come.
    fn without_pose(&self, newest_ns: i64) -> DropReason {
        match self.timing.latest_ns {
            Some(latest_ns) if self.at_edge(newest_ns.saturating_sub(latest_ns)) => DropReason::Edge,
            _ => DropReason::NoPose,
        }
    }

    /// Dropped images by reason.
    pub fn drops(&self) -> &DropCounts {
        &self.drops
    }

    /// Images that wait.
    pub fn pending(&self) -> usize {
        self.waiting.iter().map(|s| s.frames.len()).sum()
    }

    fn drop_front(&mut self, reason: DropReason) {
        if let Some(set) = self.waiting.pop_front() {
            self.drops.add(reason, set.frames.len() as u64);
            self.dropped_ns.insert(reason, set.stamp_ns);
        }
    }
}
