//! The paper's losses on rendered pictures (section 3.3 and appendix A.3), as the authors' program computes them.

use candle_core::{D, DType, Tensor};
use serde::{Deserialize, Serialize};

use super::perceptual::structure_loss;
use crate::error::ModelError;

/// Depths up to this are no measurement, metres.
const DEPTH_KNOWN_M: f64 = 0.01;

/// Weights of the terms; a term of weight 0 is left out.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RenderLossOptions {
    /// Depth of the drawn picture (paper: 1); 0 learns without depth.
    pub depth: f64,
    /// Opacity against the sky mask (paper: 0.1).
    pub sky_opacity: f64,
    /// Mean squared velocity component (paper: 0.005).
    pub velocity: f64,
    /// Structure of the picture, standing in for LPIPS (paper: 0.05).
    pub structure: f64,
    /// Steps before the structure term is switched on (paper: 5,000).
    pub structure_from_step: u64,
    /// Instead of an empty sky: sky at this depth (metres) and everything opaque, each with weight 0.01.
    pub sky_depth_m: Option<f64>,
}

impl Default for RenderLossOptions {
    fn default() -> Self {
        Self {
            depth: 1.0,
            sky_opacity: 0.1,
            velocity: 0.005,
            structure: 0.05,
            structure_from_step: 5000,
            sky_depth_m: None,
        }
    }
}

/// Weight of both terms of the sky-at-a-depth option.
const SKY_DEPTH_WEIGHT: f64 = 0.01;

/// What was drawn, for one batch of target views.
#[derive(Debug, Clone)]
pub struct Rendered {
    /// `(b, t, v, h, w, 3)`, network range -1..1.
    pub image: Tensor,
    /// `(b, t, v, h, w)` expected z-depth, metres.
    pub depth: Tensor,
    /// `(b, t, v, h, w)` opacity of the Gaussians.
    pub alpha: Tensor,
}

/// What the cameras saw.
#[derive(Debug, Clone)]
pub struct Target {
    /// `(b, t, v, 3, h, w)`, -1..1.
    pub image: Tensor,
    /// `(b, t, v, h, w)` z-depth, metres, 0 where unknown; `None` without depth.
    pub depth: Option<Tensor>,
    /// `(b, t, v, h, w)`, 1 in the sky; `None` without sky masks.
    pub sky: Option<Tensor>,
    /// `(b, t, v, h, w)`, 1 where the camera saw something: colours count there alone. `None`: everywhere.
    pub valid: Option<Tensor>,
}

/// Named loss terms, weights applied.
#[derive(Debug, Clone, Default)]
pub struct Terms(Vec<(&'static str, Tensor)>);

impl Terms {
    /// Adds a scalar.
    pub fn push(&mut self, name: &'static str, value: Tensor) {
        self.0.push((name, value));
    }

    /// Adds all terms of another set.
    pub fn extend(&mut self, other: Self) {
        self.0.extend(other.0);
    }

    /// The terms in the order they were added.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, &Tensor)> {
        self.0.iter().map(|(name, x)| (*name, x))
    }

    /// Their plain sum.
    ///
    /// # Errors
    /// When there is no term, so nothing to learn from.
    pub fn total(&self) -> Result<Tensor, ModelError> {
        let mut terms = self.0.iter().map(|(_, x)| x.clone());
        let first = terms.next().ok_or_else(|| ModelError::Input("no loss term applies to this batch".into()))?;
        Ok(terms.try_fold(first, |sum, x| sum + x)?)
    }

    /// Their values.
    pub fn values(&self) -> Result<Vec<(&'static str, f64)>, ModelError> {
        self.0.iter().map(|(name, x)| Ok((*name, x.to_dtype(DType::F64)?.to_scalar::<f64>()?))).collect()
    }
}

/// All terms of rendered target views. `velocities` are those of every Gaussian, `(..., 3)`, each counted once.
pub fn render_losses(
    rendered: &Rendered,
    target: &Target,
    velocities: &[&Tensor],
    options: &RenderLossOptions,
    step: u64,
) -> Result<Terms, ModelError> {
    let mut terms = Terms::default();
    let image = channel_last(&target.image)?;
    terms.push("rgb", color_loss_where(&rendered.image, &image, target.valid.as_ref())?);
    if let Some(depth) = &target.depth
        && options.depth > 0.0
        && let Some(loss) = depth_loss(&rendered.depth, depth)?
    {
        terms.push("depth", (loss * options.depth)?);
    }
    if options.structure > 0.0 && step >= options.structure_from_step {
        terms.push(
            "structure",
            (structure_loss(&or_truth(&rendered.image, &image, target.valid.as_ref())?, &image)? * options.structure)?,
        );
    }
    if options.velocity > 0.0 {
        terms.push("velocity", velocity_loss(velocities, options.velocity)?);
    }
    if let Some(sky) = &target.sky {
        if options.sky_opacity > 0.0 {
            terms.push("sky_opacity", (sky_opacity_loss(&rendered.alpha, sky)? * options.sky_opacity)?);
        }
        if let Some(sky_depth_m) = options.sky_depth_m {
            let off = rendered.depth.affine(1.0 / sky_depth_m, -1.0)?.sqr()?;
            if let Some(loss) = masked_mean(&off, sky)? {
                terms.push("sky_depth", (loss * SKY_DEPTH_WEIGHT)?);
            }
            let opacity = rendered.alpha.affine(1.0, -1.0)?.sqr()?.mean_all()?;
            terms.push("opaque", (opacity * SKY_DEPTH_WEIGHT)?);
        }
    }
    Ok(terms)
}

/// The drawn picture `(b, t, v, h, w, 3)` with the camera's own colours where it saw nothing: no term that compares
/// neighbourhoods finds a difference there, and no gradient goes there.
pub fn or_truth(drawn: &Tensor, truth: &Tensor, valid: Option<&Tensor>) -> candle_core::Result<Tensor> {
    let Some(valid) = valid else { return Ok(drawn.clone()) };
    let valid = valid.to_dtype(drawn.dtype())?.unsqueeze(D::Minus1)?;
    drawn.broadcast_mul(&valid)? + truth.broadcast_mul(&valid.affine(-1.0, 1.0)?)?
}

/// `(b, t, v, 3, h, w)` to `(b, t, v, h, w, 3)`.
pub fn channel_last(image: &Tensor) -> candle_core::Result<Tensor> {
    image.permute((0, 1, 2, 4, 5, 3))?.contiguous()
}

/// Mean squared error of colours in 0..1, from the network range -1..1.
pub fn color_loss(pred: &Tensor, truth: &Tensor) -> candle_core::Result<Tensor> {
    (pred.affine(0.5, 0.5)? - truth.affine(0.5, 0.5)?)?.sqr()?.mean_all()
}

/// As [`color_loss`] over the pixels that `valid` `(b, t, v, h, w)` has a 1 for; none: over all. 0 where there is no such pixel.
pub fn color_loss_where(pred: &Tensor, truth: &Tensor, valid: Option<&Tensor>) -> candle_core::Result<Tensor> {
    let Some(valid) = valid else { return color_loss(pred, truth) };
    let error = (pred.affine(0.5, 0.5)? - truth.affine(0.5, 0.5)?)?.sqr()?.mean(D::Minus1)?;
    let valid = valid.to_dtype(error.dtype())?;
    match masked_mean(&error, &valid)? {
        Some(loss) => Ok(loss),
        None => (error * valid)?.sum_all(),
    }
}

/// Mean absolute depth error over the known pixels, over the largest known depth of the batch; `None` where none is known.
pub fn depth_loss(pred: &Tensor, truth: &Tensor) -> candle_core::Result<Option<Tensor>> {
    let known = truth.gt(DEPTH_KNOWN_M)?.to_dtype(pred.dtype())?;
    let farthest = truth.flatten_all()?.max(0)?.to_dtype(DType::F64)?.to_scalar::<f64>()?;
    let error = ((pred - truth)? * &known)?.abs()?;
    match masked_mean(&error, &known)? {
        Some(loss) => Ok(Some((loss / farthest)?)),
        None => Ok(None),
    }
}

/// `weight * mean(v^2)` over all components.
pub fn velocity_loss(velocities: &[&Tensor], weight: f64) -> candle_core::Result<Tensor> {
    let means = velocities.iter().map(|v| v.sqr()?.mean_all()).collect::<candle_core::Result<Vec<_>>>()?;
    Tensor::stack(&means, 0)?.mean(D::Minus1)? * weight
}

/// `mean |alpha - (1 - sky)|`.
pub fn sky_opacity_loss(alpha: &Tensor, sky: &Tensor) -> candle_core::Result<Tensor> {
    (alpha - sky.affine(-1.0, 1.0)?)?.abs()?.mean_all()
}

/// Mean of `x` weighted by `weights` (same shape, no gradient); `None` where they sum to 0.
pub fn masked_mean(x: &Tensor, weights: &Tensor) -> candle_core::Result<Option<Tensor>> {
    let sum = weights.sum_all()?.to_dtype(DType::F64)?.to_scalar::<f64>()?;
    if sum > 0.0 { Ok(Some(((x * weights)?.sum_all()? / sum)?)) } else { Ok(None) }
}
