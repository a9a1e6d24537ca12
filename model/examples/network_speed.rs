//! Time of one forward pass of a preset with random weights, against the machine's multiply-add peak.
//!
//! `cargo run --release -p storm-model --example network_speed [tiny|small|b8] [runs]`. Prints wall and processor time per
//! forward pass and per conversion to plain numbers, medians and least, the counted products and the time they would take
//! at the peak measured in between (the floor). Processor time is the one to read on a machine that others use.

mod common;

use std::error::Error;
use std::time::Instant;

use candle_core::Device;
use common::{cpu_seconds, fma_peak};
use glam::{Affine3A, Vec3};
use storm_model::kernels::Isa;
use storm_model::{ClipBatch, ModelConfig, PixelLayout, Storm, ViewInput};
use storm_render::Intrinsics;

/// Cameras and timesteps of the window, the paper's.
const CAMERAS: usize = 3;
const TIMESTEPS: usize = 4;

/// Multiply-adds of one forward pass, by part.
fn products(c: &ModelConfig) -> Vec<(&'static str, f64)> {
    let patches = (c.image_height / c.patch_size) * (c.image_width / c.patch_size) * CAMERAS * TIMESTEPS;
    let (n, d, p) = ((patches + c.auxiliary_tokens()) as f64, c.embed_dim as f64, (c.patch_size * c.patch_size) as f64);
    let (patches, depth, ratio) = (patches as f64, c.depth as f64, c.mlp_ratio as f64);
    let (mut up, mut rows, mut width) = (0.0, patches, d);
    for &next in &c.upsampler_widths {
        up += rows * width * 4.0 * next as f64;
        (rows, width) = (4.0 * rows, next as f64);
    }
    let (hidden, e, m) = (c.key_hidden as f64, c.projected_motion_dim as f64, c.num_motion_tokens as f64);
    vec![
        ("attention", depth * 2.0 * n * n * d),
        ("linears", depth * n * d * d * (4.0 + 2.0 * ratio)),
        ("embedding", patches * ModelConfig::INPUT_CHANNELS as f64 * p * d),
        ("Gaussian head", patches * d * p * ModelConfig::GAUSSIAN_CHANNELS as f64),
        ("upsampler", up),
        ("motion keys and weights", rows * (width * hidden + hidden * e + m * (e + c.velocity_channels() as f64))),
    ]
}

fn window(c: &ModelConfig) -> Result<ClipBatch, Box<dyn Error>> {
    let (w, h) = (c.image_width, c.image_height);
    let pictures: Vec<Vec<f32>> = (0..CAMERAS * TIMESTEPS)
        .map(|k| (0..3 * w * h).map(|i| ((i * 7 + k * 1013) as f32 * 0.011).sin()).collect())
        .collect();
    let views: Vec<Vec<ViewInput>> = (0..TIMESTEPS)
        .map(|t| {
            let view = |camera: usize| ViewInput {
                rgb: &pictures[t * CAMERAS + camera],
                intrinsics: Intrinsics {
                    fx: w as f32,
                    fy: w as f32,
                    cx: w as f32 / 2.0,
                    cy: h as f32 / 2.0,
                    width: w,
                    height: h,
                },
                world_from_camera: Affine3A::from_rotation_y(camera as f32 - 1.0)
                    * Affine3A::from_translation(Vec3::new(0.0, 0.0, t as f32)),
                time_sec: 0.5 * t as f32,
            };
            (0..CAMERAS).map(view).collect()
        })
        .collect();
    Ok(ClipBatch::from_views(&views, PixelLayout::Hwc, 2.0, &Device::Cpu)?)
}

/// Least and median, milliseconds.
fn summary(mut seconds: Vec<f64>) -> String {
    seconds.sort_by(f64::total_cmp);
    match (seconds.first(), seconds.get(seconds.len() / 2)) {
        (Some(least), Some(median)) => format!("least {:8.2} ms, median {:8.2} ms", least * 1e3, median * 1e3),
        _ => "not known here".into(),
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let preset = args.next().unwrap_or_else(|| "tiny".into());
    let runs: usize = args.next().map_or(Ok(20), |x| x.parse())?;
    let config = ModelConfig::preset(&preset)?;
    let storm = Storm::untrained(&config, 1, &Device::Cpu)?;
    let batch = window(storm.config())?;
    storm.forward(&batch)?.scene(0)?;
    let (mut walls, mut cpus, mut plain, mut peaks) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for _ in 0..runs {
        peaks.push(fma_peak());
        let (start, cpu) = (Instant::now(), cpu_seconds());
        let output = storm.forward(&batch)?;
        walls.push(start.elapsed().as_secs_f64());
        let middle = cpu_seconds();
        std::hint::black_box(output.scene(0)?);
        cpus.extend(cpu.zip(middle).map(|(a, b)| b - a));
        plain.extend(middle.zip(cpu_seconds()).map(|(a, b)| b - a));
    }
    let peak = peaks.into_iter().fold(0.0, f64::max);
    let parts = products(&config);
    let flop = 2.0 * parts.iter().map(|(_, x)| x).sum::<f64>();
    let threads = rayon::current_num_threads();
    println!(
        "{preset}: {:.2} GFLOP; {:?}, {threads} threads, peak {:.1} GFLOP/s a thread",
        flop / 1e9,
        Isa::detect(),
        peak / 1e9
    );
    for (name, products) in parts {
        println!("  {name:24} {:7.3} GFLOP, {:8.2} ms of a thread at peak", 2e-9 * products, 2e3 * products / peak);
    }
    println!("floor: {:.2} ms of processor time", 1e3 * flop / peak);
    if let Some(least) = cpus.iter().copied().min_by(f64::total_cmp) {
        println!("{:.1} % of the peak (least processor time)", 100.0 * flop / peak / least);
    }
    println!("forward, wall:              {}", summary(walls));
    println!("forward, processor time:    {}", summary(cpus));
    println!("plain numbers, processor:   {}", summary(plain));
    Ok(())
}
