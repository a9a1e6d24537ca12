//! Time of one forward pass of a preset with random weights, against the machine's multiply-add peak.
//!
//! `cargo run --release -p storm-model --example network_speed [shipped|tiny|base|b8][@WIDTHxHEIGHT] [runs] [setting]...`,
//! where a setting is parts joined by `+`: `int8`, `pool2`, `int16+merge0.3`, `keep0.7`, `newest`. Settings are timed in turn, round
//! by round, and their results compared with those of f32. Prints wall and processor time per
//! forward pass and per conversion to plain numbers, medians and least, the counted products and the time they would take
//! at the peak measured in between (the floor). Processor time is the one to read on a machine that others use.

mod common;

use std::error::Error;
use std::time::Instant;

use candle_core::Device;
use common::{cpu_seconds, fma_peak};
use glam::{Affine3A, Vec3};
use storm_model::kernels::Isa;
use storm_model::{ClipBatch, ModelConfig, PixelLayout, Shortcuts, Storm, ViewInput, weights};
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
                valid: None,
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

/// One way to run the network: parts joined by `+`, each `f32`, `bf16`, `int16`, `int8`, `pool2`, `merge0.3`, `keep0.7` or
/// `newest`.
fn shortcuts(text: &str, image_tokens: usize) -> Result<Shortcuts, Box<dyn Error>> {
    let mut shortcuts = Shortcuts::default();
    for part in text.split('+') {
        if let Ok(precision) = part.parse() {
            shortcuts.precision = precision;
        } else if let Some(side) = part.strip_prefix("pool") {
            shortcuts.kv_pool = side.parse()?;
        } else if let Some(share) = part.strip_prefix("merge") {
            shortcuts.merge = share.parse()?;
        } else if let Some(share) = part.strip_prefix("keep") {
            let share: f64 = share.parse()?;
            // Evenly spread.
            let keep = |i: usize| (i as f64 * share).fract() < share;
            shortcuts.keep = Some((0..image_tokens).map(keep).collect());
        } else if part == "newest" {
            shortcuts.newest_only = true;
        } else {
            return Err(format!("'{part}' is no setting; see the head of this example").into());
        }
    }
    Ok(shortcuts)
}

/// Root mean square of the difference of the newest timestep's values, over that of the exact ones.
fn apart(got: &[f32], want: &[f32]) -> f64 {
    let want = &want[want.len() - got.len()..];
    let square = |x: f32| f64::from(x) * f64::from(x);
    let sum: f64 = got.iter().zip(want).map(|(a, b)| square(a - b)).sum();
    (sum / want.iter().map(|&b| square(b)).sum::<f64>().max(f64::MIN_POSITIVE)).sqrt()
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let preset = args.next().unwrap_or_else(|| "tiny".into());
    let runs: usize = args.next().map_or(Ok(20), |x| x.parse())?;
    let ways: Vec<String> = args.collect();
    let (name, size) = preset.split_once('@').map_or((&preset[..], None), |(name, size)| (name, Some(size)));
    let shipped = name == "shipped";
    let mut config = ModelConfig::preset(if shipped { "tiny" } else { name })?;
    let storm = if shipped {
        let (shipped, tensors) = weights::shipped(&Device::Cpu)?;
        config = shipped;
        Storm::new(&config, &tensors)?
    } else {
        Storm::untrained(&config, 1, &Device::Cpu)?
    };
    if let Some((width, height)) = size.and_then(|size| size.split_once('x')) {
        (config.image_width, config.image_height) = (width.parse()?, height.parse()?);
    }
    let batch = window(&config)?;
    let image_tokens =
        (config.image_height / config.patch_size) * (config.image_width / config.patch_size) * CAMERAS * TIMESTEPS;
    let exact = storm.forward(&batch)?.scene(0)?;
    let mut settings = vec![("f32".to_string(), Shortcuts::default())];
    for way in ways {
        let chosen = shortcuts(&way, image_tokens)?;
        settings.push((way, chosen));
    }
    let (mut plain, mut peaks) = (Vec::new(), Vec::new());
    let (mut walls, mut cpus) = (vec![Vec::new(); settings.len()], vec![Vec::new(); settings.len()]);
    for (_, setting) in &settings {
        storm.forward_with(&batch, setting)?;
    }
    for _ in 0..runs {
        peaks.push(fma_peak());
        for (k, (_, setting)) in settings.iter().enumerate() {
            let (start, cpu) = (Instant::now(), cpu_seconds());
            let output = storm.forward_with(&batch, setting)?;
            walls[k].push(start.elapsed().as_secs_f64());
            let middle = cpu_seconds();
            cpus[k].extend(cpu.zip(middle).map(|(a, b)| b - a));
            if k == 0 {
                std::hint::black_box(output.scene(0)?);
                plain.extend(middle.zip(cpu_seconds()).map(|(a, b)| b - a));
            }
        }
    }
    let peak = peaks.into_iter().fold(0.0, f64::max);
    let parts = products(&config);
    let flop = 2.0 * parts.iter().map(|(_, x)| x).sum::<f64>();
    let threads = rayon::current_num_threads();
    println!(
        "{preset}: {image_tokens} image tokens, {:.2} GFLOP; {:?}, {threads} threads, peak {:.1} GFLOP/s a thread",
        flop / 1e9,
        Isa::detect(),
        peak / 1e9
    );
    for (name, products) in parts {
        println!("  {name:24} {:7.3} GFLOP, {:8.2} ms of a thread at peak", 2e-9 * products, 2e3 * products / peak);
    }
    println!("floor: {:.2} ms of processor time", 1e3 * flop / peak);
    if let Some(least) = cpus[0].iter().copied().min_by(f64::total_cmp) {
        println!("{:.1} % of the peak (least processor time)", 100.0 * flop / peak / least);
    }
    println!("plain numbers, processor:   {}", summary(plain));
    for (k, (name, setting)) in settings.iter().enumerate() {
        // Of each round, so that what else the machine does at the time is in both.
        let mut ratios: Vec<f64> = cpus[k].iter().zip(&cpus[0]).map(|(a, b)| a / b).collect();
        ratios.sort_by(f64::total_cmp);
        let ratio = ratios.get(ratios.len() / 2).copied().unwrap_or(f64::NAN);
        println!("{name:20} wall      {}", summary(walls[k].clone()));
        println!("{:20} processor {}, {ratio:.3} of f32 (median)", "", summary(cpus[k].clone()));
        if k > 0 {
            let scene = storm.forward_with(&batch, setting)?.scene(0)?;
            let figures = [
                ("depth", apart(&scene.depths, &exact.depths)),
                ("opacity", apart(&scene.gaussians.opacities, &exact.gaussians.opacities)),
                ("colour", apart(scene.gaussians.colors.as_flattened(), exact.gaussians.colors.as_flattened())),
                (
                    "velocity",
                    apart(
                        scene.gaussians.velocity_forward.as_flattened(),
                        exact.gaussians.velocity_forward.as_flattened(),
                    ),
                ),
            ];
            let text: Vec<String> = figures.iter().map(|(name, x)| format!("{name} {x:.2e}")).collect();
            println!("{:20} apart     {}", "", text.join(", "));
        }
    }
    Ok(())
}
