//! Training clips from procedural drives: pictures, poses and ground truth in the window's anchor frame.

use std::borrow::Borrow;

use candle_core::{Device, Tensor};
use glam::{Affine3A, DAffine3, DMat3, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};
use storm_render::Intrinsics;
use storm_render::world::{Drive, DriveOptions, WorldFrame};

use super::error::TrainError;
use super::looks::{LookOptions, PoseErrors, RigLook, Shutter, rig};
use super::truth::{SkySamples, Truth};
use crate::clip::{ClipBatch, PixelLayout, ViewInput};
use crate::config::ModelConfig;
use crate::error::ModelError;

/// Drives that are never trained on: error figures are reported on them.
pub const HELD_OUT_SEEDS: std::ops::Range<u64> = 10_000..20_000;

/// Frame rate of the moments pictures are taken at, Hz.
const RATE_HZ: f64 = 10.0;

/// What clips look like.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClipOptions {
    /// Cameras, 1-6.
    pub cameras: usize,
    /// Picture width, pixels.
    pub width: usize,
    /// Picture height, pixels.
    pub height: usize,
    /// Context timesteps.
    pub timesteps: usize,
    /// Between context timesteps, seconds.
    pub stride_sec: f64,
    /// Target times are drawn from this long after the first timestep, seconds; also the network's timespan.
    pub span_sec: f64,
    /// Target times; 0 makes context pictures only.
    pub targets: usize,
    /// Length of the drive a clip is cut from, seconds.
    pub drive_sec: f64,
    /// Least and most traffic (1 is the usual).
    pub traffic: [f64; 2],
    /// Whether lenses vary from clip to clip, and the number of cameras (up to `cameras`) from block to block of batches.
    pub variety: bool,
    /// Strides the anchor may lie before the first timestep, where the clock then begins too: windows that go on in the frame
    /// of an earlier one (`Storm::forward_reusing`) look so. 0: at the first timestep, the paper's.
    pub anchor_lead: u32,
    /// How long before each timestep a prior image is taken for a velocity sweep, seconds; 0: none.
    pub prior_sec: f64,
    /// Share of the blocks of training batches that have no prior images all the same, so that the network does without.
    pub prior_dropout: f64,
    /// What of the look of training clips varies; validation clips are plain.
    pub looks: LookOptions,
}

/// Share of the clips whose anchor is at the first timestep all the same.
const NO_LEAD_SHARE: f64 = 0.5;

/// Share of the clips that keep the drive's own lenses where lenses vary.
const OWN_LENS_SHARE: f64 = 0.5;

/// Least and most focal length over the drive's own, across and down: 50 degrees become 32 to 92.
const ZOOM: [[f64; 2]; 2] = [[0.45, 1.6], [0.6, 1.6]];

impl Default for ClipOptions {
    fn default() -> Self {
        Self {
            cameras: 3,
            width: 96,
            height: 64,
            timesteps: 4,
            stride_sec: 0.5,
            span_sec: 2.0,
            targets: 4,
            drive_sec: 12.0,
            traffic: [0.75, 2.5],
            variety: false,
            anchor_lead: 0,
            prior_sec: 0.0,
            prior_dropout: 0.2,
            looks: LookOptions::default(),
        }
    }
}

impl ClipOptions {
    /// Camera the anchor sits at: the front one of the drive's rig.
    pub fn reference(&self) -> usize {
        usize::from(self.cameras >= 3)
    }

    fn check(&self) -> Result<(), TrainError> {
        let rule = |ok: bool, name, value: f64, allowed| {
            if ok { Ok(()) } else { Err(TrainError::Option { name, value: value.to_string(), allowed }) }
        };
        rule(self.stride_sec > 0.0, "stride_sec", self.stride_sec, "more than 0")?;
        rule(self.span_sec > 0.0, "span_sec", self.span_sec, "more than 0")?;
        rule((1..=10).contains(&self.timesteps), "timesteps", self.timesteps as f64, "1 to 10")?;
        rule(self.targets <= 10, "targets", self.targets as f64, "0 to 10")?;
        let needed = self.length_sec();
        rule((0.0..1.0).contains(&self.prior_sec), "prior_sec", self.prior_sec, "0 (none) to below 1")?;
        let share = self.prior_dropout;
        rule((0.0..=1.0).contains(&share), "prior_dropout", share, "0 to 1")?;
        rule(self.drive_sec >= needed, "drive_sec", self.drive_sec, "at least the clip's length")?;
        let [low, high] = self.traffic;
        rule(low >= 0.0 && high >= low, "traffic", low, "a range from 0 to 3")
    }

    fn length_sec(&self) -> f64 {
        self.span_sec.max(self.stride_sec * (self.timesteps.max(1) - 1) as f64)
    }
}

/// One clip (or a batch of them) with everything the losses need.
#[derive(Debug, Clone)]
pub struct TrainClip {
    /// What the network sees.
    pub context: ClipBatch,
    /// What is true in it.
    pub context_truth: Truth,
    /// Directions into the context's skies and their colours.
    pub sky: SkySamples,
    /// Pictures at the target times, and what is true in them.
    pub target: Option<(ClipBatch, Truth)>,
}

/// Which drive, when in it, and how much traffic: everything random about a clip.
#[derive(Debug, Clone, PartialEq)]
pub struct ClipPlan {
    /// Seed of the drive.
    pub drive_seed: u64,
    /// The clip's first moment in the drive, seconds.
    pub start_sec: f64,
    /// Target times, seconds since `start_sec`, ascending.
    pub target_sec: Vec<f64>,
    /// Density of traffic.
    pub traffic: f64,
    /// Factors on the focal lengths.
    pub zoom: [f32; 2],
    /// How long before each timestep a prior image is taken, seconds; 0: none.
    pub prior_sec: f64,
    /// How long before `start_sec` the anchor was where it is, and the clock began, seconds.
    pub lead_sec: f64,
    /// What of the look varies; how follows from `drive_seed`.
    pub looks: LookOptions,
}

/// Noise of a drive's own cameras whose images go through other ones, counts: enough to hide the steps between counts.
const DITHER: f32 = 0.5;

impl ClipPlan {
    /// Sample `index` of the training data of `seed`; never a held-out drive.
    pub fn training(seed: u64, index: u64, options: &ClipOptions) -> Self {
        // Seeds of neighbouring samples must not be neighbours: multiply by an odd constant (golden ratio, Weyl's sequence).
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ (index + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let drive_seed = rng.random_range(HELD_OUT_SEEDS.end..u64::MAX);
        let [low, high] = options.traffic;
        let traffic = low + (high - low) * rng.random::<f64>();
        let mut plan = Self::draw(drive_seed, traffic, &mut rng, options);
        if options.variety && rng.random::<f64>() >= OWN_LENS_SHARE {
            plan.zoom = ZOOM.map(|[low, high]| (low * (high / low).powf(rng.random::<f64>())) as f32);
        }
        // No earlier than the drive begins.
        let most = f64::from(options.anchor_lead).min((plan.start_sec / options.stride_sec).floor()) as u32;
        if most > 0 && rng.random::<f64>() >= NO_LEAD_SHARE {
            plan.lead_sec = f64::from(rng.random_range(1..=most)) * options.stride_sec;
        }
        plan.looks = options.looks;
        if plan.looks.rigs {
            plan.zoom = rig::zoom(plan.drive_seed, options.width, options.height);
        }
        plan
    }

    /// A clip of a given drive, for validation: usual traffic, moments drawn from the drive's seed.
    pub fn of_drive(drive_seed: u64, options: &ClipOptions) -> Self {
        Self::draw(drive_seed, 1.0, &mut ChaCha8Rng::seed_from_u64(drive_seed), options)
    }

    fn draw(drive_seed: u64, traffic: f64, rng: &mut ChaCha8Rng, options: &ClipOptions) -> Self {
        let room = (options.drive_sec - options.length_sec()).max(0.0);
        let start_sec = room * rng.random::<f64>();
        let frames = (options.span_sec * RATE_HZ).floor().max(1.0) as u64;
        let mut target_sec: Vec<f64> =
            (0..options.targets).map(|_| rng.random_range(0..frames) as f64 / RATE_HZ).collect();
        target_sec.sort_by(f64::total_cmp);
        // There is nothing before the drive.
        let start_sec = f64::max(start_sec, options.prior_sec);
        Self {
            drive_seed,
            start_sec,
            target_sec,
            traffic,
            zoom: [1.0; 2],
            prior_sec: options.prior_sec,
            lead_sec: 0.0,
            looks: LookOptions::default(),
        }
    }

    /// Drives it. `config` says what the network's depth measures and where its rays pass.
    pub fn make(&self, options: &ClipOptions, config: &ModelConfig) -> Result<TrainClip, TrainError> {
        options.check()?;
        let rig = if self.looks.sensor { RigLook::draw(self.drive_seed, options.cameras) } else { None };
        let usual = DriveOptions::default();
        let drive = Drive::new(&DriveOptions {
            seed: self.drive_seed,
            seconds: options.drive_sec,
            cameras: options.cameras,
            width: options.width,
            height: options.height,
            rate_hz: RATE_HZ,
            traffic: self.traffic,
            zoom: self.zoom,
            looks: self.looks.drive(),
            noise: if rig.is_some() { DITHER } else { usual.noise },
            ..usual
        })?;
        let anchor_from_map = inverse(
            &(map_from_camera(&drive, options.reference(), self.start_sec - self.lead_sec) * camera_from_flu()),
        );
        let context_sec: Vec<f64> = (0..options.timesteps).map(|k| k as f64 * options.stride_sec).collect();
        let errors = if self.looks.poses { PoseErrors::draw(self.drive_seed) } else { None };
        // What is asked for is drawn where it truly is; what is given is not known that well.
        let shots =
            |times: &[f64], errors| self.shots(&drive, Seen { rig: rig.as_ref(), errors }, times, &anchor_from_map);
        let context = shots(&context_sec, errors)?;
        let target = if self.target_sec.is_empty() { None } else { Some(shots(&self.target_sec, None)?) };
        let batch = |shots: &[Vec<Shot>]| -> Result<(ClipBatch, Truth), TrainError> {
            let clip = Shot::clip(shots, options.span_sec)?;
            Ok((clip, Truth::of(shots, &anchor_from_map.matrix3, config)?))
        };
        let (mut clip, context_truth) = batch(&context)?;
        if self.prior_sec > 0.0 {
            let times: Vec<f64> = context_sec.iter().map(|t| t - self.prior_sec).collect();
            clip.prior = Some(Box::new(Shot::clip(&shots(&times, errors)?, options.span_sec)?));
        }
        Ok(TrainClip {
            context: clip,
            context_truth,
            sky: SkySamples::of(&context, config)?,
            target: target.as_deref().map(batch).transpose()?,
        })
    }

    /// Images at `times` after the clip's start, `[time][camera]`.
    fn shots(
        &self,
        drive: &Drive,
        seen: Seen<'_>,
        times: &[f64],
        anchor_from_map: &DAffine3,
    ) -> Result<Vec<Vec<Shot>>, TrainError> {
        let shot = |camera: usize, time_sec: f64| {
            let at = self.start_sec + time_sec;
            let opens = map_from_camera(drive, camera, at);
            let intrinsics = drive.cameras()[camera].intrinsics;
            let mut frame = drive.render(camera, at);
            if let Some(rig) = seen.rig {
                let open_sec = rig.open_sec();
                let closes = map_from_camera(drive, camera, at + open_sec);
                let shutter = Shutter { intrinsics, opens, closes, open_sec };
                rig.take(&mut frame, camera, at, (open_sec > 0.0).then_some(&shutter))?;
            }
            let given = match seen.errors {
                Some(errors) => map_from_camera(drive, camera, at + errors.late_sec(camera)) * errors.at(camera, at),
                None => opens,
            };
            Ok(Shot {
                frame,
                intrinsics,
                anchor_from_camera: affine32(&(*anchor_from_map * given)),
                time_sec: (self.lead_sec + time_sec) as f32,
                valid: None,
            })
        };
        times.iter().map(|&t| (0..drive.cameras().len()).map(|c| shot(c, t)).collect()).collect()
    }
}

/// How images are taken and poses are known.
#[derive(Clone, Copy)]
struct Seen<'a> {
    rig: Option<&'a RigLook>,
    errors: Option<PoseErrors>,
}

/// One picture of a drive and where it was taken in the anchor frame.
pub(super) struct Shot {
    pub frame: WorldFrame,
    pub intrinsics: Intrinsics,
    pub anchor_from_camera: Affine3A,
    pub time_sec: f32,
    /// Pixels the camera saw; none: all.
    pub valid: Option<Vec<bool>>,
}

impl Shot {
    /// Colours in the network range.
    pub fn colors(&self) -> Vec<f32> {
        self.frame.rgb.iter().map(|&x| f32::from(x) / 127.5 - 1.0).collect()
    }

    pub(super) fn clip(shots: &[Vec<Self>], timespan_sec: f64) -> Result<ClipBatch, ModelError> {
        let pictures: Vec<Vec<Vec<f32>>> = shots.iter().map(|row| row.iter().map(Self::colors).collect()).collect();
        let views: Vec<Vec<ViewInput<'_>>> = shots
            .iter()
            .zip(&pictures)
            .map(|(row, pictures)| {
                row.iter()
                    .zip(pictures)
                    .map(|(shot, rgb)| ViewInput {
                        rgb,
                        intrinsics: shot.intrinsics,
                        world_from_camera: shot.anchor_from_camera,
                        time_sec: shot.time_sec,
                        valid: shot.valid.as_deref(),
                    })
                    .collect()
            })
            .collect();
        ClipBatch::from_views(&views, PixelLayout::Hwc, timespan_sec, &Device::Cpu)
    }
}

impl TrainClip {
    /// Several clips of the same sizes as one batch.
    pub fn stack<C: Borrow<Self>>(clips: &[C]) -> Result<Self, TrainError> {
        let clips: Vec<&Self> = clips.iter().map(Borrow::borrow).collect();
        let all = |pick: fn(&Self) -> ClipBatch| ClipBatch::stack(&clips.iter().map(|c| pick(c)).collect::<Vec<_>>());
        let targets: Vec<&(ClipBatch, Truth)> = clips.iter().filter_map(|c| c.target.as_ref()).collect();
        let target = if targets.is_empty() {
            None
        } else {
            let batch = ClipBatch::stack(&targets.iter().map(|t| t.0.clone()).collect::<Vec<_>>())?;
            Some((batch, Truth::stack(targets.iter().map(|t| &t.1))?))
        };
        Ok(Self {
            context: all(|c| c.context.clone())?,
            context_truth: Truth::stack(clips.iter().map(|c| &c.context_truth))?,
            sky: SkySamples::stack(clips.iter().map(|c| &c.sky))?,
            target,
        })
    }

    /// The same on another device.
    pub fn to_device(&self, device: &Device) -> candle_core::Result<Self> {
        self.map(&|x| x.to_device(device))
    }

    /// Each clip of the batch alone.
    pub(super) fn apart(&self) -> candle_core::Result<Vec<Self>> {
        let clips = self.context.image.dim(0)?;
        (0..clips).map(|at| self.map(&|x| x.narrow(0, at, 1)?.contiguous())).collect()
    }

    fn map(&self, to: &impl Fn(&Tensor) -> candle_core::Result<Tensor>) -> candle_core::Result<Self> {
        Ok(Self {
            context: map_clip(&self.context, to)?,
            context_truth: self.context_truth.map(to)?,
            sky: self.sky.map(to)?,
            target: match &self.target {
                Some((clip, truth)) => Some((map_clip(clip, to)?, truth.map(to)?)),
                None => None,
            },
        })
    }
}

fn map_clip(clip: &ClipBatch, to: &impl Fn(&Tensor) -> candle_core::Result<Tensor>) -> candle_core::Result<ClipBatch> {
    Ok(ClipBatch {
        image: to(&clip.image)?,
        intrinsics: to(&clip.intrinsics)?,
        world_from_camera: to(&clip.world_from_camera)?,
        time_sec: to(&clip.time_sec)?,
        valid: clip.valid.as_ref().map(to).transpose()?,
        timespan_sec: clip.timespan_sec,
        prior: match &clip.prior {
            Some(prior) => Some(Box::new(map_clip(prior, to)?)),
            None => None,
        },
    })
}

fn map_from_camera(drive: &Drive, camera: usize, time_sec: f64) -> DAffine3 {
    drive.map_from_base(time_sec) * drive.cameras()[camera].base_from_camera
}

/// From x forward, y left, z up to the optical axes x right, y down, z forward.
fn camera_from_flu() -> DAffine3 {
    DAffine3::from_mat3(DMat3::from_cols(DVec3::Z, DVec3::NEG_X, DVec3::NEG_Y))
}

fn inverse(t: &DAffine3) -> DAffine3 {
    let r = t.matrix3.transpose();
    DAffine3 { matrix3: r, translation: -(r * t.translation) }
}

fn affine32(t: &DAffine3) -> Affine3A {
    Affine3A::from_mat3_translation(t.matrix3.as_mat3(), t.translation.as_vec3())
}
