//! The Gaussian head: image tokens to pixel-aligned Gaussians (paper appendix A.2, "Gaussian Parameterization").

use candle_core::{D, Tensor};
use candle_nn::ops::sigmoid;

use super::params::Params;
use super::stages::Stages;
use crate::config::{ColorActivation, ColorBase, DepthActivation, ModelConfig};
use crate::error::ModelError;
use crate::kernels::gaussians::Meaning;
use crate::ops::{self, Activation, Linear, linear};
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
        if let Some(gaussians) = fused(config, &raw, image, rays)? {
            return Ok(gaussians);
        }
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

/// The same in one pass over the pixels, where no gradients are tracked and the kernel covers the tensors.
fn fused(
    config: &ModelConfig,
    raw: &Tensor,
    image: &Tensor,
    rays: &Rays,
) -> Result<Option<PixelGaussians>, ModelError> {
    let &[b, t, v, _, h, w] = image.dims() else {
        return Ok(None);
    };
    let meaning = Meaning {
        patch: config.patch_size,
        near: config.near,
        far: config.far,
        log_depth: config.depth_activation == DepthActivation::Log,
        scale_offset: config.scale_offset,
        // What the weights have: see `Storm::new`.
        max_scale: config.max_scale as f32,
        opacity_offset: config.opacity_offset,
        squash_colors: config.color_activation == ColorActivation::TanhLike,
        residual_colors: config.color == ColorBase::Residual,
    };
    let inputs = [raw, image, &rays.origins, &rays.directions];
    let Some([means, scales, quats, opacities, colors, depths]) = ops::gaussians(&meaning, inputs, [b * t * v, h, w])?
    else {
        return Ok(None);
    };
    let tensor = |values: Vec<f32>, channels: usize| Tensor::from_vec(values, (b, t, v, h, w, channels), raw.device());
    let scalar = |values: Vec<f32>| Tensor::from_vec(values, (b, t, v, h, w), raw.device());
    Ok(Some(PixelGaussians {
        means: tensor(means, 3)?,
        scales: tensor(scales, 3)?,
        quats: tensor(quats, 4)?,
        opacities: scalar(opacities)?,
        colors: tensor(colors, 3)?,
        depths: scalar(depths)?,
    }))
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};

    use super::*;

    /// Values of up to a few hundred metres by an exponential each way.
    const RELATIVE: f32 = 2e-6;

    #[test]
    fn the_kernel_is_the_plain_version() {
        let device = Device::Cpu;
        let noise = |seed: u64, dims: &[usize], scale: f32| {
            Tensor::from_vec(crate::kernels::tests::noise(seed, dims.iter().product(), scale), dims, &device).unwrap()
        };
        for (k, patch) in [8, 3, 16].into_iter().enumerate() {
            let (t, v, h, w) = (2, 2, 2 * patch, 3 * patch);
            let base = ModelConfig { patch_size: patch, ..ModelConfig::preset("tiny").unwrap() };
            for config in
                [base.clone(), base.with_paper_choices(), ModelConfig { patch_size: patch, ..ModelConfig::default() }]
            {
                let max_scale = Tensor::new(config.max_scale as f32, &device).unwrap();
                let outputs = patch * patch * ModelConfig::GAUSSIAN_CHANNELS;
                let weight = noise(k as u64, &[outputs, 5], 2.0);
                let head =
                    |weight: Tensor| GaussianHead { pred: Linear::new(weight, None), max_scale: max_scale.clone() };
                let tokens = noise(7, &[1, t * v * 6, 5], 2.0);
                let image = noise(8, &[1, t, v, 3, h, w], 1.0);
                let rays = Rays {
                    origins: noise(9, &[1, t, v, 1, 1, 3], 5.0),
                    directions: noise(10, &[1, t, v, h, w, 3], 1.0),
                    plucker: noise(11, &[t * v, 6, h, w], 1.0),
                };
                let variable = Var::from_tensor(&weight).unwrap();
                let run = |weight: Tensor| {
                    head(weight).forward(&config, &tokens, &image, &rays, &mut Stages::none()).unwrap()
                };
                let (got, want) = (run(weight.clone()), run(variable.as_tensor().clone()));
                let pairs = [
                    (got.depths, want.depths),
                    (got.means, want.means),
                    (got.scales, want.scales),
                    (got.quats, want.quats),
                    (got.opacities, want.opacities),
                    (got.colors, want.colors),
                ];
                for (i, (a, b)) in pairs.into_iter().enumerate() {
                    assert_eq!(a.dims(), b.dims());
                    let numbers = |x: Tensor| x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
                    for (a, b) in numbers(a).into_iter().zip(numbers(b)) {
                        assert!(
                            (a - b).abs() <= RELATIVE * b.abs().max(1.0) * 3.0,
                            "tensor {i}, patch {patch}: {a} {b}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn nan_is_not_lost() {
        let device = Device::Cpu;
        let config = ModelConfig::preset("tiny").unwrap();
        let zeros = |dims: &[usize]| Tensor::zeros(dims, candle_core::DType::F32, &device).unwrap();
        let rays = Rays {
            origins: zeros(&[1, 1, 1, 1, 1, 3]),
            directions: zeros(&[1, 1, 1, 8, 8, 3]),
            plucker: zeros(&[1, 6, 8, 8]),
        };
        let raw = Tensor::full(f32::NAN, (1, 1, 768), &device).unwrap();
        let all = fused(&config, &raw, &zeros(&[1, 1, 1, 3, 8, 8]), &rays).unwrap().unwrap();
        for x in [all.depths, all.means, all.scales, all.quats, all.opacities, all.colors] {
            assert!(x.flatten_all().unwrap().to_vec1::<f32>().unwrap().iter().all(|x| x.is_nan()));
        }
    }
}
