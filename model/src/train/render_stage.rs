//! The paper's stage: Gaussians moved to the target times, drawn, put before the sky, exposed, and compared.

use candle_core::{D, Tensor};
use storm_render::View;

use super::clips::TrainClip;
use super::losses::{RenderLossOptions, Rendered, Target, Terms, channel_last, masked_mean, or_truth, render_losses};
use super::lpips::FeatureNetwork;
use super::pixel::velocities;
use super::raster::{DRAWN, SharedRenderer, draw};
use super::truth::Truth;
use super::views::views;
use crate::clip::ClipBatch;
use crate::config::{DepthMeaning, ModelConfig, VelocityKind};
use crate::error::ModelError;
use crate::network::ClipOutput;
use crate::rays::Rays;
use crate::scene::fade_weights;

/// All terms of a batch whose clips have target pictures. With `features`, they take the structure term's place, with its
/// weight and from its step on.
pub fn render_stage_losses(
    output: &ClipOutput,
    clip: &TrainClip,
    renderer: &SharedRenderer,
    options: &RenderLossOptions,
    features: Option<&FeatureNetwork>,
    step: u64,
) -> Result<Terms, ModelError> {
    let Some((target, truth)) = &clip.target else {
        return Err(ModelError::Input("the clips have no target pictures".into()));
    };
    let Truth { depth, sky, sky_known, .. } = truth;
    let rendered = draw_targets(output, target, renderer)?;
    let depth = (options.depth > 0.0).then(|| depth.clone());
    let labelled = truth.sky_labelled()?;
    let whole = labelled == 1.0;
    let target =
        Target { image: target.image.clone(), depth, sky: whole.then(|| sky.clone()), valid: target.valid.clone() };
    // The stand-in makes way for a feature network.
    let structure = if features.is_some() { 0.0 } else { options.structure };
    let stood_in = RenderLossOptions { structure, ..*options };
    let mut terms = render_losses(&rendered, &target, &velocities(output), &stood_in, step)?;
    if let Some(features) = features
        && options.structure > 0.0
        && step >= options.structure_from_step
    {
        let seen = channel_last(&target.image)?;
        let distance = features.distance(&or_truth(&rendered.image, &seen, target.valid.as_ref())?, &seen)?;
        terms.push("lpips", (distance * options.structure)?);
    }
    if labelled > 0.0 && !whole && options.sky_opacity > 0.0 {
        let error = (&rendered.alpha - sky.affine(-1.0, 1.0)?)?.abs()?;
        if let Some(loss) = masked_mean(&error, sky_known)? {
            terms.push("sky_opacity", (loss * options.sky_opacity)?);
        }
    }
    Ok(terms)
}

/// What the network's windows look like from the target views, as [`crate::Scene::render`] draws them.
pub fn draw_targets(
    output: &ClipOutput,
    target: &ClipBatch,
    renderer: &SharedRenderer,
) -> Result<Rendered, ModelError> {
    let [b, t, v, h, w] = target.dims()?;
    let &[batch, steps, cameras, rows, cols] = output.opacities.dims() else {
        return Err(ModelError::Input("opacities are not (b, t, v, h, w)".into()));
    };
    if batch != b || cameras != v {
        let text = format!("targets of {b} windows and {v} cameras for {batch} windows and {cameras} cameras");
        return Err(ModelError::Input(text));
    }
    let n = steps * cameras * rows * cols;
    let times = target.time_sec.to_device(&candle_core::Device::Cpu)?.flatten_all()?.to_vec1::<f32>()?;
    let views = views(target)?;
    let mut drawn = Vec::with_capacity(b * t);
    for window in 0..b {
        let shape =
            Tensor::cat(&[&output.quats.get(window)?, &output.scales.get(window)?], D::Minus1)?.reshape((n, ()))?;
        let colors = output.colors.get(window)?.reshape((n, 3))?;
        for k in 0..t {
            let first = (window * t + k) * v;
            let means = means_at(output, window, f64::from(times[first]))?.reshape((n, 3))?;
            let seen: Vec<View> = views[first..first + v].to_vec();
            let opacities = opacities_at(output, window, times[first])?.reshape((n, 1))?;
            drawn.push(draw(&Tensor::cat(&[&means, &shape, &opacities, &colors], 1)?, seen, renderer)?);
        }
    }
    let drawn = Tensor::stack(&drawn, 0)?.reshape(vec![b, t, v, h, w, DRAWN])?;
    let channel = |at: usize| drawn.narrow(D::Minus1, at, 1)?.squeeze(D::Minus1);
    let alpha = channel(3)?.contiguous()?;
    let colors = drawn.narrow(D::Minus1, 0, 3)?.contiguous()?;
    let image = finish(output, colors, &alpha, target)?;
    Ok(Rendered { image, depth: channel(4)?.contiguous()?, alpha })
}

/// Opacities above this fade as this: the derivative of what they become is infinite at 1.
const FADING_OPACITY_MAX: f64 = 1.0 - 1e-4;

/// Opacities of one window for drawing at a time, `(t, v, h, w)`: as [`crate::Scene::opacities_at`].
fn opacities_at(output: &ClipOutput, window: usize, time_sec: f32) -> Result<Tensor, ModelError> {
    let opacities = output.opacities.get(window)?;
    let own = output.time_sec.get(window)?;
    let (t, v) = own.dims2()?;
    let own = own.to_device(&candle_core::Device::Cpu)?.flatten_all()?.to_vec1::<f32>()?;
    let Some(weights) = fade_weights(&own, time_sec, output.config.time_fade_sec) else { return Ok(opacities) };
    let weights = Tensor::from_vec(weights, (t, v, 1, 1), opacities.device())?;
    let depth = opacities.minimum(FADING_OPACITY_MAX)?.affine(-1.0, 1.0)?.log()?;
    Ok(depth.broadcast_mul(&weights)?.exp()?.affine(-1.0, 1.0)?)
}

/// Centres of one window at a time (paper eq. 1), `(t, v, h, w, 3)`.
fn means_at(output: &ClipOutput, window: usize, time_sec: f64) -> Result<Tensor, ModelError> {
    let means = output.means.get(window)?;
    let ahead = output.time_sec.get(window)?.affine(-1.0, time_sec)?;
    let (t, v) = ahead.dims2()?;
    let moved =
        |velocity: &Tensor, ahead: &Tensor| velocity.get(window)?.broadcast_mul(&ahead.reshape(vec![t, v, 1, 1, 1])?);
    Ok(match output.config.velocity {
        VelocityKind::One => (means + moved(&output.velocity_forward, &ahead)?)?,
        VelocityKind::ForwardBackward => {
            let later = moved(&output.velocity_forward, &ahead.maximum(0.0)?)?;
            let earlier = moved(&output.velocity_backward, &ahead.minimum(0.0)?)?;
            ((means + later)? + earlier)?
        }
    })
}

/// Sky behind, then exposure. `colors` is `(b, t, v, h, w, 3)`.
fn finish(output: &ClipOutput, colors: Tensor, alpha: &Tensor, target: &ClipBatch) -> Result<Tensor, ModelError> {
    let [b, t, v, h, w] = target.dims()?;
    let mut colors = colors;
    if output.sky_token.is_some() {
        // The sky head takes directions with z = 1 in their camera, whatever depth means.
        let config = ModelConfig { depth_meaning: DepthMeaning::ZDepth, ..ModelConfig::clone(&output.config) };
        let directions = Rays::new(&config, target)?.directions.reshape((b, t * v * h * w, 3))?;
        if let Some(sky) = output.sky_color(&directions)? {
            let gap = alpha.affine(-1.0, 1.0)?.unsqueeze(D::Minus1)?;
            colors = (colors + sky.reshape(vec![b, t, v, h, w, 3])?.broadcast_mul(&gap)?)?;
        }
    }
    super::pixel::exposed(output, &colors)
}
