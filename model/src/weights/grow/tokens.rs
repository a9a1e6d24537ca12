//! More motion tokens.

use candle_core::{Device, Tensor};

use super::take;
use crate::config::{MaskDecoder, ModelConfig, VelocityBases};
use crate::error::ModelError;
use crate::weights::{Tensors, untrained};

/// How far under 0 the logits of new tokens start: each gets `exp(-6)`, 1 part in 400, of what a token at 0 gets.
const UNDER: f64 = 6.0;

/// Tokens up to the number in `to`. Their queries ask for channel `spare` alone, in which all keys are made 1.
pub(super) fn add_motion(
    config: &mut ModelConfig,
    tensors: &mut Tensors,
    to: &ModelConfig,
    spare: usize,
    seed: u64,
) -> Result<(), ModelError> {
    let (had, has) = (config.num_motion_tokens, to.num_motion_tokens);
    config.num_motion_tokens = has;
    if had == has {
        return Ok(());
    }
    // The last of an even number of spread bases is a second one that stands still: it stays the last.
    let stays_last = config.velocity_bases == VelocityBases::Spread && had.is_multiple_of(2);
    let place = |k: usize| if stays_last && k + 1 == had { has - 1 } else { k };
    let (query, key) = match config.mask_decoder {
        MaskDecoder::Authors => ("fc2", "motion_key_head.fc2"),
        MaskDecoder::Paper => ("fc3", "motion_key_head.fc1"),
    };
    let mut old = std::mem::take(tensors);
    let mut renamed = Tensors::new();
    for part in ["motion_query_heads", "motion_basis_decoders"] {
        for k in 0..had {
            let from = format!("{part}.{k}.");
            let names: Vec<String> = old.range(from.clone()..).map(|(name, _)| name.clone()).collect();
            for name in names.into_iter().take_while(|name| name.starts_with(&from)) {
                let x = take(&mut old, &name)?;
                renamed.insert(format!("{part}.{}.{}", place(k), &name[from.len()..]), x);
            }
        }
    }
    let trained = take(&mut old, "motion_tokens")?;
    for (name, fresh) in untrained(config, seed, &Device::Cpu)? {
        let x = if name == "motion_tokens" {
            let row = |k: usize| match (0..had).find(|&old| place(old) == k) {
                Some(old) => trained.narrow(1, old, 1),
                None => fresh.narrow(1, k, 1),
            };
            Tensor::cat(&(0..has).map(row).collect::<candle_core::Result<Vec<_>>>()?, 1)?
        } else if let Some(x) = renamed.remove(&name) {
            x
        } else if name.starts_with("motion_query_heads.") && name.ends_with(&format!(".{query}.weight")) {
            fresh.zeros_like()?
        } else if name.starts_with("motion_query_heads.") && name.ends_with(&format!(".{query}.bias")) {
            with_entry(&fresh, spare, -UNDER * config.tau)?
        } else if name.starts_with("motion_query_heads.") || name.starts_with("motion_basis_decoders.") {
            fresh
        } else {
            take(&mut old, &name)?
        };
        tensors.insert(name, x);
    }
    let (weight, bias) = (format!("{key}.weight"), format!("{key}.bias"));
    let x = take(tensors, &weight)?;
    let columns = x.dim(1)?;
    let zero = Tensor::zeros((1, columns), x.dtype(), &Device::Cpu)?;
    tensors.insert(weight, x.slice_assign(&[spare..spare + 1, 0..columns], &zero)?);
    let x = take(tensors, &bias)?;
    tensors.insert(bias, with_entry(&x, spare, 1.0)?);
    Ok(())
}

/// A vector with one entry set.
fn with_entry(x: &Tensor, at: usize, value: f64) -> candle_core::Result<Tensor> {
    let set = |(k, x)| if k == at { value as f32 } else { x };
    let values: Vec<f32> = x.to_vec1::<f32>()?.into_iter().enumerate().map(set).collect();
    Tensor::new(values, &Device::Cpu)
}
