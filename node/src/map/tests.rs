use glam::{DMat3, DQuat, EulerRot};
use proptest::prelude::*;

use super::*;

fn config(voxel_m: f64, max_gaussians: usize) -> MapConfig {
    MapConfig { voxel_m, max_gaussians, ..Default::default() }
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

fn insert_all(map: &mut VoxelMap, pose: &Rigid, g: &Gaussians) -> MapCounts {
    map.insert(pose, g, |i| Some(g.opacities[i]), |i| color01(&g.colors[i]))
}

fn covariance64(quat: [f32; 4], scale: [f32; 3]) -> DMat3 {
    let [w, x, y, z] = quat.map(f64::from);
    let r = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let s = DVec3::from(scale.map(f64::from));
    r * DMat3::from_diagonal(s * s) * r.transpose()
}

#[test]
fn one_gaussian_comes_back_as_it_went_in() {
    let pose = Rigid::new(DQuat::from_euler(EulerRot::ZYX, 0.7, -0.2, 0.1), DVec3::new(10.0, -4.0, 2.0));
    let g = random_gaussians(200, 100.0, 3);
    for i in 0..g.len() {
        let mut map = VoxelMap::new(&config(0.25, 100));
        map.set_origin(DVec3::new(1.0, 1.0, 1.0));
        map.insert(&pose, &g, |k| (k == i).then_some(0.5), |_| [0.2, 0.4, 0.6]);
        let c = map.cloud();
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
    }
}

#[test]
fn utm_coordinates_change_nothing() {
    let run = |shift: DVec3| {
        let mut map = VoxelMap::new(&config(0.25, 1_000_000));
        for step in 0..5 {
            let turn = DQuat::from_rotation_z(0.1 * f64::from(step));
            let pose = Rigid::new(turn, shift + DVec3::new(1.3 * f64::from(step), 0.2, 0.0));
            insert_all(&mut map, &pose, &random_gaussians(5000, 30.0, step as u64));
        }
        map.cloud()
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
    let mut map = VoxelMap::new(&config(0.25, 1_000_000));
    let g = random_gaussians(3000, 20.0, 1);
    let first = insert_all(&mut map, &Rigid::IDENTITY, &g);
    let before = map.cloud();
    let second = insert_all(&mut map, &Rigid::IDENTITY, &g);
    let after = map.cloud();
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
    let mut map = VoxelMap::new(&config(0.25, 100));
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
    for weight in [f32::NAN, f32::INFINITY, 0.0, -1.0] {
        assert_eq!(map.insert(&Rigid::IDENTITY, &g, |_| Some(weight), |_| [0.0; 3]).rejected, 1);
    }
    assert_eq!(map.insert(&Rigid::IDENTITY, &g, |_| Some(1.0), |_| [f32::NAN; 3]).rejected, 1);
    let nowhere = Rigid::new(DQuat::IDENTITY, DVec3::NAN);
    assert_eq!(map.insert(&nowhere, &g, |_| Some(1.0), |_| [0.0; 3]).rejected, 1);
    assert!(map.is_empty() && map.cloud().is_empty());
    assert_eq!(map.counts().rejected, bad.len() as u64 + 6);
}

#[test]
fn a_full_map_gives_up_the_least_confident() {
    let mut map = VoxelMap::new(&config(0.25, 1000));
    for step in 0..20 {
        let g = random_gaussians(500, 100.0, 100 + step);
        // Later ones are more confident, so they must be what is left.
        let sum = map.insert(&Rigid::IDENTITY, &g, |_| Some(1.0 + step as f32), |_| [0.5; 3]);
        assert_eq!(sum.created + sum.merged, 500);
        assert!(map.len() <= 1000);
    }
    let c = map.counts();
    assert_eq!(c.created - c.evicted, map.len() as u64);
    assert!(map.cloud().confidences.iter().all(|&w| w >= 17.0), "the last two steps fill the map");
    assert!(map.bytes() < 1000 * 400, "{}", map.bytes());
    for (i, cell) in map.cells.iter().enumerate() {
        assert_eq!(map.index.get(&cell.key), Some(&(i as u32)));
    }
    assert_eq!(map.index.len(), map.cells.len());
}

#[test]
fn the_same_input_gives_the_same_cloud_whatever_the_threads() {
    let run = || {
        let mut map = VoxelMap::new(&config(0.3, 3000));
        for step in 0..10 {
            let pose = Rigid::new(DQuat::from_rotation_z(0.3), DVec3::new(step as f64, 0.0, 0.0));
            insert_all(&mut map, &pose, &random_gaussians(1000, 40.0, step));
        }
        map.cloud()
    };
    let pool = |n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
    let one = pool(1).install(run);
    assert_eq!(one, pool(3).install(run));
    assert!(one.positions.windows(2).all(|p| (p[0][0] / 0.3).floor() <= (p[1][0] / 0.3).floor()));
}

/// A street as the network sees it: `rows x cols` pixels of ground and house fronts, in picture order, x ahead.
fn street(rows: usize, cols: usize) -> Gaussians {
    let mut g = random_gaussians(rows * cols, 1.0, 77);
    for i in 0..rows * cols {
        let (v, u) = ((i / cols) as f32 / rows as f32 - 0.4, (i % cols) as f32 / cols as f32 - 0.5);
        let ground = if v > 0.02 { 1.6 / v } else { 80.0 };
        let front = if u.abs() > 0.02 { 8.0 / u.abs() } else { 80.0 };
        let depth = ground.min(front).min(80.0) * (1.0 + 0.02 * g.means[i][0]);
        g.means[i] = [depth, -u * depth, -v * depth];
    }
    g
}

/// Time this thread has run, ms, without what other programs took (Linux; 0 elsewhere).
fn cpu_ms() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    text.split_whitespace().next().and_then(|ns| ns.parse::<f64>().ok()).unwrap_or(0.0) * 1e-6
}

/// A measurement, not a check: `cargo test --release -p storm-node --lib map::tests::rate -- --ignored --nocapture`.
#[test]
#[ignore = "timing"]
fn rate() {
    let scattered = random_gaussians(40_000, 60.0, 5);
    for (name, g) in [("street", street(160, 250)), ("scattered at random", scattered)] {
        let mut map = VoxelMap::new(&MapConfig::default());
        let mut times_ms = Vec::new();
        for step in 0..100 {
            let turn = DQuat::from_rotation_z(0.01 * f64::from(step));
            let pose = Rigid::new(turn, DVec3::new(5.0 * f64::from(step), 0.0, 0.0));
            let start_ms = cpu_ms();
            insert_all(&mut map, &pose, &g);
            times_ms.push(cpu_ms() - start_ms);
        }
        times_ms.sort_by(f64::total_cmp);
        let start = std::time::Instant::now();
        let n = map.cloud().len();
        let (cloud_ms, mb) = (start.elapsed().as_secs_f64() * 1e3, map.bytes() as f64 / 1e6);
        let [least, p50, p90, worst] = [0, 50, 90, 99].map(|i| times_ms[i]);
        println!(
            "insert 40,000, {name}, CPU: least {least:.1}, p50 {p50:.1}, p90 {p90:.1}, worst {worst:.1} ms; {n} cells, \
             {mb:.0} MB, cloud {cloud_ms:.0} ms; {:?}",
            map.counts(),
        );
    }
}

proptest! {
    /// Against the definition: weighted mean and covariance of the whole mixture, in f64.
    #[test]
    fn a_cell_holds_the_moments_of_its_mixture(seed in any::<u64>(), n in 1usize..40) {
        let g = random_gaussians(n, 2.0, seed);
        let mut map = VoxelMap::new(&config(100.0, 10));
        map.set_origin(DVec3::splat(-50.0));
        insert_all(&mut map, &Rigid::IDENTITY, &g);
        let c = map.cloud();
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
        // f32 at 50 m from the origin, and sums of forty f32 terms.
        prop_assert!((got - mean).length() < 2e-5);
        prop_assert!(covariance64(c.quats[0], c.scales[0]).abs_diff_eq(cov, 2e-5));
        let color = mean_of(&|i| DVec3::from(color01(&g.colors[i]).map(f64::from)));
        prop_assert!((DVec3::from(c.colors01[0].map(f64::from)) - color).length() < 1e-5);
        let opacity = mean_of(&|i| DVec3::splat(f64::from(g.opacities[i]))).x;
        prop_assert!((f64::from(c.opacities[0]) - opacity).abs() < 1e-5);
    }
}
