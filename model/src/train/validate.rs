//! Error figures of a network on drives it was never trained on, cheap enough to ask for during training.

use candle_core::{Device, Tensor};
use serde::Serialize;
use storm_render::raster::CpuRasterizer;

use super::clips::{ClipOptions, ClipPlan, TrainClip};
use super::error::TrainError;
use super::held_pictures::add_psnr;
use crate::config::ModelConfig;
use crate::error::ModelError;
use crate::metrics::flow::flow_scores;
use crate::metrics::{Mean, MetricError};
use crate::network::Storm;

/// Drives for validation: held out, and none of those that final figures are reported on (which start at 10,000).
pub const VALIDATION_SEEDS: std::ops::Range<u64> = 19_000..20_000;

/// Means over the validation clips. Depth and flow are those of the Gaussians at their own pixels, surfaces only.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
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
    psnr: Mean,
    surface: Mean,
    sky: Mean,
}

impl Means {
    fn result(&self) -> Validation {
        Validation {
            depth_relative: self.relative.value(),
            depth_rmse: self.squared.value().map(f64::sqrt),
            epe3d: self.all.value(),
            epe3d_moving: self.moving.value(),
            epe3d_moving_still: self.still.value(),
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
    let flow: Vec<[f32; 3]> = numbers(&truth.flow)?.chunks_exact(3).map(|v| [v[0], v[1], v[2]]).collect();
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
    debug_assert_eq!(scene.config.embed_dim, config.embed_dim);
    match &clip.target {
        Some((target, _)) => add_psnr(&scene, target, raster, &mut means.psnr),
        None => Ok(()),
    }
}
