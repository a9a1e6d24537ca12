use std::sync::Arc;

use glam::{DQuat, DVec3};
use storm_model::config::ModelConfig;
use storm_model::scene::SceneShape;
use storm_render::Gaussians;

use super::*;
use crate::window::camera_from_flu;

const SHAPE: SceneShape = SceneShape { timesteps: 4, cameras: 1, height: 24, width: 36 };
const STRIDE_SEC: f64 = 0.5;
/// The box's velocity, m/s.
const DRIVES: DVec3 = DVec3::new(0.0, 4.0, 0.0);

/// A vehicle at 12 m/s that turns by 20 degrees a second, in front of a wall 40 m ahead with a box before it that drives across.
struct Street {
    cameras: Vec<Intrinsics>,
    first_sec: f64,
}

/// Who is seen, where, m and in what colour (-1 to 1).
struct Hit {
    place: DVec3,
    on_box: bool,
    color: [f32; 3],
}

impl Street {
    fn new(first_sec: f64) -> Self {
        Self { cameras: vec![Intrinsics::from_fov(70.0, SHAPE.width, SHAPE.height)], first_sec }
    }

    fn pose(&self, t: usize) -> Rigid {
        let time = self.first_sec + STRIDE_SEC * t as f64;
        let base = Rigid::new(DQuat::from_rotation_z(-0.5 + 0.35 * time), DVec3::new(12.0 * time - 10.0, 0.0, 1.5));
        base * camera_from_flu().inverse()
    }

    fn look(&self, time_sec: f64, eye: DVec3, ray: DVec3) -> Hit {
        let wall = eye + ray * ((40.0 - eye.x) / ray.x);
        let front = eye + ray * ((28.0 - eye.x) / ray.x);
        let corner = DVec3::new(28.0, -6.0, 0.0) + DRIVES * time_sec;
        let inside = front.y > corner.y && front.y < corner.y + 4.0 && front.z > 0.0 && front.z < 3.0;
        if inside {
            return Hit { place: front, on_box: true, color: [0.8, -0.8, -0.8] };
        }
        // Bricks, so that places differ.
        let brick = ((wall.y / 1.5).floor() + (wall.z / 1.5).floor()).rem_euclid(2.0) as f32;
        Hit { place: wall, on_box: false, color: [brick - 0.5, 0.3, 0.1 * brick] }
    }

    /// The scene, with `leaked` as the velocity of what stands, and whether each Gaussian is on the box.
    fn scene(&self, leaked: Vec3) -> (Scene, Vec<bool>, Rigid) {
        let map_from_anchor = self.pose(0) * camera_from_flu();
        let anchor_from_map = map_from_anchor.inverse();
        let (mut g, mut on_box, mut depths) = (Gaussians::default(), Vec::new(), Vec::new());
        g.motion_count = 2;
        for t in 0..SHAPE.timesteps {
            let pose = self.pose(t);
            for p in 0..SHAPE.height * SHAPE.width {
                let (u, v) = ((p % SHAPE.width) as f32 + 0.5, (p / SHAPE.width) as f32 + 0.5);
                let ray = pose.rotation * self.cameras[0].ray(u, v).as_dvec3();
                let hit = self.look(self.first_sec + STRIDE_SEC * t as f64, pose.translation, ray);
                let moves = anchor_from_map.rotation * DRIVES;
                let velocity = if hit.on_box { moves.as_vec3() } else { leaked };
                g.means.push(anchor_from_map.apply(hit.place).as_vec3().to_array());
                g.quats.push([1.0, 0.0, 0.0, 0.0]);
                g.scales.push([0.2; 3]);
                g.opacities.push(1.0);
                g.colors.push(hit.color);
                g.velocity_backward.push(velocity.to_array());
                g.velocity_forward.push(velocity.to_array());
                g.time_sec.push((STRIDE_SEC * t as f64) as f32);
                g.motion_weights.extend(if hit.on_box { [0.0, 1.0] } else { [1.0, 0.0] });
                on_box.push(hit.on_box);
                depths.push((hit.place - pose.translation).length() as f32);
            }
        }
        let config = Arc::new(ModelConfig::preset("tiny").unwrap());
        let none = (Vec::new(), Vec::new());
        let (affine, motion_bases) = none;
        let scene =
            Scene { gaussians: g, shape: SHAPE, depths, valid: Vec::new(), sky: None, affine, motion_bases, config };
        (scene, on_box, map_from_anchor)
    }

    fn step(&self, overlap: &mut Overlap, leaked: Vec3) -> (Scene, Vec<bool>, Agreement) {
        let (mut scene, on_box, map_from_anchor) = self.scene(leaked);
        let stamps_ns: Vec<i64> =
            (0..SHAPE.timesteps).map(|t| ((self.first_sec + STRIDE_SEC * t as f64) * 1e9).round() as i64).collect();
        let poses: Vec<Rigid> = (0..SHAPE.timesteps).map(|t| self.pose(t)).collect();
        let look = OverlapLook {
            stamps_ns: &stamps_ns,
            epoch: 0,
            map_from_anchor: &map_from_anchor,
            cameras: &self.cameras,
            poses: &poses,
        };
        let agreement = overlap.step(&mut scene, &look);
        (scene, on_box, agreement)
    }
}

fn overlap() -> Overlap {
    Overlap::new(&OverlapConfig::default())
}

/// Shares of the newest timestep's standing and moving pixels that are said to move, as far as another picture of the
/// window shows the place: of what has just come into view nothing can be said.
fn moving_shares(street: &Street, scene: &Scene, on_box: &[bool]) -> (f64, f64) {
    let (mut still, mut moving) = ((0, 0), (0, 0));
    let anchor_from_map = (street.pose(0) * camera_from_flu()).inverse();
    let elsewhere = |i: usize| {
        (0..SHAPE.timesteps - 1).any(|t| {
            let camera_from_anchor = (anchor_from_map * street.pose(t)).inverse();
            let p = camera_from_anchor.apply(Vec3::from(scene.gaussians.means[i]).as_dvec3()).as_vec3();
            let inside = |(u, v): (f32, f32)| {
                u > 2.0 && v > 2.0 && u < SHAPE.width as f32 - 2.0 && v < SHAPE.height as f32 - 2.0
            };
            p.z > 1.0 && street.cameras[0].project(p).is_some_and(inside)
        })
    };
    for i in scene.shape.picture(SHAPE.timesteps - 1, 0).filter(|&i| elsewhere(i)) {
        let side = if on_box[i] { &mut moving } else { &mut still };
        side.1 += 1;
        side.0 += usize::from(speed_mps(scene, i) >= MOVING_MPS);
    }
    assert!(still.1 > 100 && moving.1 > 10, "{still:?} {moving:?}");
    (still.0 as f64 / still.1 as f64, moving.0 as f64 / moving.1 as f64)
}

#[test]
fn fast_ego_motion_does_not_make_what_stands_move() {
    let mut o = overlap();
    for k in 0..6 {
        let street = Street::new(0.1 * f64::from(k));
        // Another part of the ego motion every time.
        let leaked = Vec3::new(3.0, -2.0, 0.3) * [1.0, -1.5, 0.7, 2.0, -0.8, 1.2][k as usize];
        let (scene, on_box, agreement) = street.step(&mut o, leaked);
        let (still, moving) = moving_shares(&street, &scene, &on_box);
        assert!(still < 0.05, "window {k}: {still} of the street moves");
        assert!(moving > 0.95, "window {k}: only {moving} of the box still moves");
        assert!(agreement.geometry.iter().chain(&agreement.velocity).all(|c| *c > 0.0 && *c < 1.0));
    }
    let counts = o.counts();
    assert!(counts.stilled > 0 && counts.stilled <= counts.moving, "{counts:?}");
}

#[test]
fn what_agrees_is_left_alone_and_trusted() {
    let mut o = overlap();
    let (before, ..) = Street::new(0.5).scene(Vec3::ZERO);
    o.step_twice();
    let (scene, on_box, agreement) = Street::new(0.5).step(&mut o, Vec3::ZERO);
    assert_eq!(scene.gaussians, before.gaussians);
    assert_eq!(o.counts().stilled, 0);
    let sure = (0..on_box.len()).filter(|&i| agreement.geometry[i] > 0.6).count();
    assert!(sure > on_box.len() / 2, "{sure} of {}", on_box.len());
}

impl Overlap {
    /// The same window twice.
    fn step_twice(&mut self) {
        for _ in 0..2 {
            Street::new(0.5).step(self, Vec3::ZERO);
        }
        assert!(self.counts().compared > 0);
        assert!(self.counts().depth_part < 1e-5, "{:?}", self.counts());
    }
}

#[test]
fn disagreement_between_windows_lowers_what_is_believed() {
    let mut o = overlap();
    let street = Street::new(0.5);
    street.step(&mut o, Vec3::ZERO);
    let (mut scene, _, map_from_anchor) = street.scene(Vec3::ZERO);
    // One picture half as far again as before.
    let pose = street.pose(1);
    let eye = map_from_anchor.inverse().apply(pose.translation).as_vec3();
    for i in scene.shape.picture(1, 0) {
        let mean = Vec3::from(scene.gaussians.means[i]);
        scene.gaussians.means[i] = (eye + 1.5 * (mean - eye)).to_array();
    }
    let stamps_ns: Vec<i64> = (0..4).map(|t| 500_000_000 + 500_000_000 * t).collect();
    let poses: Vec<Rigid> = (0..4).map(|t| street.pose(t)).collect();
    let look = OverlapLook {
        stamps_ns: &stamps_ns,
        epoch: 0,
        map_from_anchor: &map_from_anchor,
        cameras: &street.cameras,
        poses: &poses,
    };
    let agreement = o.step(&mut scene, &look);
    let mean = |t: usize| {
        let range = scene.shape.picture(t, 0);
        range.clone().map(|i| agreement.geometry[i]).sum::<f32>() / range.len() as f32
    };
    assert!(mean(1) < 0.4 && mean(0) > 0.6, "{} {}", mean(1), mean(0));
}

#[test]
fn nothing_is_done_where_sizes_do_not_fit_and_epochs_do_not_mix() {
    let mut o = overlap();
    let street = Street::new(0.0);
    let (mut scene, _, map_from_anchor) = street.scene(Vec3::X * 5.0);
    let poses: Vec<Rigid> = (0..4).map(|t| street.pose(t)).collect();
    let mut look = OverlapLook {
        stamps_ns: &[0, 1],
        epoch: 0,
        map_from_anchor: &map_from_anchor,
        cameras: &street.cameras,
        poses: &poses,
    };
    let before = scene.gaussians.clone();
    assert_eq!(o.step(&mut scene, &look), Agreement::default());
    assert_eq!(scene.gaussians, before);
    let stamps_ns = [0, 500_000_000, 1_000_000_000, 1_500_000_000];
    look.stamps_ns = &stamps_ns;
    o.step(&mut scene, &look);
    assert_eq!(o.counts().compared, 0);
    look.epoch = 1;
    o.step(&mut scene, &look);
    assert_eq!(o.counts().compared, 0);
    o.step(&mut scene, &look);
    assert!(o.counts().compared > 0 && o.bytes() > 0);
}

#[test]
fn the_same_whatever_the_threads() {
    let run = || {
        let mut o = overlap();
        (0..3).map(|k| Street::new(0.1 * f64::from(k)).step(&mut o, Vec3::Y * 4.0).2).collect::<Vec<_>>()
    };
    let pool = |n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
    assert_eq!(pool(1).install(run), pool(3).install(run));
}
