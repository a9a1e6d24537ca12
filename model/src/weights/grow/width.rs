//! Wider layers.
//!
//! Whatever is added to the tokens is only ever read through a layer norm, which takes away the mean over the channels: with
//! that mean taken out of all weights that write to the tokens, nothing changes. Then further channels of zeros leave the
//! mean at 0 and make the variance `old / new` as large, which the norms' gains take back. The same holds within the
//! upsampler, between a doubling and its norm.

use candle_core::Tensor;

use super::place::{Axis, place};
use super::take;
use crate::config::{MaskDecoder, ModelConfig};
use crate::error::ModelError;
use crate::weights::names::upsampler_norm;
use crate::weights::{Tensors, WeightsError, untrained};

/// All widths of `to`.
pub(super) fn widen(
    config: &mut ModelConfig,
    tensors: &mut Tensors,
    to: &ModelConfig,
    seed: u64,
) -> Result<(), ModelError> {
    let wide = ModelConfig {
        embed_dim: to.embed_dim,
        num_heads: to.num_heads,
        mlp_ratio: to.mlp_ratio,
        upsampler_widths: to.upsampler_widths.clone(),
        key_hidden: to.key_hidden,
        basis_hidden: to.basis_hidden,
        projected_motion_dim: to.projected_motion_dim,
        ..config.clone()
    };
    if wide == *config {
        return Ok(());
    }
    centre_tokens(config, tensors, wide.embed_dim)?;
    centre_doublings(config, tensors, &wide.upsampler_widths)?;
    for (name, fresh) in untrained(&wide, seed, &candle_core::Device::Cpu)? {
        let old = take(tensors, &name)?;
        let parts = if name.contains(".attn.qkv.") { 3 } else { 1 };
        let zero = zero_axes(&name, config)?;
        let axes: Vec<Axis> = (old.dims().iter().zip(fresh.dims()).enumerate())
            .map(|(k, (&a, &b))| Axis::parts(if k == 0 { parts } else { 1 }, a, b, zero.contains(&k)))
            .collect();
        tensors.insert(name, place(&old, &fresh, &axes)?);
    }
    *config = wide;
    Ok(())
}

/// The axis of a tensor that is added to the tokens, along which their channels lie.
fn token_axis(name: &str) -> Option<usize> {
    match name {
        "pos_embed" | "sky_token" | "affine_token" | "motion_tokens" => Some(2),
        _ => {
            let layer = name.strip_suffix(".weight").or(name.strip_suffix(".bias"))?;
            let last = layer.ends_with(".attn.proj") || layer.ends_with(".mlp.fc2");
            let added = ["patch_embed.proj", "time_embedder.mlp.2", "sweep.inject"];
            (last || added.contains(&layer)).then_some(0)
        }
    }
}

/// True of the gain of a norm over the tokens' channels.
fn token_gain(name: &str) -> bool {
    matches!(name, "norm.weight" | "sweep.norm.weight")
        || name.ends_with(".norm1.weight")
        || name.ends_with(".norm2.weight")
}

fn centred(x: &Tensor, axis: usize) -> candle_core::Result<Tensor> {
    x.broadcast_sub(&x.mean_keepdim(axis)?)
}

fn centre_tokens(config: &ModelConfig, tensors: &mut Tensors, width: usize) -> Result<(), ModelError> {
    if width == config.embed_dim {
        return Ok(());
    }
    let gain = (config.embed_dim as f64 / width as f64).sqrt();
    for (name, x) in tensors.iter_mut() {
        if let Some(axis) = token_axis(name) {
            *x = centred(x, axis)?;
        } else if token_gain(name) {
            *x = (&*x * gain)?;
        }
    }
    Ok(())
}

fn centre_doublings(config: &ModelConfig, tensors: &mut Tensors, widths: &[usize]) -> Result<(), ModelError> {
    for (stage, (&old, &new)) in config.upsampler_widths.iter().zip(widths).enumerate() {
        if old == new || !upsampler_norm(config, stage) {
            continue;
        }
        let (conv, norm) = (3 * stage, 3 * stage + 1);
        for (name, axis) in [("weight", 1), ("bias", 0)] {
            let name = format!("output_upscaling.{conv}.{name}");
            let x = take(tensors, &name)?;
            tensors.insert(name, centred(&x, axis)?);
        }
        let name = format!("output_upscaling.{norm}.weight");
        let gain = take(tensors, &name)?;
        tensors.insert(name, (gain * (old as f64 / new as f64).sqrt())?);
    }
    Ok(())
}

/// The axes of a tensor along which new entries must be zero for the network's results to stay.
fn zero_axes(name: &str, config: &ModelConfig) -> Result<&'static [usize], ModelError> {
    if let Some(axis) = token_axis(name) {
        // Their inputs are hidden layers that grow as well; those of a patch and of the sweep do not.
        return Ok(match axis {
            0 if name.ends_with(".weight") => &[0, 1],
            0 => &[0],
            _ => &[2],
        });
    }
    let weight = name.ends_with(".weight");
    let mut parts = name.split('.');
    let (first, layer) = (parts.next().unwrap_or_default(), name.rsplit('.').nth(1).unwrap_or_default());
    let last_query = if config.mask_decoder == MaskDecoder::Paper { "fc3" } else { "fc2" };
    Ok(match (first, layer) {
        // Norms, and layers that read normed tokens, whose new channels are zero.
        ("max_scale" | "norm" | "sweep" | "sky_head" | "affine_linear" | "gs_pred" | "time_embedder", _) => &[],
        ("transformer", "norm1" | "norm2" | "qkv" | "fc1") => &[],
        // Two rows of layers: a doubling, and its norm.
        ("output_upscaling", k) => match k.parse::<usize>().map(|k| k % 3) {
            Ok(0) if weight => &[1],
            Ok(0) => &[0],
            _ => &[],
        },
        ("motion_query_heads", layer) if layer == last_query => {
            if weight {
                &[0, 1]
            } else {
                &[0]
            }
        }
        // Where there are no motion tokens bases are read from keys, whose new channels are not zero.
        ("motion_basis_decoder", "fc1") if weight && config.num_motion_tokens == 0 => &[1],
        ("motion_query_heads" | "motion_key_head" | "motion_basis_decoder" | "motion_basis_decoders", "fc1") => &[],
        ("motion_query_heads" | "motion_key_head" | "motion_basis_decoder" | "motion_basis_decoders", "fc2") => {
            if weight {
                &[1]
            } else {
                &[]
            }
        }
        _ => return Err(WeightsError::tensor(name, "has no rule by which it could be grown").into()),
    })
}
