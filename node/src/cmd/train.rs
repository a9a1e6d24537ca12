//! `storm train`: makes weights from procedural drives and recordings.

mod bags;
mod curves;
mod cuts;
mod grid;
mod mean;
mod recipe;
mod recordings;
mod variants;

use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use candle_core::Device;
use storm_model::train::{ClipOptions, Loader, TrainError, TrainOptions, Trainer, provenance, validate};
use storm_model::weights::{self, SavedType, save_safetensors};
use storm_model::{ModelConfig, Storm};
use tracing::info;

use super::{Outcome, UsageError, interrupt, progress_bar};
use curves::Curves;
use grid::GridName;
use recipe::{PAPER_RATE, RecipeArgs, Start};
use recordings::{RecordingArgs, Recordings};
use variants::{Beginning, VariantArgs};

/// Target times drawn for validation.
const VALIDATION_TARGETS: usize = 2;

/// What `--weights` calls the weights that ship.
const SHIPPED: &str = "shipped";

/// Arguments of `storm train`.
#[derive(Debug, Clone, clap::Args)]
pub struct Args {
    #[command(flatten)]
    recorded: RecordingArgs,
    #[command(flatten)]
    variant: VariantArgs,
    #[command(flatten)]
    recipe: RecipeArgs,
    /// Train a whole grid of networks, --steps each, and write table and picture to --out: the paper's ablations, or sizes
    /// and choices around the preset with their step times. Finished networks are kept, so a grid may be made in pieces.
    #[arg(long, conflicts_with_all = ["resume", "per_frame", "motion_tokens", "timesteps", "no_sky_token", "no_affine_token"])]
    grid: Option<GridName>,
    /// Save and end at this step of the run; --resume goes on there.
    #[arg(long)]
    stop_at: Option<u64>,
    /// Architecture of a new network, or of the one that --grow-from makes [default: tiny; with --grow-from: that of its weights].
    #[arg(long, conflicts_with_all = ["weights", "resume"])]
    preset: Option<String>,
    /// Start from these weights, or from the ones that ship (`shipped`), with a fresh optimiser. Several, comma-separated: from their
    /// mean (with --minutes 0 it is only written).
    #[arg(long, conflicts_with = "resume", value_delimiter = ',')]
    weights: Vec<PathBuf>,
    /// Start from these weights (or `shipped`), grown into the larger network that --preset and --network describe: larger patches
    /// of larger images, more patches, wider or more blocks, with the results of the small one (with --minutes 0 it is
    /// only written).
    #[arg(long, value_name = "WEIGHTS", conflicts_with_all = ["weights", "resume", "grid"])]
    grow_from: Option<PathBuf>,
    /// Go on exactly where this checkpoint was written; its options hold, only --out, --minutes and the reports differ.
    #[arg(long)]
    resume: Option<PathBuf>,
    /// Chooses the first weights and all training data; drives 10,000 to 19,999 are never used.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Steps of the whole run (the learning rate falls to its end over them).
    #[arg(long, default_value_t = 10_000)]
    steps: u64,
    /// Clips per step.
    #[arg(long, default_value_t = 8)]
    batch: usize,
    /// Train without ground-truth depth (with --stage render: from pictures and sky masks alone).
    #[arg(long)]
    no_depth_labels: bool,
    /// Train without ground-truth flow.
    #[arg(long)]
    no_flow_labels: bool,
    /// Weight of the ground-truth flow term [default: 0.1].
    #[arg(long, allow_hyphen_values = true)]
    flow_weight: Option<f64>,
    /// How much more a moving pixel weighs in the flow term [default: 10].
    #[arg(long, allow_hyphen_values = true)]
    moving_weight: Option<f64>,
    /// Weight of one term of the pixel stage, as `--pixel-weight opacity=0`; may be given again. To finish, leave opacity,
    /// scale, color, depth and log_depth to the drawn pictures: they know better what several timesteps together look like.
    #[arg(long, value_name = "TERM=WEIGHT", conflicts_with = "resume")]
    pixel_weight: Vec<String>,
    /// Learning rate of the velocity bases' decoder over that of all else [default: 1]; with `--pixel-weight bases=0.1` 10.
    #[arg(long, allow_hyphen_values = true, conflicts_with = "resume")]
    basis_rate: Option<f64>,
    /// Weight of the velocity regulariser [default: 0.005, the paper's].
    #[arg(long, allow_hyphen_values = true)]
    lambda_reg: Option<f64>,
    /// Give each timestep an image so many seconds before it for the velocity sweep (networks with sweep_after_block), but for a
    /// fifth of the clips [default: 0, none].
    #[arg(long, default_value_t = 0.0, conflicts_with = "resume")]
    prior_sec: f64,
    /// Cameras of a clip, 1 to 6.
    #[arg(long, default_value_t = 3)]
    cameras: usize,
    /// Stop (and save) after so many minutes.
    #[arg(long)]
    minutes: Option<f64>,
    /// Folder for weights, checkpoint and curves.
    #[arg(long, default_value = "storm_out/train")]
    out: PathBuf,
    /// Validate every so many steps; 0 only at the end.
    #[arg(long, default_value_t = 1000)]
    validate_every: u64,
    /// Held-out drives to validate on; 0 never.
    #[arg(long, default_value_t = 8)]
    validate_drives: u64,
    /// Checkpoint every so many minutes.
    #[arg(long, default_value_t = 10.0)]
    checkpoint_minutes: f64,
    /// Threads that make clips [default: the cores, at most 4].
    #[arg(long, default_value_t = 0)]
    loader_threads: usize,
    /// Save weights as f16 (half the size).
    #[arg(long)]
    f16: bool,
    /// Where to compute: cpu, cuda or metal (as built).
    #[arg(long, default_value = "cpu")]
    device: String,
}

impl Args {
    /// The architecture of a new network.
    fn preset_name(&self) -> &str {
        self.preset.as_deref().unwrap_or("tiny")
    }
}

/// Trains.
pub fn run(args: &Args, progress: bool) -> Result<Outcome> {
    // SAFETY: the command line has been read and the log started; no other thread runs yet.
    unsafe { storm_model::ops::set_up_training() };
    let device = device(&args.device)?;
    if let Some(name) = args.grid {
        return grid::run(args, name, &device, progress);
    }
    let mut trainer = start(args, &device)?;
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make folder {}", args.out.display()))?;
    let total = trainer.options().schedule.steps.min(args.stop_at.unwrap_or(u64::MAX));
    // The whole history of the weights (thousands of letters where they were trained on and on) goes into the weights file.
    info!(
        "{}: {} weights, step {} of {total}; {}",
        trainer.config().describe(),
        trainer.weight_count(),
        trainer.steps_done(),
        trainer.options().describe_run()
    );
    let mut curves = Curves::open(&args.out, trainer.steps_done())?;
    let mut recordings = Recordings::open(&mut trainer, &args.out, &device)?;
    if trainer.steps_done() == 0 {
        recordings.score(&Storm::new(trainer.config(), &trainer.weights(true)?)?, 0, &device)?;
    }
    let data = recordings.data(&trainer);
    let mut loader = Loader::new(data, trainer.config().clone(), trainer.steps_done(), args.loader_threads);
    let stop = interrupt::stop_flag();
    let begin = Instant::now();
    let mut saved = Instant::now();
    let limit = args.minutes.map(|m| Duration::try_from_secs_f64(60.0 * m)).transpose();
    let limit = limit.map_err(|e| UsageError(format!("--minutes: {e}")))?;
    let every = Duration::try_from_secs_f64(60.0 * args.checkpoint_minutes)
        .map_err(|e| UsageError(format!("--checkpoint-minutes: {e}")))?;
    let first = trainer.steps_done();
    let bar = progress_bar(progress, total, "training").with_position(first);
    bar.reset_eta();
    let mut waited = 0.0;
    while trainer.steps_done() < total
        && !stop.load(Ordering::Relaxed)
        && limit.is_none_or(|limit| begin.elapsed() < limit)
    {
        let wait = Instant::now();
        let clip = loader.next_batch()?;
        let wait = wait.elapsed().as_secs_f64();
        waited += wait;
        let report = match trainer.step(&clip) {
            Ok(report) => report,
            Err(e) => {
                // The weights are still those of the step before: keep them for a look at what went wrong.
                if matches!(e, TrainError::NonFinite { .. }) {
                    trainer.save_checkpoint(&args.out.join("stopped.ckpt"))?;
                }
                return Err(e.into());
            }
        };
        curves.step(&report, wait)?;
        let done = trainer.steps_done();
        let rate = (done - first) as f64 * trainer.options().batch as f64 / begin.elapsed().as_secs_f64();
        bar.set_message(format!("loss {:.4}, {rate:.1} samples/s,", report.total));
        bar.set_position(done);
        if args.validate_every > 0 && done.is_multiple_of(args.validate_every) && done < total {
            check(args, &trainer, &device, &mut curves, &mut recordings)?;
        }
        if saved.elapsed() >= every {
            save(args, &trainer)?;
            saved = Instant::now();
        }
    }
    bar.finish_and_clear();
    let done = trainer.steps_done();
    let seconds = begin.elapsed().as_secs_f64();
    save(args, &trainer)?;
    if stop.load(Ordering::Relaxed) {
        // Whoever sent the signal does not wait for error figures.
        info!("stopped at step {done}; go on with --resume {}", args.out.join("last.ckpt").display());
    } else {
        check(args, &trainer, &device, &mut curves, &mut recordings)?;
    }
    let samples = (done - first) as f64 * trainer.options().batch as f64;
    say!(
        "{} steps, {seconds:.0} s, {:.2} samples/s, {:.0} % of the time waiting for clips",
        done - first,
        samples / seconds.max(1e-9),
        100.0 * waited / seconds.max(1e-9)
    );
    say!("{}", args.out.join("weights.safetensors").display());
    Ok(Outcome::Done)
}

/// From a checkpoint, from weights, or from nothing.
fn start(args: &Args, device: &Device) -> Result<Trainer> {
    if let Some(path) = &args.resume {
        return Ok(Trainer::resume(path, device)?);
    }
    let preset = |name: &str| {
        let config = ModelConfig::preset(name).map_err(|e| UsageError(e.to_string()))?;
        Ok::<_, UsageError>(ModelConfig { num_cams: config.num_cams.max(args.cameras), ..config })
    };
    let Beginning { config, weights, history } = if let Some(path) = &args.grow_from {
        let into = args.preset.as_deref().map(preset).transpose()?;
        args.variant.grow(trained(path)?, into, args.seed)?
    } else if args.weights.is_empty() {
        args.variant.make(&preset(args.preset_name())?, args.seed, args.preset_name())?
    } else {
        args.variant.change(mean::mean(&args.weights, &trained)?, args.seed)?
    };
    let mut options = TrainOptions::new(args.seed, args.steps, args.batch, PAPER_RATE);
    options.history = history;
    options.clips = ClipOptions {
        cameras: args.cameras,
        width: config.image_width,
        height: config.image_height,
        prior_sec: args.prior_sec,
        ..ClipOptions::default()
    };
    let from = match (args.recorded.alone(), args.weights.is_empty() && args.grow_from.is_none()) {
        (true, _) => Start::Recordings,
        (false, false) => Start::Weights,
        (false, true) => Start::New,
    };
    args.recipe.apply(&mut options, from)?;
    if let Some(x) = args.flow_weight {
        options.pixel.flow = x;
    }
    if args.no_flow_labels {
        options.pixel.flow = 0.0;
    }
    if args.no_depth_labels {
        (options.pixel.depth, options.pixel.log_depth, options.pixel.scale, options.render.depth) =
            (0.0, 0.0, 0.0, 0.0);
    }
    if let Some(x) = args.moving_weight {
        options.pixel.moving_weight = x;
    }
    if let Some(x) = args.lambda_reg {
        options.pixel.velocity = x;
        options.render.velocity = x;
    }
    if let Some(x) = args.basis_rate {
        options.adam.basis_rate = x;
    }
    options.pixel = variants::set_keys("--pixel-weight", &options.pixel, &args.pixel_weight)?;
    args.variant.apply(&mut options);
    args.recorded.apply(&mut options)?;
    options.check().map_err(|e| UsageError(e.to_string()))?;
    Ok(Trainer::new(&config, &weights, options, device)?)
}

/// The network of a weights file, or the one that ships.
fn trained(path: &std::path::Path) -> Result<Beginning> {
    if path.as_os_str() == SHIPPED {
        let (config, weights) = weights::shipped(&Device::Cpu)?;
        return Ok(Beginning { config, weights, history: weights::shipped_provenance() });
    }
    let (config, weights) =
        weights::load(path, None, &Device::Cpu).with_context(|| format!("cannot use weights {}", path.display()))?;
    let history = provenance(path).unwrap_or_else(|| "weights of unknown origin".into());
    Ok(Beginning { config, weights, history })
}

/// Weights (their moving average), the checkpoint, and what happened before it.
fn save(args: &Args, trainer: &Trainer) -> Result<()> {
    trainer.save_checkpoint(&args.out.join("last.ckpt"))?;
    let dtype = if args.f16 { SavedType::F16 } else { SavedType::F32 };
    let provenance = match trainer.steps_done() {
        0 => trainer.options().history.clone(),
        steps => format!("{}, {steps} steps done", trainer.options().describe()),
    };
    let path = args.out.join("weights.safetensors");
    save_safetensors(&path, trainer.config(), &trainer.weights(true)?, dtype, &provenance)?;
    Ok(())
}

fn check(
    args: &Args,
    trainer: &Trainer,
    device: &Device,
    curves: &mut Curves,
    recordings: &mut Recordings,
) -> Result<()> {
    let model = Storm::new(trainer.config(), &trainer.weights(true)?)?;
    recordings.score(&model, trainer.steps_done(), device)?;
    if args.validate_drives == 0 {
        return Ok(());
    }
    let options = ClipOptions { targets: VALIDATION_TARGETS, ..trainer.options().clips };
    let v = validate(&model, &options, args.validate_drives, device)?;
    info!("step {}: {}", trainer.steps_done(), curves::describe(&v));
    curves.validation(trainer.steps_done(), &v)?;
    Ok(())
}

fn device(name: &str) -> Result<Device> {
    let wrong = |e: candle_core::Error| UsageError(format!("--device {name}: {e}"));
    Ok(match name {
        "cpu" => Device::Cpu,
        "cuda" => Device::new_cuda(0).map_err(wrong)?,
        "metal" => Device::new_metal(0).map_err(wrong)?,
        other => return Err(UsageError(format!("--device {other}: use cpu, cuda or metal")).into()),
    })
}
