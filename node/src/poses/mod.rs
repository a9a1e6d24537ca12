//! Vehicle poses over time, interpolated and never extrapolated.

mod check;
mod gate;
mod timeline;

pub use check::{MAX_POSITION_M, PoseCounts, PoseNote, PoseReject, REFUSE_QUAT_TOLERANCE, checked};
pub use gate::{PoseGate, PoseTiming};
pub(crate) use timeline::{MAX_FOLLOWED_GAP_SEC, Timeline, usual_interval_ns};
pub use timeline::{PoseLookup, PoseMissing};

use crate::config::SyncConfig;
use crate::rigid::Rigid;

/// Poses kept: a quarter of an hour at 100 Hz, some 8 MB. Recordings that hold all poses before all images are read
/// within it.
const MAX_POSES: usize = 100_000;

/// The vehicle's poses, `map_from_base`, by stamp.
#[derive(Debug)]
pub struct PoseBuffer {
    timeline: Timeline,
    counts: PoseCounts,
}

impl PoseBuffer {
    /// Uses `pose_gap_sec` and the clock-jump limits.
    pub fn new(config: &SyncConfig) -> Self {
        let timeline = Timeline::new(MAX_POSES, config.pose_gap_sec, config.jump_back_sec, config.jump_forward_sec);
        Self { timeline, counts: PoseCounts::default() }
    }

    /// Takes one pose; order does not matter. Non-finite, far-out and far-from-unit ones are refused.
    pub fn push(&mut self, stamp_ns: i64, map_from_base: Rigid) -> Result<PoseNote, PoseReject> {
        let outcome = self.timeline.push(stamp_ns, map_from_base);
        self.counts.count(&outcome);
        outcome
    }

    /// The pose at a stamp: position linear, rotation spherical, between the two poses around it, in f64.
    pub fn lookup(&self, stamp_ns: i64) -> PoseLookup {
        self.timeline.lookup(stamp_ns)
    }

    /// When the newest pose came and how often they come.
    pub fn timing(&self) -> PoseTiming {
        PoseTiming { latest_ns: self.timeline.latest_ns(), interval_sec: self.timeline.usual_interval_sec() }
    }

    /// The newest pose's stamp.
    pub fn latest_ns(&self) -> Option<i64> {
        self.timeline.latest_ns()
    }

    /// Poses kept.
    pub fn len(&self) -> usize {
        self.timeline.len()
    }

    /// True when there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The images' clock jumped and now reads `stamp_ns`: forgets the poses, unless they have jumped there already.
    pub fn follow_clock(&mut self, stamp_ns: i64) {
        if !self.timeline.same_time_base(stamp_ns) {
            self.timeline.clear();
        }
    }

    /// Forgets all poses.
    pub fn clear(&mut self) {
        self.timeline.clear();
    }

    /// What became of the poses so far.
    pub fn counts(&self) -> PoseCounts {
        self.counts
    }
}

#[cfg(test)]
mod tests;
