//! One network at one setting: run time per stage, work, memory, and errors against the truth, or, of a network without weights,
//! against itself at its most exact.

use std::collections::BTreeMap;
use std::time::Instant;

use anyhow::{Context, Result};
use serde::Serialize;
use storm_model::metrics::Mean;
use storm_model::metrics::mask::iou;
use storm_model::scene::{RenderedView, Scene, Want};
use storm_render::Intrinsics;

use super::flops::{WindowSize, count};
use crate::config::{Config, ModelConfigSection, WindowConfig};
use crate::engine::evaluate::{Clip, Placed, Prediction, Tally};
use crate::engine::figures::Figures;
use crate::engine::select::SURFACE_OPACITY;
use crate::engine::{Engine, ModelSource, UNTRAINED, views_of};
use crate::pipeline::messages::motion_mask;
use crate::pipeline::step::newest_time_sec;
use crate::pipeline::timing::{StageStats, Timings, peak_rss_mb, reset_peak_rss};
use crate::window::WindowBuilder;

/// Drive whose pictures are used where no clips are given.
const SEED: u64 = 424_242;
/// From this width on a step takes minutes of processor time: one run, no warm-up.
const LARGE: usize = 768;

/// What errors are measured against.
pub(super) const TRUTH: &str = "truth";
/// See [`TRUTH`].
pub(super) const EXACT: &str = "the same network, exact, f32";

/// One network at one setting.
#[derive(Debug, Clone, Serialize)]
pub(in crate::cmd) struct Setting {
    pub model: String,
    pub weights: String,
    /// The row's name.
    pub setting: String,
    pub dtype: String,
    /// Configuration keys it changes.
    pub skips: Vec<String>,
    pub tokens: usize,
    pub gflop: f64,
    pub gaussians: usize,
    pub picture: [usize; 2],
    pub clips: usize,
    pub step_ms: StageStats,
    pub stages_ms: BTreeMap<String, StageStats>,
    pub peak_rss_mb: Option<f64>,
    /// What the figures are measured against.
    pub against: &'static str,
    #[serde(flatten)]
    pub figures: Figures,
    /// PSNR on a recorded bag, dB.
    pub bag_psnr: Option<f64>,
}

/// What is measured on.
pub(super) struct Data {
    pub clips: Vec<Clip>,
    /// Of a recorded bag.
    pub bag: Vec<Clip>,
}

impl Data {
    /// Held-out clips at the preset's picture size.
    pub fn held_out(config: &Config, clips: usize, bag: Vec<Clip>) -> Result<Self> {
        let size = ModelSource::open(&config.model)?.picture_size(&config.model)?;
        let seeds = crate::engine::evaluate::HELD_OUT_SEEDS;
        let clips = seeds.take(clips.max(1)).map(|seed| Clip::of_seed(seed, size)).collect::<Result<_>>()?;
        Ok(Self { clips, bag })
    }
}

/// The exact network's newest views of every clip, for networks without weights.
pub(super) type References = Vec<Vec<RenderedView>>;

/// An engine for clips of so many cameras, and whether it has weights.
fn engine(config: &Config, cameras: usize) -> Result<Engine> {
    let source = ModelSource::open(&config.model)?;
    Ok(Engine::new(source, &config.model, cameras, config.window.timespan_sec)?.with_skips(&config.skip))
}

/// Measures a setting: at least `runs` timed steps, every clip scored. `references` grow at the first, most exact setting of a
/// network without weights.
pub(super) fn measure(
    model: &str,
    name: &str,
    set: &[String],
    config: &Config,
    data: &Data,
    references: &mut References,
    runs: usize,
) -> Result<Setting> {
    let clips = data.clips.iter().map(|c| shortened(c, &config.window)).collect::<Result<Vec<_>>>()?;
    let first = clips.first().context("no clip to measure on")?;
    reset_peak_rss();
    let mut engine = engine(config, first.cameras.len())?;
    let network = engine.model_config().clone();
    let large = network.embed_dim >= LARGE;
    let untrained = engine.weights() == UNTRAINED;
    let warm = usize::from(!large);
    let runs = if large { clips.len() } else { runs.max(clips.len()) };
    let (mut timings, mut tally, mut gaps) = (Timings::default(), Tally::default(), Gaps::default());
    let mut gaussians = 0;
    for run in 0..warm + runs {
        let (nth, clip) = (run.saturating_sub(warm), &clips[run.saturating_sub(warm) % clips.len()]);
        let mut once = Timings::default();
        let (scene, views) = step(&mut engine, clip, &mut once)?;
        if run < warm {
            continue;
        }
        timings.merge(once);
        gaussians = scene.gaussians.len();
        if nth >= clips.len() {
            continue;
        }
        if untrained {
            match references.get(nth) {
                Some(exact) => gaps.add(exact, &views)?,
                None => references.push(views),
            }
        } else {
            let whole = scene.shape.timesteps == clip.window.steps.len();
            tally.add(clip, &Prediction::Scenes(vec![Placed::in_window(clip, scene, whole)]), None)?;
        }
    }
    let peak_rss_mb = peak_rss_mb();
    let weights = engine.weights().to_string();
    let shortcuts = engine.shortcuts().clone();
    drop(engine);
    let size = WindowSize {
        timesteps: config.window.timesteps,
        cameras: first.cameras.len(),
        width: first.cameras[0].width,
        height: first.cameras[0].height,
    };
    let work = count(&network, size, &shortcuts);
    let stages_ms = timings.stats();
    Ok(Setting {
        model: model.into(),
        weights,
        setting: name.into(),
        dtype: config.model.precision.clone(),
        skips: set.to_vec(),
        tokens: work.tokens,
        gflop: work.flops * 1e-9,
        gaussians,
        picture: [size.width, size.height],
        clips: clips.len(),
        step_ms: stages_ms["step"].clone(),
        stages_ms,
        peak_rss_mb,
        against: if untrained { EXACT } else { TRUTH },
        figures: if untrained { gaps.figures() } else { tally.figures() },
        bag_psnr: if untrained { None } else { bag_psnr(config, &data.bag)? },
    })
}

/// The network and the newest timestep's views, each timed.
fn step(engine: &mut Engine, clip: &Clip, timings: &mut Timings) -> Result<(Scene, Vec<RenderedView>)> {
    let start = Instant::now();
    let window = &clip.window;
    let scene = timings.time("network", || engine.step(window, &clip.cameras))?;
    let targets = views_of(&window.steps[window.steps.len() - 1], &window.map_from_anchor, &clip.cameras);
    let want = Want { flow: true, motion: true };
    let views = timings.time("render", || engine.render(&scene, &targets, newest_time_sec(window), want))?;
    timings.add("step", start.elapsed().as_secs_f64() * 1e3);
    Ok((scene, views))
}

/// The clip with the configured number of timesteps, the newest ones; its other frames are held out.
fn shortened(clip: &Clip, config: &WindowConfig) -> Result<Clip> {
    let frames = || clip.frames.iter().map(|f| (f.set.clone(), f.truth.clone()));
    let mut builder = WindowBuilder::new(config, clip.reference);
    let mut window = None;
    if config.timesteps == clip.window.steps.len() {
        window = Some(clip.window.clone());
    } else {
        for (set, _) in frames().filter(|(set, _)| set.stamp_ns <= clip.window.stamp_ns) {
            window = builder.push((*set).clone()).or(window);
        }
    }
    let window = window.filter(|w| w.stamp_ns == clip.window.stamp_ns);
    let window = window.with_context(|| format!("{} has no window of {} timesteps", clip.name, config.timesteps))?;
    Ok(Clip::new(
        clip.name.clone(),
        clip.seed,
        window,
        clip.reference,
        frames().collect(),
        clip.cameras.clone(),
        Vec::new(),
    ))
}

/// PSNR of held-out pictures of a recording.
fn bag_psnr(config: &Config, bag: &[Clip]) -> Result<Option<f64>> {
    let Some(first) = bag.first() else { return Ok(None) };
    let mut engine = engine(config, first.cameras.len())?;
    let mut tally = Tally::default();
    for clip in bag {
        let clip = shortened(clip, &config.window)?;
        let scene = engine.step(&clip.window, &clip.cameras)?;
        let whole = scene.shape.timesteps == clip.window.steps.len();
        tally.add(&clip, &Prediction::Scenes(vec![Placed::in_window(&clip, scene, whole)]), None)?;
    }
    Ok(tally.figures().psnr)
}

/// How views differ from the exact network's: by the names of the error figures.
#[derive(Default)]
struct Gaps {
    psnr: Mean,
    depth_square: Mean,
    epe: Mean,
    iou: Mean,
}

impl Gaps {
    fn add(&mut self, exact: &[RenderedView], views: &[RenderedView]) -> Result<()> {
        for (a, b) in exact.iter().zip(views) {
            let (x, y) = (a.rgb8(), b.rgb8());
            let square: f64 = x.iter().zip(&y).map(|(&x, &y)| (f64::from(x) - f64::from(y)).powi(2)).sum();
            // Pictures that are alike to the last level are as if a level's rounding lay between them.
            let mean = (square / x.len().max(1) as f64).max(1.0 / 12.0);
            self.psnr.add(Some(10.0 * (255.0 * 255.0 / mean).log10()));
            for i in 0..a.depth.len() {
                if a.alpha[i] >= SURFACE_OPACITY && b.alpha[i] >= SURFACE_OPACITY {
                    self.depth_square.add(Some(f64::from(a.depth[i] - b.depth[i]).powi(2)));
                }
            }
            for (v, w) in a.flow.iter().flatten().zip(b.flow.iter().flatten()) {
                self.epe.add(Some(f64::from(glam::Vec3::from(*v).distance(glam::Vec3::from(*w)))));
            }
            let moves = |view: &RenderedView| motion_mask(view).iter().map(|m| *m != 0).collect::<Vec<bool>>();
            self.iou.add(iou(&moves(b), &moves(a), None)?);
        }
        Ok(())
    }

    fn figures(&self) -> Figures {
        Figures {
            psnr: self.psnr.value(),
            depth_rmse: self.depth_square.value().map(f64::sqrt),
            epe3d: self.epe.value(),
            moving_iou: self.iou.value(),
            ..Figures::default()
        }
    }
}

/// Step times of the network that a section names, on a drive of its own size, without scores that anybody asked for.
pub(in crate::cmd) fn time_network(name: &str, section: &ModelConfigSection, runs: usize) -> Result<Setting> {
    let config = Config { model: section.clone(), ..Config::default() };
    let size = ModelSource::open(section)?.picture_size(section)?;
    let data = Data { clips: vec![Clip::of_seed(SEED, size)?], bag: Vec::new() };
    measure(name, "default", &[], &config, &data, &mut References::new(), runs)
}

/// Milliseconds of one pass of a network on any window, and the pass's count of work: the median of a few runs, fewer where one
/// takes seconds.
pub(super) fn time_pass(engine: &mut Engine, clip: &Clip, cameras: &[Intrinsics], seconds: f64) -> Result<f64> {
    let start = Instant::now();
    let mut ms = Vec::new();
    loop {
        let one = Instant::now();
        engine.step(&clip.window, cameras)?;
        ms.push(one.elapsed().as_secs_f64() * 1e3);
        if ms.len() >= 7 || (ms.len() >= 2 && start.elapsed().as_secs_f64() > seconds) || ms[0] > 1e3 * seconds {
            break;
        }
    }
    // The first one warms up, where there are others.
    let mut timed = if ms.len() > 1 { ms.split_off(1) } else { ms };
    timed.sort_by(f64::total_cmp);
    Ok(timed[(timed.len() - 1) / 2])
}
