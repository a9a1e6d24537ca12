//! Time per fused window at `tiny`'s size.

use super::*;

/// A measurement, not a check: `cargo test --release -p storm-node --lib map::tests::rate -- --ignored --nocapture`.
#[test]
#[ignore = "timing"]
fn rate() {
    // Four timesteps, three cameras of 96 x 64 pixels: ground and house fronts, x ahead.
    let (w, h) = (96, 64);
    let k = Intrinsics::from_fov(50.0, w, h);
    let mut g = random_gaussians(12 * w * h, 1.0, 77);
    for i in 0..g.len() {
        let ray = k.ray((i % w) as f32 + 0.5, (i / w % h) as f32 + 0.5);
        let yaw = (i / (w * h) % 3) as f32 - 1.0;
        let d = glam::Quat::from_rotation_z(0.8 * yaw) * Vec3::new(1.0, -ray.x, -ray.y);
        let ground = if d.z < -0.02 { 1.6 / -d.z } else { 80.0 };
        let front = if d.y.abs() > 0.02 { 9.0 / d.y.abs() } else { 80.0 };
        let depth = ground.min(front).min(80.0) * (1.0 + 0.003 * g.means[i][0]);
        let back = -5.0 * (3 - i / (3 * w * h)) as f32;
        g.means[i] = (d * depth + Vec3::X * back).to_array();
        g.scales[i] = [0.5 * depth / k.fx; 3];
    }
    let eyes: Vec<Eye> =
        (0..12).map(|p| Eye { position: Vec3::X * (-5.0 * (3 - p / 3) as f32), pixel_rad: 1.0 / k.fx }).collect();
    let mut map = StaticMap::new(&MapConfig::default());
    let (mut wall_ms, first_new) = (Vec::new(), 9 * w * h);
    let start_ms = cpu_ms().unwrap_or(0.0);
    let steps = 200;
    for step in 0..steps {
        let pose = Rigid::new(DQuat::from_rotation_z(0.002 * f64::from(step)), DVec3::X * f64::from(step));
        let views: Vec<DepthView> = (0..3u32)
            .map(|c| {
                let yaw = Rigid::new(DQuat::from_rotation_z(0.8 * (f64::from(c) - 1.0)), DVec3::ZERO);
                let camera = crate::window::camera_from_flu().inverse();
                let depth = (0..w * h).map(|p| g.means[(9 + c as usize) * w * h + p]).map(|m| Vec3::from(m).length());
                DepthView { map_from_camera: pose * yaw * camera, intrinsics: k, depth: depth.collect() }
            })
            .collect();
        let window = MapWindow {
            stamp_ns: i64::from(step) * 100_000_000,
            map_from_anchor: &pose,
            gaussians: &g,
            eyes: &eyes,
            pixels: w * h,
            first_new,
            views: &views,
        };
        let start = std::time::Instant::now();
        map.fuse(&window, |i| Some(confidence(g.opacities[i], 10.0)), |i| color01(&g.colors[i]));
        wall_ms.push(start.elapsed().as_secs_f64() * 1e3);
    }
    let cpu = (cpu_ms().unwrap_or(0.0) - start_ms) / f64::from(steps);
    wall_ms.sort_by(f64::total_cmp);
    let at = |q: f64| wall_ms[(q * f64::from(steps - 1)) as usize];
    println!(
        "fuse {} Gaussians, {} threads: wall p50 {:.1}, p90 {:.1}, p99 {:.1} ms; CPU mean {cpu:.1} ms; {} cells in {} \
         tiles, {:.0} MB; {:?}",
        g.len(),
        rayon::current_num_threads(),
        at(0.5),
        at(0.9),
        at(0.99),
        map.len(),
        map.tiles.len(),
        map.bytes() as f64 / 1e6,
        map.counts(),
    );
}
