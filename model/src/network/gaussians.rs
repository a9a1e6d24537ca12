//! The Gaussian head: image tokens to pixel-aligned Gaussians (paper appendix A.2, "Gaussian Parameterization").

use candle_core::{D, Tensor};
use candle_nn::ops::sigmoid;

use super::params::Params;
use super::stages::Stages;
use crate::config::{ColorActivation, ColorBase, DepthActivation, ModelConfig};
use crate::error::ModelError;
use crate::ops::{Activation, Linear, linear};
use crate::rays::Rays;

/// Per-pixel Gaussians, channel last.
pub(crate) struct PixelGaussians {
    pub depths: Tensor,
    pub means: Tensor,
    pub scales: Tensor,
    pub quats: Tensor,
    pub opacities: Tensor,
    pub colors: Tensor,
}

#[derive(Debug, Clone)]
pub(crate) struct GaussianHead {
    pred: Linear,
    max_scale: Tensor,
}

impl GaussianHead {
    pub fn new(params: &Params<'_>) -> Result<Self, ModelError> {
        Ok(Self { pred: params.linear("gs_pred")?, max_scale: params.get("max_scale")? })
    }

    /// `tokens` is `(b, t v rows cols, d)`; `image` the `(b, t, v, 3, h, w)` it was made from.
    pub fn forward(
        &self,
        config: &ModelConfig,
        tokens: &Tensor,
        image: &Tensor,
        rays: &Rays,
        stages: &mut Stages,
    ) -> Result<PixelGaussians, ModelError> {
        let &[b, t, v, _, h, w] = image.dims() else {
            return Err(ModelError::Input("image is not (b, t, v, 3, h, w)".into()));
        };
        let (p, c) = (config.patch_size, ModelConfig::GAUSSIAN_CHANNELS);
        let raw = linear(tokens, &self.pred, Activation::None, None)?;
        stages.keep("gs_pred_raw", &raw);
        let raw = raw
            .reshape(vec![b * t * v, h / p, w / p, p, p, c])?
            .permute(vec![0, 1, 3, 2, 4, 5])?
            .contiguous()?
            .reshape((b, t, v, h, w, c))?;
        let depth = sigmoid(&raw.narrow(D::Minus1, 0, 1)?)?;
        let depth = match config.depth_activation {
            DepthActivation::Sigmoid => depth.affine(config.far - config.near, config.near)?,
            DepthActivation::Log => depth.affine((config.far / config.near).ln(), config.near.ln())?.exp()?,
        };
        let scales = raw.narrow(D::Minus1, 1, 3)?.affine(1.0, config.scale_offset)?.exp()?;
        let colors = raw.narrow(D::Minus1, 9, 3)?;
        let colors = match config.color_activation {
            ColorActivation::None => colors.contiguous()?,
            ColorActivation::TanhLike => sigmoid(&colors)?.affine(2.0, -1.0)?,
        };
        let colors = match config.color {
            ColorBase::Absolute => colors,
            ColorBase::Residual => (image.permute((0, 1, 2, 4, 5, 3))? + colors)?,
        };
        Ok(PixelGaussians {
            means: rays.origins.broadcast_add(&rays.directions.broadcast_mul(&depth)?)?,
            depths: depth.squeeze(D::Minus1)?,
            scales: scales.broadcast_minimum(&self.max_scale)?,
            quats: raw.narrow(D::Minus1, 4, 4)?.contiguous()?,
            opacities: sigmoid(&raw.narrow(D::Minus1, 8, 1)?.affine(1.0, config.opacity_offset)?)?
                .squeeze(D::Minus1)?,
            colors,
        })
    }
}
