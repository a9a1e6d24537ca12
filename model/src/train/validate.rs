//! Error figures of a network on drives it was never trained on, cheap enough to ask for during training.

use candle_core::{Device, Tensor};
use serde::Serialize;
use storm_render::raster::CpuRasterizer;

use super::clips::{ClipOptions, ClipPlan, TrainClip};
use super::error::TrainError;
use super::held_pictures::add_psnr;
use crate::config::ModelConfig;
use crate::error::ModelError;
use crate::metrics::bases::BaseSpread;
use crate::metrics::flow::{AV2_DYNAMIC_MPS, Flow, flow_scores, norm, three_way_epe};
use crate::metrics::mask::iou;
use crate::metrics::movers::{MISSED_BELOW_MPS, MoverErrors};
use crate::metrics::{Mean, MetricError};
use crate::network::Storm;

/// Drives for validation: held out, and none of those that final figures are reported on (which start at 10,000).
pub const VALIDATION_SEEDS: std::ops::Range<u64> = 19_000..20_000;

/// Means over the validation clips. Depth and flow are those of the Gaussians at their own pixels, surfaces only.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Validation {
    /// Mean absolute depth error over the true depth.
    pub depth_relative: Option<f64>,
    /// Root mean squared depth error, metres.
    pub depth_rmse: Option<f64>,
    /// Mean velocity error, m/s.
    pub epe3d: Option<f64>,
    /// Mean velocity error of moving pixels, m/s.
    pub epe3d_moving: Option<f64>,
    /// Mean speed of moving pixels: their error if everything were taken as still, m/s.
    pub epe3d_moving_still: Option<f64>,
    /// Mean velocity error of road users at 0.5 m/s or faster, m/s.
    pub epe3d_foreground_dynamic: Option<f64>,
    /// Mean velocity error of other road users, m/s.
    pub epe3d_foreground_static: Option<f64>,
    /// Mean velocity error of the surroundings, m/s.
    pub epe3d_background_static: Option<f64>,
    /// Share of moving road users' pixels that are missed (below 1 m/s, in truth above 2), 0-1; over all pixels alike.
    pub missed_share: Option<f64>,
    /// Mean absolute error of moving road users' speed, m/s.
    pub speed_error: Option<f64>,
    /// Mean angle between true and predicted direction of moving road users seen to move, radians.
    pub direction_error: Option<f64>,
    /// Intersection over union of moving pixels (1 m/s and faster), 0-1.
    pub moving_iou: Option<f64>,
    /// Largest distance of a velocity base from the fan it started from, m/s.
    pub bases_from_fan: Option<f64>,
    /// How much velocity bases differ between clips, m/s.
    pub bases_between_clips: Option<f64>,
    /// Peak signal-to-noise ratio of rendered pictures at held-out times, dB.
    pub psnr: Option<f64>,
    /// Opacity where there is a surface, 0-1.
    pub opacity_surface: Option<f64>,
    /// Opacity where there is sky, 0-1.
    pub opacity_sky: Option<f64>,
}

/// Scores a network on one clip of each of `drives` validation drives. Weights must not be variables (inference kernels).
pub fn validate(model: &Storm, options: &ClipOptions, drives: u64, device: &Device) -> Result<Validation, TrainError> {
    let config = model.config();
    let mut raster = CpuRasterizer::new(config.raster_settings()).map_err(|e| ModelError::Render(e.to_string()))?;
    let mut means = Means::default();
    let last = VALIDATION_SEEDS.end.min(VALIDATION_SEEDS.start.saturating_add(drives));
    for seed in VALIDATION_SEEDS.start..last {
        let plan = ClipPlan::of_drive(seed, options);
        let clip = plan.make(options, config)?;
        score(model, config, &clip, &mut raster, device, &mut means)?;
    }
    Ok(means.result())
}

#[derive(Default)]
struct Means {
    relative: Mean,
    squared: Mean,
    all: Mean,
    moving: Mean,
    still: Mean,
    /// Moving road users, standing ones, surroundings.
    three_way: [Mean; 3],
    movers: MoverErrors,
    moving_iou: Mean,
    bases: BaseSpread,
    psnr: Mean,
    surface: Mean,
    sky: Mean,
}

impl Means {
    fn result(&self) -> Validation {
        let (movers, bases) = (self.movers.figures(), self.bases.figures());
        let [dynamic, still, background] = self.three_way.map(|kind| kind.value());
        Validation {
            depth_relative: self.relative.value(),
            depth_rmse: self.squared.value().map(f64::sqrt),
            epe3d: self.all.value(),
            epe3d_moving: self.moving.value(),
            epe3d_moving_still: self.still.value(),
            epe3d_foreground_dynamic: dynamic,
            epe3d_foreground_static: still,
            epe3d_background_static: background,
            missed_share: movers.missed_share,
            speed_error: movers.speed_error,
            direction_error: movers.direction_error,
            moving_iou: self.moving_iou.value(),
            bases_from_fan: bases.from_fan,
            bases_between_clips: bases.between_clips,
            psnr: self.psnr.value(),
            opacity_surface: self.surface.value(),
            opacity_sky: self.sky.value(),
        }
    }
}

fn numbers(x: &Tensor) -> Result<Vec<f32>, TrainError> {
    Ok(x.flatten_all()?.to_vec1::<f32>()?)
}

fn metric(e: MetricError) -> TrainError {
    ModelError::Input(e.to_string()).into()
}

fn score(
    model: &Storm,
    config: &ModelConfig,
    clip: &TrainClip,
    raster: &mut CpuRasterizer,
    device: &Device,
    means: &mut Means,
) -> Result<(), TrainError> {
    let moved = clip.to_device(device)?;
    let scene = model.forward(&moved.context)?.scene(0)?;
    let truth = &clip.context_truth;
    let (distance, sky, moving) = (numbers(&truth.distance)?, numbers(&truth.sky)?, numbers(&truth.moving)?);
    let user: Vec<bool> = numbers(&truth.user)?.iter().map(|&u| u == 1.0).collect();
    let flow: Vec<Flow> = numbers(&truth.flow)?.chunks_exact(3).map(|v| [v[0], v[1], v[2]]).collect();
    let mut depth = [0f64; 3];
    for (i, (&want, &got)) in distance.iter().zip(&scene.depths).enumerate() {
        let surface = sky[i] == 0.0;
        let opacity = Some(f64::from(scene.gaussians.opacities[i]));
        if surface {
            means.surface.add(opacity)
        } else {
            means.sky.add(opacity)
        }
        if surface && want > 0.0 {
            let error = f64::from(got) - f64::from(want);
            depth = [depth[0] + error.abs() / f64::from(want), depth[1] + error * error, depth[2] + 1.0];
        }
    }
    means.relative.add((depth[2] > 0.0).then(|| depth[0] / depth[2]));
    means.squared.add((depth[2] > 0.0).then(|| depth[1] / depth[2]));
    let surface: Vec<bool> = sky.iter().map(|&s| s == 0.0).collect();
    let movers: Vec<bool> = moving.iter().map(|&m| m == 1.0).collect();
    let epe = |pred: &[[f32; 3]], mask: &[bool]| {
        flow_scores(pred, &flow, Some(mask)).map(|s| s.map(|s| s.epe3d)).map_err(metric)
    };
    means.all.add(epe(&scene.gaussians.velocity_forward, &surface)?);
    means.moving.add(epe(&scene.gaussians.velocity_forward, &movers)?);
    means.still.add(epe(&vec![[0.0; 3]; flow.len()], &movers)?);
    users(&scene.gaussians.velocity_forward, &flow, &user, &surface, means).map_err(metric)?;
    let seen: Vec<bool> = scene.gaussians.velocity_forward.iter().map(|&v| speed(v) >= MISSED_BELOW_MPS).collect();
    means.moving_iou.add(iou(&seen, &movers, Some(&surface)).map_err(metric)?);
    means.bases.add(&scene.motion_bases, config);
    debug_assert_eq!(scene.config.embed_dim, config.embed_dim);
    match &clip.target {
        Some((target, _)) => add_psnr(&scene, target, raster, &mut means.psnr),
        None => Ok(()),
    }
}

fn speed(v: Flow) -> f64 {
    norm(v.map(f64::from))
}

/// Errors of road users and surroundings apart, and what is wrong with those that move.
fn users(pred: &[Flow], flow: &[Flow], user: &[bool], surface: &[bool], means: &mut Means) -> Result<(), MetricError> {
    let kinds = three_way_epe(pred, flow, user, Some(surface), AV2_DYNAMIC_MPS)?;
    let values = [kinds.foreground_dynamic, kinds.foreground_static, kinds.background_static];
    means.three_way.iter_mut().zip(values).for_each(|(mean, value)| mean.add(value));
    let moving = |i: &usize| user[*i] && surface[*i] && speed(flow[*i]) >= AV2_DYNAMIC_MPS;
    (0..flow.len()).filter(moving).try_for_each(|i| means.movers.add(i, pred[i], flow[i]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn road_users_and_surroundings_are_counted_apart() {
        let still = [0.0; 3];
        let flow = [[5.0, 0.0, 0.0], [4.0, 0.0, 0.0], still, still, [9.0, 0.0, 0.0]];
        let pred = [[5.0, 1.0, 0.0], still, [0.0, 0.5, 0.0], [0.25, 0.0, 0.0], still];
        let (user, surface) = ([true, true, true, false, true], [true, true, true, true, false]);
        let mut means = Means::default();
        users(&pred, &flow, &user, &surface, &mut means).unwrap();
        let v = means.result();
        assert_eq!(v.epe3d_foreground_dynamic, Some(2.5));
        assert_eq!((v.epe3d_foreground_static, v.epe3d_background_static), (Some(0.5), Some(0.25)));
        // What is no surface does not count.
        assert_eq!(v.missed_share, Some(0.5));
        assert!((v.direction_error.unwrap() - (0.2f64).atan()).abs() < 1e-7, "{v:?}");
    }
}
