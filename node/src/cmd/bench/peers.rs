//! What the network is compared with: the baselines of `storm eval` on the same clips, the authors' shapes in PyTorch, and the
//! procedural drive, whose speed bounds training.

use std::path::Path;
use std::process::Command;
use std::time::Instant;

use anyhow::{Context, Result};
use serde_json::json;
use storm_render::world::{Drive, DriveOptions};

use super::network::Data;
use super::pairs::median;
use crate::config::Config;
use crate::engine::evaluate::{Effort, Evaluation, Method};
use crate::engine::figures::Figures;
use crate::engine::{Engine, ModelSource};

const SEED: u64 = 424_242;
/// Images drawn to time the drive.
const WORLD_IMAGES: usize = 180;

/// The methods' figures and run times on the clips.
pub(super) fn baselines(
    data: &Data,
    methods: &[Method],
    tick: &mut dyn FnMut(),
) -> Result<Vec<(&'static str, Figures)>> {
    if methods.is_empty() || data.clips.is_empty() {
        return Ok(Vec::new());
    }
    let config = Config::default();
    let source = ModelSource::open(&config.model)?;
    let engine = Engine::new(source, &config.model, data.clips[0].cameras.len(), config.window.timespan_sec)?;
    let mut evaluation = Evaluation::new(engine, None, methods, Effort::default());
    for clip in &data.clips {
        evaluation.add(clip, &mut |_, _| {})?;
        tick();
    }
    Ok(evaluation.figures().into_iter().map(|(method, figures)| (method.name(), figures)).collect())
}

/// Images with all ground truth per second.
pub(super) fn time_world() -> Result<(f64, serde_json::Value)> {
    let options = DriveOptions { seed: SEED, seconds: 10.0, width: 240, height: 160, ..DriveOptions::default() };
    let drive = Drive::new(&options)?;
    let cameras = drive.cameras().len();
    drive.render(0, 0.0);
    let start = Instant::now();
    for i in 0..WORLD_IMAGES {
        let frame = (i / cameras) % drive.frame_count();
        std::hint::black_box(drive.render(i % cameras, drive.frame_time_sec(frame, i % cameras)));
    }
    let fps = WORLD_IMAGES as f64 / start.elapsed().as_secs_f64();
    Ok((fps, json!({"images_per_sec": fps, "picture": [240, 160], "images": WORLD_IMAGES})))
}

/// Runs of the peer each time it is called, the first of them cold.
const PEER_RUNS: &str = "2";

/// The same shapes in PyTorch at B/8's size: two more runs to those `before`.
pub(super) fn time_peer(python: &Path, before: Option<&serde_json::Value>) -> Result<serde_json::Value> {
    let script = "tests/python/peer_network.py";
    let output = Command::new(python)
        .args([script, "--runs", PEER_RUNS])
        .output()
        .with_context(|| format!("cannot run {} {script} (from the project's root)", python.display()))?;
    let text = String::from_utf8_lossy(&output.stdout);
    let mut peer: serde_json::Value = serde_json::from_str(text.trim()).with_context(|| {
        format!("the peer failed: {}", String::from_utf8_lossy(&output.stderr).lines().last().unwrap_or("no output"))
    })?;
    let runs = |peer: &serde_json::Value| -> Vec<f64> {
        peer["seconds"].as_array().into_iter().flatten().filter_map(serde_json::Value::as_f64).collect()
    };
    let mut seconds = before.map_or_else(Vec::new, runs);
    seconds.extend(runs(&peer));
    peer["seconds"] = json!(seconds);
    peer["median_s"] = json!(median(seconds));
    Ok(peer)
}
