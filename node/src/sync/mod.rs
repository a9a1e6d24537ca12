//! Images of several cameras brought together around a reference stamp.

mod cadence;
pub(crate) mod clock;
mod drops;
mod starvation;

use std::collections::{BTreeMap, VecDeque};

pub use drops::{DropCounts, DropReason};
pub use starvation::{StarvationReport, TopicReport};

use crate::config::SyncConfig;
use cadence::Cadence;
use clock::{ClockGuard, signed_ns, unsigned_ns};
use starvation::StarvationWatch;

/// One image per camera, taken at nearly the same time.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameSet<T> {
    /// Reference stamp: the stamp of the image in the middle of the set, nanoseconds.
    pub stamp_ns: i64,
    /// Moves on by one at every clock jump or reset; sets of different epochs never share a window.
    pub epoch: u32,
    /// Each image's own stamp (its camera's offset applied) and payload, in camera order.
    pub frames: Vec<(i64, T)>,
}

#[derive(Debug)]
struct Waiting<T> {
    /// Message time when it came in.
    since_ns: i64,
    item: T,
}

/// Brings images together, one per camera; no threads and no clock of its own.
///
/// Rule: a set is one image per camera, all within `slop_sec` of the reference, which is the stamp of one of them. It
/// is emitted the moment its last image arrives. Where that image allows several sets, the one with the smallest sum of
/// distances to its reference is taken, then the older reference. Reference stamps rise strictly within an epoch, and
/// so do the stamps of each camera; what is left behind an emitted set is dropped as incomplete. Images may arrive out
/// of order.
///
/// Every image that came in is in a set, in [`Synchronizer::drops`] or in [`Synchronizer::pending`], exactly once.
#[derive(Debug)]
pub struct Synchronizer<T> {
    slop_ns: u64,
    timeout_ns: i64,
    max_pending: usize,
    offsets_ns: Vec<i64>,
    /// Per camera, images that wait for the others, by stamp.
    waiting: Vec<BTreeMap<i64, Waiting<T>>>,
    /// Per camera, the stamp in the newest set.
    used_ns: Vec<Option<i64>>,
    reference_ns: Option<i64>,
    now_ns: Option<i64>,
    epoch: u32,
    clock: ClockGuard<(usize, T)>,
    ready: VecDeque<FrameSet<T>>,
    drops: DropCounts,
    images_in: u64,
    watch: StarvationWatch,
    cadence: Cadence,
}

impl<T> Synchronizer<T> {
    /// For `cameras` cameras; `offsets` (seconds, one per camera; missing ones are 0) are added to the stamps.
    pub fn new(cameras: usize, config: &SyncConfig, offsets: &[f64]) -> Self {
        Self {
            slop_ns: unsigned_ns(config.slop_sec),
            timeout_ns: signed_ns(config.timeout_sec),
            max_pending: config.max_pending,
            offsets_ns: (0..cameras).map(|i| offsets.get(i).map_or(0, |&sec| signed_ns(sec))).collect(),
            waiting: (0..cameras).map(|_| BTreeMap::new()).collect(),
            used_ns: vec![None; cameras],
            reference_ns: None,
            now_ns: None,
            epoch: 0,
            clock: ClockGuard::new(config.jump_back_sec, config.jump_forward_sec),
            ready: VecDeque::new(),
            drops: DropCounts::default(),
            images_in: 0,
            watch: StarvationWatch::new(cameras, config.starvation_sec, config.slop_sec),
            cadence: Cadence::new(cameras),
        }
    }

    /// One for other cameras that goes on counting where this one stopped, in the same epoch. What waits here is dropped
    /// as incomplete.
    pub fn with_cameras(mut self, cameras: usize, config: &SyncConfig, offsets: &[f64]) -> Self {
        self.drop_waiting(DropReason::Incomplete);
        self.drops.add(DropReason::Incomplete, self.clock.held() as u64);
        self.drops.add(DropReason::Incomplete, self.ready.iter().map(|s| s.frames.len() as u64).sum());
        let (epoch, drops, images_in) = (self.epoch, self.drops, self.images_in);
        Self { epoch, drops, images_in, ..Self::new(cameras, config, offsets) }
    }

    /// Takes one image. A camera index out of range is counted as [`DropReason::NoCalibration`].
    pub fn push(&mut self, camera: usize, stamp_ns: i64, item: T) {
        self.images_in += 1;
        let Some(&offset_ns) = self.offsets_ns.get(camera) else {
            self.drops.add(DropReason::NoCalibration, 1);
            return;
        };
        let stamp_ns = stamp_ns.saturating_add(offset_ns);
        self.watch.image(camera, stamp_ns);
        let admission = self.clock.admit(stamp_ns, (camera, item));
        if admission.stray.is_some() {
            self.drops.add(DropReason::ClockJump, 1);
        }
        if admission.jumped {
            self.start_anew();
        }
        for (stamp_ns, (camera, item)) in admission.accepted {
            self.place(camera, stamp_ns, item);
        }
    }

    /// Message time is now `now_ns` (the newest stamp of any input): images that waited longer than `timeout_sec` are
    /// dropped. The wait counts from the message time an image came in at, so that images which all come late, behind
    /// other inputs, are not lost. A time of another time base than the images' is ignored.
    pub fn advance(&mut self, now_ns: i64) {
        let newest_ns = self.clock.newest_ns().unwrap_or(now_ns);
        if !self.clock.near(newest_ns, now_ns) {
            return;
        }
        let before_ns = self.now_ns.filter(|&before_ns| self.clock.near(newest_ns, before_ns));
        let now_ns = before_ns.map_or(now_ns, |before_ns| before_ns.max(now_ns));
        self.now_ns = Some(now_ns);
        for (camera, waiting) in self.waiting.iter_mut().enumerate() {
            let before = waiting.len();
            waiting.retain(|_, w| w.since_ns.saturating_add(self.timeout_ns) >= now_ns);
            let left = before - waiting.len();
            self.drops.add(DropReason::Incomplete, left as u64);
            self.cadence.left(camera, left);
        }
    }

    /// The next set, oldest first.
    pub fn pop(&mut self) -> Option<FrameSet<T>> {
        self.ready.pop_front()
    }

    /// End of the recording: nothing more will come, so what waits is dropped. Complete sets stay to be popped.
    pub fn flush(&mut self) {
        for camera in 0..self.waiting.len() {
            for (stamp_ns, _) in std::mem::take(&mut self.waiting[camera]) {
                let reason = match self.reference_ns {
                    Some(last_ns) => self.cadence.at_edge(camera, stamp_ns.abs_diff(last_ns), self.edge_ns()),
                    None => DropReason::Incomplete,
                };
                self.drops.add(reason, 1);
            }
        }
        if self.clock.reset().is_some() {
            self.drops.add(DropReason::ClockJump, 1);
        }
    }

    /// Starts anew in the next epoch, as after a clock jump. Complete sets stay to be popped.
    pub fn reset(&mut self) {
        if self.clock.reset().is_some() {
            self.drops.add(DropReason::ClockJump, 1);
        }
        self.start_anew();
    }

    /// So long before the first set and after the last one, an image without a partner only says that the cameras did not begin
    /// or end together.
    fn edge_ns(&self) -> u64 {
        self.timeout_ns.unsigned_abs()
    }

    /// Dropped images by reason.
    pub fn drops(&self) -> &DropCounts {
        &self.drops
    }

    /// Images pushed so far.
    pub fn images_in(&self) -> u64 {
        self.images_in
    }

    /// Images inside: waiting, held on suspicion of a clock jump, or in complete sets not popped yet.
    pub fn pending(&self) -> usize {
        let waiting: usize = self.waiting.iter().map(BTreeMap::len).sum();
        waiting + self.clock.held() + self.ready.iter().map(|s| s.frames.len()).sum::<usize>()
    }

    /// The epoch sets are emitted in at present.
    pub fn epoch(&self) -> u32 {
        self.epoch
    }

    /// Once per `starvation_sec` without a set: what came in instead. Ask regularly, with any clock that moves on.
    pub fn starvation(&mut self, now_ns: i64) -> Option<StarvationReport> {
        self.watch.report(now_ns)
    }

    /// An image of a camera could not be read: it counts in the starvation report.
    pub fn unreadable(&mut self, camera: usize) {
        self.watch.unreadable(camera);
    }

    /// In one sentence why images found no partner, with the key that may change it; `names`: the image topics.
    pub fn why_incomplete(&self, names: &[String]) -> String {
        self.watch.why_incomplete(names)
    }

    fn start_anew(&mut self) {
        self.drop_waiting(DropReason::ClockJump);
        self.cadence.reset();
        self.used_ns.fill(None);
        self.reference_ns = None;
        self.now_ns = None;
        self.epoch = self.epoch.wrapping_add(1);
    }

    fn drop_waiting(&mut self, reason: DropReason) {
        for waiting in &mut self.waiting {
            self.drops.add(reason, waiting.len() as u64);
            waiting.clear();
        }
    }

    /// Puts one image among the waiting and emits the set it completes, if any.
    fn place(&mut self, camera: usize, stamp_ns: i64, item: T) {
        if self.used_ns[camera] == Some(stamp_ns) || self.waiting[camera].contains_key(&stamp_ns) {
            self.drops.add(DropReason::Duplicate, 1);
            return;
        }
        if self.floor_ns(camera).is_some_and(|floor_ns| stamp_ns <= floor_ns) {
            self.drops.add(DropReason::Late, 1);
            return;
        }
        self.cadence.image(camera, stamp_ns);
        let now_ns = self.now_ns.filter(|&now_ns| self.clock.near(stamp_ns, now_ns));
        let since_ns = now_ns.map_or(stamp_ns, |now_ns| now_ns.max(stamp_ns));
        self.waiting[camera].insert(stamp_ns, Waiting { since_ns, item });
        // Only sets with this image can be new: any other would have been emitted when its own last image came.
        if let Some((reference_ns, picks_ns)) = self.best_set(stamp_ns) {
            self.emit(reference_ns, &picks_ns);
        } else if self.waiting[camera].len() > self.max_pending {
            self.waiting[camera].pop_first();
            self.drops.add(DropReason::Overflow, 1);
        }
    }

    /// An image at or before this stamp can be in no set any more.
    fn floor_ns(&self, camera: usize) -> Option<i64> {
        let behind_ns = i64::try_from(self.slop_ns).unwrap_or(i64::MAX);
        let by_reference_ns = self.reference_ns.map(|r| r.saturating_sub(behind_ns));
        self.used_ns[camera].max(by_reference_ns)
    }

    /// The best set that has a reference within slop of `stamp_ns`: reference stamp and one stamp per camera.
    fn best_set(&self, stamp_ns: i64) -> Option<(i64, Vec<i64>)> {
        let slop_ns = i64::try_from(self.slop_ns).unwrap_or(i64::MAX);
        let (low_ns, high_ns) = (stamp_ns.saturating_sub(slop_ns), stamp_ns.saturating_add(slop_ns));
        let mut best: Option<(u128, i64, Vec<i64>)> = None;
        for &reference_ns in self.waiting.iter().flat_map(|w| w.range(low_ns..=high_ns).map(|(s, _)| s)) {
            if self.reference_ns.is_some_and(|last_ns| reference_ns <= last_ns) {
                continue;
            }
            let picks_ns: Option<Vec<i64>> = self.waiting.iter().map(|w| self.nearest(w, reference_ns)).collect();
            let Some(picks_ns) = picks_ns else { continue };
            let cost: u128 = picks_ns.iter().map(|p| u128::from(p.abs_diff(reference_ns))).sum();
            if best.as_ref().is_none_or(|(c, r, _)| (cost, reference_ns) < (*c, *r)) {
                best = Some((cost, reference_ns, picks_ns));
            }
        }
        best.map(|(_, reference_ns, picks_ns)| (reference_ns, picks_ns))
    }

    /// The stamp nearest to the reference within slop; the older of two equally near.
    fn nearest(&self, waiting: &BTreeMap<i64, Waiting<T>>, reference_ns: i64) -> Option<i64> {
        let before = waiting.range(..=reference_ns).next_back().map(|(&s, _)| s);
        let after = waiting.range(reference_ns..).next().map(|(&s, _)| s);
        let distance = |s: &i64| s.abs_diff(reference_ns);
        before.into_iter().chain(after).min_by_key(distance).filter(|s| distance(s) <= self.slop_ns)
    }

    fn emit(&mut self, reference_ns: i64, picks_ns: &[i64]) {
        let last_ns = self.reference_ns.replace(reference_ns);
        let mut frames = Vec::with_capacity(picks_ns.len());
        for (camera, &pick_ns) in picks_ns.iter().enumerate() {
            if let Some(waiting) = self.waiting[camera].remove(&pick_ns) {
                frames.push((pick_ns, waiting.item));
            }
            self.used_ns[camera] = Some(pick_ns);
        }
        for camera in 0..self.waiting.len() {
            if let Some(after_ns) = self.floor_ns(camera).and_then(|floor_ns| floor_ns.checked_add(1)) {
                let kept = self.waiting[camera].split_off(&after_ns);
                let left = std::mem::replace(&mut self.waiting[camera], kept);
                if last_ns.is_none() {
                    for &stamp_ns in left.keys() {
                        let before_ns = reference_ns.abs_diff(stamp_ns);
                        self.drops.add(self.cadence.at_edge(camera, before_ns, self.edge_ns()), 1);
                    }
                } else {
                    self.drops.add(DropReason::Incomplete, left.len() as u64);
                    self.cadence.left(camera, left.len());
                }
            }
        }
        // Before the first set nobody knows whether an image was surplus.
        let surplus = self.cadence.set(last_ns.map_or(u64::MAX, |ns| reference_ns.abs_diff(ns)));
        self.drops.recount(DropReason::Incomplete, DropReason::Surplus, surplus);
        self.watch.set_emitted();
        self.ready.push_back(FrameSet { stamp_ns: reference_ns, epoch: self.epoch, frames });
    }
}

#[cfg(test)]
mod tests;
