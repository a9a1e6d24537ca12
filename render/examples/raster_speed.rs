//! Milliseconds to render the load of one step, and to take its gradients: 460,800 pixel-aligned Gaussians (12 images of 160x240: three cameras at
//! four times along a straight drive) into three 160x240 views.
//!
//! `cargo run --release -p storm-render --example raster_speed [repeats] [yaw_deg]`; `yaw_deg` is the angle between
//! neighbouring cameras: at 50 (the default) each sees its own third of the Gaussians, at 0 all see all of them.

use glam::{Affine3A, Mat3, Quat, Vec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::time::Instant;
use storm_render::raster::{
    CpuRasterizer, Picture, PictureGradient, RasterError, RasterSettings, SplatGradients, Splats,
};
use storm_render::{Intrinsics, View};

const WIDTH: usize = 240;
const HEIGHT: usize = 160;
/// Standard deviation of a Gaussian in the picture it was made from, pixels.
const SIGMA_PX: f32 = 0.5;

/// Three cameras, `yaw_deg` apart, at `forward` metres along x (x forward, y left, z up).
fn rig(forward: f32, yaw_deg: f32) -> [View; 3] {
    let base_from_camera = Mat3::from_cols(Vec3::NEG_Y, Vec3::NEG_Z, Vec3::X);
    [yaw_deg, 0.0, -yaw_deg].map(|yaw_deg| {
        let rotation = Mat3::from_quat(Quat::from_rotation_z(yaw_deg.to_radians())) * base_from_camera;
        let pose = Affine3A::from_mat3_translation(rotation, Vec3::new(forward, 0.0, 1.5));
        View::from_pose(pose, Intrinsics::from_fov(55.0, WIDTH, HEIGHT))
    })
}

struct Scene {
    means: Vec<[f32; 3]>,
    quats: Vec<[f32; 4]>,
    scales: Vec<[f32; 3]>,
    opacities: Vec<f32>,
}

/// One Gaussian per pixel; depths vary smoothly over the picture (surfaces) with a few per cent of noise.
fn scene(rng: &mut ChaCha8Rng, yaw_deg: f32) -> Scene {
    let mut s = Scene { means: vec![], quats: vec![], scales: vec![], opacities: vec![] };
    for step in 0..4 {
        for view in rig(step as f32 * 5.0, yaw_deg) {
            let camera = view.intrinsics;
            let pose = view.world_from_camera();
            let phase: [f32; 3] = std::array::from_fn(|_| rng.random_range(0.0..6.3));
            for row in 0..HEIGHT {
                for col in 0..WIDTH {
                    let (u, v) = (col as f32 + 1.0, row as f32 + 1.0);
                    let waves = (u * 0.05 + phase[0]).sin() + (v * 0.07 + phase[1]).sin() + (u * 0.11 + phase[2]).cos();
                    let depth =
                        3.0 * (80.0f32 / 3.0).powf((waves / 6.0 + 0.5 + rng.random_range(-0.02..0.02)).clamp(0.0, 1.0));
                    s.means.push(pose.transform_point3(camera.ray(u, v) * depth).into());
                    s.quats.push(std::array::from_fn(|_| rng.random_range(-1.0..1.0)));
                    let scale = SIGMA_PX * depth / camera.fx;
                    s.scales.push(std::array::from_fn(|_| scale * rng.random_range(0.7..1.3)));
                    s.opacities.push(rng.random_range(0.3..1.0));
                }
            }
        }
    }
    s
}

/// Processor time of this process so far, all threads, milliseconds; `None` where `/proc` does not say.
fn cpu_ms() -> Option<f64> {
    /// Linux reports these times in hundredths of a second.
    const TICK_MS: f64 = 10.0;
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The fields after the command, which ends at the last parenthesis; user and system time are numbers 14 and 15.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks = |field: usize| fields.get(field)?.parse::<f64>().ok();
    Some((ticks(11)? + ticks(12)?) * TICK_MS)
}

/// Runs `work` once and then `repeats` times; the times of the repeats, in words.
fn measure(repeats: usize, mut work: impl FnMut() -> Result<(), RasterError>) -> Result<String, RasterError> {
    let mut times_ms = Vec::new();
    let mut cpu_start = None;
    for repeat in 0..=repeats {
        if repeat == 1 {
            cpu_start = cpu_ms();
        }
        let start = Instant::now();
        work()?;
        times_ms.push(start.elapsed().as_secs_f64() * 1e3);
    }
    let cpu = cpu_start.zip(cpu_ms()).map_or(f64::NAN, |(from, to)| (to - from) / repeats as f64);
    let first_ms = times_ms.remove(0);
    times_ms.sort_by(f64::total_cmp);
    Ok(format!(
        "median {:.1} ms, best {:.1} ms, first {first_ms:.1} ms, processor time {cpu:.0} ms",
        times_ms.get(times_ms.len() / 2).copied().unwrap_or(first_ms),
        times_ms.first().copied().unwrap_or(first_ms),
    ))
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let repeats: usize = std::env::args().nth(1).map_or(Ok(15), |a| a.parse())?;
    let yaw_deg: f32 = std::env::args().nth(2).map_or(Ok(50.0), |a| a.parse())?;
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let scene = scene(&mut rng, yaw_deg);
    let views = rig(11.0, yaw_deg);
    println!("{} Gaussians, 3 views of {WIDTH}x{HEIGHT}, {} threads", scene.means.len(), rayon::current_num_threads());
    for channels in [3, 6, 22] {
        let features: Vec<f32> = (0..scene.means.len() * channels).map(|_| rng.random_range(-1.0..1.0)).collect();
        let splats = Splats {
            means: &scene.means,
            quats: &scene.quats,
            scales: &scene.scales,
            opacities: &scene.opacities,
            features: &features,
            feature_count: channels,
        };
        let mut rasterizer = CpuRasterizer::new(RasterSettings::default())?;
        let mut pictures: Vec<Picture> = Vec::new();
        let forward = measure(repeats, || rasterizer.render_into(&splats, &views, &mut pictures))?;
        println!("{channels:2} channels: forward {forward}");
        let mut values = |n: usize| (0..n).map(|_| rng.random_range(-1.0f32..1.0)).collect::<Vec<_>>();
        let upstream: Vec<PictureGradient> = pictures
            .iter()
            .map(|p| PictureGradient {
                features: values(p.features.len()),
                alpha: values(p.alpha.len()),
                depth: values(p.depth.len()),
            })
            .collect();
        let mut gradients = SplatGradients::default();
        let both = measure(repeats, || {
            rasterizer.render_into(&splats, &views, &mut pictures)?;
            rasterizer.backward_into(&splats, &views, &pictures, &upstream, &mut gradients)
        })?;
        let touched = gradients.opacities.iter().filter(|&&x| x != 0.0).count();
        let covered = pictures.iter().flat_map(|p| &p.alpha).filter(|&&a| a > 0.99).count();
        println!("             with backward {both}; {touched} Gaussians have a gradient");
        println!(
            "             {:?}; {:.0}% of pixels opaque",
            rasterizer.stats(),
            100.0 * covered as f64 / (3 * WIDTH * HEIGHT) as f64,
        );
    }
    Ok(())
}
