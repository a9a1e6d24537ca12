//! Choosing the timesteps of a window.

use std::collections::VecDeque;
use std::sync::Arc;

use serde::Serialize;

use super::{PosedSet, Window, camera_from_flu};
use crate::config::WindowConfig;
use crate::sync::clock::{seconds_between, signed_ns, unsigned_ns};

/// A set may come this part of `hop_sec` early and still make a step: stamps jitter, and a hop equal to the camera's
/// period must not lose every second set.
const HOP_TOLERANCE: f64 = 0.05;

/// What became of the sets.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct WindowCounts {
    /// Gave a window.
    pub windows: u64,
    /// Gave none: the epoch is too young to fill one.
    pub filling: u64,
    /// Gave none: too soon after the last one.
    pub hop: u64,
    /// Gave none: a timestep has no set near its place.
    pub gap: u64,
    /// Refused: not newer than the newest set of its epoch, or of an epoch that is over.
    pub out_of_order: u64,
    /// Refused: no reference camera, a different number of cameras than before, or a pose that is not finite.
    pub malformed: u64,
}

fn hop_ns(hop_sec: f64) -> u64 {
    unsigned_ns(hop_sec * (1.0 - HOP_TOLERANCE))
}

/// Builds windows from posed sets as they come.
#[derive(Debug)]
pub struct WindowBuilder<T> {
    timesteps: usize,
    stride_ns: i64,
    tolerance_ns: u64,
    hop_ns: u64,
    /// How long before each timestep a prior set is wanted; 0: none.
    prior_ns: i64,
    reference_camera: usize,
    pub(super) history: VecDeque<Arc<PosedSet<T>>>,
    epoch: Option<u32>,
    first_ns: i64,
    cameras: usize,
    last_step_ns: Option<i64>,
    counts: WindowCounts,
}

impl<T> WindowBuilder<T> {
    /// Anchored at `reference_camera`.
    pub fn new(config: &WindowConfig, reference_camera: usize) -> Self {
        Self {
            timesteps: config.timesteps.max(1),
            stride_ns: signed_ns(config.stride_sec).max(1),
            tolerance_ns: unsigned_ns(config.stride_sec * config.stride_tolerance),
            hop_ns: hop_ns(config.hop_sec),
            prior_ns: 0,
            reference_camera,
            history: VecDeque::new(),
            epoch: None,
            first_ns: 0,
            cameras: 0,
            last_step_ns: None,
            counts: WindowCounts::default(),
        }
    }

    /// The same, with a set about `prior_sec` before each timestep (half as much more or less) where there is one; 0: without.
    #[must_use]
    pub fn with_prior(mut self, prior_sec: f64) -> Self {
        self.prior_ns = signed_ns(prior_sec).max(0);
        self
    }

    /// Least time between two windows from now on, seconds.
    pub fn set_hop(&mut self, hop_sec: f64) {
        self.hop_ns = hop_ns(hop_sec);
    }

    /// Takes the next set; gives the window that ends at it, if there is one.
    pub fn push(&mut self, set: PosedSet<T>) -> Option<Window<T>> {
        if self.keep(set) { self.newest() } else { None }
    }

    /// The window that ends at the newest set, if there is one.
    pub fn newest(&mut self) -> Option<Window<T>> {
        let newest_ns = self.history.back()?.stamp_ns;
        if self.last_step_ns.is_some_and(|last_ns| newest_ns.abs_diff(last_ns) < self.hop_ns) {
            self.counts.hop += 1;
            return None;
        }
        if self.filling(newest_ns) {
            self.counts.filling += 1;
            return None;
        }
        let Some(picks) = self.pick(newest_ns) else {
            self.counts.gap += 1;
            return None;
        };
        self.counts.windows += 1;
        self.last_step_ns = Some(newest_ns);
        self.window(&picks)
    }

    /// The same windows over other cameras, anchored at `reference_camera` of them. `kept`: which of the cameras so far
    /// they are, so that the history goes on; none when there is a camera among them that the history lacks.
    pub fn with_cameras(mut self, reference_camera: usize, kept: Option<&[usize]>) -> Self
    where
        T: Clone,
    {
        self.reference_camera = reference_camera;
        match kept {
            Some(kept) => {
                for set in &mut self.history {
                    let frames = kept.iter().filter_map(|&c| set.frames.get(c).cloned()).collect();
                    *set = Arc::new(PosedSet { frames, ..**set });
                }
                self.cameras = kept.len();
            }
            None => self.reset(),
        }
        self
    }

    /// Forgets all sets, as a new epoch does.
    pub fn reset(&mut self) {
        self.history.clear();
        self.epoch = None;
        self.last_step_ns = None;
    }

    /// What became of the sets so far.
    pub fn counts(&self) -> WindowCounts {
        self.counts
    }

    /// Sets kept for windows to come.
    pub fn history(&self) -> usize {
        self.history.len()
    }

    /// Adds a set to the history and drops what no window can use any more; false when the set is refused.
    pub fn keep(&mut self, set: PosedSet<T>) -> bool {
        let finite = set.frames.iter().all(|f| f.map_from_camera.is_finite());
        if self.epoch != Some(set.epoch) {
            if self.epoch.is_some_and(|epoch| set.epoch < epoch) {
                self.counts.out_of_order += 1;
                return false;
            }
            if !(finite && self.reference_camera < set.frames.len()) {
                self.counts.malformed += 1;
                return false;
            }
            self.reset();
            self.epoch = Some(set.epoch);
            self.first_ns = set.stamp_ns;
            self.cameras = set.frames.len();
        } else if self.history.back().is_some_and(|newest| set.stamp_ns <= newest.stamp_ns) {
            self.counts.out_of_order += 1;
            return false;
        } else if !(finite && set.frames.len() == self.cameras) {
            self.counts.malformed += 1;
            return false;
        }
        let oldest_ns =
            self.place_ns(set.stamp_ns, self.timesteps - 1).saturating_sub(self.prior_ns + self.prior_ns / 2);
        self.history.push_back(Arc::new(set));
        let too_old = |stamp_ns: i64| stamp_ns < oldest_ns && stamp_ns.abs_diff(oldest_ns) > self.tolerance_ns;
        while self.history.front().is_some_and(|oldest| too_old(oldest.stamp_ns)) {
            self.history.pop_front();
        }
        true
    }

    /// Where timestep `k` back from the newest should lie.
    fn place_ns(&self, newest_ns: i64, k: usize) -> i64 {
        newest_ns.saturating_sub(self.stride_ns.saturating_mul(i64::try_from(k).unwrap_or(i64::MAX)))
    }

    /// Whether the oldest timestep's place lies before the epoch's first set: by more than the tolerance, or by so much that the
    /// next set, which comes at once, will have a place nearer to it. Uneven timesteps are no way to begin.
    fn filling(&self, newest_ns: i64) -> bool {
        let next = self.history.get(1).map(|second| second.stamp_ns.abs_diff(self.first_ns) / 2);
        let most_ns = next.map_or(self.tolerance_ns, |half_ns| half_ns.min(self.tolerance_ns));
        i128::from(self.first_ns) > i128::from(self.place_ns(newest_ns, self.timesteps - 1)) + i128::from(most_ns)
    }

    /// History indices of the window's timesteps, oldest first.
    fn pick(&self, newest_ns: i64) -> Option<Vec<usize>> {
        let mut picks = vec![self.history.len().checked_sub(1)?];
        for k in 1..self.timesteps {
            let place_ns = self.place_ns(newest_ns, k);
            let distance = |i: usize| self.history[i].stamp_ns.abs_diff(place_ns);
            // Only sets older than the timestep before can be meant, so the timesteps are distinct and in order.
            let older = *picks.last()?;
            let after = self.history.partition_point(|set| set.stamp_ns < place_ns).min(older);
            let candidates = after.checked_sub(1).into_iter().chain((after < older).then_some(after));
            let nearest = candidates.min_by_key(|&i| distance(i)).filter(|&i| distance(i) <= self.tolerance_ns)?;
            picks.push(nearest);
        }
        picks.reverse();
        Some(picks)
    }

    fn window(&self, picks: &[usize]) -> Option<Window<T>> {
        let steps: Vec<_> = picks.iter().map(|&i| Arc::clone(&self.history[i])).collect();
        let (first, newest) = (steps.first()?, steps.last()?);
        let map_from_anchor = first.frames.get(self.reference_camera)?.map_from_camera * camera_from_flu();
        let prior = if self.prior_ns > 0 { picks.iter().map(|&i| self.prior_of(i)).collect() } else { Vec::new() };
        let since_first = |stamp_ns| seconds_between(first.stamp_ns, stamp_ns);
        let time_sec = steps.iter().map(|s| s.frames.iter().map(|f| since_first(f.stamp_ns)).collect()).collect();
        Some(Window { epoch: newest.epoch, stamp_ns: newest.stamp_ns, map_from_anchor, time_sec, prior, steps })
    }

    /// The set nearest to where the prior of a set in the history should lie, if it is near enough.
    fn prior_of(&self, index: usize) -> Option<Arc<PosedSet<T>>> {
        let place_ns = self.history[index].stamp_ns.saturating_sub(self.prior_ns);
        let nearest = self.history.range(..index).min_by_key(|set| set.stamp_ns.abs_diff(place_ns))?;
        (nearest.stamp_ns.abs_diff(place_ns) <= self.prior_ns.unsigned_abs() / 2).then(|| Arc::clone(nearest))
    }
}
