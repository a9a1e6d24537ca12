//! STORM-B/8 at full size (3 cameras x 4 timesteps x 160 x 240) against the authors' program.
//!
//! The weights come from a hash, so none are stored; the reference numbers were made by running the authors' program in
//! float64. Usage: `cargo run --release -p storm-model --example full_b8 -- FOLDER`, with FOLDER holding
//! `full_b8.safetensors`, `full_b8_weight_table.json` and `full_b8_noise_floor.json`. Prints every tensor's worst error,
//! the run time and the memory used; exits 1 when an error is over the tolerance.

use std::collections::{BTreeMap, HashMap};
use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::Instant;

use candle_core::{Device, IndexOp, Tensor};
use glam::{Affine3A, Mat3A, Vec3A};
use rayon::prelude::*;
use storm_model::scene::{Affine, Scene, Want};
use storm_model::weights::{Tensors, tensor_specs};
use storm_model::{ClipBatch, ClipOutput, ModelConfig, Stages, Storm};
use storm_render::raster::CpuRasterizer;
use storm_render::{Intrinsics, View};

/// Allowed error over the largest difference between the authors' program in f32 and in f64.
const FLOORS: f64 = 4.0;

/// Renders have no floor of their own in the file: 1e-4 of the channel's range, as f32 renders of other scenes differ
/// (colour and alpha about 1, flow a few m/s, depth up to 200 m).
const RENDER_TOLERANCE: f64 = 1e-4;

type Stored = HashMap<String, Tensor>;

#[derive(serde::Deserialize)]
struct Normal {
    mean: f64,
    std: f64,
}

/// SplitMix64 over FNV-1a of the name: the same numbers as the reference run's.
fn hashed(name: &str, count: usize, normal: &Normal) -> Vec<f32> {
    let start = name.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3));
    let value = |i: usize| {
        let mut s = start.wrapping_add((i as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        s = (s ^ s >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        s = (s ^ s >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        s ^= s >> 31;
        let u = (s >> 40) as f64 * (-24f64).exp2();
        (normal.mean + normal.std * 12f64.sqrt() * (u - 0.5)) as f32
    };
    (0..count).into_par_iter().map(value).collect()
}

fn weights(config: &ModelConfig, table: &HashMap<String, Normal>) -> Result<Tensors, Box<dyn Error>> {
    let mut tensors = Tensors::new();
    for spec in tensor_specs(config) {
        let count = spec.shape.iter().product();
        let mut values = match table.get(&spec.name) {
            Some(normal) => hashed(&spec.name, count, normal),
            None if spec.name == "max_scale" => vec![config.max_scale as f32],
            None => return Err(format!("no mean and deviation for {}", spec.name).into()),
        };
        if spec.name == "gs_pred.bias" {
            let shifts = [-2.7f32, -0.6, -0.6, -0.6, 0.6, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0, 0.0];
            values.iter_mut().enumerate().for_each(|(i, x)| *x += shifts[i % 12]);
        }
        tensors.insert(spec.name, Tensor::from_vec(values, spec.shape, &Device::Cpu)?);
    }
    Ok(tensors)
}

fn numbers(x: &Tensor) -> candle_core::Result<Vec<f32>> {
    x.flatten_all()?.to_vec1()
}

struct Report {
    stored: Stored,
    failed: usize,
}

impl Report {
    fn compare(&mut self, name: &str, ours: &[f32], tolerance: f64) -> Result<(), Box<dyn Error>> {
        let theirs = numbers(&self.stored[name])?;
        if ours.len() != theirs.len() {
            return Err(format!("{name}: {} values, {} stored", ours.len(), theirs.len()).into());
        }
        self.worst(name, ours.iter().zip(&theirs).map(|(a, b)| f64::from((a - b).abs())), tolerance);
        Ok(())
    }

    fn worst(&mut self, name: &str, differences: impl Iterator<Item = f64>, tolerance: f64) {
        let worst = differences.fold(0.0, |m: f64, d| if d.is_nan() { f64::INFINITY } else { m.max(d) });
        let verdict = if worst <= tolerance { "ok" } else { "TOO FAR" };
        println!("  {name:<20} worst {worst:.2e}, allowed {tolerance:.2e}  {verdict}");
        self.failed += usize::from(verdict != "ok");
    }
}

fn clip(stored: &Stored) -> Result<ClipBatch, Box<dyn Error>> {
    let image = hashed("context_image", 4 * 3 * 3 * 160 * 240, &Normal { mean: 0.0, std: 0.5 });
    if image[..16] != numbers(&stored["context_image_probe"])?[..] {
        return Err("the hash makes other numbers here than in the reference run".into());
    }
    Ok(ClipBatch {
        image: Tensor::from_vec(image, (1, 4, 3, 3, 160, 240), &Device::Cpu)?,
        intrinsics: stored["context_intrinsics"].clone(),
        world_from_camera: stored["context_camtoworlds"].clone(),
        time_sec: (&stored["context_time"] * 2.0)?,
        valid: None,
        timespan_sec: 2.0,
        prior: None,
    })
}

/// Rows `index` of `(rows, c)` values.
fn rows(values: &[f32], c: usize, index: &[usize]) -> Vec<f32> {
    index.iter().flat_map(|&i| values[i * c..(i + 1) * c].iter().copied()).collect()
}

fn check_network(
    report: &mut Report,
    output: &ClipOutput,
    stages: &Stages,
    floors: &HashMap<String, BTreeMap<String, f64>>,
) -> Result<(), Box<dyn Error>> {
    let tokens: Vec<usize> = report.stored["token_index"].to_vec1::<i32>()?.iter().map(|&i| i as usize).collect();
    let pixels: Vec<usize> = report.stored["pix_index"].to_vec1::<i32>()?.iter().map(|&i| i as usize).collect();
    for name in ["tokens_in", "block_0", "block_5", "block_11", "tokens_norm"] {
        let stage = stages.get(name).ok_or(name)?;
        let ours = rows(&numbers(stage)?, stage.dim(2)?, &tokens);
        report.compare(name, &ours, FLOORS * floors[name]["f32_max"])?;
    }
    let weights = output.motion_weights.as_ref().ok_or("motion weights")?;
    let sampled: [(&str, &Tensor, usize); 8] = [
        ("depths", &output.depths, 1),
        ("means", &output.means, 3),
        ("scales", &output.scales, 3),
        ("quats", &output.quats, 4),
        ("opacities", &output.opacities, 1),
        ("colors", &output.colors, 3),
        ("forward_flow", &output.velocity_forward, 3),
        ("motion_weights", weights, 16),
    ];
    for (name, tensor, c) in sampled {
        report.compare(name, &rows(&numbers(tensor)?, c, &pixels), FLOORS * floors[name]["f32_max"])?;
    }
    let whole = [
        ("motion_bases", output.motion_bases.as_ref()),
        ("affine", output.affine.as_ref()),
        ("sky_token", output.sky_token.as_ref()),
    ];
    for (name, tensor) in whole {
        report.compare(name, &numbers(tensor.ok_or(name)?)?, FLOORS * floors[name]["f32_max"])?;
    }
    Ok(())
}

/// The front camera at 0.3 s: before sky and exposure, every fourth row and column.
fn check_render(report: &mut Report, mut scene: Scene) -> Result<(), Box<dyn Error>> {
    let m = numbers(&report.stored["target_camtoworlds"].i((0, 0, 1))?)?;
    let k = numbers(&report.stored["target_intrinsics"].i((0, 0, 1))?)?;
    let time_sec = 2.0 * numbers(&report.stored["target_time"])?[1];
    let column = |c: usize| Vec3A::new(m[c], m[4 + c], m[8 + c]);
    let pose = Affine3A { matrix3: Mat3A::from_cols(column(0), column(1), column(2)), translation: column(3) };
    let view = View::from_pose(pose, Intrinsics { fx: k[0], fy: k[4], cx: k[2], cy: k[5], width: 240, height: 160 });
    scene.sky = None;
    scene.affine = vec![Affine::IDENTITY; 3];
    let mut rasterizer = CpuRasterizer::new(scene.raster_settings())?;
    let start = Instant::now();
    let views = scene.render(&mut rasterizer, &[(view, Some(1))], time_sec, Want { flow: true, motion: false })?;
    println!("render of one view with flow: {:.0} ms", start.elapsed().as_secs_f64() * 1e3);
    let view = &views[0];
    let flow = view.flow.as_ref().ok_or("no flow was rendered")?;
    let theirs = numbers(&report.stored["render_view1_s4"])?;
    let fragile: Vec<u8> = report.stored["fragile_view1_s4"].flatten_all()?.to_vec1()?;
    let channels: [(&str, std::ops::Range<usize>, f64); 4] = [
        ("render colour", 0..3, 1.0),
        ("render flow", 3..6, 4.0),
        ("render depth", 6..7, 200.0),
        ("render alpha", 7..8, 1.0),
    ];
    for (name, range, scale) in channels {
        let safe = (0..40 * 60).filter(|&i| fragile[i] == 0);
        let differences = safe.flat_map(|i| {
            let pixel = (i / 60 * 4) * 240 + i % 60 * 4;
            let (c, f) = (view.color[pixel], flow[pixel]);
            let ours = [c[0], c[1], c[2], f[0], f[1], f[2], view.depth[pixel], view.alpha[pixel]];
            let theirs = &theirs[8 * i..8 * i + 8];
            range.clone().map(|k| f64::from((ours[k] - theirs[k]).abs())).collect::<Vec<_>>()
        });
        report.worst(name, differences, RENDER_TOLERANCE * scale);
    }
    Ok(())
}

/// Most memory this process has held so far, MB (Linux).
fn peak_rss_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? / 1024.0)
}

fn main() -> Result<(), Box<dyn Error>> {
    let folder: PathBuf = std::env::args().nth(1).ok_or("usage: full_b8 FOLDER")?.into();
    let json = |name: &str| std::fs::read_to_string(Path::new(&folder).join(name));
    let table = serde_json::from_str(&json("full_b8_weight_table.json")?)?;
    let floors = serde_json::from_str(&json("full_b8_noise_floor.json")?)?;
    let stored = candle_core::safetensors::load(folder.join("full_b8.safetensors"), &Device::Cpu)?;
    let config = ModelConfig::preset("b8")?;
    let storm = Storm::new(&config, &weights(&config, &table)?)?;
    let clip = clip(&stored)?;

    let mut stages = Stages::only(&["tokens_in", "block_0", "block_5", "block_11", "tokens_norm"]);
    let start = Instant::now();
    let output = storm.forward_stages(&clip, &mut stages)?;
    println!("forward: {:.1} s (first run: weights are packed on the way)", start.elapsed().as_secs_f64());
    let mut report = Report { stored, failed: 0 };
    check_network(&mut report, &output, &stages, &floors)?;
    let start = Instant::now();
    let scene = output.scene(0)?;
    println!("to plain numbers: {:.0} ms", start.elapsed().as_secs_f64() * 1e3);
    check_render(&mut report, scene)?;
    if let Some(peak) = peak_rss_mb() {
        println!("peak memory: {peak:.0} MB");
    }
    if report.failed > 0 {
        return Err(format!("{} tensors are too far off", report.failed).into());
    }
    Ok(())
}
