//! `storm refine`: per-scene optimisation of a saved map on the pictures of a bag.

use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;

use anyhow::{Context, Result};
use serde_json::json;
use storm_render::raster::RasterSettings;

use super::{Outcome, UsageError, progress_bar};
use crate::baselines::gs3d::Params;
use crate::config::Config;
use crate::map::{MapCloud, StaticMap};
use crate::output::ply::{PlyCloud, write_ply};
use crate::refine::{Boxes, RefineOptions, RefineReport, Score, refine, shots};
use crate::saved;

/// Confidence of a refined Gaussian in the native map: that of one seen from a metre away.
const CONFIDENCE: f32 = 1.0;

/// Arguments of `storm refine`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// A map (map.ply), or a results folder (then what `objects.csv` says moves is left out of the pictures).
    map: PathBuf,
    /// The recording the map is of.
    #[arg(long)]
    bag: PathBuf,
    /// Folder for the refined map: map.ply, map/ (native), refine.csv, refine.json.
    #[arg(long)]
    out: PathBuf,
    /// Most iterations.
    #[arg(long, default_value_t = 3000)]
    iterations: u64,
    /// Most time, minutes.
    #[arg(long, default_value_t = f64::INFINITY)]
    minutes: f64,
    /// Iterations between two looks at the figures.
    #[arg(long, default_value_t = 250)]
    score_every: u64,
    /// Size the pictures are brought to, WIDTHxHEIGHT.
    #[arg(long, default_value = "192x128")]
    size: String,
    /// Most moments of the recording that are used, spread evenly.
    #[arg(long, default_value_t = 120)]
    moments: usize,
    /// Every so manieth moment is held out; 0: none.
    #[arg(long, default_value_t = 6)]
    hold_out: usize,
    /// For the order of the pictures.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Configuration file; `input`, `sync` and `map` count.
    #[arg(long)]
    config: Option<PathBuf>,
    /// Single configuration values, key=value.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// Refines, prints the figures, writes the map.
pub fn run(args: &Args, progress: bool) -> Result<Outcome> {
    let size = super::parse_size("--size", &args.size)?;
    if !(args.minutes > 0.0 && args.iterations > 0) {
        let text = format!("--minutes {} --iterations {}: both must be above 0", args.minutes, args.iterations);
        return Err(UsageError(text).into());
    }
    let config = Config::from_arguments(args.config.as_deref(), &args.set)?;
    let folder = args.map.is_dir();
    let file = if folder { args.map.join("map.ply") } else { args.map.clone() };
    let saved = saved::load_ply(&file)?;
    let objects = args.map.join("objects.csv");
    let boxes = if folder && objects.exists() { Boxes::read(&objects)? } else { Boxes::default() };
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make {}", args.out.display()))?;
    let shots = shots(&args.bag, &config, size, &saved.map_from_local, &boxes, (args.moments, args.hold_out))?;
    let mut params = params_of(&saved.cloud);
    let stop = super::interrupt::stop_flag();
    let options = RefineOptions {
        iterations: args.iterations,
        minutes: args.minutes,
        score_every: args.score_every,
        seed: args.seed,
    };
    let bar = progress_bar(progress, args.iterations, "refining");
    say!("iteration   seconds   fitted PSNR dB   held-out PSNR dB");
    let report = refine(&mut params, &shots, RasterSettings::default(), &options, &mut |done, score| {
        bar.set_position(done);
        if let Some(s) = score {
            bar.suspend(|| say!("{}", line(s)));
        }
        !stop.load(Ordering::Relaxed)
    })?;
    bar.finish_and_clear();
    say!(
        "{} Gaussians, {} pictures fitted, {} held out, {:.0} % of their pixels covered",
        report.gaussians,
        report.fitted,
        report.held_out,
        100.0 * report.covered
    );
    write(args, &config, &params, &saved, &report)?;
    say!("{}", args.out.join("map.ply").display());
    Ok(Outcome::Done)
}

fn line(s: &Score) -> String {
    let show = |x: Option<f64>| x.map_or("-".into(), |x| format!("{x:.2}"));
    format!("{:9}   {:7.1}   {:>14}   {:>16}", s.iteration, s.seconds, show(s.psnr_fitted), show(s.psnr_held_out))
}

fn params_of(cloud: &PlyCloud) -> Params {
    let g = storm_render::Gaussians {
        means: cloud.positions.clone(),
        quats: cloud.quats.clone(),
        scales: cloud.scales.clone(),
        opacities: cloud.opacities.clone(),
        colors: cloud.colors01.iter().map(|c| c.map(|x| 2.0 * x - 1.0)).collect(),
        ..Default::default()
    };
    Params::of_gaussians(&g)
}

fn write(
    args: &Args,
    config: &Config,
    params: &Params,
    saved: &saved::SavedGaussians,
    report: &RefineReport,
) -> Result<()> {
    let g = params.gaussians();
    let origin = saved.map_from_local.translation;
    let ply = PlyCloud {
        positions: g.means,
        colors01: g.colors.iter().map(|c| c.map(|x| (0.5 * x + 0.5).clamp(0.0, 1.0))).collect(),
        opacities: g.opacities,
        scales: g.scales,
        quats: g.quats,
    };
    let iterations = report.scores.last().map_or(0, |s| s.iteration);
    let notes = [format!(
        "static map, refined by {iterations} iterations; positions in metres, relative to origin_m in the map frame"
    )];
    write_ply(&args.out.join("map.ply"), &ply, origin.to_array(), &notes)?;
    let n = ply.len();
    let cloud = MapCloud {
        origin,
        positions: ply.positions,
        colors01: ply.colors01,
        opacities: ply.opacities,
        scales: ply.scales,
        quats: ply.quats,
        confidences: vec![CONFIDENCE; n],
    };
    StaticMap::of_cloud(&config.map, &args.out.join("map"), &cloud)?.save()?;
    let show = |x: Option<f64>| x.map_or(String::new(), |x| format!("{x:.4}"));
    let rows = report
        .scores
        .iter()
        .map(|s| format!("{},{:.3},{},{}\n", s.iteration, s.seconds, show(s.psnr_fitted), show(s.psnr_held_out)));
    let csv = std::iter::once("iteration,seconds,psnr_fitted_db,psnr_held_out_db\n".to_string()).chain(rows);
    put(&args.out.join("refine.csv"), &csv.collect::<String>())?;
    let json = json!({"map": args.map, "bag": args.bag, "size": args.size, "report": report});
    put(&args.out.join("refine.json"), &(serde_json::to_string_pretty(&json)? + "\n"))
}

fn put(path: &Path, text: &str) -> Result<()> {
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}
