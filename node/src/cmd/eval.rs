//! `storm eval`: error figures on drives that training never saw.

use std::path::PathBuf;

use anyhow::{Context, Result};
use serde_json::json;
use storm_render::raster::CpuRasterizer;

use super::{Outcome, UsageError, progress_bar};
use crate::config::ModelConfigSection;
use crate::engine::evaluate::{Clip, Evaluation, HELD_OUT_SEEDS};
use crate::engine::score::Figures;
use crate::engine::{Engine, ModelSource};

/// Arguments of `storm eval`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Which drives: held-out (seeds 10,000 to 10,019; 2 s, 3 cameras, 10 Hz).
    #[arg(long, default_value = "held-out", value_parser = ["held-out"])]
    suite: String,
    /// Other seeds: A..B, B not included.
    #[arg(long, value_parser = parse_seeds)]
    seeds: Option<std::ops::Range<u64>>,
    /// Weights: .safetensors, or a PyTorch .pth/.pt checkpoint.
    #[arg(long, default_value = "")]
    weights: String,
    /// Architecture when there is no weights file.
    #[arg(long, default_value = "tiny")]
    preset: String,
    /// Write the figures as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
}

fn parse_seeds(text: &str) -> Result<std::ops::Range<u64>, String> {
    let wrong = || format!("'{text}' is not A..B with A < B");
    let (a, b) = text.split_once("..").ok_or_else(wrong)?;
    match (a.trim().parse(), b.trim().parse()) {
        (Ok(a), Ok(b)) if a < b => Ok(a..b),
        _ => Err(wrong()),
    }
}

/// Scores the network and its baselines, prints the table.
pub fn run(args: &Args, progress: bool) -> Result<Outcome> {
    let section = ModelConfigSection {
        weights: args.weights.clone(),
        preset: args.preset.clone(),
        ..ModelConfigSection::default()
    };
    let source = ModelSource::open(&section)?;
    let size = source.picture_size(&section)?;
    if source.config().num_cams < 3 && source.config().use_affine_token {
        return Err(UsageError("these weights are for fewer than the suite's 3 cameras".into()).into());
    }
    let timespan_sec = crate::config::WindowConfig::default().timespan_sec;
    let mut engine = Engine::new(source, &section, 3, timespan_sec)?;
    let mut raster = CpuRasterizer::new(engine.raster_settings())?;
    let seeds = args.seeds.clone().unwrap_or(HELD_OUT_SEEDS);
    let bar = progress_bar(progress, seeds.end - seeds.start, "scoring clips");
    let mut evaluation = Evaluation::default();
    for seed in seeds.clone() {
        evaluation
            .add(&Clip::of_seed(seed, size)?, &mut engine, &mut raster)
            .with_context(|| format!("seed {seed}"))?;
        bar.inc(1);
    }
    bar.finish_and_clear();
    let methods = [
        ("storm", evaluation.storm.figures()),
        ("static", evaluation.still.figures()),
        ("nearest_context", evaluation.nearest_context.figures()),
    ];
    println!("weights: {}; seeds {}..{}; {}x{} pixels", engine.weights(), seeds.start, seeds.end, size.0, size.1);
    print_table(&methods);
    if let Some(path) = &args.json {
        let mut report =
            json!({"weights": engine.weights(), "seeds": [seeds.start, seeds.end], "picture": [size.0, size.1]});
        for (name, figures) in &methods {
            report[*name] = serde_json::to_value(figures)?;
        }
        std::fs::write(path, serde_json::to_string_pretty(&report)? + "\n")
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    Ok(Outcome::Done)
}

fn print_table(methods: &[(&str, Figures)]) {
    print!("{:24}", "");
    methods.iter().for_each(|(name, _)| print!("{name:>18}"));
    println!();
    let rows = methods.first().map_or(0, |(_, f)| f.rows().len());
    for row in 0..rows {
        for (i, (_, figures)) in methods.iter().enumerate() {
            let (name, unit, value) = figures.rows()[row];
            if i == 0 {
                print!("{:24}", if unit.is_empty() { name.to_string() } else { format!("{name}, {unit}") });
            }
            match value {
                Some(x) => print!("{x:>18.3}"),
                None => print!("{:>18}", "-"),
            }
        }
        println!();
    }
}
