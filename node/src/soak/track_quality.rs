//! Trajectories against the truth: the figures of TAPVid-3D, beside constant velocity from the start and beside points
//! that follow the true flow of whatever is seen at their place.
//!
//! A trajectory starts on a road user; where that point of it is later follows from the road user's pose. (Limbs and
//! wheels move by themselves; what they add is counted as error for every method alike.)

use std::collections::HashMap;

use anyhow::Result;
use glam::{DVec3, Vec3};
use serde::Serialize;
use storm_model::metrics::track::{TrackPoint, TrackScores, track_scores};
use storm_render::world::{Drive, Mover};

use crate::rigid::Rigid;
use crate::tracks::LiveTrack;

use super::oracle::OracleSet;

/// Room around a road user's box in which a trajectory's start counts as on it, metres.
const BOX_ROOM_M: f64 = 0.2;
/// A true point counts as seen when the surface drawn there is no more than this before it, metres and part of depth.
const SEEN_M: f32 = 0.5;
const SEEN_PART: f32 = 0.02;

/// A trajectory's true point.
struct Truth {
    /// Road user.
    mover: u64,
    /// Where on it.
    local: DVec3,
    /// Start, for constant velocity.
    start_sec: f64,
    start: DVec3,
    velocity: DVec3,
    alive_sec: f64,
    stamps: usize,
    /// Where the true flow has taken it, when, and the last flow.
    flowed: DVec3,
    flowed_sec: f64,
    flow: DVec3,
}

/// How good the trajectories are.
#[derive(Debug, Clone, Default, Serialize)]
pub struct TrackFigures {
    /// Trajectories that started on a road user.
    pub judged: usize,
    /// Those that started on none.
    pub astray: usize,
    /// APD3D and OA.
    pub tracks: TrackScores,
    /// The same points moved on at the velocity of their first flow.
    pub constant_velocity: TrackScores,
    /// The same points chained by the true flow at the pixel they are seen at, by the last one while they are hidden.
    pub oracle_flow: TrackScores,
    /// Trajectories whose end lies in another road user's box than their start.
    pub switches: usize,
    /// Mean life, seconds.
    pub mean_life_sec: f64,
    /// Trajectories per road user that had any.
    pub per_mover: f64,
    /// Mean error of velocity against the road user's own, m/s.
    pub velocity_error_mps: f64,
}

/// Follows trajectories while they live.
pub struct TrackJudge {
    focal_px: f64,
    truths: HashMap<u32, Option<Truth>>,
    own: Vec<TrackPoint>,
    steady: Vec<TrackPoint>,
    flowed: Vec<TrackPoint>,
    switches: std::collections::HashSet<u32>,
    velocity_errors: (f64, usize),
}

fn inside(m: &Mover, p: DVec3) -> bool {
    m.map_from_object.inverse().transform_point3(p).abs().cmple(0.5 * m.size + BOX_ROOM_M).all()
}

impl TrackJudge {
    /// Nothing yet.
    pub fn new(drive: &Drive) -> Self {
        let k = drive.cameras()[0].intrinsics;
        Self {
            focal_px: f64::from(k.fx * k.fy).sqrt(),
            truths: HashMap::new(),
            own: Vec::new(),
            steady: Vec::new(),
            flowed: Vec::new(),
            switches: std::collections::HashSet::new(),
            velocity_errors: (0.0, 0),
        }
    }

    /// Takes the trajectories alive after a step.
    pub fn step(&mut self, drive: &Drive, set: &OracleSet, live: &[LiveTrack]) {
        let movers = drive.movers(set.time_sec);
        let by_id: HashMap<u64, &Mover> = movers.iter().map(|m| (m.id, m)).collect();
        let views: Vec<(Rigid, usize)> = set.poses.iter().enumerate().map(|(c, p)| (p.inverse(), c)).collect();
        for track in live {
            let end = track.end();
            let seen_now = end.stamp_ns == set.stamp_ns();
            if track.len() == 1 && seen_now {
                let mover = movers.iter().find(|m| inside(m, end.position_map));
                let truth = mover.map(|m| Truth {
                    mover: m.id,
                    local: m.map_from_object.inverse().transform_point3(end.position_map),
                    start_sec: set.time_sec,
                    start: end.position_map,
                    velocity: end.velocity_map_mps,
                    alive_sec: 0.0,
                    stamps: 0,
                    flowed: end.position_map,
                    flowed_sec: set.time_sec,
                    flow: views
                        .iter()
                        .find_map(|(to, c)| true_flow(drive, set, *c, to, end.position_map))
                        .unwrap_or(end.velocity_map_mps),
                });
                self.truths.insert(track.id, truth);
                continue;
            }
            let Some(Some(truth)) = self.truths.get_mut(&track.id) else { continue };
            let Some(mover) = by_id.get(&truth.mover) else { continue };
            let here = mover.map_from_object.transform_point3(truth.local);
            let since_sec = set.time_sec - truth.start_sec;
            let coasted = end.position_map
                + end.velocity_map_mps * crate::sync::clock::seconds_between(end.stamp_ns, set.stamp_ns());
            if seen_now {
                (truth.alive_sec, truth.stamps) = (since_sec, truth.stamps + 1);
                if movers.iter().any(|m| m.id != mover.id && inside(m, end.position_map))
                    && !inside(mover, end.position_map)
                {
                    self.switches.insert(track.id);
                }
                let arm = here - mover.map_from_object.translation;
                let velocity = mover.velocity_mps + DVec3::new(0.0, 0.0, mover.yaw_rate).cross(arm);
                self.velocity_errors.0 += (end.velocity_map_mps - velocity).length();
                self.velocity_errors.1 += 1;
            }
            // In the camera that sees the true point, else in the first.
            let (camera, visible) = views
                .iter()
                .find_map(|(camera_from_map, c)| sees(drive, set, *c, camera_from_map, here).map(|_| (*c, true)))
                .unwrap_or((0, false));
            let place = |p: DVec3| views[camera].0.apply(p).as_vec3().to_array();
            let point = TrackPoint { pred: place(coasted), truth: place(here), pred_visible: seen_now, visible };
            self.own.push(point);
            let steady = truth.start + truth.velocity * since_sec;
            self.steady.push(TrackPoint { pred: place(steady), ..point });
            truth.flowed += truth.flow * (set.time_sec - truth.flowed_sec);
            truth.flowed_sec = set.time_sec;
            let flow = views.iter().find_map(|(to, c)| true_flow(drive, set, *c, to, truth.flowed));
            truth.flow = flow.unwrap_or(truth.flow);
            self.flowed.push(TrackPoint { pred: place(truth.flowed), pred_visible: flow.is_some(), ..point });
        }
    }

    /// The figures.
    pub fn finish(self) -> Result<TrackFigures> {
        let judged: Vec<&Truth> = self.truths.values().flatten().filter(|t| t.stamps > 0).collect();
        let movers: std::collections::HashSet<u64> = judged.iter().map(|t| t.mover).collect();
        let n = judged.len().max(1) as f64;
        Ok(TrackFigures {
            judged: judged.len(),
            astray: self.truths.values().filter(|t| t.is_none()).count(),
            tracks: track_scores(&self.own, self.focal_px)?,
            constant_velocity: track_scores(&self.steady, self.focal_px)?,
            oracle_flow: track_scores(&self.flowed, self.focal_px)?,
            switches: self.switches.len(),
            mean_life_sec: judged.iter().map(|t| t.alive_sec).sum::<f64>() / n,
            per_mover: judged.len() as f64 / movers.len().max(1) as f64,
            velocity_error_mps: self.velocity_errors.0 / self.velocity_errors.1.max(1) as f64,
        })
    }
}

/// The pixel a camera sees a place at, if nothing hides it.
fn sees(drive: &Drive, set: &OracleSet, camera: usize, camera_from_map: &Rigid, p: DVec3) -> Option<usize> {
    let p: Vec3 = camera_from_map.apply(p).as_vec3();
    let k = drive.cameras()[camera].intrinsics;
    let (u, v) = k.project(p)?;
    let inside = u >= 0.0 && v >= 0.0 && u < k.width as f32 && v < k.height as f32;
    let pixel = || v as usize * k.width + u as usize;
    let depth = || set.frames[camera].depth[pixel()];
    (inside && depth() > 0.0 && depth() > p.z - SEEN_M - SEEN_PART * p.z).then(pixel)
}

/// The true flow of the moving surface a camera sees at a place, map axes, m/s.
fn true_flow(drive: &Drive, set: &OracleSet, camera: usize, camera_from_map: &Rigid, p: DVec3) -> Option<DVec3> {
    let pixel = sees(drive, set, camera, camera_from_map, p)?;
    let frame = &set.frames[camera];
    (frame.moving[pixel] > 0).then(|| Vec3::from(frame.flow[pixel]).as_dvec3())
}
