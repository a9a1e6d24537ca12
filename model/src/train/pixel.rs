//! The cheap first stage: every Gaussian against the truth of the pixel it came from, nothing drawn.

use candle_core::{D, Tensor};
use serde::{Deserialize, Serialize};

use super::bases::bases_loss;
use super::clips::TrainClip;
use super::groups::group_loss;
use super::losses::{Terms, channel_last, color_loss_where, depth_loss, masked_mean, velocity_loss};
use crate::config::VelocityKind;
use crate::error::ModelError;
use crate::network::ClipOutput;

/// Keeps logarithms and roots of opacities and errors finite.
const EPS: f64 = 1e-4;

/// Weights of the terms; a term of weight 0 is left out.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PixelLossOptions {
    /// Mean absolute error of the logarithm of depth.
    pub log_depth: f64,
    /// Mean absolute error of the logarithm of the depths that a velocity sweep is made at; nothing without a sweep.
    pub swept_depth: f64,
    /// The paper's depth term.
    pub depth: f64,
    /// Mean squared colour error after the exposure.
    pub color: f64,
    /// Cross-entropy of opacity: 1 on surfaces, 0 in the sky.
    pub opacity: f64,
    /// Mean absolute error of the logarithm of the scales to the pixel's footprint.
    pub scale: f64,
    /// Standard deviation a Gaussian should have, pixels of its picture: neighbours then overlap without gaps or blur.
    pub footprint_px: f64,
    /// Mean squared sky colour error on sky pixels.
    pub sky_color: f64,
    /// Mean squared velocity component (paper: 0.005).
    pub velocity: f64,
    /// Mean velocity error against ground-truth flow; 0 trains without flow labels.
    pub flow: f64,
    /// Cross-entropy of the motion weights against the tokens whose velocity is the true one; left out with `flow`.
    pub groups: f64,
    /// Mean absolute difference, m/s, between the scene's motions and the velocity bases nearest to them; left out with `flow`.
    pub bases: f64,
    /// How much more a moving pixel weighs than a standing one in the flow terms.
    pub moving_weight: f64,
}

impl Default for PixelLossOptions {
    fn default() -> Self {
        Self {
            log_depth: 1.0,
            swept_depth: 0.2,
            depth: 1.0,
            color: 1.0,
            opacity: 0.1,
            scale: 0.1,
            footprint_px: 0.6,
            sky_color: 1.0,
            velocity: 0.005,
            flow: 0.1,
            groups: 0.05,
            bases: 0.0,
            moving_weight: 10.0,
        }
    }
}

/// All terms of a batch. Only the clip's context is used.
pub fn pixel_losses(output: &ClipOutput, clip: &TrainClip, options: &PixelLossOptions) -> Result<Terms, ModelError> {
    let truth = &clip.context_truth;
    let surface = truth.sky.affine(-1.0, 1.0)?;
    let mut terms = Terms::default();
    let mut add = |name: &'static str, weight: f64, value: Option<Tensor>| -> Result<(), ModelError> {
        if let Some(value) = value {
            terms.push(name, (value * weight)?);
        }
        Ok(())
    };
    let measured = truth.measured()?;
    if options.log_depth > 0.0 {
        // Where there is no depth, the one put there only keeps the logarithm finite.
        let known = (&truth.distance + measured.affine(-1.0, 1.0)?)?;
        let error = (output.depths.log()? - known.log()?)?.abs()?;
        add("log_depth", options.log_depth, masked_mean(&error, &measured)?)?;
    }
    if options.swept_depth > 0.0
        && let Some(swept) = &output.swept_depths
    {
        let (known, share) = log_depth_of_cells(&truth.distance, &measured, swept.dims())?;
        let error = (swept.log()? - known)?.abs()?;
        add("swept_depth", options.swept_depth, masked_mean(&error, &share)?)?;
    }
    if options.depth > 0.0 {
        add("pixel_depth", options.depth, depth_loss(&output.depths, &truth.distance)?)?;
    }
    if options.color > 0.0 {
        let exposed = exposed(output, &output.colors)?;
        let seen = channel_last(&clip.context.image)?;
        add("color", options.color, Some(color_loss_where(&exposed, &seen, clip.context.valid.as_ref())?))?;
    }
    if options.opacity > 0.0 {
        // The probability given to what is there.
        let right = ((&output.opacities * surface.affine(2.0, -1.0)?)? + &truth.sky)?;
        let surprise = right.affine(1.0 - EPS, EPS)?.log()?.neg()?;
        add("opacity", options.opacity, masked_mean(&surprise, &truth.sky_known)?)?;
    }
    if options.scale > 0.0 {
        let wanted =
            footprint(clip, &measured, options.footprint_px, output.config.max_scale)?.log()?.unsqueeze(D::Minus1)?;
        let error = output.scales.log()?.broadcast_sub(&wanted)?.abs()?.mean(D::Minus1)?;
        add("scale", options.scale, masked_mean(&error, &measured)?)?;
    }
    if options.sky_color > 0.0 {
        add("sky_color", options.sky_color, sky_color_loss(output, clip)?)?;
    }
    let velocities = velocities(output);
    if options.velocity > 0.0 {
        add("velocity", 1.0, Some(velocity_loss(&velocities, options.velocity)?))?;
    }
    if options.flow > 0.0 {
        let labelled = (&surface * &truth.flow_known)?;
        let weights = (&labelled * truth.moving.affine(options.moving_weight - 1.0, 1.0)?)?;
        let share = options.flow / velocities.len() as f64;
        let mut sum: Option<Tensor> = None;
        for v in velocities {
            let error = ((v - &truth.flow)?.sqr()?.sum(D::Minus1)? + EPS * EPS)?.sqrt()?;
            sum = match (sum, masked_mean(&error, &weights)?) {
                (Some(a), Some(b)) => Some((a + b)?),
                (a, b) => a.or(b),
            };
        }
        add("flow", share, sum)?;
        if options.bases > 0.0 {
            add("bases", options.bases, bases_loss(output, &truth.flow, &(&labelled * &truth.moving)?)?)?;
        }
        if options.groups > 0.0 {
            add("groups", options.groups, group_loss(output, &truth.flow, &weights)?)?;
        }
    }
    Ok(terms)
}

/// The velocities of a network, each once.
pub(super) fn velocities(output: &ClipOutput) -> Vec<&Tensor> {
    match output.config.velocity {
        VelocityKind::One => vec![&output.velocity_forward],
        VelocityKind::ForwardBackward => vec![&output.velocity_backward, &output.velocity_forward],
    }
}

/// Colours `(b, t, v, h, w, 3)` after their camera's exposure.
pub(super) fn exposed(output: &ClipOutput, colors: &Tensor) -> Result<Tensor, ModelError> {
    let &[b, t, v, h, w, _] = colors.dims() else {
        return Err(ModelError::Input(format!("colours have shape {:?}", colors.dims())));
    };
    if output.affine.is_none() {
        return Ok(colors.clone());
    }
    let by_camera = colors.transpose(1, 2)?.contiguous()?.reshape((b, v, t * h * w, 3))?;
    let exposed = output.apply_affine(&by_camera)?.reshape((b, v, t, h, w, 3))?;
    Ok(exposed.transpose(1, 2)?.contiguous()?)
}

/// Means of the logarithm of known distances over cells, and the share of a cell's pixels that are known, both of shape `cells`.
fn log_depth_of_cells(distance: &Tensor, known: &Tensor, cells: &[usize]) -> Result<(Tensor, Tensor), ModelError> {
    let (&[b, t, v, h, w], &[_, _, _, rows, cols]) = (distance.dims(), cells) else {
        return Err(ModelError::Input(format!("depths of shape {:?} for cells {cells:?}", distance.dims())));
    };
    let mean = |x: Tensor| -> candle_core::Result<Tensor> {
        let x = x.reshape(vec![b * t * v * rows, h / rows, cols, w / cols])?;
        x.mean(3)?.mean(1)?.reshape(cells)
    };
    let share = mean(known.clone())?;
    let logs = (distance + known.affine(-1.0, 1.0)?)?.log()?;
    let sum = mean((logs * known)?)?;
    Ok(((sum / share.maximum(EPS)?)?, share))
}

/// `(b, t, v, h, w)`: `footprint_px` pixels at the true z-depth, metres, at most `max_scale`; 1 where it is unknown.
fn footprint(clip: &TrainClip, measured: &Tensor, footprint_px: f64, max_scale: f64) -> Result<Tensor, ModelError> {
    let truth = &clip.context_truth;
    let focal = |i: usize| clip.context.intrinsics.narrow(3, i, 1)?.narrow(4, i, 1);
    let focal = ((focal(0)? + focal(1)?)? * 0.5)?;
    let metres = (truth.depth.broadcast_div(&focal)? * footprint_px)?.minimum(max_scale)?;
    Ok((metres * measured)?.add(&measured.affine(-1.0, 1.0)?)?)
}

fn sky_color_loss(output: &ClipOutput, clip: &TrainClip) -> Result<Option<Tensor>, ModelError> {
    let sky = &clip.sky;
    let (b, v, n, _) = sky.directions.dims4()?;
    let Some(colors) = output.sky_color(&sky.directions.reshape((b, v * n, 3))?)? else { return Ok(None) };
    let colors = output.apply_affine(&colors.reshape((b, v, n, 3))?)?;
    let error = ((colors - &sky.colors)? * 0.5)?.sqr()?.mean_keepdim(D::Minus1)?;
    Ok(masked_mean(&error, &sky.weights)?)
}
