//! `storm info`: what a bag holds, and how it would be used.

use std::path::PathBuf;

use anyhow::{Context, Result};

use super::Outcome;
use crate::bag::Bag;
use crate::config::Config;
use crate::engine::ModelSource;
use crate::source::bag::BagSource;

/// Arguments of `storm info`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// MCAP or sqlite3 bag, file or folder.
    bag: PathBuf,
    /// Configuration file (YAML).
    #[arg(long)]
    config: Option<PathBuf>,
}

/// Prints the topics and the parts they would play.
pub fn run(args: &Args) -> Result<Outcome> {
    let config = match &args.config {
        Some(path) => Config::load(path)?,
        None => Config::default(),
    };
    let bag = Bag::open(&args.bag).with_context(|| format!("cannot read bag {}", args.bag.display()))?;
    let seconds = match (bag.start_ns(), bag.end_ns()) {
        (Some(start), Some(end)) => (end as f64 - start as f64) * 1e-9,
        _ => 0.0,
    };
    say!("{}: {} messages over {seconds:.2} s", args.bag.display(), bag.message_count());
    for t in bag.topics() {
        say!("  {:>7}  {}  {} ({})", t.count, t.name, t.type_name, t.serialization);
    }
    let problems = bag.problems();
    problems.iter().for_each(|p| say!("problem: {p}"));
    drop(bag);
    let size = ModelSource::open(&config.model)?.picture_size(&config.model)?;
    let source = BagSource::open(&args.bag, &config, size)?;
    let (rig, plan) = (source.rig(), source.plan());
    rig.lines(size).iter().for_each(|line| say!("{line}"));
    for left_out in &plan.left_out {
        say!("no camera: {left_out}");
    }
    say!("{}", source.pose_line());
    rig.warnings().iter().for_each(|line| say!("warning: {line}"));
    say!("ground truth: {} topics", plan.truth.len());
    Ok(if problems.is_empty() { Outcome::Done } else { Outcome::Lost })
}
