//! What a perfect network would give: pixel-aligned Gaussians with the procedural drive's true depth, colour and flow, so
//! that the map and the trajectories can be measured apart from the network. Errors are added on request.

use std::collections::VecDeque;
use std::sync::Arc;

use anyhow::{Context, Result};
use glam::{DVec3, Mat3, Quat, Vec3};
use rayon::prelude::*;
use storm_model::config::ModelConfig;
use storm_model::scene::{Scene, SceneShape};
use storm_render::Gaussians;
use storm_render::world::{Drive, WorldFrame};

use crate::rigid::Rigid;
use crate::window::camera_from_flu;

/// Standard deviation of a Gaussian as a part of the distance to the next pixel's surface point: at a half, neighbours
/// close up.
const PIXEL_SIGMA: f32 = 0.5;
/// Standard deviation across the surface, as a part of the depth.
const FLAT_SIGMA: f32 = 1e-3;
/// A neighbour farther off than so many pixel widths is on another surface, or the surface is seen edge on.
const SLANT_PIXELS: f32 = 6.0;
/// Motion tokens: one for what stands, the others shared by the road users.
const TOKENS: usize = 4;

/// Errors put on the truth.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct OracleErrors {
    /// Standard deviation of depth as a part of depth.
    pub depth: f64,
    /// Standard deviation of every velocity component of moving surfaces, m/s.
    pub velocity_mps: f64,
    /// Chance that a road user is taken for standing, per picture.
    pub missed: f64,
    /// Part of the ego motion that is taken for the scene's: standard deviation over windows and their pictures' moments,
    /// as a part of how fast a standing surface moves past the vehicle.
    pub ego_leak: f64,
}

/// One synchronized set: pictures with truth, and their Gaussians in map axes relative to `place`.
pub struct OracleSet {
    /// Seconds since the drive's start.
    pub time_sec: f64,
    /// The truth, per camera.
    pub frames: Vec<WorldFrame>,
    /// map_from_camera, per camera.
    pub poses: Vec<Rigid>,
    place: DVec3,
    /// The vehicle's velocity (m/s) and turn (rad/s), map axes.
    ego: (DVec3, DVec3),
    gaussians: Gaussians,
    depths: Vec<f32>,
}

/// A vehicle's velocity and turn at a time, from its poses a little before and after.
fn ego_motion(drive: &Drive, time_sec: f64) -> (DVec3, DVec3) {
    const APART_SEC: f64 = 0.02;
    let (a, b) = (drive.map_from_base(time_sec - APART_SEC), drive.map_from_base(time_sec + APART_SEC));
    let turn = glam::DQuat::from_mat3(&(b.matrix3 * a.matrix3.transpose())).to_scaled_axis();
    ((b.translation - a.translation) / (2.0 * APART_SEC), turn / (2.0 * APART_SEC))
}

/// Draws a number in 0..1 for a place in the drive; the same for the same place.
fn chance(seed: u64, parts: [u64; 3]) -> f64 {
    let mut h = seed ^ 0x5851_f42d_4c95_7f2d;
    for p in parts {
        h = (h ^ p).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        h ^= h >> 29;
    }
    (h.wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 11) as f64 / (1u64 << 53) as f64
}

/// Nearly normal: the sum of twelve draws has variance 1.
fn normal(seed: u64, parts: [u64; 3]) -> f64 {
    (0..12).map(|k| chance(seed.wrapping_add(k * 7919), parts)).sum::<f64>() - 6.0
}

impl OracleSet {
    /// The set at a time of the drive.
    pub fn at(drive: &Drive, time_sec: f64, errors: &OracleErrors) -> Self {
        let cameras = drive.cameras();
        let base = drive.map_from_base(time_sec);
        let poses: Vec<Rigid> = cameras.iter().map(|c| Rigid::from(&(base * c.base_from_camera))).collect();
        let frames: Vec<WorldFrame> = (0..cameras.len()).map(|c| drive.render(c, time_sec)).collect();
        let place = base.translation;
        let ego = if errors.ego_leak > 0.0 { ego_motion(drive, time_sec) } else { (DVec3::ZERO, DVec3::ZERO) };
        let (gaussians, depths) = (Gaussians::default(), Vec::new());
        let mut set = Self { time_sec, frames, poses, place, ego, gaussians, depths };
        set.gaussians.motion_count = TOKENS;
        for c in 0..cameras.len() {
            set.picture(drive, c, errors);
        }
        set
    }

    fn picture(&mut self, drive: &Drive, camera: usize, errors: &OracleErrors) {
        let k = drive.cameras()[camera].intrinsics;
        let (frame, pose) = (&self.frames[camera], self.poses[camera]);
        let (w, h) = (frame.width, frame.height);
        let turn = pose.rotation.as_quat();
        let eye = (pose.translation - self.place).as_vec3();
        let seed = drive.options().seed;
        let stamp = (self.time_sec * 1e3).round() as u64;
        let noisy = |i: usize| {
            let part =
                if errors.depth > 0.0 { errors.depth * normal(seed, [stamp, camera as u64, i as u64]) } else { 0.0 };
            frame.depth[i] * (1.0 + part as f32)
        };
        // Where neighbours are is taken from the truth: a network's shapes are smooth where its depths are not.
        let at = |i: usize| k.ray((i % w) as f32 + 0.5, (i / w) as f32 + 0.5) * frame.depth[i];
        let made: Vec<_> = (0..w * h)
            .into_par_iter()
            .with_min_len(512)
            .map(|i| {
                let (row, col, depth) = (i / w, i % w, frame.depth[i]);
                let ray = k.ray(col as f32 + 0.5, row as f32 + 0.5);
                let hit = depth > 0.0;
                if !hit {
                    return ([0.0; 3], [1.0, 0.0, 0.0, 0.0], [1e-3; 3], 0.0, 0.0);
                }
                let here = at(i);
                let pixel = depth / k.fx;
                let toward = |axis: Vec3, before: Option<usize>, after: Option<usize>| {
                    let steps = [before.map(|j| here - at(j)), after.map(|j| at(j) - here)];
                    let near = |s: &Vec3| s.length() < SLANT_PIXELS * pixel;
                    let best =
                        steps.into_iter().flatten().filter(near).min_by(|a, b| a.length().total_cmp(&b.length()));
                    best.unwrap_or(axis * pixel)
                };
                let u = toward(Vec3::X, (col > 0).then(|| i - 1), (col + 1 < w).then(|| i + 1));
                let v = toward(Vec3::Y, (row > 0).then(|| i - w), (row + 1 < h).then(|| i + w));
                let x = u.normalize();
                let across = v - x * v.dot(x);
                let y = if across.length() > 1e-3 * pixel { across.normalize() } else { x.any_orthonormal_vector() };
                let q = turn * Quat::from_mat3(&Mat3::from_cols(x, y, x.cross(y)));
                let depth = noisy(i);
                let mean = eye + turn * (ray * depth);
                let sigma = PIXEL_SIGMA * Vec3::new(u.length(), across.length().max(0.3 * pixel), 0.0);
                let scale = [sigma.x, sigma.y, FLAT_SIGMA * depth];
                (mean.to_array(), [q.w, q.x, q.y, q.z], scale, 1.0, ray.length() * depth)
            })
            .collect();
        let g = &mut self.gaussians;
        for (i, (mean, quat, scale, opacity, depth)) in made.into_iter().enumerate() {
            g.means.push(mean);
            g.quats.push(quat);
            g.scales.push(scale);
            g.opacities.push(opacity);
            g.colors.push([0, 1, 2].map(|c| f32::from(frame.rgb[3 * i + c]) / 127.5 - 1.0));
            let instance = frame.instance[i];
            let missed = errors.missed > 0.0
                && instance > 0
                && chance(seed, [stamp, 77 + camera as u64, u64::from(instance)]) < errors.missed;
            let moves = frame.moving[i] > 0 && !missed;
            let error = |axis: u64| match moves && errors.velocity_mps > 0.0 {
                true => (errors.velocity_mps * normal(seed, [stamp, 1000 + axis, i as u64])) as f32,
                false => 0.0,
            };
            let v = frame.flow[i];
            let v = if moves { [v[0] + error(0), v[1] + error(1), v[2] + error(2)] } else { [0.0; 3] };
            g.velocity_forward.push(v);
            g.velocity_backward.push(v);
            let token = if moves { 1 + usize::from(instance) % (TOKENS - 1) } else { 0 };
            g.motion_weights.extend((0..TOKENS).map(|t| f32::from(u8::from(t == token))));
            self.depths.push(depth);
        }
    }

    /// Memory held, bytes.
    pub fn bytes(&self) -> usize {
        let g = &self.gaussians;
        let frames: usize = self
            .frames
            .iter()
            .map(|f| size_of_val(&f.rgb[..]) + size_of_val(&f.depth[..]) + size_of_val(&f.flow[..]))
            .sum();
        // Means, scales, colours and two velocities of three numbers, four of rotation, one opacity.
        frames + g.len() * (20 + g.motion_count) * size_of::<f32>() + self.depths.capacity() * size_of::<f32>()
    }

    /// Stamp, nanoseconds.
    pub fn stamp_ns(&self) -> i64 {
        (self.time_sec * 1e9).round() as i64
    }
}

/// The sets a window is made of.
pub struct OracleWindow {
    sets: VecDeque<Arc<OracleSet>>,
    stride: usize,
    timesteps: usize,
    reference: usize,
    /// Of [`OracleErrors`], and the drive's seed.
    ego_leak: (f64, u64),
    config: Arc<ModelConfig>,
}

/// One window as a perfect network sees it.
pub struct OracleStep {
    /// The scene.
    pub scene: Scene,
    /// Its anchor in the map.
    pub map_from_anchor: Rigid,
    /// map_from_camera per picture, timestep by timestep.
    pub poses: Vec<Rigid>,
    /// Time of its first timestep, seconds since the drive's start.
    pub first_sec: f64,
}

impl OracleWindow {
    /// Windows of `timesteps` sets, `stride` sets apart, anchored at camera `reference`. `ego_leak`: see
    /// [`OracleErrors`], and a seed.
    pub fn new(timesteps: usize, stride: usize, reference: usize, ego_leak: (f64, u64)) -> Result<Self> {
        let config = ModelConfig::preset("tiny").context("the preset tiny")?;
        Ok(Self { sets: VecDeque::new(), stride, timesteps, reference, ego_leak, config: Arc::new(config) })
    }

    /// Takes the next set; a window once there are enough.
    pub fn push(&mut self, set: Arc<OracleSet>) -> Option<OracleStep> {
        self.sets.push_back(set);
        let span = (self.timesteps - 1) * self.stride + 1;
        if self.sets.len() > span {
            self.sets.pop_front();
        }
        (self.sets.len() == span).then(|| self.step())
    }

    /// Gives standing surfaces a part of the vehicle's own motion, another part in every window and at every moment, and
    /// no two pixels quite the same.
    fn leak(&self, sets: &[&OracleSet], g: &mut Gaussians, anchor_from_map: &Mat3) {
        let (sigma, seed) = self.ego_leak;
        let newest = sets.last().map_or(0, |s| s.stamp_ns()) as u64;
        let mut i = 0;
        for (t, set) in sets.iter().enumerate() {
            let part = (sigma * normal(seed, [newest, 31, t as u64])) as f32;
            let (velocity, turn) = (set.ego.0.as_vec3(), set.ego.1.as_vec3());
            for place in &set.gaussians.means {
                if g.velocity_forward[i] == [0.0; 3] && g.opacities[i] > 0.0 {
                    let uneven = 0.7 + 0.6 * chance(seed, [newest, 32, i as u64]) as f32;
                    let passing = velocity + turn.cross(Vec3::from(*place));
                    let v = *anchor_from_map * passing * (part * uneven);
                    (g.velocity_forward[i], g.velocity_backward[i]) = (v.to_array(), v.to_array());
                }
                i += 1;
            }
        }
    }

    /// Memory of the sets that wait, bytes.
    pub fn bytes(&self) -> usize {
        self.sets.iter().map(|s| s.bytes()).sum()
    }

    fn step(&self) -> OracleStep {
        let sets: Vec<&OracleSet> = (0..self.timesteps).map(|t| self.sets[t * self.stride].as_ref()).collect();
        let first = sets[0];
        let map_from_anchor = first.poses[self.reference.min(first.poses.len() - 1)] * camera_from_flu();
        let first_sec = first.time_sec;
        let mut g = Gaussians { motion_count: TOKENS, ..Gaussians::default() };
        let mut depths = Vec::new();
        let anchor_from_map = map_from_anchor.rotation.conjugate();
        let turn = anchor_from_map.as_quat();
        let r = Mat3::from_quat(turn);
        for set in &sets {
            let from = &set.gaussians;
            let shift = (anchor_from_map * (set.place - map_from_anchor.translation)).as_vec3();
            let rotate = |v: &[f32; 3]| (r * Vec3::from(*v)).to_array();
            g.means.extend(from.means.iter().map(|m| (r * Vec3::from(*m) + shift).to_array()));
            g.quats.extend(from.quats.iter().map(|&[w, x, y, z]| {
                let q = turn * Quat::from_xyzw(x, y, z, w);
                [q.w, q.x, q.y, q.z]
            }));
            g.scales.extend_from_slice(&from.scales);
            g.opacities.extend_from_slice(&from.opacities);
            g.colors.extend_from_slice(&from.colors);
            g.velocity_backward.extend(from.velocity_backward.iter().map(rotate));
            g.velocity_forward.extend(from.velocity_forward.iter().map(rotate));
            g.time_sec.extend(std::iter::repeat_n((set.time_sec - first_sec) as f32, from.len()));
            g.motion_weights.extend_from_slice(&from.motion_weights);
            depths.extend_from_slice(&set.depths);
        }
        let frame = &first.frames[0];
        let shape = SceneShape {
            timesteps: self.timesteps,
            cameras: first.frames.len(),
            height: frame.height,
            width: frame.width,
        };
        if self.ego_leak.0 > 0.0 {
            self.leak(&sets, &mut g, &r);
        }
        let scene = Scene {
            gaussians: g,
            shape,
            depths,
            valid: Vec::new(),
            sky: None,
            affine: Vec::new(),
            motion_bases: Vec::new(),
            config: self.config.clone(),
        };
        let poses = sets.iter().flat_map(|s| s.poses.iter().copied()).collect();
        OracleStep { scene, map_from_anchor, poses, first_sec }
    }
}
