//! A rigid transform over time: sorted samples, bounded, interpolated and never extrapolated.

use std::collections::VecDeque;

use super::check::{PoseNote, PoseReject, checked};
use crate::rigid::Rigid;
use crate::sync::clock::{ClockGuard, seconds_between, unsigned_ns};

/// Why there is no pose for a stamp, and never will be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PoseMissing {
    /// The stamp is older than the oldest pose.
    BeforeFirst {
        /// The oldest pose's stamp.
        first_ns: i64,
    },
    /// The poses on both sides are too far apart.
    GapTooWide {
        /// Their distance, seconds.
        gap_sec: f64,
    },
}

/// The pose at a stamp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PoseLookup {
    /// Interpolated, or exact.
    At(Rigid),
    /// The stamp is newer than the newest pose; ask again when there are more.
    Wait,
    /// There is none and waiting does not help.
    Never(PoseMissing),
}

/// The widest gap that is interpolated across because the samples themselves come no faster, seconds. At 15 m/s a curve of 50 m
/// radius is 0.6 m from its chord by then; a larger gap has to be asked for with `sync.pose_gap_sec`.
pub(crate) const MAX_FOLLOWED_GAP_SEC: f64 = 2.0;

/// Intervals on each side of a gap that tell how often samples come.
const RATE_INTERVALS: usize = 8;

/// A gap may be this many times the usual interval and still be the samples' own rate.
const RATE_SLACK: f64 = 1.5;

/// Samples of one transform, sorted by stamp.
#[derive(Debug)]
pub(crate) struct Timeline {
    samples: VecDeque<(i64, Rigid)>,
    capacity: usize,
    gap_ns: u64,
    clock: ClockGuard<Rigid>,
}

impl Timeline {
    /// Keeps at most `capacity` samples and interpolates across at most `gap_sec`.
    pub fn new(capacity: usize, gap_sec: f64, jump_back_sec: f64, jump_forward_sec: f64) -> Self {
        Self {
            samples: VecDeque::new(),
            capacity: capacity.max(2),
            gap_ns: unsigned_ns(gap_sec),
            clock: ClockGuard::new(jump_back_sec, jump_forward_sec),
        }
    }

    /// Takes one sample; out of order is fine.
    pub fn push(&mut self, stamp_ns: i64, transform: Rigid) -> Result<PoseNote, PoseReject> {
        let (transform, note) = checked(&transform)?;
        let admission = self.clock.admit(stamp_ns, transform);
        if admission.jumped {
            self.samples.clear();
        }
        if admission.accepted.is_empty() {
            return Ok(PoseNote::Held);
        }
        let mut result = Ok(note);
        for (stamp_ns, transform) in admission.accepted {
            // The last one is the sample given here; the outcome reported is its.
            result = self.insert(stamp_ns, transform).map(|fresh| if fresh { note } else { PoseNote::Duplicate });
        }
        if admission.jumped { result.map(|_| PoseNote::ClockJump) } else { result }
    }

    /// False when there is a sample with this stamp already; the first one stays.
    fn insert(&mut self, stamp_ns: i64, transform: Rigid) -> Result<bool, PoseReject> {
        let at = self.samples.partition_point(|(s, _)| *s < stamp_ns);
        if self.samples.get(at).is_some_and(|(s, _)| *s == stamp_ns) {
            return Ok(false);
        }
        if self.samples.len() < self.capacity {
            self.samples.insert(at, (stamp_ns, transform));
        } else if at == 0 {
            return Err(PoseReject::TooOld);
        } else {
            self.samples.pop_front();
            self.samples.insert(at - 1, (stamp_ns, transform));
        }
        Ok(true)
    }

    /// The transform at a stamp, linear in position and spherical in rotation between the two samples around it.
    pub fn lookup(&self, stamp_ns: i64) -> PoseLookup {
        let at = self.samples.partition_point(|(s, _)| *s < stamp_ns);
        let Some(&(after_ns, after)) = self.samples.get(at) else { return PoseLookup::Wait };
        if after_ns == stamp_ns {
            return PoseLookup::At(after);
        }
        let Some(&(before_ns, before)) = at.checked_sub(1).and_then(|i| self.samples.get(i)) else {
            return PoseLookup::Never(PoseMissing::BeforeFirst { first_ns: after_ns });
        };
        let gap_ns = after_ns.abs_diff(before_ns);
        if gap_ns > self.gap_ns && gap_ns > self.followed_ns(at) {
            return PoseLookup::Never(PoseMissing::GapTooWide { gap_sec: seconds_between(before_ns, after_ns) });
        }
        let alpha = stamp_ns.abs_diff(before_ns) as f64 / gap_ns as f64;
        PoseLookup::At(before.interpolate(&after, alpha))
    }

    /// The gap allowed by how often samples come around sample `at`: no more than [`MAX_FOLLOWED_GAP_SEC`].
    fn followed_ns(&self, at: usize) -> u64 {
        let from = at.saturating_sub(RATE_INTERVALS + 1);
        let to = at.saturating_add(RATE_INTERVALS + 1).min(self.samples.len());
        let usual_ns = usual_interval_ns(self.samples.range(from..to).map(|(s, _)| *s)).unwrap_or(0);
        let allowed_ns = (usual_ns as f64 * RATE_SLACK) as u64;
        allowed_ns.min(unsigned_ns(MAX_FOLLOWED_GAP_SEC))
    }

    /// How often the newest samples come, seconds; none with fewer than two.
    pub fn usual_interval_sec(&self) -> Option<f64> {
        let from = self.samples.len().saturating_sub(2 * RATE_INTERVALS + 1);
        Some(usual_interval_ns(self.samples.range(from..).map(|(s, _)| *s))? as f64 * 1e-9)
    }

    /// The newest sample's stamp.
    pub fn latest_ns(&self) -> Option<i64> {
        self.samples.back().map(|(s, _)| *s)
    }

    /// The oldest sample kept.
    pub fn first(&self) -> Option<Rigid> {
        self.samples.front().map(|(_, transform)| *transform)
    }

    /// Samples kept.
    pub fn len(&self) -> usize {
        self.samples.len()
    }

    /// True when `stamp_ns` is of the time base of these samples (or there are none).
    pub fn same_time_base(&self, stamp_ns: i64) -> bool {
        self.latest_ns()
            .is_none_or(|latest_ns| self.clock.near(latest_ns, stamp_ns) || self.clock.near(stamp_ns, latest_ns))
    }

    /// Forgets everything.
    pub fn clear(&mut self) {
        self.samples.clear();
        self.clock.reset();
    }
}

/// The median of the intervals between rising stamps (of an even number the smaller middle one); none with fewer than two.
pub(crate) fn usual_interval_ns(stamps_ns: impl Iterator<Item = i64>) -> Option<u64> {
    let mut before_ns = None;
    let mut intervals: Vec<u64> =
        stamps_ns.filter_map(|ns| before_ns.replace(ns).map(|earlier: i64| ns.abs_diff(earlier))).collect();
    let middle = intervals.len().checked_sub(1)? / 2;
    Some(*intervals.select_nth_unstable(middle).1)
}
