//! What overlapping windows say of each other.
//!
//! Windows overlap: the picture taken at one moment is seen by up to as many windows as a window has timesteps, and a
//! window shows the same surfaces at several moments. Three questions are asked of that. How far do predictions of one
//! and the same pixel differ (`seen`)? That is how wrong the network is, and sets the gates of the other two. Is a surface
//! that is said to move found at its place, or where it would have been, in the pictures of the other moments
//! (`hypotheses`)? And what do its neighbours and its motion group say where that does not settle it (`vote`)?
//!
//! A surface found where it stood, and not where it would have been, stands: its velocity is taken away before anybody
//! sees it. So a network that takes part of a fast ego motion for the scene's does not make the street move. The
//! other way round nothing is invented: what the network says stands is left standing.

mod hypotheses;
mod seen;
#[cfg(test)]
mod tests;
mod vote;

use std::collections::VecDeque;

use glam::{Affine3A, Vec3};
use rayon::prelude::*;
use serde::Serialize;
use storm_model::scene::Scene;
use storm_render::Intrinsics;

use crate::config::OverlapConfig;
use crate::engine::select::{MOVING_MPS, speed_mps};
use crate::rigid::Rigid;
use crate::window::relative;

use hypotheses::{Gates, Picture, Verdict, judge};
use seen::{Differences, Seen};

/// A pixel less opaque than this shows the sky.
const SKY_OPACITY: f32 = 0.1;
/// Share of a new window in what is known of the network's errors.
const LEARN: f32 = 0.2;
/// Gates are this many times the median difference: 3 standard deviations of a normal error (0.6745 of one is the
/// median's).
const GATE_MEDIANS: f32 = 4.5;
/// A depth gate beyond this part of the depth would tell nothing apart.
const WIDEST_GATE: f32 = 0.25;

/// Where and when a scene's pictures were taken.
#[derive(Debug, Clone, Copy)]
pub struct OverlapLook<'a> {
    /// Stamp per timestep, nanoseconds, rising; a picture that comes again has the same.
    pub stamps_ns: &'a [i64],
    /// Windows of different epochs do not overlap.
    pub epoch: u32,
    /// The window's anchor in the map.
    pub map_from_anchor: &'a Rigid,
    /// One per camera, at the scene's picture size.
    pub cameras: &'a [Intrinsics],
    /// map_from_camera per picture, timestep by timestep.
    pub poses: &'a [Rigid],
}

/// How far a window's Gaussians are borne out, one number each, 0 to 1: agreeing looks (and one) of all looks (and two), so
/// 0.5 where nothing is known.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Agreement {
    /// Whether the surface is where it is said to be.
    pub geometry: Vec<f32>,
    /// Whether it moves as it is said to.
    pub velocity: Vec<f32>,
}

/// What was found over a run.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct OverlapCounts {
    /// Gaussians of newest timesteps that the network said move.
    pub moving: u64,
    /// Those of them that the overlap says stand; their velocity was taken away.
    pub stilled: u64,
    /// Pixels that were predicted before.
    pub compared: u64,
    /// Median difference of depth between predictions of one pixel, as a part of the depth; the newest windows'.
    pub depth_part: f32,
    /// Median difference of velocity between them where something is said to move, m/s.
    pub velocity_mps: f32,
}

/// Compares each window with those before it.
#[derive(Debug)]
pub struct Overlap {
    config: OverlapConfig,
    epoch: Option<u32>,
    /// Oldest first.
    seen: VecDeque<Seen>,
    counts: OverlapCounts,
}

impl Overlap {
    /// Nothing seen yet.
    pub fn new(config: &OverlapConfig) -> Self {
        Self { config: config.clone(), epoch: None, seen: VecDeque::new(), counts: OverlapCounts::default() }
    }

    /// Forgets what was seen; the counts stay.
    pub fn reset(&mut self) {
        self.seen.clear();
        self.epoch = None;
    }

    /// What was found so far.
    pub fn counts(&self) -> OverlapCounts {
        self.counts
    }

    /// Memory held, bytes.
    pub fn bytes(&self) -> usize {
        self.seen.iter().map(Seen::bytes).sum()
    }

    /// Compares a window with what is known and takes away the velocities that the overlap contradicts. Anything whose
    /// sizes do not fit together is left as it is.
    pub fn step(&mut self, scene: &mut Scene, look: &OverlapLook) -> Agreement {
        let shape = scene.shape;
        let pictures = shape.timesteps * shape.cameras;
        let fits = look.stamps_ns.len() == shape.timesteps
            && look.poses.len() == pictures
            && look.cameras.len() == shape.cameras
            && scene.gaussians.len() == shape.len()
            && pictures > 0;
        if !(fits && self.config.enabled) {
            return Agreement::default();
        }
        if self.epoch != Some(look.epoch) {
            self.seen.clear();
            self.epoch = Some(look.epoch);
        }
        // Later windows begin later.
        let first_ns = look.stamps_ns[0];
        self.seen.retain(|s| s.stamp_ns() >= first_ns);

        let now = pictures_of(scene, look);
        let differences = self.compare(scene, look, &now);
        self.learn(&differences);
        let gate_part = self.gate_part();
        let gates = Gates {
            depth_part: gate_part,
            velocity_mps: self.counts.velocity_mps,
            color_step: self.config.max_color_step as f32,
        };
        let verdicts = judge(scene, &now, &gates);
        let stilled = vote::stilled(scene, &verdicts, &now);
        let agreement = self.agreement(&verdicts, &stilled, &differences, gate_part);
        self.take_away(scene, &stilled);
        agreement
    }

    /// Compares with, and enters into, what was predicted for the same pixels. One per picture.
    fn compare(&mut self, scene: &Scene, look: &OverlapLook, now: &[Picture]) -> Vec<Differences> {
        let shape = scene.shape;
        let map_from_anchor = look.map_from_anchor.rotation.as_quat();
        let mut all = Vec::with_capacity(now.len());
        for (t, &stamp_ns) in look.stamps_ns.iter().enumerate() {
            let at = self.seen.partition_point(|s| s.stamp_ns() < stamp_ns);
            let known = self.seen.get(at).is_some_and(|s| s.stamp_ns() == stamp_ns && s.fits(shape));
            if !known {
                self.seen.insert(at, Seen::new(stamp_ns, shape));
            }
            let pictures = &now[t * shape.cameras..(t + 1) * shape.cameras];
            let first = shape.picture(t, 0).start;
            all.extend(self.seen[at].compare(scene, first, pictures, map_from_anchor));
        }
        all
    }

    /// Follows the network's errors, slowly: one odd window changes little.
    fn learn(&mut self, differences: &[Differences]) {
        let mut depth: Vec<f32> = Vec::new();
        let mut velocity: Vec<f32> = Vec::new();
        for d in differences {
            self.counts.compared += d.known as u64;
            depth.extend(d.depths());
            velocity.extend(d.velocities());
        }
        for (known, mut new) in [(&mut self.counts.depth_part, depth), (&mut self.counts.velocity_mps, velocity)] {
            if !new.is_empty() {
                let middle = new.len() / 2;
                let (_, median, _) = new.select_nth_unstable_by(middle, f32::total_cmp);
                *known = if *known > 0.0 { *known + LEARN * (*median - *known) } else { *median };
            }
        }
    }

    /// Depths that differ by less than this part of the depth are the same surface.
    fn gate_part(&self) -> f32 {
        let least = self.config.depth_gate as f32;
        (GATE_MEDIANS * self.counts.depth_part).max(least).min(WIDEST_GATE.max(least))
    }

    fn agreement(
        &self,
        verdicts: &[Verdict],
        stilled: &[bool],
        differences: &[Differences],
        gate_part: f32,
    ) -> Agreement {
        let velocity_gate_mps = (GATE_MEDIANS * self.counts.velocity_mps).max(MOVING_MPS);
        let pixels = differences.first().map_or(1, |d| d.depth_part.len().max(1));
        let share = |agree: f32, against: f32| (1.0 + agree) / (2.0 + agree + against);
        verdicts
            .par_iter()
            .zip(stilled)
            .enumerate()
            .with_min_len(4096)
            .map(|(i, (verdict, &stilled))| {
                let d = &differences[i / pixels];
                let (depth, velocity) = (d.depth_part[i % pixels], d.velocity_mps[i % pixels]);
                // Never predicted before: infinite, for neither side.
                let look = |difference: f32, gate: f32| match difference.is_finite() {
                    true if difference <= gate => (1.0, 0.0),
                    true => (0.0, 1.0),
                    false => (0.0, 0.0),
                };
                let (near, off) = look(depth, gate_part);
                let (same, other) = look(velocity, velocity_gate_mps);
                let looks = if stilled || !verdict.claimed { verdict.still } else { verdict.moves };
                let (agree, against) = (f32::from(looks.there), f32::from(looks.through));
                // What was said of a velocity that was taken away counts no more.
                let (same, other) = if stilled { (0.0, 0.0) } else { (same, other) };
                (share(near + agree, off + against), share(same + agree, other + against))
            })
            .unzip()
            .into()
    }

    fn take_away(&mut self, scene: &mut Scene, stilled: &[bool]) {
        let newest = scene.shape.picture(scene.shape.timesteps - 1, 0).start;
        for i in newest..scene.gaussians.len() {
            self.counts.moving += u64::from(speed_mps(scene, i) >= MOVING_MPS);
        }
        let g = &mut scene.gaussians;
        for (i, _) in stilled.iter().enumerate().filter(|(_, s)| **s) {
            self.counts.stilled += u64::from(i >= newest);
            g.velocity_backward[i] = [0.0; 3];
            g.velocity_forward[i] = [0.0; 3];
        }
    }
}

impl From<(Vec<f32>, Vec<f32>)> for Agreement {
    fn from((geometry, velocity): (Vec<f32>, Vec<f32>)) -> Self {
        Self { geometry, velocity }
    }
}

/// The scene's pictures as depth images of themselves, timestep by timestep.
fn pictures_of(scene: &Scene, look: &OverlapLook) -> Vec<Picture> {
    let shape = scene.shape;
    (0..shape.timesteps * shape.cameras)
        .into_par_iter()
        .map(|k| {
            let camera = k % shape.cameras;
            let camera_from_anchor: Affine3A = relative(look.map_from_anchor, &look.poses[k]).inverse().to_f32();
            let range = shape.picture(k / shape.cameras, camera);
            let g = &scene.gaussians;
            let depth = range
                .clone()
                .map(|i| {
                    let z = camera_from_anchor.transform_point3(Vec3::from(g.means[i])).z;
                    // The sky is without end; what is neither sky nor surface says nothing.
                    let opacity = g.opacities[i];
                    if !scene.is_valid(i) {
                        // Nobody saw it: it is no sky.
                        f32::NAN
                    } else if opacity >= crate::engine::select::SURFACE_OPACITY && z > 0.0 {
                        z
                    } else if opacity <= SKY_OPACITY {
                        f32::INFINITY
                    } else {
                        f32::NAN
                    }
                })
                .collect();
            let time_sec = g.time_sec[range.start];
            Picture { camera_from_anchor, intrinsics: look.cameras[camera], depth, first: range.start, time_sec }
        })
        .collect()
}
