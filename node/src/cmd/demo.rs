//! `storm demo`: a short procedural drive, made and replayed.

use anyhow::{Context, Result};
use storm_render::world::{Drive, DriveOptions};
use tracing::info;

use super::replay::{Common, run_into};
use super::{Outcome, UsageError, progress_bar};
use crate::synth::{self, SynthOptions};

/// Arguments of `storm demo`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Which drive.
    #[arg(long, default_value_t = 7)]
    seed: u64,
    /// Length of the drive, seconds.
    #[arg(long, default_value_t = 4.0, allow_hyphen_values = true)]
    seconds: f64,
    #[command(flatten)]
    common: Common,
}

/// Makes the drive below the results folder and replays it.
pub fn run(args: &Args, progress: bool) -> Result<Outcome> {
    let config = args.common.config()?;
    let needed_sec = config.window.span_sec();
    if args.seconds < needed_sec {
        let (timesteps, stride_sec) = (config.window.timesteps, config.window.stride_sec);
        let text = format!(
            "--seconds {}: a window needs {timesteps} timesteps {stride_sec} s apart, {needed_sec} s in all (window.timesteps, \
             window.stride_sec)",
            args.seconds
        );
        return Err(UsageError(text).into());
    }
    let out = args.common.out.clone().unwrap_or_else(|| "storm_out/demo".into());
    let options = DriveOptions { seed: args.seed, seconds: args.seconds, ..DriveOptions::default() };
    let drive = Drive::new(&options).map_err(|e| UsageError(e.to_string()))?;
    let bag = out.join("drive");
    info!("making a drive of {} s (seed {}) in {}", args.seconds, args.seed, bag.display());
    let bar = progress_bar(progress, (drive.frame_count() * options.cameras) as u64, "driving");
    std::fs::create_dir_all(&out).with_context(|| format!("cannot make results folder {}", out.display()))?;
    synth::write_drive(&drive, &bag, &SynthOptions::default(), &mut |done, total| {
        bar.set_length(total);
        bar.set_position(done);
    })?;
    bar.finish_and_clear();
    run_into(&bag, &out, &args.common, 1, progress)
}
