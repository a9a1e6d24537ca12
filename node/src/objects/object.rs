//! One moving object: filter, frame, box, look.

use std::collections::VecDeque;

use glam::{DMat3, DQuat, DVec3};

use crate::config::ObjectsConfig;
use crate::map::{ObjectModel, ObjectSample};
use crate::rigid::Rigid;
use crate::sync::clock::seconds_between;

use super::cluster::{Cluster, ObjectPoint};

/// How fast velocities change, standard deviation per axis, m/s^2: hard braking is 8, usual driving 1 to 2.
const ACCELERATION_MPS2: f64 = 3.0;
/// What a mean flow is off by, however many points agree on it, m/s.
const FLOW_SIGMA_MPS: f64 = 0.3;
/// Speed from which the direction of travel is the heading, m/s.
const HEADING_MPS: f64 = 1.0;
/// Share of a group's centre in the place: what one sees of an object changes with the view, its flow does not.
const CENTER_SHARE: f64 = 0.2;
/// Share of a new view in the remembered offset of the seen part's centre.
const OFFSET_SHARE: f64 = 0.1;
/// An acceleration is the slope of the velocities over this long, and is not given before there are this many seconds.
const SLOPE_SEC: f64 = 1.0;
const SLOPE_LEAST_SEC: f64 = 0.45;
/// Poses kept: a minute at 10 Hz.
const HISTORY: usize = 600;

/// Where an object was at a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObjectState {
    /// The step's stamp, nanoseconds.
    pub stamp_ns: i64,
    /// Its frame: x along the direction of travel, z up.
    pub map_from_object: Rigid,
    /// Velocity in map axes, m/s.
    pub velocity_mps: DVec3,
}

/// A moving object.
#[derive(Debug, Clone)]
pub struct MovingObject {
    /// Unique within a run, in order of birth.
    pub id: u32,
    states: VecDeque<ObjectState>,
    born_ns: i64,
    covariance: DMat3,
    /// The seen part's centre in the object's frame.
    offset: DVec3,
    model: ObjectModel,
    steps: usize,
}

fn heading(velocity: DVec3) -> Option<DQuat> {
    (velocity.truncate().length() >= HEADING_MPS).then(|| DQuat::from_rotation_z(velocity.y.atan2(velocity.x)))
}

impl MovingObject {
    pub(super) fn new(id: u32, stamp_ns: i64, group: &Cluster) -> Self {
        let rotation = heading(group.velocity).unwrap_or(DQuat::IDENTITY);
        let state =
            ObjectState { stamp_ns, map_from_object: Rigid::new(rotation, group.center), velocity_mps: group.velocity };
        Self {
            id,
            states: VecDeque::from([state]),
            born_ns: stamp_ns,
            covariance: group.covariance + DMat3::from_diagonal(DVec3::splat(FLOW_SIGMA_MPS * FLOW_SIGMA_MPS)),
            offset: DVec3::ZERO,
            model: ObjectModel::default(),
            steps: 0,
        }
    }

    fn last(&self) -> ObjectState {
        // There is one from the start, and the last is never taken away.
        self.states.back().copied().unwrap_or(ObjectState {
            stamp_ns: self.born_ns,
            map_from_object: Rigid::IDENTITY,
            velocity_mps: DVec3::ZERO,
        })
    }

    /// Where the seen part's centre should be, and how far off its place (m) and velocity (m/s) may be.
    pub(super) fn expectation(&self, stamp_ns: i64, config: &ObjectsConfig) -> (DVec3, f64, f64) {
        let last = self.last();
        let dt_sec = seconds_between(last.stamp_ns, stamp_ns).max(0.0);
        let center = last.map_from_object.apply(self.offset) + last.velocity_mps * dt_sec;
        let gate_m = config.gate_m + 0.5 * self.size_m().max_element() + ACCELERATION_MPS2 * dt_sec * dt_sec;
        (center, gate_m, config.velocity_gate_mps + ACCELERATION_MPS2 * dt_sec)
    }

    /// Takes a group in.
    pub(super) fn observe(&mut self, stamp_ns: i64, group: &Cluster, points: &[ObjectPoint], config: &ObjectsConfig) {
        let last = self.last();
        let dt_sec = seconds_between(last.stamp_ns, stamp_ns).max(0.0);
        let mut state = ObjectState { stamp_ns, ..last };
        if dt_sec > 0.0 {
            // Kalman's update of the velocity with the mean flow.
            let drift = (ACCELERATION_MPS2 * dt_sec).powi(2);
            let p = self.covariance + DMat3::from_diagonal(DVec3::splat(drift));
            let r = group.covariance + DMat3::from_diagonal(DVec3::splat(FLOW_SIGMA_MPS * FLOW_SIGMA_MPS));
            let gain = p * (p + r).inverse();
            state.velocity_mps += gain * (group.velocity - last.velocity_mps);
            self.covariance = (DMat3::IDENTITY - gain) * p;
            // The place goes on by the mean of both velocities, and a little towards where the group is.
            let place = last.map_from_object.translation + 0.5 * (last.velocity_mps + state.velocity_mps) * dt_sec;
            let rotation = heading(state.velocity_mps).unwrap_or(last.map_from_object.rotation);
            let off = group.center - (place + rotation * self.offset);
            state.map_from_object = Rigid::new(rotation, place + CENTER_SHARE * off);
        }
        let seen = state.map_from_object.inverse().apply(group.center);
        self.offset += OFFSET_SHARE * (seen - self.offset);
        let object_from_map = state.map_from_object.inverse();
        let turn = object_from_map.rotation.as_quat();
        let samples = group.members.iter().map(|&m| &points[m]).map(|p| ObjectSample {
            position: object_from_map.apply(p.position_map).as_vec3(),
            rotation: turn * p.rotation,
            scale: p.scale,
            color01: p.color01,
            opacity: p.opacity,
            distance_m: p.distance_m,
        });
        self.model.add(samples, config.voxel_m as f32, self.steps as u32);
        self.steps += 1;
        if dt_sec > 0.0 {
            self.states.push_back(state);
            if self.states.len() > HISTORY {
                self.states.pop_front();
            }
        }
    }

    /// Memory of its poses and Gaussians, bytes.
    pub(super) fn bytes(&self) -> usize {
        self.states.capacity() * size_of::<ObjectState>() + self.model.bytes()
    }

    /// Whether it was seen often enough to be believed.
    pub fn confirmed(&self, config: &ObjectsConfig) -> bool {
        self.steps >= config.confirm_steps
    }

    /// Stamp of the last step it was seen at, nanoseconds.
    pub fn last_seen_ns(&self) -> i64 {
        self.last().stamp_ns
    }

    /// Time since it was first seen, seconds.
    pub fn age_sec(&self) -> f64 {
        seconds_between(self.born_ns, self.last_seen_ns())
    }

    /// Velocity, map axes, m/s.
    pub fn velocity_mps(&self) -> DVec3 {
        self.last().velocity_mps
    }

    /// Change of velocity, map axes, m/s^2; see [`MovingObject::acceleration_at`].
    pub fn acceleration_mps2(&self) -> Option<DVec3> {
        self.acceleration_at(self.states.len().checked_sub(1)?)
    }

    /// Change of velocity up to a state over the second before it, map axes, m/s^2, by least squares: consecutive windows
    /// see the same object, so this is how their velocities differ. None before half a second of it was seen.
    pub fn acceleration_at(&self, state: usize) -> Option<DVec3> {
        let last = self.states.get(state)?;
        let recent = || {
            let before = (0..=state).rev().filter_map(|i| self.states.get(i));
            let timed = before.map(|s| (-seconds_between(s.stamp_ns, last.stamp_ns), s.velocity_mps));
            timed.take_while(|(t, _)| *t >= -SLOPE_SEC)
        };
        let n = recent().count() as f64;
        let (mean_t, mean_v) = (recent().map(|r| r.0).sum::<f64>() / n, recent().map(|r| r.1).sum::<DVec3>() / n);
        let spread: f64 = recent().map(|(t, _)| (t - mean_t).powi(2)).sum();
        let long = recent().last().is_some_and(|(t, _)| t <= -SLOPE_LEAST_SEC);
        let slope = recent().map(|(t, v)| (v - mean_v) * (t - mean_t)).sum::<DVec3>() / spread;
        (long && spread > 0.0 && slope.is_finite()).then_some(slope)
    }

    /// Covariance of the velocity, map axes, (m/s)^2.
    pub fn velocity_covariance(&self) -> DMat3 {
        self.covariance
    }

    /// Its poses, oldest first; the last minute of them.
    pub fn states(&self) -> &VecDeque<ObjectState> {
        &self.states
    }

    /// Size of the box around its Gaussians, along its own axes, metres.
    pub fn size_m(&self) -> DVec3 {
        let (low, high) = self.model.bounds();
        (high - low).as_dvec3().max(DVec3::ZERO)
    }

    /// Centre of the box in its frame, metres.
    pub fn box_center(&self) -> DVec3 {
        let (low, high) = self.model.bounds();
        (0.5 * (low + high)).as_dvec3()
    }

    /// Its Gaussians, in its frame.
    pub fn model(&self) -> &ObjectModel {
        &self.model
    }

    /// Where it was, between its first kept and its last pose, or coasting up to `ahead_sec` beyond; none outside.
    pub fn pose_at(&self, stamp_ns: i64, ahead_sec: f64) -> Option<Rigid> {
        let after = self.states.partition_point(|s| s.stamp_ns < stamp_ns);
        match (after.checked_sub(1).and_then(|i| self.states.get(i)), self.states.get(after)) {
            (_, Some(b)) if b.stamp_ns == stamp_ns => Some(b.map_from_object),
            (Some(a), Some(b)) => {
                let s = seconds_between(a.stamp_ns, stamp_ns) / seconds_between(a.stamp_ns, b.stamp_ns);
                Some(a.map_from_object.interpolate(&b.map_from_object, s))
            }
            (Some(a), None) => {
                let dt_sec = seconds_between(a.stamp_ns, stamp_ns);
                let place = a.map_from_object.translation + a.velocity_mps * dt_sec;
                (dt_sec <= ahead_sec).then(|| Rigid::new(a.map_from_object.rotation, place))
            }
            (None, _) => None,
        }
    }
}
