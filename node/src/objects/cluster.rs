//! Groups of moving Gaussians: connected, of one motion.

use std::collections::HashMap;

use glam::{DMat3, DVec3, Quat, Vec3};

use crate::config::ObjectsConfig;

/// Speeds beyond this are a mistake of the network, m/s.
const MAX_SPEED_MPS: f64 = 200.0;

/// A moving Gaussian of the newest timestep.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObjectPoint {
    /// Centre in the map frame, metres.
    pub position_map: DVec3,
    /// Velocity in the map frame's axes, m/s.
    pub velocity_map_mps: DVec3,
    /// Motion token with the largest weight.
    pub motion_id: u16,
    /// Opacity, 0 to 1.
    pub opacity: f32,
    /// Colour, 0 to 1.
    pub color01: [f32; 3],
    /// Orientation in map axes, unit.
    pub rotation: Quat,
    /// Standard deviations along the local axes, metres.
    pub scale: Vec3,
    /// Distance from the camera that saw it, metres.
    pub distance_m: f32,
}

/// One group.
#[derive(Debug, Clone)]
pub(super) struct Cluster {
    /// Numbers of its points, rising.
    pub members: Vec<usize>,
    pub center: DVec3,
    /// Mean velocity, and the covariance of that mean, (m/s)^2.
    pub velocity: DVec3,
    pub covariance: DMat3,
}

fn plausible(p: &ObjectPoint) -> bool {
    let finite = p.position_map.is_finite()
        && p.velocity_map_mps.is_finite()
        && p.opacity.is_finite()
        && p.scale.is_finite()
        && p.rotation.is_finite()
        && p.color01.iter().chain([&p.distance_m]).all(|x| x.is_finite());
    finite && p.velocity_map_mps.length() <= MAX_SPEED_MPS && p.position_map.length() <= crate::poses::MAX_POSITION_M
}

/// Disjoint sets.
struct Sets(Vec<usize>);

impl Sets {
    fn root(&mut self, mut i: usize) -> usize {
        while self.0[i] != i {
            self.0[i] = self.0[self.0[i]];
            i = self.0[i];
        }
        i
    }

    /// The smaller number stays the root, so that groups are named by their first member.
    fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b)] = a.min(b);
    }
}

/// All groups of enough points, by their first member; and how many points were refused.
pub(super) fn clusters(points: &[ObjectPoint], config: &ObjectsConfig) -> (Vec<Cluster>, u64) {
    let usable: Vec<usize> = (0..points.len()).filter(|&i| plausible(&points[i])).collect();
    let rejected = (points.len() - usable.len()) as u64;
    let Some(&first) = usable.first() else { return (Vec::new(), rejected) };
    let origin = points[first].position_map;
    let key = |p: DVec3| ((p - origin) / config.connect_m).floor().as_i64vec3().to_array();
    // Per cube and token the first point stands for all; points of one cube and token are connected.
    let mut cubes: HashMap<[i64; 3], Vec<usize>> = HashMap::new();
    let mut sets = Sets((0..points.len()).collect());
    for &i in &usable {
        let here = cubes.entry(key(points[i].position_map)).or_default();
        match here.iter().find(|&&j| alike(&points[i], &points[j], config)) {
            Some(&j) => sets.join(i, j),
            None => here.push(i),
        }
    }
    for &i in &usable {
        let [x, y, z] = key(points[i].position_map);
        // Half of the 26 neighbours: the others ask themselves.
        for n in 14..27 {
            let near = [x + n / 9 - 1, y + n / 3 % 3 - 1, z + n % 3 - 1];
            for &j in cubes.get(&near).into_iter().flatten() {
                if alike(&points[i], &points[j], config) {
                    sets.join(i, j);
                }
            }
        }
    }
    let mut groups: HashMap<usize, Vec<usize>> = HashMap::new();
    for &i in &usable {
        groups.entry(sets.root(i)).or_default().push(i);
    }
    let mut groups: Vec<Vec<usize>> = groups.into_values().filter(|m| m.len() >= config.min_points).collect();
    groups.sort_unstable_by_key(|m| m[0]);
    (groups.into_iter().map(|members| summary(members, points)).collect(), rejected)
}

/// Of one motion: the same token or not, their velocities agree.
fn alike(a: &ObjectPoint, b: &ObjectPoint, config: &ObjectsConfig) -> bool {
    let apart = (a.velocity_map_mps - b.velocity_map_mps).length();
    // Tokens are a network's guess at what moves together; within one, velocities may differ twice as much (a turning
    // bus, a walking leg).
    let room = if a.motion_id == b.motion_id { 2.0 } else { 1.0 };
    apart <= room * config.velocity_step_mps
}

fn summary(members: Vec<usize>, points: &[ObjectPoint]) -> Cluster {
    let n = members.len() as f64;
    let mean = |f: &dyn Fn(&ObjectPoint) -> DVec3| members.iter().map(|&i| f(&points[i])).sum::<DVec3>() / n;
    let center = mean(&|p| p.position_map - points[members[0]].position_map) + points[members[0]].position_map;
    let velocity = mean(&|p| p.velocity_map_mps);
    let mut spread = DMat3::ZERO;
    for &i in &members {
        let d = points[i].velocity_map_mps - velocity;
        spread += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    }
    Cluster { members, center, velocity, covariance: spread * (1.0 / (n * (n - 1.0).max(1.0))) }
}
