//! Weights of a larger network that begins with what a smaller one has learned.
//!
//! Every step takes the weights of a network that works to those of a larger one with (nearly) the same results, each in a
//! file of its own; [`grow`] applies those that two configurations differ by, in order. New entries through which
//! something new could reach a result are zero, those on their other side are not: the first training step moves the
//! former, the later ones both (as in Net2Net, Chen et al., ICLR 2016).

mod check;
mod depth;
mod patch;
mod place;
mod position;
#[cfg(test)]
mod tests;
mod tokens;
mod width;

use candle_core::{DType, Device, Tensor};

use super::{Tensors, check_shapes};
use crate::config::ModelConfig;
use crate::error::ModelError;

/// The weights `tensors` of the network `from` as those of the larger network `to`; `seed` chooses what new parts start from.
///
/// What the grown network's results differ by from the small one's:
/// - `patch_size` (with the image as much larger, on the same patch grid): nothing but the 2 x 2 averages of the image that the
///   small one would have been given; motion stays as coarse as it was (`ModelConfig::motion_copies`).
/// - `image_height`, `image_width`: nothing; the position embedding is resampled as it is for an image of that size.
/// - `embed_dim` with `num_heads`, `mlp_ratio`, `upsampler_widths`, `key_hidden`, `basis_hidden`, `projected_motion_dim`,
///   `depth`, `num_cams`, `sweep_after_block` from 0: rounding.
/// - larger patches with a sweep: it compares finer images.
/// - `num_motion_tokens`: what a few more keys change in attention.
///
/// # Errors
/// A configuration that is not larger in all of these, or that differs in what no step leads to; tensors that are not
/// those of `from`.
pub fn grow(from: &ModelConfig, tensors: &Tensors, to: &ModelConfig, seed: u64) -> Result<Tensors, ModelError> {
    from.validate()?;
    to.validate()?;
    check_shapes(from, tensors.iter().map(|(name, x)| (name.as_str(), x.dims())))?;
    check::check(from, to)?;
    let host = |x: &Tensor| x.to_device(&Device::Cpu)?.to_dtype(DType::F32);
    let copied = tensors.iter().map(|(name, x)| Ok((name.clone(), host(x)?)));
    let mut tensors = copied.collect::<Result<Tensors, ModelError>>()?;
    if !tensors.contains_key("max_scale") {
        tensors.insert("max_scale".into(), Tensor::new(&[from.max_scale as f32], &Device::Cpu)?);
    }
    let mut config = from.clone();
    patch::enlarge(&mut config, &mut tensors, to.patch_size)?;
    position::resize(&mut config, &mut tensors, to)?;
    width::widen(&mut config, &mut tensors, to, seed)?;
    depth::deepen(&mut config, &mut tensors, to, seed)?;
    tokens::add_motion(&mut config, &mut tensors, to, from.projected_motion_dim, seed)?;
    super::for_cameras(&mut config, &mut tensors, to.num_cams)?;
    check_shapes(to, tensors.iter().map(|(name, x)| (name.as_str(), x.dims())))?;
    Ok(tensors)
}

/// A tensor that [`check_shapes`] has found to be there.
fn take(tensors: &mut Tensors, name: &str) -> Result<Tensor, ModelError> {
    tensors.remove(name).ok_or_else(|| super::WeightsError::missing(name).into())
}
