//! The weights that ship: `tiny`, trained by `storm train` on procedural drives alone; how is in the file's metadata.

use candle_core::Device;

use super::{Tensors, load_built_in};
use crate::config::ModelConfig;
use crate::error::ModelError;

/// What the weights that ship are called in results.
pub const SHIPPED_NAME: &str = "tiny (shipped)";

static BYTES: &[u8] = include_bytes!("../../weights/tiny.safetensors");

/// The weights that ship.
pub fn shipped(device: &Device) -> Result<(ModelConfig, Tensors), ModelError> {
    load_built_in(SHIPPED_NAME, BYTES, None, device)
}

/// How they were made.
pub fn shipped_provenance() -> String {
    super::provenance(BYTES).unwrap_or_else(|| SHIPPED_NAME.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Most bytes the weights may add to the repository and the program.
    const MOST_BYTES: usize = 12 << 20;

    #[test]
    fn they_are_the_tiny_preset_and_small() {
        let (config, tensors) = shipped(&Device::Cpu).unwrap();
        assert_eq!(config, ModelConfig::preset("tiny").unwrap());
        assert!(BYTES.len() <= MOST_BYTES, "{} bytes", BYTES.len());
        crate::Storm::new(&config, &tensors).unwrap();
        assert!(shipped_provenance().contains("procedural drives"), "{}", shipped_provenance());
    }
}
