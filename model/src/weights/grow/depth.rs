//! More blocks, and the velocity sweep between them.

use candle_core::Device;

use crate::config::ModelConfig;
use crate::error::ModelError;
use crate::weights::{Tensors, untrained};

/// Blocks after the last one, whose two last layers are zero: they add nothing to the tokens. Nor does an untrained sweep.
pub(super) fn deepen(
    config: &mut ModelConfig,
    tensors: &mut Tensors,
    to: &ModelConfig,
    seed: u64,
) -> Result<(), ModelError> {
    (config.depth, config.sweep_after_block) = (to.depth, to.sweep_after_block);
    for (name, fresh) in untrained(config, seed, &Device::Cpu)? {
        if tensors.contains_key(&name) {
            continue;
        }
        let last = [".attn.proj.weight", ".mlp.fc2.weight"].iter().any(|end| name.ends_with(end));
        let fresh = if last { fresh.zeros_like()? } else { fresh };
        tensors.insert(name, fresh);
    }
    Ok(())
}
