//! `storm bench`: run time of the network, the rasteriser and the drive, on this machine.

mod drives;

use std::path::PathBuf;
use std::process::Command;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result};
use serde::Serialize;
use serde_json::json;
use storm_model::scene::Want;
use storm_render::raster::RasterSettings;
use storm_render::world::{Drive, DriveOptions};
use storm_render::{Intrinsics, View};

use super::{Outcome, UsageError, progress_bar};
use crate::config::{Config, ModelConfigSection};
use crate::dice::Dice;
use crate::engine::score::{Scorer, Scores};
use crate::engine::{Engine, ModelSource, views_of};
use crate::overlap::Agreement;
use crate::pipeline::step::{Step, StepMaker, newest_time_sec};
use crate::pipeline::timing::{StageStats, Timings, peak_rss_mb, reset_peak_rss};
use crate::source::Frame;
use crate::source::world::{first_window, posed_set, truth_images};
use crate::window::Window;

/// Drive whose pictures are used; held-out seeds start at 10,000.
const BENCH_SEED: u64 = 424_242;
/// Images drawn to time the drive.
const WORLD_IMAGES: usize = 180;

/// Steps of a vehicle that waits, and their distance.
const SKIPPED_STEPS: i64 = 50;
const SKIP_HOP_NS: i64 = 100_000_000;

/// Held-out frames each network's scene is scored on.
const SCORED_FRAMES: usize = 4;

/// Arguments of `storm bench`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Only the small networks.
    #[arg(long)]
    quick: bool,
    /// Write the figures as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
    /// Networks to time, comma-separated [default: tiny,small,b8; with --quick: tiny].
    #[arg(long, value_delimiter = ',')]
    models: Vec<String>,
    /// Timed runs of each network after one warm-up (the largest: one run, no warm-up).
    #[arg(long, default_value_t = 5)]
    runs: usize,
    /// A Python with PyTorch: times tests/python/peer_network.py at B/8's size in the same run.
    #[arg(long)]
    peer_python: Option<PathBuf>,
}

/// One network at one setting.
#[derive(Debug, Serialize)]
pub(super) struct Setting {
    model: String,
    weights: String,
    dtype: &'static str,
    skips: Vec<String>,
    skipped: u64,
    pub(super) tokens: usize,
    gaussians: usize,
    picture: [usize; 2],
    pub(super) step_ms: StageStats,
    stages_ms: std::collections::BTreeMap<String, StageStats>,
    peak_rss_mb: Option<f64>,
    psnr: Option<f64>,
    depth_rmse: Option<f64>,
    epe3d: Option<f64>,
}

/// Measures and prints.
pub fn run(args: &Args, progress: bool) -> Result<Outcome> {
    if let Ok(set)=std::env::var("DRIVES"){let config=Config::from_arguments(None,&set.split_whitespace().map(String::from).collect::<Vec<_>>())?;let d=drives::run(&config,0.5,&mut |_|{})?;println!("{}",serde_json::to_string_pretty(&d)?);return Ok(Outcome::Done)}
    let models: Vec<String> = match (args.models.is_empty(), args.quick) {
        (false, _) => args.models.clone(),
        (true, true) => vec!["tiny".into()],
        (true, false) => ["tiny", "small", "b8"].map(String::from).to_vec(),
    };
    let bar = progress_bar(progress, models.len() as u64 + 1, "measuring");
    println!("{}", machine()["cpu"].as_str().unwrap_or("unknown processor"));
    let (world_fps, world) = time_world()?;
    println!("drive: {world_fps:.0} images of 240x160 with ground truth per second");
    bar.inc(1);
    let mut settings = Vec::new();
    for model in &models {
        let section = ModelConfigSection { preset: model.clone(), ..ModelConfigSection::default() };
        let setting = time_network(model, &section, args.runs)?;
        println!(
            "{:6} {:>6} tokens {:>7} Gaussians: step p50 {:>9.1} ms, p99 {:>9.1} ms, network {:>9.1} ms, three views {:>7.1} ms, skipped {:>5.2} ms, peak {:.0} MB",
            setting.model,
            setting.tokens,
            setting.gaussians,
            setting.step_ms.p50,
            setting.step_ms.p99,
            setting.stages_ms["network"].p50,
            setting.stages_ms["render"].p50,
            setting.stages_ms.get("skipped step").map_or(f64::NAN, |s| s.p50),
            setting.peak_rss_mb.unwrap_or(0.0),
        );
        settings.push(setting);
        bar.inc(1);
    }
    let peer = match &args.peer_python {
        Some(python) => Some(time_peer(python)?),
        None => None,
    };
    if let (Some(peer), Some(b8)) = (&peer, settings.iter().find(|s| s.model == "b8")) {
        let seconds = peer["median_s"].as_f64().unwrap_or(f64::NAN);
        let ours = b8.stages_ms["network"].p50 / 1e3;
        println!("PyTorch fp32 at B/8's size: {seconds:.1} s; ours {ours:.1} s; ratio {:.2}", ours / seconds);
    }
    bar.finish_and_clear();
    if let Some(path) = &args.json {
        let report = json!({"machine": machine(), "settings": settings, "world": world, "peer_pytorch": peer});
        std::fs::write(path, serde_json::to_string_pretty(&report)? + "\n")
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    Ok(Outcome::Done)
}

fn machine() -> serde_json::Value {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let field = |name: &str| {
        let line = info.lines().find(|l| l.starts_with(name));
        line.and_then(|l| l.split_once(':')).map(|(_, v)| v.trim().to_string()).unwrap_or_default()
    };
    let flags = field("flags");
    let has = |f: &&str| flags.split(' ').any(|x| x == *f);
    let simd: Vec<&str> = ["avx2", "fma", "avx512f", "avx512_bf16", "avx512_vnni"].into_iter().filter(has).collect();
    json!({"cpu": field("model name"), "threads": rayon::current_num_threads(), "simd": simd, "version": env!("CARGO_PKG_VERSION")})
}

fn time_world() -> Result<(f64, serde_json::Value)> {
    let options = DriveOptions { seed: BENCH_SEED, seconds: 10.0, width: 240, height: 160, ..DriveOptions::default() };
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

/// Step times of the network that a configuration names, on a drive of its own size.
pub(super) fn time_network(name: &str, section: &ModelConfigSection, runs: usize) -> Result<Setting> {
    let config = Config::default();
    let source = ModelSource::open(section)?;
    let (width, height) = source.picture_size(section)?;
    let options = DriveOptions { seed: BENCH_SEED, seconds: 2.0, cameras: 3, width, height, ..DriveOptions::default() };
    let drive = Drive::new(&options).map_err(|e| UsageError(e.to_string()))?;
    let window = first_window(&drive, &config.window, 1).context("the drive gave no window")?;
    let cameras: Vec<Intrinsics> = drive.cameras().iter().map(|c| c.intrinsics).collect();
    reset_peak_rss();
    let mut engine = Engine::new(source, section, cameras.len(), config.window.timespan_sec)?;
    let network = engine.model_config().clone();
    let grid = (height / network.patch_size) * (width / network.patch_size);
    let tokens = grid * cameras.len() * config.window.timesteps + network.auxiliary_tokens();
    // A step of the largest networks takes minutes of processor time: one run says enough.
    let large = network.embed_dim >= 768;
    let (warm, runs) = if large { (0, 1) } else { (1, runs.max(1)) };
    let mut timings = Timings::default();
    let mut last = None;
    for run in 0..warm + runs {
        let mut once = Timings::default();
        let start = Instant::now();
        let scene = once.time("network", || engine.step(&window, &cameras))?;
        let targets: Vec<(View, Option<usize>)> =
            views_of(&window.steps[window.steps.len() - 1], &window.map_from_anchor, &cameras);
        let want = Want { flow: true, motion: true };
        let views = once.time("render", || engine.render(&scene, &targets, newest_time_sec(&window), want))?;
        once.add("step", start.elapsed().as_secs_f64() * 1e3);
        last = Some((scene, views));
        if run >= warm {
            timings.merge(once);
        }
    }
    let peak_rss_mb = peak_rss_mb();
    let (scene, views) = last.context("no run")?;
    let gaussians = scene.gaussians.len();
    let agreement = Arc::new(Agreement::default());
    let step = Step {
        index: 0,
        window: window.clone(),
        scene: Arc::new(scene),
        views: views.into(),
        agreement,
        notch: None,
        pixels: None,
        total_ms: 0.0,
    };
    let scores = score(engine.raster_settings(), step, &drive, &cameras)?;
    let weights = engine.weights().to_string();
    let skipped = if large { 0 } else { time_skipped(engine, window, cameras, &mut timings)? };
    let stages_ms = timings.stats();
    Ok(Setting {
        model: name.into(),
        weights,
        dtype: "f32",
        skips: Vec::new(),
        skipped,
        tokens,
        gaussians,
        picture: [width, height],
        step_ms: stages_ms["step"].clone(),
        stages_ms,
        peak_rss_mb,
        psnr: scores.as_ref().and_then(|s| s.storm.psnr),
        depth_rmse: scores.as_ref().and_then(|s| s.storm.depth_rmse),
        epe3d: scores.as_ref().and_then(|s| s.storm.epe3d),
    })
}

/// Steps that see the window again, with other noise: the vehicle waits. How many of them were skipped.
fn time_skipped(engine: Engine, window: Window<Frame>, cameras: Vec<Intrinsics>, timings: &mut Timings) -> Result<u64> {
    let mut maker = StepMaker::new(engine, cameras, &Config::default(), None)?;
    maker.run(window.clone())?;
    let mut dice = Dice::new(BENCH_SEED);
    for k in 1..=SKIPPED_STEPS {
        let mut again = window.clone();
        again.stamp_ns += k * SKIP_HOP_NS;
        for set in &mut again.steps {
            let mut one = (**set).clone();
            one.stamp_ns += k * SKIP_HOP_NS;
            for frame in &mut one.frames {
                let mut rgb = (*frame.item.rgb).clone();
                rgb.data.iter_mut().for_each(|x| *x = x.saturating_add(dice.below(3) as u8).saturating_sub(1));
                frame.item = Frame { rgb: Arc::new(rgb) };
            }
            *set = Arc::new(one);
        }
        let before = maker.skips().still;
        let start = Instant::now();
        maker.run(again)?;
        if maker.skips().still > before {
            timings.add("skipped step", start.elapsed().as_secs_f64() * 1e3);
        }
    }
    Ok(maker.skips().still)
}

/// The window's scene against the frames between its timesteps.
fn score(settings: RasterSettings, step: Step, drive: &Drive, cameras: &[Intrinsics]) -> Result<Option<Scores>> {
    let mut scorer = Scorer::new(settings, cameras.to_vec(), SCORED_FRAMES)?;
    for frame in 0..drive.frame_count() {
        let (set, truth) = posed_set(drive, frame);
        for (camera, t) in truth.into_iter().enumerate() {
            let stamp_ns = set.frames[camera].stamp_ns;
            truth_images(t).into_iter().for_each(|(kind, image)| scorer.truth(camera, stamp_ns, kind, image));
        }
        scorer.set(Arc::new(set));
    }
    scorer.step(Arc::new(step))?;
    scorer.finish()
}

fn time_peer(python: &PathBuf) -> Result<serde_json::Value> {
    let script = "tests/python/peer_network.py";
    let output = Command::new(python)
        .arg(script)
        .output()
        .with_context(|| format!("cannot run {} {script} (from the project's root)", python.display()))?;
    let text = String::from_utf8_lossy(&output.stdout);
    let mut peer: serde_json::Value = serde_json::from_str(text.trim()).with_context(|| {
        format!("the peer failed: {}", String::from_utf8_lossy(&output.stderr).lines().last().unwrap_or("no output"))
    })?;
    let mut seconds: Vec<f64> = peer["seconds"].as_array().into_iter().flatten().filter_map(|x| x.as_f64()).collect();
    seconds.sort_by(f64::total_cmp);
    peer["median_s"] = json!(seconds.get(seconds.len() / 2));
    Ok(peer)
}
