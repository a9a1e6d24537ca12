//! What the network is compared with: the baselines of `storm eval` on the same clips, the authors' shapes in PyTorch, and the
//! procedural drive, whose speed bounds training.

use std::path::Path;
use std::process::Command;
use std::time::Instant;

use anyhow::{Context, Result};
use serde::Serialize;
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

/// Runs of each peer each time it is called, the first of them cold.
const PEER_RUNS: &str = "2";
/// How PyTorch is asked to run the network: name and options of the script.
const PEERS: [(&str, &[&str]); 4] = [
    ("f32, eager", &[]),
    ("f32, compiled", &["--compile"]),
    ("bf16, eager", &["--bf16"]),
    ("bf16, compiled", &["--bf16", "--compile"]),
];

/// The network's shapes at B/8's size in another program.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Peer {
    pub name: &'static str,
    /// Every run.
    pub seconds: Vec<f64>,
    pub median_s: Option<f64>,
    /// How many times longer the largest network's default takes.
    pub times_less: Option<f64>,
    /// What it said of itself the last time.
    pub said: serde_json::Value,
    /// Why it gave no figures.
    pub failed: Option<String>,
}

/// Every way of running PyTorch: two more runs to those before. A way that fails (compiling wants a C++ compiler) says so.
pub(super) fn time_peers(python: &Path, peers: &mut Vec<Peer>) -> Result<()> {
    if peers.is_empty() {
        let new = |name| Peer {
            name,
            seconds: Vec::new(),
            median_s: None,
            times_less: None,
            said: json!(null),
            failed: None,
        };
        peers.extend(PEERS.map(|(name, _)| new(name)));
    }
    let script = "tests/python/peer_network.py";
    for (peer, (_, options)) in peers.iter_mut().zip(PEERS) {
        let output = Command::new(python)
            .args([script, "--runs", PEER_RUNS])
            .args(options)
            .output()
            .with_context(|| format!("cannot run {} {script} (from the project's root)", python.display()))?;
        let text = String::from_utf8_lossy(&output.stdout);
        match serde_json::from_str(text.lines().last().unwrap_or_default()) {
            Ok(said) => peer.said = said,
            Err(_) => {
                let why = String::from_utf8_lossy(&output.stderr).lines().last().unwrap_or("no output").to_string();
                tracing::warn!("PyTorch, {}, failed: {why}", peer.name);
                peer.failed = Some(why);
                continue;
            }
        }
        let runs = peer.said["seconds"].as_array();
        peer.seconds.extend(runs.into_iter().flatten().filter_map(serde_json::Value::as_f64));
        peer.median_s = median(peer.seconds.clone());
    }
    Ok(())
}
