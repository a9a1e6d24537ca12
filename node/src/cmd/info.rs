//! `storm info`: what a bag holds, and how it would be used.

use std::path::PathBuf;

use anyhow::{Context, Result};

use super::Outcome;
use crate::bag::Bag;
use crate::config::Config;
use crate::source::bag::plan_of;
use crate::source::topics::PoseTopic;

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
    let plan = plan_of(&bag, &config.input)?;
    for (i, c) in plan.cameras.iter().enumerate() {
        say!("camera {i}: {} with {}", c.name, bag.topics()[c.info].name);
    }
    for left_out in &plan.left_out {
        say!("no camera: {left_out}");
    }
    match plan.pose {
        PoseTopic::Message(t) => say!("pose: {}", bag.topics()[t].name),
        PoseTopic::Tf => say!("pose: /tf, {} from the vehicle frame", config.input.map_frame),
    }
    say!("ground truth: {} topics", plan.truth.len());
    Ok(if problems.is_empty() { Outcome::Done } else { Outcome::Lost })
}
