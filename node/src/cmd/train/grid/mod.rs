//! `storm train --grid`: networks that differ in one thing each, trained with the command's own options on the same data, then
//! scored on validation drives, which no training sees.
//!
//! Finished networks are kept and not trained again by the next call, so a grid may be made in pieces (their step times are
//! taken again by each call: let the last one have the machine for itself). A network whose training ended in a
//! non-finite value is reported so: the paper saw that without the velocity regulariser.

mod report;
mod rows;

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use anyhow::{Context, Result};
use candle_core::Device;
use storm_model::Storm;
use storm_model::train::{ClipOptions, Loader, TrainError, Validation, validate};
use tracing::info;

use self::rows::{Row, Setting};
use super::{Args, VALIDATION_TARGETS, save, start};
use crate::cmd::{Outcome, UsageError, bench, interrupt, progress_bar};
use crate::config::ModelConfigSection;
use crate::output::atomic::write_bytes;

pub use self::rows::GridName;

/// Timed steps of each network of a grid that reports them.
const TIMED_STEPS: usize = 15;

/// What came of a network on clips of so many timesteps.
#[derive(Debug, Clone)]
enum Found {
    Figures(Box<Figures>),
    /// The training ended; why.
    Ended(String),
}

/// A network and its errors.
#[derive(Debug, Clone, Copy)]
struct Figures {
    errors: Validation,
    parameters: usize,
    cost: Option<Cost>,
}

/// What a step costs: network and three views.
#[derive(Debug, Clone, Copy)]
struct Cost {
    tokens: usize,
    step_ms: f64,
}

/// Trains and scores a grid.
pub fn run(args: &Args, name: GridName, device: &Device, progress: bool) -> Result<Outcome> {
    if args.validate_drives == 0 {
        return Err(UsageError("--grid scores networks; use --validate-drives 1 or more".into()).into());
    }
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make folder {}", args.out.display()))?;
    let rows = name.rows();
    let mut settings: Vec<&Setting> = Vec::new();
    for row in &rows {
        if !settings.contains(&&row.setting) {
            settings.push(&row.setting);
        }
    }
    let stop = interrupt::stop_flag();
    let bar = progress_bar(progress, settings.len() as u64, "training networks");
    let mut found: Vec<Option<Found>> = vec![None; rows.len()];
    for setting in settings {
        let own = setting.args(args);
        let begin = Instant::now();
        let ended = train(&own, device, &stop)?;
        if stop.load(Ordering::Relaxed) {
            info!("stopped; the same command goes on with {}", setting.folder());
            return Ok(Outcome::Done);
        }
        let seconds = begin.elapsed().as_secs_f64();
        let cost = if name == GridName::Sizes && ended.is_none() { Some(cost(&own)?) } else { None };
        for (row, found) in rows.iter().zip(&mut found).filter(|(row, _)| row.setting == *setting) {
            *found = Some(match &ended {
                Some(why) => Found::Ended(why.clone()),
                None => Found::Figures(Box::new(score(&own, row.seen, cost, device)?)),
            });
        }
        info!("{}: {seconds:.0} s", setting.folder());
        bar.inc(1);
    }
    bar.finish_and_clear();
    let results: Vec<(Row, Found)> =
        rows.into_iter().zip(found).filter_map(|(row, found)| found.map(|found| (row, found))).collect();
    report::write(args, name, &results)?;
    say_text!("{}", report::table(args, name, &results));
    say!("{}", args.out.join(format!("{}.md", name.name())).display());
    Ok(Outcome::Done)
}

/// Trains one network unless its weights are there; a text where a non-finite value ended it.
fn train(args: &Args, device: &Device, stop: &AtomicBool) -> Result<Option<String>> {
    let ended = args.out.join("ended.txt");
    if let Ok(why) = std::fs::read_to_string(&ended) {
        return Ok(Some(why.trim_end().to_owned()));
    }
    if weights_of(args).exists() {
        return Ok(None);
    }
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make folder {}", args.out.display()))?;
    let mut trainer = start(args, device)?;
    let mut loader = Loader::new(trainer.data(), trainer.config().clone(), 0, args.loader_threads);
    while trainer.steps_done() < trainer.options().schedule.steps {
        if stop.load(Ordering::Relaxed) {
            return Ok(None);
        }
        match trainer.step(&loader.next_batch()?) {
            Ok(_) => {}
            Err(e @ TrainError::NonFinite { .. }) => {
                let why = e.to_string();
                write_bytes(&ended, (why.clone() + "\n").as_bytes())?;
                return Ok(Some(why));
            }
            Err(e) => return Err(e.into()),
        }
    }
    save(args, &trainer)?;
    Ok(None)
}

fn weights_of(args: &Args) -> std::path::PathBuf {
    args.out.join("weights.safetensors")
}

fn cost(args: &Args) -> Result<Cost> {
    let section =
        ModelConfigSection { weights: weights_of(args).display().to_string(), ..ModelConfigSection::default() };
    let timed = bench::time_network("", &section, TIMED_STEPS)?;
    Ok(Cost { tokens: timed.tokens, step_ms: timed.step_ms.p50 })
}

fn score(args: &Args, timesteps: usize, cost: Option<Cost>, device: &Device) -> Result<Figures> {
    let model = Storm::load(&weights_of(args), device)?;
    let config = model.config();
    let options = ClipOptions {
        cameras: args.cameras,
        width: config.image_width,
        height: config.image_height,
        timesteps,
        targets: VALIDATION_TARGETS,
        ..ClipOptions::default()
    };
    let parameters = storm_model::weights::tensor_specs(config).iter().map(|s| s.shape.iter().product::<usize>()).sum();
    Ok(Figures { errors: validate(&model, &options, args.validate_drives, device)?, parameters, cost })
}
