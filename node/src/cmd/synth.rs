//! `storm synth`: a procedural drive as a bag.

use std::path::PathBuf;

use anyhow::{Context, Result};
use storm_render::world::{Drive, DriveOptions};

use super::{Outcome, UsageError, progress_bar};
use crate::synth::{self, SynthOptions};

/// Arguments of `storm synth`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Which drive: the same number gives the same street, traffic and noise.
    #[arg(long)]
    seed: u64,
    /// Length, seconds.
    #[arg(long, allow_hyphen_values = true)]
    seconds: f64,
    /// Folder to write (an MCAP bag with its metadata.yaml).
    #[arg(long)]
    out: PathBuf,
    /// Cameras, 1 to 6.
    #[arg(long, default_value_t = 3)]
    cameras: usize,
    /// Picture width, pixels.
    #[arg(long, default_value_t = 240)]
    width: usize,
    /// Picture height, pixels.
    #[arg(long, default_value_t = 160)]
    height: usize,
    /// Pictures per second and camera.
    #[arg(long, default_value_t = 10.0)]
    rate: f64,
    /// Each camera fires this much after the one before it, seconds.
    #[arg(long, default_value_t = 0.0)]
    stagger: f64,
    /// Where the map's origin lies: X,Y,Z in metres (UTM-sized values are fine).
    #[arg(long, value_parser = parse_point, default_value = "0,0,0", allow_hyphen_values = true)]
    origin: [f64; 3],
    /// Sensor noise, standard deviation in 8-bit counts.
    #[arg(long)]
    noise: Option<f32>,
    /// Give all cameras the same exposure and white balance.
    #[arg(long)]
    same_exposure: bool,
}

/// Parses `X,Y,Z`.
pub(super) fn parse_point(text: &str) -> Result<[f64; 3], String> {
    let parts: Vec<f64> = text.split(',').map(|p| p.trim().parse().unwrap_or(f64::NAN)).collect();
    match <[f64; 3]>::try_from(parts) {
        Ok(p) if p.iter().all(|x| x.is_finite()) => Ok(p),
        _ => Err(format!("'{text}' is not three finite numbers X,Y,Z")),
    }
}

/// Writes the bag.
pub fn run(args: &Args, progress: bool) -> Result<Outcome> {
    let defaults = DriveOptions::default();
    let options = DriveOptions {
        seed: args.seed,
        seconds: args.seconds,
        cameras: args.cameras,
        width: args.width,
        height: args.height,
        rate_hz: args.rate,
        stagger_sec: args.stagger,
        origin: args.origin,
        noise: args.noise.unwrap_or(defaults.noise),
        exposure: !args.same_exposure,
        ..defaults
    };
    let drive = Drive::new(&options).map_err(|e| UsageError(e.to_string()))?;
    let bar = progress_bar(progress, (drive.frame_count() * options.cameras) as u64, "writing images");
    synth::write_drive(&drive, &args.out, &SynthOptions::default(), &mut |done, total| {
        bar.set_length(total);
        bar.set_position(done);
    })
    .with_context(|| format!("cannot write {}", args.out.display()))?;
    bar.finish_and_clear();
    say!("{}", args.out.display());
    Ok(Outcome::Done)
}
