//! `storm replay`: a recorded bag to a results folder.

use std::path::{Path, PathBuf};

use anyhow::Result;
use tracing::warn;

use super::{Outcome, UsageError, progress_bar};
use crate::config::Config;
use crate::pipeline::replay::{self, ReplayOptions, default_out, recording_name};

/// Arguments of `storm replay`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// MCAP or sqlite3 bag, file or folder.
    bag: PathBuf,
    #[command(flatten)]
    common: Common,
    /// Windows that go through the network in one forward pass; the results are those of one by one, memory grows.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    batch: u16,
}

/// Arguments that `replay` and `demo` share.
#[derive(Debug, clap::Args)]
pub struct Common {
    /// Results folder [default: storm_out/<bag>].
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Replace the results of another recording that are in the results folder (those of the same one are replaced in any case).
    #[arg(long)]
    pub overwrite: bool,
    #[command(flatten)]
    overrides: Overrides,
}

/// What the configuration is made from.
#[derive(Debug, clap::Args)]
pub struct Overrides {
    /// Configuration file (YAML, plain or ROS 2 parameters).
    #[arg(long)]
    pub config: Option<PathBuf>,
    /// Weights: .safetensors, or a PyTorch .pth/.pt checkpoint.
    #[arg(long)]
    pub weights: Option<PathBuf>,
    /// Where the network runs: cpu, cuda, metal.
    #[arg(long)]
    pub device: Option<String>,
    /// Override one configuration key: --set window.stride_sec=0.4 (repeatable).
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub set: Vec<String>,
}

impl Common {
    /// The configuration: file, then overrides, then flags.
    pub fn config(&self) -> Result<Config> {
        self.overrides.config()
    }
}

impl Overrides {
    /// The configuration: file, then overrides, then flags.
    pub fn config(&self) -> Result<Config> {
        let mut config = Config::from_arguments(self.config.as_deref(), &self.set)?;
        if let Some(weights) = &self.weights {
            config.model.weights = weights.display().to_string();
        }
        if let Some(device) = &self.device {
            config.model.device = device.clone();
        }
        config.validate()?;
        Ok(config)
    }
}

/// Replays the bag.
pub fn run(args: &Args, progress: bool) -> Result<Outcome> {
    let out = args.common.out.clone().unwrap_or_else(|| default_out(&args.bag));
    run_into(&args.bag, &out, &args.common, usize::from(args.batch), progress)
}

/// Replays `bag` into `out`, `batch` windows at a time, and prints what came of it.
pub(super) fn run_into(bag: &Path, out: &Path, common: &Common, batch: usize, progress: bool) -> Result<Outcome> {
    let config = common.config()?;
    if out.exists() && !out.is_dir() {
        return Err(UsageError(format!("--out {} is a file; give a folder", out.display())).into());
    }
    check_earlier_results(bag, out, common.overwrite)?;
    if config.model.threads > 0 {
        // Fails only when a pool was set up before in this process; then that one is kept.
        let _ = rayon::ThreadPoolBuilder::new().num_threads(config.model.threads).build_global();
    }
    let bar = progress_bar(progress, 0, "replaying");
    let stop = super::interrupt::stop_flag();
    let options = ReplayOptions { bag: bag.to_path_buf(), out: out.to_path_buf(), config, batch, stop };
    let metrics = replay::run(&options, &|done, total| {
        bar.set_length(total);
        bar.set_position(done);
    });
    bar.finish_and_clear();
    let metrics = metrics?;
    let report = out.join("report.html");
    match report.exists() {
        true => say!("{}", report.display()),
        false => say!("{} (no report.html)", out.display()),
    }
    say!(
        "{} frames, {} steps, {} map Gaussians, {} trajectories; weights: {}",
        metrics.frames_in,
        metrics.steps,
        metrics.map_gaussians,
        metrics.tracks,
        metrics.weights
    );
    if let Some(s) = &metrics.held_out {
        say!("{}", s.line());
    }
    let left_out = metrics.left_out_line();
    if !left_out.is_empty() {
        say!("not used: {left_out}");
    }
    if let Some(verdict) = &metrics.verdict {
        complain!("{verdict}");
    }
    if metrics.lost() {
        complain!("lost: {}", metrics.loss_line());
        return Ok(Outcome::Lost);
    }
    Ok(Outcome::Done)
}

/// Refuses a folder with the results of another recording, and says that those of the same one are replaced.
fn check_earlier_results(bag: &Path, out: &Path, overwrite: bool) -> Result<()> {
    let Ok(text) = std::fs::read_to_string(out.join("metrics.json")) else { return Ok(()) };
    let earlier: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
    let earlier = earlier["recording"].as_str().unwrap_or("an unknown recording");
    if earlier == recording_name(bag) || overwrite {
        warn!("{} holds results of {earlier}; they are replaced", out.display());
        return Ok(());
    }
    let text =
        format!("{} holds results of {earlier}: give another --out, or --overwrite to replace them", out.display());
    Err(UsageError(text).into())
}
