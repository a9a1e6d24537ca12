//! What skipping saves and costs: a vehicle that stands, cruises and drives through traffic, with every step computed and with the
//! ladder of notches, on the same windows in turn.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result};
use serde::Serialize;
use storm_render::world::{Drive, DriveOptions};

use super::pairs::median;
use crate::config::Config;
use crate::decode::RgbPicture;
use crate::dice::Dice;
use crate::engine::evaluate::{Clip, Placed, Prediction, Tally};
use crate::engine::figures::Figures;
use crate::engine::truth::TruthAt;
use crate::engine::{Engine, ModelSource};
use crate::gate::contract::Notch;
use crate::gate::skipper::SkipCounts;
use crate::pipeline::step::{Step, StepMaker};
use crate::pipeline::timing::StageStats;
use crate::source::Frame;
use crate::source::world::posed_set;
use crate::window::{PosedSet, Window, WindowBuilder};

/// Drives of their own, that neither training nor the held-out suite has.
const SEED: u64 = 424_300;
const RATE_HZ: f64 = 10.0;
const CAMERAS: usize = 3;
/// The camera windows are anchored at.
const REFERENCE: usize = 1;
/// Sensor noise, 8-bit levels.
const NOISE: f32 = 1.5;
/// Every so manieth step is scored.
const SCORE_EVERY: usize = 5;
/// Of a vehicle that stands all full steps are alike: every so manieth is enough.
const FULL_EVERY: usize = 10;

/// What the vehicle does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Doing {
    /// Waits where nothing moves.
    Standing,
    /// Drives where nobody else does.
    Cruising,
    /// Drives through dense traffic.
    Busy,
}

/// Parts of the drive and their lengths, seconds.
const PARTS: [(Doing, f64); 4] =
    [(Doing::Standing, 22.0), (Doing::Cruising, 7.0), (Doing::Busy, 7.0), (Doing::Standing, 22.0)];

impl Doing {
    fn name(self) -> &'static str {
        match self {
            Self::Standing => "standing",
            Self::Cruising => "cruising",
            Self::Busy => "busy",
        }
    }
}

/// One kind of drive.
#[derive(Debug, Clone, Serialize)]
pub(super) struct DriveRow {
    /// `standing`, `cruising`, `busy`, or `mixed`: all of them one after the other.
    pub drive: &'static str,
    /// Steps, and those of them by the notch that took them.
    pub steps: usize,
    pub still: usize,
    pub predicted: usize,
    pub approximate: usize,
    /// Mean milliseconds per step, all computed in full and with the ladder.
    pub full_ms: f64,
    pub ms: f64,
    /// How many times less; of `mixed` their mean, weighted by steps, as if a full step took equally long in all three.
    pub ratio: f64,
    /// Median milliseconds of a step that was taken again, and of one that was predicted.
    pub still_ms: Option<f64>,
    pub predicted_ms: Option<f64>,
    /// Error figures, likewise.
    pub full: Option<Figures>,
    pub skipping: Option<Figures>,
}

/// The drives with a setting, and what its contract did.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Drives {
    pub rows: Vec<DriveRow>,
    pub skips: SkipCounts,
    /// Per stage of full steps, over all drives.
    pub stages_ms: BTreeMap<String, StageStats>,
}

/// Times and errors over one kind of drive.
#[derive(Default)]
struct Sums {
    steps: usize,
    /// Steps run in full beside them.
    full_steps: usize,
    notches: [Vec<f64>; 3],
    ms: [f64; 2],
    tallies: [Tally; 2],
}

/// Drives with this configuration, and beside it with every step computed in full. `tick` is called with the part done, 0 to 1.
pub(super) fn run(config: &Config, seconds_scale: f64, tick: &mut dyn FnMut(f64)) -> Result<Drives> {
    let mut full = config.clone();
    full.skip.check_every = 0;
    let mut makers = [maker(&full)?, maker(config)?];
    let source = ModelSource::open(&config.model)?;
    let size = source.picture_size(&config.model)?;
    let mut sums: [Sums; 3] = Default::default();
    let total: f64 = PARTS.iter().map(|(_, s)| s).sum();
    let mut done = 0.0;
    for (epoch, (doing, seconds)) in PARTS.into_iter().enumerate() {
        let sum = &mut sums[doing as usize];
        let part = Part::new(doing, size, (seconds * seconds_scale).max(2.0), epoch as u32)?;
        makers.iter_mut().for_each(|m| m.set_cameras(part.cameras()));
        part.drive(config, &mut makers, sum)?;
        done += seconds;
        tick(done / total);
    }
    let rows = [Doing::Standing, Doing::Cruising, Doing::Busy].into_iter().zip(&sums);
    let mut rows: Vec<DriveRow> = rows.map(|(doing, sum)| sum.row(doing.name())).collect();
    rows.push(mixed(&rows));
    Ok(Drives { rows, skips: makers[1].skips(), stages_ms: makers[0].timings().stats() })
}

fn maker(config: &Config) -> Result<StepMaker> {
    let source = ModelSource::open(&config.model)?;
    let engine = Engine::new(source, &config.model, CAMERAS, config.window.timespan_sec)?;
    Ok(StepMaker::new(engine.with_skips(&config.skip), Vec::new(), config, None)?)
}

fn mixed(rows: &[DriveRow]) -> DriveRow {
    let sum = |get: &dyn Fn(&DriveRow) -> usize| rows.iter().map(get).sum::<usize>();
    let steps = sum(&|r| r.steps);
    let mean = |get: &dyn Fn(&DriveRow) -> f64| {
        rows.iter().map(|r| get(r) * r.steps as f64).sum::<f64>() / steps.max(1) as f64
    };
    let (full_ms, ms) = (mean(&|r| r.full_ms), mean(&|r| r.ms));
    // Not the quotient of those: the three were driven one after the other, and the machine may have been slow during one. Each
    // one's own ratio is of steps in turn, so that a full step counts alike in all.
    let ratio = steps as f64 / rows.iter().map(|r| r.steps as f64 / r.ratio).sum::<f64>();
    DriveRow {
        drive: "mixed",
        steps,
        still: sum(&|r| r.still),
        predicted: sum(&|r| r.predicted),
        approximate: sum(&|r| r.approximate),
        full_ms,
        ms,
        ratio,
        still_ms: None,
        predicted_ms: None,
        full: None,
        skipping: None,
    }
}

impl Sums {
    fn row(&self, drive: &'static str) -> DriveRow {
        let (full_ms, ms) = (self.ms[0] / self.full_steps.max(1) as f64, self.ms[1] / self.steps.max(1) as f64);
        let [still, predicted, approximate] = [0, 1, 2].map(|n| self.notches[n].len());
        let figures = |t: &Tally| (t.images() > 0).then(|| t.figures());
        let [full, skipping] = [figures(&self.tallies[0]), figures(&self.tallies[1])];
        DriveRow {
            drive,
            steps: self.steps,
            still,
            predicted,
            approximate,
            full_ms,
            ms,
            ratio: full_ms / ms,
            still_ms: median(self.notches[0].clone()),
            predicted_ms: median(self.notches[1].clone()),
            full,
            skipping,
        }
    }
}

/// One part of the drive: sets at 10 Hz with what is true of them.
struct Part {
    drive: Drive,
    doing: Doing,
    epoch: u32,
    frames: usize,
    /// The one moment of a vehicle at rest.
    moment: Option<(PosedSet<Frame>, Vec<TruthAt>)>,
}

impl Part {
    fn new(doing: Doing, (width, height): (usize, usize), seconds: f64, epoch: u32) -> Result<Self> {
        let traffic = if doing == Doing::Busy { 2.5 } else { 0.0 };
        let noise = if doing == Doing::Standing { 0.0 } else { NOISE };
        let options = DriveOptions {
            seed: SEED + u64::from(epoch),
            seconds,
            cameras: CAMERAS,
            width,
            height,
            rate_hz: RATE_HZ,
            noise,
            traffic,
            ..DriveOptions::default()
        };
        let drive = Drive::new(&options)?;
        let mut part = Self { drive, doing, epoch, frames: (seconds * RATE_HZ) as usize, moment: None };
        part.moment = (doing == Doing::Standing).then(|| part.drawn(0));
        Ok(part)
    }

    fn cameras(&self) -> Vec<storm_render::Intrinsics> {
        self.drive.cameras().iter().map(|c| c.intrinsics).collect()
    }

    fn drawn(&self, frame: usize) -> (PosedSet<Frame>, Vec<TruthAt>) {
        let (mut set, truth) = posed_set(&self.drive, frame);
        set.epoch = self.epoch;
        (set, truth.into_iter().map(TruthAt::of_frame).collect())
    }

    fn set(&self, k: usize) -> (PosedSet<Frame>, Vec<TruthAt>) {
        let Some((set, truth)) = &self.moment else { return self.drawn(k) };
        let mut set = set.clone();
        set.stamp_ns = (k as f64 * 1e9 / RATE_HZ) as i64;
        let mut dice = Dice::new(SEED + k as u64);
        for frame in &mut set.frames {
            frame.stamp_ns = set.stamp_ns;
            frame.item.rgb = Arc::new(noisy(&frame.item.rgb, &mut dice));
        }
        (set, truth.clone())
    }

    /// Both makers over all windows, in turn.
    fn drive(&self, config: &Config, makers: &mut [StepMaker; 2], sum: &mut Sums) -> Result<()> {
        let mut builder = WindowBuilder::new(&config.window, REFERENCE);
        let mut seen: Vec<(Arc<PosedSet<Frame>>, Vec<TruthAt>)> = Vec::new();
        for k in 0..self.frames {
            let (set, truth) = self.set(k);
            seen.push((Arc::new(set.clone()), truth));
            let Some(window) = builder.push(set) else { continue };
            sum.steps += 1;
            let full_too = self.doing != Doing::Standing || sum.steps % FULL_EVERY == 1;
            sum.full_steps += usize::from(full_too);
            for (m, maker) in makers.iter_mut().enumerate().filter(|(m, _)| *m == 1 || full_too) {
                let start = Instant::now();
                let step = maker.run(window.clone())?.context("a step of the drive is not finite")?;
                let ms = start.elapsed().as_secs_f64() * 1e3;
                sum.ms[m] += ms;
                if let Some(notch) = step.notch.filter(|_| m == 1) {
                    sum.notches[Notch::ALL.iter().position(|n| *n == notch).unwrap_or(0)].push(ms);
                }
                if sum.steps.is_multiple_of(SCORE_EVERY) && self.doing != Doing::Standing {
                    score(&mut sum.tallies[m], &window, &seen, self.cameras(), &step)?;
                }
            }
        }
        Ok(())
    }
}

/// A step's scene against all frames of its window, those between the timesteps held out.
fn score(
    tally: &mut Tally,
    window: &Window<Frame>,
    seen: &[(Arc<PosedSet<Frame>>, Vec<TruthAt>)],
    cameras: Vec<storm_render::Intrinsics>,
    step: &Step,
) -> Result<()> {
    let first_ns = window.steps.first().map_or(window.stamp_ns, |s| s.stamp_ns);
    let frames = seen.iter().filter(|(set, _)| set.stamp_ns >= first_ns).cloned().collect();
    let clip = Clip::new(String::new(), SEED, window.clone(), REFERENCE, frames, cameras, Vec::new());
    let placed = Placed {
        stamp_ns: window.stamp_ns,
        map_from_anchor: step.window.map_from_anchor,
        scene: (*step.scene).clone(),
        pixel_aligned: false,
    };
    tally.add(&clip, &Prediction::Scenes(vec![placed]), None)
}

/// A picture with fresh sensor noise.
fn noisy(rgb: &RgbPicture, dice: &mut Dice) -> RgbPicture {
    let mut noise = || NOISE * ((0..12).map(|_| dice.unit()).sum::<f32>() - 6.0);
    let data = rgb.data.iter().map(|&x| (f32::from(x) + noise()).round().clamp(0.0, 255.0) as u8).collect();
    RgbPicture { data, ..*rgb }
}
