//! Point trajectories chained from scene flow (paper, appendix "Point trajectory estimation").
//!
//! Each live trajectory's end is moved by its own flow to the time of the new step; each new moving Gaussian is
//! connected to the nearest such place, and so on from step to step. Beyond the paper: the connection has a distance
//! gate that grows with the trajectory's own uncertainty, is one-to-one (mutually nearest) and wants the colours to
//! agree; a trajectory may miss its Gaussian for a short while and coasts on its flow meanwhile; new ones start at
//! moving Gaussians that none passes by, spaced so that one patch of surface does not start many. Only the newest
//! timestep of a window is taken, so a point that several windows see is one point.

mod grid;
mod live;
mod nearest;
mod spacing;
mod track;

use std::borrow::Cow;

use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;

use crate::config::TracksConfig;
use crate::sync::clock::seconds_between;
use grid::Grid;
use nearest::mutual_nearest;
use spacing::Spacing;

pub use live::LiveTrack;
pub use track::{Track, TrackPoint, TrackSample};

/// Speeds beyond this are a mistake of the network, m/s; the Gaussian is left out and counted.
const MAX_SPEED_MPS: f64 = 200.0;

/// Trajectories or points one task takes at least: fewer are not worth a thread.
const MIN_TRACKS: usize = 1024;

/// Ended trajectories one task puts together at least.
const MIN_ENDED: usize = 32;

/// No point.
const NONE: u32 = u32::MAX;

/// What became of points and trajectories.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct TrackCounts {
    /// Trajectories started.
    pub born: u64,
    /// Trajectories ended that are long enough to be written.
    pub finished: u64,
    /// Trajectories ended before `min_points`; not written.
    pub too_short: u64,
    /// Points that continued a trajectory.
    pub continued: u64,
    /// Points near enough to continue a trajectory, but of another colour.
    pub unlike: u64,
    /// Points that could have started a trajectory but for `max_active`; also those too near to others, once it is reached.
    pub no_room: u64,
    /// Points refused: not finite, or absurdly fast.
    pub rejected: u64,
    /// Steps refused: stamp not newer than the last.
    pub out_of_order: u64,
}

/// Chains trajectories from step to step.
#[derive(Debug)]
pub struct Tracker {
    config: TracksConfig,
    epoch: Option<u32>,
    stamp_ns: i64,
    next_id: u32,
    /// In order of id.
    live: Vec<LiveTrack>,
    finished: Vec<Track>,
    counts: TrackCounts,
}

impl Tracker {
    /// With no trajectories.
    pub fn new(config: &TracksConfig) -> Self {
        let (live, finished) = (Vec::new(), Vec::new());
        let counts = TrackCounts::default();
        Self { config: config.clone(), epoch: None, stamp_ns: 0, next_id: 0, live, finished, counts }
    }

    /// Takes one step: the moving Gaussians of its newest timestep, at `stamp_ns`. A new epoch ends all trajectories.
    pub fn step(&mut self, stamp_ns: i64, epoch: u32, points: &[TrackPoint]) {
        if self.epoch != Some(epoch) {
            self.end_where(|_| true);
            self.epoch = Some(epoch);
        } else if stamp_ns <= self.stamp_ns {
            self.counts.out_of_order += 1;
            return;
        }
        self.stamp_ns = stamp_ns;
        let usable = usable(points);
        self.counts.rejected += (points.len() - usable.len()) as u64;

        let (live, config) = (&self.live, &self.config);
        let continued = mutual_nearest(
            (live.len(), |i| (live[i].predicted(stamp_ns), live[i].gate_m(stamp_ns, config))),
            (usable.len(), |j| usable[j].position_map),
            config.gate_m,
        );
        self.go_on(stamp_ns, &usable, &continued);
        let bridge_sec = self.config.bridge_sec;
        self.end_where(|t| seconds_between(t.end().stamp_ns, stamp_ns) > bridge_sec);
        if self.config.min_points <= live::PIECE_POINTS {
            self.finished.extend(self.live.iter_mut().filter_map(LiveTrack::cut));
        }
        self.start(stamp_ns, &usable, &continued);
    }

    /// Trajectories that have ended since the last call and are long enough, and pieces of very long ones, in order of
    /// id.
    pub fn drain(&mut self) -> Vec<Track> {
        self.finished.sort_by_key(|t| t.id);
        std::mem::take(&mut self.finished)
    }

    /// End of the recording: ends all trajectories and gives those not drained yet.
    pub fn finish(&mut self) -> Vec<Track> {
        self.end_where(|_| true);
        self.drain()
    }

    /// Trajectories alive, coasting ones included, in order of id.
    pub fn live(&self) -> &[LiveTrack] {
        &self.live
    }

    /// What became of points and trajectories so far.
    pub fn counts(&self) -> TrackCounts {
        self.counts
    }

    /// Takes each point into the trajectory it continues, if it looks like it.
    fn go_on(&mut self, stamp_ns: i64, points: &[TrackPoint], continued: &[Option<usize>]) {
        let mut next = vec![NONE; self.live.len()];
        for (j, track) in continued.iter().enumerate() {
            if let Some(slot) = track.and_then(|i| next.get_mut(i)) {
                *slot = j as u32;
            }
        }
        let config = &self.config;
        let took = |(track, j): (&mut LiveTrack, &u32)| match points.get(*j as usize) {
            Some(point) if track.looks_like(point, config) => {
                track.go_on(stamp_ns, point);
                (1, 0)
            }
            Some(_) => (0, 1),
            None => (0, 0),
        };
        let (taken, unlike) = self
            .live
            .par_iter_mut()
            .zip(&next)
            .with_min_len(MIN_TRACKS)
            .map(took)
            .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        self.counts.continued += taken;
        self.counts.unlike += unlike;
    }

    /// Memory held, bytes.
    pub fn bytes(&self) -> usize {
        let live: usize = self.live.iter().map(LiveTrack::bytes).sum();
        let ended: usize = self.finished.iter().map(|t| t.points.capacity() * size_of::<TrackSample>()).sum();
        let lists = self.live.capacity() * size_of::<LiveTrack>() + self.finished.capacity() * size_of::<Track>();
        live + ended + lists
    }

    /// Starts trajectories at the points that continue none, the most opaque first.
    fn start(&mut self, stamp_ns: i64, points: &[TrackPoint], continued: &[Option<usize>]) {
        let Some(origin) = points.first().map(|p| p.position_map) else { return };
        let fresh = |p: &TrackPoint| {
            let opaque = f64::from(p.opacity) >= self.config.min_opacity;
            opaque && p.may_start && p.velocity_map_mps.length() >= self.config.min_speed_mps
        };
        let wanted = points.par_iter().zip(continued).with_min_len(MIN_TRACKS).filter(|(p, c)| c.is_none() && fresh(p));
        let mut candidates: Vec<&TrackPoint> = wanted.map(|(p, _)| p).collect();
        if candidates.is_empty() || self.live.len() >= self.config.max_active {
            self.counts.no_room += candidates.len() as u64;
            return;
        }
        // Stable, so points equally opaque stay in the caller's order.
        candidates.par_sort_by(|a, b| b.opacity.total_cmp(&a.opacity));
        // In a cube of twice the spacing one sees at least that far, whichever of its corners one is nearest to.
        let spacing_m = self.config.spacing_m;
        let local = |p: DVec3| (p - origin).as_vec3().to_array();
        let ends: Vec<_> =
            self.live.par_iter().with_min_len(MIN_TRACKS).map(|t| local(t.predicted(stamp_ns))).collect();
        let standing = Grid::new(&ends, 2.0 * spacing_m as f32);
        let limit2 = (spacing_m * spacing_m) as f32;
        let apart = |p: &&&TrackPoint| standing.beside(&local(p.position_map), limit2).0.1 >= limit2;
        let mut taken = Spacing::new(spacing_m, origin, candidates.len());
        // Piece by piece: often there is room for few, and nobody needs to know about the others.
        for (i, some) in candidates.chunks(MIN_TRACKS).enumerate() {
            let some: Vec<&&TrackPoint> = some.par_iter().with_min_len(MIN_TRACKS / 8).filter(apart).collect();
            for (k, p) in some.iter().enumerate() {
                if taken.claim(p.position_map) {
                    self.live.push(LiveTrack::new(self.next_id, stamp_ns, p));
                    self.next_id = self.next_id.wrapping_add(1);
                    self.counts.born += 1;
                }
                if self.live.len() >= self.config.max_active {
                    let after = candidates.len().saturating_sub((i + 1) * MIN_TRACKS);
                    self.counts.no_room += (after + some.len() - k - 1) as u64;
                    return;
                }
            }
        }
    }

    /// Ends all trajectories; the next step starts new ones.
    pub fn end_all(&mut self) {
        self.end_where(|_| true);
        self.epoch = None;
    }

    fn end_where(&mut self, ended: impl Fn(&LiveTrack) -> bool) {
        let (all, min_points) = (self.live.len(), self.config.min_points);
        let mut long: Vec<LiveTrack> = self.live.extract_if(.., |t| ended(t)).collect();
        long.retain(|t| t.len() >= min_points);
        self.counts.finished += long.len() as u64;
        self.counts.too_short += (all - self.live.len() - long.len()) as u64;
        self.finished.par_extend(long.into_par_iter().with_min_len(MIN_ENDED).map(LiveTrack::ended));
    }
}

/// The points without those that make no sense; mostly all of them.
fn usable(points: &[TrackPoint]) -> Cow<'_, [TrackPoint]> {
    if points.par_iter().with_min_len(MIN_TRACKS).all(plausible) {
        return Cow::Borrowed(points);
    }
    Cow::Owned(points.iter().copied().filter(plausible).collect())
}

fn plausible(p: &TrackPoint) -> bool {
    let finite = p.position_map.is_finite() && p.velocity_map_mps.is_finite() && p.opacity.is_finite();
    let finite = finite && p.color01.iter().chain([&p.distance_m]).all(|x| x.is_finite());
    finite
        && p.velocity_map_mps.length_squared() <= MAX_SPEED_MPS * MAX_SPEED_MPS
        && p.position_map.length() <= crate::poses::MAX_POSITION_M
}

#[cfg(test)]
mod tests;
