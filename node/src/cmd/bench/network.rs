//! One network at one setting: run time per stage, work, memory, and errors against the truth, or, of a network without weights,
//! against itself at its most exact.

use std::collections::BTreeMap;
use std::time::Instant;

use anyhow::{Context, Result};
use serde::Serialize;
use storm_model::metrics::Mean;
use storm_model::metrics::mask::iou;
use storm_model::ops::give_back_freed_memory;
use storm_model::scene::{RenderedView, Scene, Want};

use super::flops::{WindowSize, count};
use super::pairs::{Pairs, Turns};
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
/// From this width on a step takes a minute of processor time: few runs, no warm-up.
const LARGE: usize = 768;
/// Runs of those.
const RUNS_OF_LARGE: usize = 3;
/// Short steps are run for this long, up to so many times.
const SHORT: (f64, usize) = (24.0, 25);

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
    /// How many times longer the default's step takes, run in turn with this one's: see [`Pairs`].
    pub times_less: Option<f64>,
    /// Those turns: this setting's steps and the default's.
    pub turns_ms: Pairs,
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
        let source = ModelSource::open(&config.model)?;
        let (size, prior_sec) = (source.picture_size(&config.model)?, source.prior_sec(&config.model));
        let seeds = crate::engine::evaluate::HELD_OUT_SEEDS;
        let clips = seeds.take(clips.max(1)).map(|seed| Clip::of_seed(seed, size, prior_sec)).collect::<Result<_>>()?;
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

/// A setting's engine and the windows it is run on.
struct Runs {
    engine: Engine,
    clips: Vec<Clip>,
}

impl Runs {
    /// Of an engine that has run already, but for the largest networks.
    fn new(config: &Config, data: &Data) -> Result<Self> {
        let clips = data.clips.iter().map(|c| shortened(c, &config.window)).collect::<Result<Vec<_>>>()?;
        let cameras = clips.first().context("no clip to measure on")?.cameras.len();
        let mut runs = Self { engine: engine(config, cameras)?, clips };
        if !runs.large() {
            runs.step(0, &mut Timings::default())?;
        }
        Ok(runs)
    }

    fn large(&self) -> bool {
        self.engine.model_config().embed_dim >= LARGE
    }

    /// The network and the newest timestep's views, each timed.
    fn step(&mut self, nth: usize, timings: &mut Timings) -> Result<(Scene, Vec<RenderedView>, f64)> {
        let clip = &self.clips[nth % self.clips.len()];
        let (start, window) = (Instant::now(), &clip.window);
        let scene = timings.time("network", || self.engine.step(window, &clip.cameras))?;
        let targets = views_of(&window.steps[window.steps.len() - 1], &window.map_from_anchor, &clip.cameras);
        let want = Want { flow: true, motion: true };
        let views = timings.time("render", || self.engine.render(&scene, &targets, newest_time_sec(window), want))?;
        let ms = start.elapsed().as_secs_f64() * 1e3;
        timings.add("step", ms);
        Ok((scene, views, ms))
    }
}

/// What is measured: a network with these keys of its configuration changed.
pub(super) struct Subject<'a> {
    pub model: &'a str,
    /// The row's name.
    pub name: &'a str,
    /// `KEY=VALUE`.
    pub set: &'a [String],
    pub config: &'a Config,
    /// The setting that is run in turn with it.
    pub beside: Option<&'a Config>,
}

/// Measures a setting: at least `runs` timed steps, every clip scored. `references` grow at the first, most exact setting of a
/// network without weights.
pub(super) fn measure(subject: &Subject, data: &Data, references: &mut References, runs: usize) -> Result<Setting> {
    let config = subject.config;
    // What earlier rows held is not this one's.
    give_back_freed_memory();
    reset_peak_rss();
    let mut own = Runs::new(config, data)?;
    let large = own.large();
    let mut peak = (!large).then(peak_rss_mb).flatten();
    let mut beside: Option<Runs> = None;
    let untrained = own.engine.weights() == UNTRAINED;
    let (mut timings, mut tally, mut gaps) = (Timings::default(), Tally::default(), Gaps::default());
    let mut gaussians = 0;

    let clips = own.clips.len();
    let mut one = |turn: usize| -> Result<f64> {
        let (scene, views, ms) = own.step(turn, &mut timings)?;
        peak = peak.or_else(peak_rss_mb);
        gaussians = scene.gaussians.len();
        if turn < clips && untrained {
            match references.get(turn) {
                Some(exact) => gaps.add(exact, &views)?,
                None => references.push(views),
            }
        } else if turn < clips {
            let clip = &own.clips[turn];
            let whole = scene.shape.timesteps == clip.window.steps.len();
            tally.add(clip, &Prediction::Scenes(vec![Placed::in_window(clip, scene, whole)]), None)?;
        }
        Ok(ms)
    };
    let mut other = |turn: usize| -> Result<f64> {
        let beside = match &mut beside {
            Some(runs) => runs,
            // Made only now: the peak is of the setting alone.
            none => none.insert(Runs::new(subject.beside.unwrap_or(config), data)?),
        };
        Ok(beside.step(turn, &mut Timings::default())?.2)
    };
    let turns = if large {
        Turns { least: clips.max(RUNS_OF_LARGE), most: clips.max(RUNS_OF_LARGE), seconds: 0.0 }
    } else {
        let least = runs.max(clips);
        Turns { least, most: least.max(SHORT.1), seconds: SHORT.0 }
    };
    let pairs = Pairs::take(turns, &mut one, subject.beside.is_some().then_some(&mut other as _))?;
    let Runs { engine, clips } = own;
    let cameras = &clips.first().context("no clip to measure on")?.cameras;
    let size = WindowSize {
        timesteps: config.window.timesteps,
        cameras: cameras.len(),
        width: cameras[0].width,
        height: cameras[0].height,
    };
    let work = count(engine.model_config(), size, engine.shortcuts());
    let stages_ms = timings.stats();
    Ok(Setting {
        model: subject.model.into(),
        weights: engine.weights().to_string(),
        setting: subject.name.into(),
        dtype: config.model.precision.clone(),
        skips: subject.set.to_vec(),
        tokens: work.tokens,
        gflop: work.flops * 1e-9,
        gaussians,
        picture: [size.width, size.height],
        clips: clips.len(),
        step_ms: stages_ms["step"].clone(),
        times_less: pairs.times_less(),
        turns_ms: pairs,
        stages_ms,
        peak_rss_mb: peak,
        against: if untrained { EXACT } else { TRUTH },
        figures: if untrained { gaps.figures() } else { tally.figures() },
        bag_psnr: if untrained { None } else { bag_psnr(config, &data.bag)? },
    })
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
    let data = Data { clips: vec![Clip::of_seed(SEED, size, 0.0)?], bag: Vec::new() };
    let subject = Subject { model: name, name: "default", set: &[], config: &config, beside: None };
    measure(&subject, &data, &mut References::new(), runs)
}
