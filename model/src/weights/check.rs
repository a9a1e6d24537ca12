//! Do these tensors make this network?

use std::collections::BTreeMap;

use super::error::{Mismatch, WeightsError};
use super::names::tensor_specs;
use crate::config::ModelConfig;

/// Compares names and shapes with those of the network `config` describes; every difference is in the error.
///
/// A missing `max_scale` is no difference (the configuration has it). Latent-STORM is refused by its own message.
pub fn check_shapes<'a>(
    config: &ModelConfig,
    have: impl Iterator<Item = (&'a str, &'a [usize])>,
) -> Result<(), WeightsError> {
    let mut have: BTreeMap<&str, &[usize]> = have.collect();
    if let Some(name) = have.keys().find(|name| name.starts_with("decoder.")) {
        return Err(WeightsError::tensor(name, "belongs to a Latent-STORM checkpoint; only pixel STORM is supported"));
    }
    let mut mismatch = Mismatch::default();
    for spec in tensor_specs(config) {
        match have.remove(spec.name.as_str()) {
            Some(shape) if shape == spec.shape => {}
            Some(shape) => mismatch.shapes.push((spec.name, shape.to_vec(), spec.shape)),
            None if spec.name == "max_scale" => {}
            None => mismatch.missing.push(spec.name),
        }
    }
    mismatch.extra = have.into_keys().map(str::to_owned).collect();
    if mismatch.is_empty() { Ok(()) } else { Err(WeightsError::Mismatch(mismatch)) }
}
