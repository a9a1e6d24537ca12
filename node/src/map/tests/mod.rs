//! The map: what fusing makes of Gaussians (here) and of looks at a wall (`looks`), what keeping makes of tiles (`keeping`), and
//! how long it takes (`rate`).

mod keeping;
mod looks;
mod rate;

use glam::{DMat3, DQuat, EulerRot, Vec3};
use proptest::prelude::*;
use storm_model::config::ModelConfig;
use storm_model::scene::{Affine, Scene, SceneShape};
use storm_render::{Gaussians, Intrinsics};

use super::*;
use crate::pipeline::timing::cpu_ms;
use crate::rigid::Rigid;

fn config(voxel_m: f64, max_gaussians: usize) -> MapConfig {
    MapConfig { voxel_m, tile_m: 64.0 * voxel_m, max_gaussians, ..Default::default() }
}

/// A small deterministic stream of numbers in 0..1 (no generator crate is needed for shapes like these).
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (self.0 >> 40) as f32 / (1u64 << 24) as f32
    }

    fn within(&mut self, half: f32) -> f32 {
        (2.0 * self.next() - 1.0) * half
    }
}

fn random_gaussians(n: usize, half_m: f32, seed: u64) -> Gaussians {
    let mut r = Numbers(seed);
    let mut g = Gaussians::default();
    for _ in 0..n {
        g.means.push([r.within(half_m), r.within(half_m), r.within(2.0)]);
        g.quats.push([r.within(1.0) + 1.5, r.within(1.0), r.within(1.0), r.within(1.0)]);
        g.scales.push([0.01 + 0.3 * r.next(), 0.01 + 0.3 * r.next(), 0.01 + 0.3 * r.next()]);
        g.opacities.push(0.1 + 0.9 * r.next());
        g.colors.push([r.within(1.0), r.within(1.0), r.within(1.0)]);
    }
    g
}

fn window<'a>(stamp_ns: i64, pose: &'a Rigid, g: &'a Gaussians) -> MapWindow<'a> {
    MapWindow { stamp_ns, map_from_anchor: pose, gaussians: g, eyes: &[], pixels: 0, first_new: 0, views: &[] }
}

fn insert_all(map: &mut StaticMap, pose: &Rigid, g: &Gaussians) -> MapCounts {
    map.fuse(&window(0, pose, g), |i| Some(g.opacities[i]), |i| color01(&g.colors[i]))
}

fn covariance64(quat: [f32; 4], scale: [f32; 3]) -> DMat3 {
    let [w, x, y, z] = quat.map(f64::from);
    let r = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let s = DVec3::from(scale.map(f64::from));
    r * DMat3::from_diagonal(s * s) * r.transpose()
}

/// The map without the widening that drawing wants.
fn bare_cloud(map: &StaticMap) -> MapCloud {
    let mut cloud = MapCloud::empty(map.origin());
    let add = |corner, tile: &Tile| {
        let live: Vec<_> = tile.live().copied().collect();
        cloud.push_cells(corner, map.config.voxel_m, &live, false);
    };
    map.each_tile(add).unwrap();
    cloud
}

fn check(map: &StaticMap) {
    assert!(map.tiles.iter().all(Tile::is_consistent));
    assert!(map.tiles.iter().enumerate().all(|(i, t)| map.by_index.get(&t.index) == Some(&(i as u32))));
    assert_eq!(map.by_index.len(), map.tiles.len());
}

#[test]
fn one_gaussian_comes_back_as_it_went_in() {
    let pose = Rigid::new(DQuat::from_euler(EulerRot::ZYX, 0.7, -0.2, 0.1), DVec3::new(10.0, -4.0, 2.0));
    let g = random_gaussians(200, 100.0, 3);
    for i in 0..g.len() {
        let mut map = StaticMap::new(&config(0.25, 100));
        map.set_origin(DVec3::new(1.0, 1.0, 1.0));
        map.fuse(&window(0, &pose, &g), |k| (k == i).then_some(0.5), |_| [0.2, 0.4, 0.6]);
        let c = bare_cloud(&map);
        assert_eq!(
            (c.len(), c.confidences[0], c.colors01[0], c.opacities[0]),
            (1, 0.5, [0.2, 0.4, 0.6], g.opacities[i])
        );
        let expected = pose.apply(DVec3::from(g.means[i].map(f64::from)));
        let got = c.origin + DVec3::from(c.positions[0].map(f64::from));
        assert!((got - expected).length() < 2e-5, "f32 at 100 m");
        let r = pose.matrix3();
        let turned = r * covariance64(g.quats[i], g.scales[i]) * r.transpose();
        assert!(covariance64(c.quats[0], c.scales[0]).abs_diff_eq(turned, 1e-6));
        // As drawn, it fills its voxel.
        assert!(map.cloud().unwrap().scales[0][1] >= 0.1);
        assert!(map.evidence(expected).is_some() && map.evidence(expected + 1.0).is_none());
    }
}

#[test]
fn utm_coordinates_change_nothing() {
    let run = |shift: DVec3| {
        let mut map = StaticMap::new(&config(0.25, 1_000_000));
        for step in 0..5 {
            let turn = DQuat::from_rotation_z(0.1 * f64::from(step));
            let pose = Rigid::new(turn, shift + DVec3::new(1.3 * f64::from(step), 0.2, 0.0));
            insert_all(&mut map, &pose, &random_gaussians(5000, 30.0, step as u64));
        }
        bare_cloud(&map)
    };
    let (near, far) = (run(DVec3::ZERO), run(DVec3::new(4_512_345.678, -651_234.567, 123.4)));
    assert_eq!((near.len(), near.origin.y), (far.len(), 0.2));
    for i in 0..near.len() {
        let d = Vec3::from(near.positions[i]) - Vec3::from(far.positions[i]);
        assert!(d.length() < 1e-3, "{i}: {}", d.length());
    }
}

#[test]
fn a_second_pass_adds_confidence_and_no_gaussians() {
    let mut map = StaticMap::new(&config(0.25, 1_000_000));
    let g = random_gaussians(3000, 20.0, 1);
    let first = insert_all(&mut map, &Rigid::IDENTITY, &g);
    let before = bare_cloud(&map);
    let second = insert_all(&mut map, &Rigid::IDENTITY, &g);
    let after = bare_cloud(&map);
    assert_eq!((first.created + first.merged, second.created, second.merged), (3000, 0, 3000));
    assert_eq!(before.len(), after.len());
    for i in 0..before.len() {
        assert!((after.confidences[i] - 2.0 * before.confidences[i]).abs() < 1e-4);
        assert!((Vec3::from(before.positions[i]) - Vec3::from(after.positions[i])).length() < 1e-5);
        let (a, b) = (covariance64(before.quats[i], before.scales[i]), covariance64(after.quats[i], after.scales[i]));
        assert!(a.abs_diff_eq(b, 1e-6));
    }
}

#[test]
fn what_is_not_finite_is_counted_and_left_out() {
    let mut map = StaticMap::new(&config(0.25, 100));
    let fresh = || random_gaussians(1, 5.0, 9);
    let mut bad = Vec::new();
    for x in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX] {
        for field in 0..4 {
            let mut g = fresh();
            match field {
                0 => g.means[0][1] = x,
                1 => g.quats[0][2] = x,
                2 => g.scales[0][0] = x,
                _ => g.opacities[0] = x,
            }
            bad.push(g);
        }
    }
    let mut g = fresh();
    g.quats[0] = [0.0; 4];
    bad.push(g);
    let mut g = fresh();
    g.scales[0][2] = -0.1;
    bad.push(g);
    let mut g = fresh();
    g.scales.clear();
    bad.push(g);
    for g in &bad {
        assert_eq!(insert_all(&mut map, &Rigid::IDENTITY, g).rejected, 1, "{g:?}");
    }
    let g = fresh();
    let here = window(0, &Rigid::IDENTITY, &g);
    for weight in [f32::NAN, f32::INFINITY, 0.0, -1.0] {
        assert_eq!(map.fuse(&here, |_| Some(weight), |_| [0.0; 3]).rejected, 1);
    }
    assert_eq!(map.fuse(&here, |_| Some(1.0), |_| [f32::NAN; 3]).rejected, 1);
    let nowhere = Rigid::new(DQuat::IDENTITY, DVec3::NAN);
    assert_eq!(map.fuse(&window(0, &nowhere, &g), |_| Some(1.0), |_| [0.0; 3]).rejected, 1);
    assert!(map.is_empty() && map.cloud().unwrap().is_empty());
    assert_eq!(map.counts().rejected, bad.len() as u64 + 6);
}

#[test]
fn a_full_map_gives_up_the_least_confident() {
    let mut map = StaticMap::new(&config(0.25, 1000));
    for step in 0..20 {
        let g = random_gaussians(500, 100.0, 100 + step);
        // Later ones are more confident, so they must be what is left.
        let sum = map.fuse(&window(0, &Rigid::IDENTITY, &g), |_| Some(1.0 + step as f32), |_| [0.5; 3]);
        assert_eq!(sum.created + sum.merged, 500);
        assert!(map.len() <= 1000);
        check(&map);
    }
    let c = map.counts();
    assert_eq!(c.created - c.evicted, map.len() as u64);
    assert!(map.cloud().unwrap().confidences.iter().all(|&w| w >= 17.0), "the last two steps fill the map");
    let mut small = StaticMap::new(&MapConfig { max_mb: 1, ..config(0.25, 1_000_000) });
    (0..10).for_each(|step| {
        insert_all(&mut small, &Rigid::IDENTITY, &random_gaussians(5000, 100.0, step));
        assert!(small.bytes() <= 1 << 20, "{}", small.bytes());
    });
    assert!(small.len() > 1000);
}

#[test]
fn the_same_input_gives_the_same_cloud_whatever_the_threads() {
    let run = || {
        let mut map = StaticMap::new(&config(0.3, 3000));
        for step in 0..10 {
            let pose = Rigid::new(DQuat::from_rotation_z(0.3), DVec3::new(step as f64, 0.0, 0.0));
            insert_all(&mut map, &pose, &random_gaussians(1000, 40.0, step));
        }
        map.cloud().unwrap()
    };
    let pool = |n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
    assert_eq!(pool(1).install(run), pool(3).install(run));
}

/// A wall of `n x n` pixels straight ahead (x), seen from the anchor's origin with a picture of 90 degrees; depths
/// are `error(i)` off along their rays.
fn wall(n: usize, distance: f32, error: impl Fn(usize) -> f32) -> (Gaussians, Intrinsics) {
    let k = Intrinsics::from_fov(90.0, n, n);
    let mut g = Gaussians::default();
    let half = 0.5 * distance / k.fx;
    for i in 0..n * n {
        let ray = k.ray((i % n) as f32 + 0.5, (i / n) as f32 + 0.5);
        let p = Vec3::new(1.0, -ray.x, -ray.y) * distance;
        g.means.push((p * (1.0 + error(i) / p.length())).to_array());
        g.quats.push([1.0, 0.0, 0.0, 0.0]);
        g.scales.push([0.01, half, half]);
        g.opacities.push(1.0);
        g.colors.push([0.0; 3]);
    }
    (g, k)
}

fn look(map: &mut StaticMap, stamp_ms: i64, at: DVec3, g: &Gaussians, k: &Intrinsics) -> MapCounts {
    let pose = Rigid::new(DQuat::IDENTITY, at);
    let eyes = [Eye { position: Vec3::ZERO, pixel_rad: 1.0 / k.fx }];
    let camera = pose * crate::window::camera_from_flu().inverse();
    let depth = g.means.iter().map(|m| m[0]).collect();
    let views = [DepthView { map_from_camera: camera, intrinsics: *k, depth }];
    let window = MapWindow { eyes: &eyes, pixels: g.len(), views: &views, ..window(stamp_ms * 1_000_000, &pose, g) };
    map.fuse(&window, |i| Some(confidence(1.0, Vec3::from(g.means[i]).length())), |_| [0.5; 3])
}

proptest! {
    /// Against the definition: weighted mean and covariance of the whole mixture, in f64.
    #[test]
    fn a_cell_holds_the_moments_of_its_mixture(seed in any::<u64>(), n in 1usize..40) {
        let g = random_gaussians(n, 2.0, seed);
        let mut map = StaticMap::new(&config(100.0, 10));
        map.set_origin(DVec3::splat(-50.0));
        insert_all(&mut map, &Rigid::IDENTITY, &g);
        let c = bare_cloud(&map);
        prop_assert_eq!(c.len(), 1);
        let total: f64 = g.opacities.iter().map(|&w| f64::from(w)).sum();
        let weighted = |f: &dyn Fn(usize) -> DVec3, i: usize| f(i) * f64::from(g.opacities[i]);
        let mean_of = |f: &dyn Fn(usize) -> DVec3| (0..n).map(|i| weighted(f, i)).sum::<DVec3>() / total;
        let position = |i: usize| DVec3::from(g.means[i].map(f64::from));
        let mean = mean_of(&position);
        let mut cov = DMat3::ZERO;
        for i in 0..n {
            let d = position(i) - mean;
            let spread = DMat3::from_cols(d * d.x, d * d.y, d * d.z);
            cov += (covariance64(g.quats[i], g.scales[i]) + spread) * (f64::from(g.opacities[i]) / total);
        }
        let got = c.origin + DVec3::from(c.positions[0].map(f64::from));
        // f32 at 50 m from the corner, and sums of forty f32 terms.
        prop_assert!((got - mean).length() < 3e-5);
        prop_assert!(covariance64(c.quats[0], c.scales[0]).abs_diff_eq(cov, 3e-5));
        let color = mean_of(&|i| DVec3::from(color01(&g.colors[i]).map(f64::from)));
        prop_assert!((DVec3::from(c.colors01[0].map(f64::from)) - color).length() < 1e-5);
        let opacity = mean_of(&|i| DVec3::splat(f64::from(g.opacities[i]))).x;
        prop_assert!((f64::from(c.opacities[0]) - opacity).abs() < 1e-5);
    }
}
