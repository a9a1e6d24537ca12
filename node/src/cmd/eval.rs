//! `storm eval`: error figures on drives that training never saw, or on a bag, beside baselines and ceilings.

mod table;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use serde_json::{Value, json};
use tracing::info;

use super::{Outcome, UsageError, progress_bar};
use crate::config::{Config, ModelConfigSection};
use crate::engine::evaluate::bag::{BagClips, Part};
use crate::engine::evaluate::{Clip, Effort, Evaluation, HELD_OUT_SEEDS, Method};
use crate::engine::{Engine, ModelSource, UNTRAINED};

/// A clip that took longer is told of in the log, for those who see no bar.
const LONG: Duration = Duration::from_secs(20);

/// Arguments of `storm eval`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Which drives: held-out (seeds 10,000 to 10,019; 2 s, 3 cameras, 10 Hz).
    #[arg(long, default_value = "held-out", value_parser = ["held-out"])]
    suite: String,
    /// Other seeds: A..B, B not included.
    #[arg(long, value_parser = parse_seeds, conflicts_with = "bag")]
    seeds: Option<std::ops::Range<u64>>,
    /// Clips of a recording instead: pictures always, depth, flow and masks where it has ground-truth topics.
    #[arg(long)]
    bag: Option<PathBuf>,
    /// Clips cut from the bag, spread evenly (they overlap where it is short).
    #[arg(long, default_value_t = 10, requires = "bag")]
    clips: usize,
    /// Use the bag from here on, seconds after its first synchronized set.
    #[arg(long, default_value_t = 0.0, requires = "bag")]
    from_sec: f64,
    /// Use the bag up to here, seconds after its first synchronized set.
    #[arg(long, requires = "bag")]
    to_sec: Option<f64>,
    /// Configuration file, for the bag's topics and windows.
    #[arg(long, requires = "bag")]
    config: Option<PathBuf>,
    /// Set one configuration key, e.g. --set model.precision=int8 or --set skip.kv_pool=2; repeatable.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Weights: .safetensors, or a PyTorch .pth/.pt checkpoint [default: those that ship].
    #[arg(long, default_value = "", hide_default_value = true)]
    weights: String,
    /// Architecture when no weights are named [default: tiny].
    #[arg(long)]
    preset: Option<String>,
    /// What to compare, by the names of the table: a list, `cheap` or `all`. gs3d, gs3d_init and nsfp take minutes per clip.
    #[arg(long, default_value = "cheap", value_parser = Method::parse_list)]
    methods: std::vec::Vec<Method>,
    /// Weights trained without motion, one timestep at a time, for the method per_frame [default: the same weights].
    #[arg(long)]
    per_frame_weights: Option<PathBuf>,
    /// Iterations of the per-scene optimisation gs3d.
    #[arg(long, default_value_t = Effort::default().gs3d_iterations)]
    gs3d_iterations: u64,
    /// Write the figures as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
    /// Write the tables as Markdown: the figures, then where the error is.
    #[arg(long)]
    markdown: Option<PathBuf>,
}

fn parse_seeds(text: &str) -> Result<std::ops::Range<u64>, String> {
    let wrong = || format!("'{text}' is not A..B with A < B");
    let (a, b) = text.split_once("..").ok_or_else(wrong)?;
    match (a.trim().parse(), b.trim().parse()) {
        (Ok(a), Ok(b)) if a < b => Ok(a..b),
        _ => Err(wrong()),
    }
}

/// Scores the network and what it is compared with, prints the table.
pub fn run(args: &Args, progress: bool) -> Result<Outcome> {
    let mut config = Config::from_arguments(args.config.as_deref(), &args.set)?;
    if !args.weights.is_empty() {
        config.model.weights = args.weights.clone();
    }
    if let Some(preset) = &args.preset {
        config.model.preset = preset.clone();
    }
    config.validate()?;
    if config.skip.newest_only {
        let text = "skip.newest_only = true: scoring wants the Gaussians of every timestep; leave it out";
        return Err(UsageError(text.into()).into());
    }
    if config.skip.reuse > 0 {
        let text = "skip.reuse: clips are scored one by one, none goes on from another; leave it out (`storm bench` scores it on drives)";
        return Err(UsageError(text.into()).into());
    }
    let source = ModelSource::open(&config.model)?;
    let size = source.picture_size(&config.model)?;
    config.model.sweep_prior_sec = source.prior_sec(&config.model);
    let data = Data::open(args, &config, size)?;
    let cameras = data.cameras();
    let timespan_sec = config.window.timespan_sec;
    let engine = Engine::new(source, &config.model, cameras, timespan_sec)?.with_skips(&config.skip);
    let per_frame = args.per_frame_weights.as_deref().map(|path| {
        let section = ModelConfigSection { weights: path.display().to_string(), ..config.model.clone() };
        let source = ModelSource::open(&section)?;
        if source.picture_size(&section)? != size {
            let text = format!("--per-frame-weights {} are not for {}x{} pixels", path.display(), size.0, size.1);
            return Err(UsageError(text).into());
        }
        Engine::new(source, &section, cameras, timespan_sec)
    });
    let effort = Effort { gs3d_iterations: args.gs3d_iterations, ..Effort::default() };
    let mut evaluation = Evaluation::new(engine, per_frame.transpose()?, &args.methods, effort);

    let bar = progress_bar(progress, (data.count() * args.methods.len()) as u64, "scoring");
    let mut clips = 0;
    data.each(size, config.model.sweep_prior_sec, |clip| {
        let (mut at, begin) = (None, Instant::now());
        let result = evaluation.add(&clip, &mut |method, steps| {
            if at != Some(method) {
                bar.inc(u64::from(at.is_some()));
                at = Some(method);
            }
            let steps = steps.map_or(String::new(), |(done, all)| format!(" {done}/{all}"));
            bar.set_message(format!("{}: {}{steps}", clip.name, method.name()));
        });
        bar.inc(1);
        clips += 1;
        let took = begin.elapsed();
        if took > LONG && bar.is_hidden() {
            info!("{}: {clips} of {} clips, {:.0} s", clip.name, data.count(), took.as_secs_f64());
        }
        result
    })?;
    bar.finish_and_clear();

    let weights = evaluation.engine().weights().to_string();
    let figures = evaluation.figures();
    let named: Vec<(&str, _)> = figures.iter().map(|(method, figures)| (method.name(), figures)).collect();
    let errors = evaluation.standard_errors();
    let spread = errors.first().map(|(_, errors)| errors);
    if weights == UNTRAINED {
        complain!("weights: untrained. Seeded random weights stand in; the network's figures mean nothing");
    }
    say!(
        "weights: {weights}; {}; {} held-out pictures of {}x{} pixels",
        data.describe(),
        evaluation.images(),
        size.0,
        size.1
    );
    let breakdowns = evaluation.breakdowns();
    let causes: Vec<(&str, _)> = breakdowns.iter().map(|(method, b)| (method.name(), b)).collect();
    say_text!("{}{}", table::text(&named, spread), table::where_text(&causes));
    if let Some(path) = &args.markdown {
        write(path, &(table::markdown(&named, spread) + &table::where_markdown(&causes)))?;
    }
    if let Some(path) = &args.json {
        let mut report = json!({
            "weights": weights,
            "picture": [size.0, size.1],
            "images": evaluation.images(),
            "clips": data.count(),
            "gs3d_iterations": args.gs3d_iterations,
        });
        data.note(&mut report);
        for (name, figures) in &named {
            report[*name] = serde_json::to_value(figures)?;
        }
        for (name, breakdown) in &causes {
            report["where"][*name] = serde_json::to_value(breakdown)?;
        }
        for (method, errors) in &errors {
            report["standard_errors"][method.name()] = serde_json::to_value(errors)?;
        }
        write(path, &(serde_json::to_string_pretty(&report)? + "\n"))?;
    }
    Ok(Outcome::Done)
}

fn write(path: &Path, text: &str) -> Result<()> {
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}

/// Where clips come from.
enum Data {
    Drives(std::ops::Range<u64>),
    Bag { clips: Box<BagClips>, name: String, part: Part },
}

impl Data {
    fn open(args: &Args, config: &Config, size: (usize, usize)) -> Result<Self> {
        let Some(path) = &args.bag else { return Ok(Self::Drives(args.seeds.clone().unwrap_or(HELD_OUT_SEEDS))) };
        let part = Part { from_sec: args.from_sec, to_sec: args.to_sec.unwrap_or(f64::INFINITY), clips: args.clips };
        if !(part.from_sec >= 0.0 && part.to_sec > part.from_sec && part.clips > 0) {
            let text = format!(
                "--from-sec {}, --to-sec {}, --clips {}: give 0 <= from < to and at least one clip",
                part.from_sec, part.to_sec, part.clips
            );
            return Err(UsageError(text).into());
        }
        let clips = Box::new(BagClips::open(path, config, size, config.model.sweep_prior_sec, &part)?);
        let name = path.file_name().map_or_else(|| "bag".into(), |n| n.to_string_lossy().into_owned());
        Ok(Self::Bag { clips, name, part })
    }

    fn cameras(&self) -> usize {
        match self {
            Self::Drives(_) => 3,
            Self::Bag { clips, .. } => clips.rig().cameras.len(),
        }
    }

    fn count(&self) -> usize {
        match self {
            Self::Drives(seeds) => usize::try_from(seeds.end - seeds.start).unwrap_or(usize::MAX),
            Self::Bag { clips, .. } => clips.count(),
        }
    }

    fn each(&self, size: (usize, usize), prior_sec: f64, mut each: impl FnMut(Clip) -> Result<()>) -> Result<()> {
        match self {
            Self::Drives(seeds) => {
                for seed in seeds.clone() {
                    each(Clip::of_seed(seed, size, prior_sec).with_context(|| format!("seed {seed}"))?)?;
                }
                Ok(())
            }
            Self::Bag { clips, .. } => clips.each(each),
        }
    }

    fn describe(&self) -> String {
        match self {
            Self::Drives(seeds) => format!("seeds {}..{}", seeds.start, seeds.end),
            Self::Bag { clips, name, part } => {
                let to = if part.to_sec.is_finite() { format!("{} s", part.to_sec) } else { "the end".into() };
                format!("{} clips of {name}, from {} s to {to}", clips.count(), part.from_sec)
            }
        }
    }

    fn note(&self, report: &mut Value) {
        match self {
            Self::Drives(seeds) => report["seeds"] = json!([seeds.start, seeds.end]),
            Self::Bag { name, part, .. } => {
                report["bag"] = json!(name);
                report["from_sec"] = json!(part.from_sec);
                report["to_sec"] = json!(part.to_sec.is_finite().then_some(part.to_sec));
            }
        }
    }
}
