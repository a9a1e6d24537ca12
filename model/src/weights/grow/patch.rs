//! Larger patches of a larger image: the same tokens of the same things.

use candle_core::Tensor;

use super::take;
use crate::config::ModelConfig;
use crate::error::ModelError;
use crate::weights::Tensors;

/// Channels of the Gaussian head that hold the logarithm of a scale.
const SCALES: std::ops::RangeInclusive<usize> = 1..=3;

/// Patches `patch_size / config.patch_size` times as large of images as much larger. The embedding reads the average of each
/// block of pixels that one pixel was; the block's Gaussians are that pixel's, as much smaller.
pub(super) fn enlarge(config: &mut ModelConfig, tensors: &mut Tensors, patch_size: usize) -> Result<(), ModelError> {
    let factor = patch_size / config.patch_size;
    if factor == 1 {
        return Ok(());
    }
    let side = config.patch_size;
    let embedding = take(tensors, "patch_embed.proj.weight")?;
    tensors.insert("patch_embed.proj.weight".into(), (repeat(&embedding, [2, 3], factor)? / (factor * factor) as f64)?);
    for name in ["gs_pred.weight", "gs_pred.bias"] {
        let rows = take(tensors, name)?;
        let inner = rows.elem_count() / (side * side);
        let rows = repeat(&rows.reshape((1, 1, side, side, inner))?, [2, 3], factor)?;
        let mut shape = vec![patch_size * patch_size * ModelConfig::GAUSSIAN_CHANNELS];
        shape.extend(inner.checked_div(ModelConfig::GAUSSIAN_CHANNELS).filter(|_| name.ends_with("weight")));
        let mut rows = rows.reshape(shape)?;
        if name.ends_with("bias") {
            let smaller = (0..rows.elem_count()).map(|i| {
                if SCALES.contains(&(i % ModelConfig::GAUSSIAN_CHANNELS)) { (factor as f32).ln() } else { 0.0 }
            });
            rows = (rows - Tensor::from_iter(smaller, &candle_core::Device::Cpu)?)?;
        }
        tensors.insert(name.into(), rows);
    }
    config.patch_size = patch_size;
    config.image_height *= factor;
    config.image_width *= factor;
    Ok(())
}

/// Every entry of these two axes as a block of `factor x factor`.
fn repeat(x: &Tensor, axes: [usize; 2], factor: usize) -> candle_core::Result<Tensor> {
    axes.into_iter().try_fold(x.clone(), |x, axis| {
        let places: Vec<u32> = (0..x.dim(axis)? * factor).map(|i| (i / factor) as u32).collect();
        x.index_select(&Tensor::new(places, x.device())?, axis)
    })
}
