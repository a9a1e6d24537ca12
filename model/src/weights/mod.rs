//! Weight files: safetensors (ours, with the configuration inside) and PyTorch checkpoints, under the authors' names.

mod check;
mod error;
mod grow;
mod infer;
mod init;
pub(crate) mod names;
mod pickle;
mod safetensors;
mod shipped;
mod torch;

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{DType, Device, Tensor};
pub use check::check_shapes;
pub use error::{Mismatch, WeightsError};
pub use grow::grow;
pub use infer::infer_config;
pub use init::untrained;
pub use names::{Init, TensorSpec, tensor_specs};
pub(crate) use safetensors::provenance;
pub use safetensors::{SavedType, save_safetensors};
pub use shipped::{SHIPPED_NAME, shipped, shipped_provenance};

use crate::config::ModelConfig;
use crate::error::ModelError;

/// Tensors by the authors' names.
pub type Tensors = BTreeMap<String, Tensor>;

/// Buffers of the authors' state dicts that carry no weights.
const BUFFERS: [&str; 2] = ["plucker_embedder.x", "plucker_embedder.y"];

/// Prefixes that wrappers put before every name (data parallelism, compilation).
const WRAPPERS: [&str; 2] = ["module.", "_orig_mod."];

/// Most bytes of one tensor we read: 16 times the largest of the largest published model.
const MAX_TENSOR_BYTES: usize = 1 << 30;

/// Start of files of PyTorch before 1.6: a pickle of its magic number.
const LEGACY_MAGIC: [u8; 8] = *b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46";

/// An open weight file: names and shapes known, values read one tensor at a time.
trait Source {
    /// Shapes by name as the file has it.
    fn shapes(&self) -> BTreeMap<String, Vec<usize>>;
    /// Values as f32.
    fn read(&mut self, name: &str) -> Result<Vec<f32>, WeightsError>;
    /// The configuration stored with the weights.
    fn config(&self) -> Result<Option<ModelConfig>, WeightsError>;
}

/// Reads a weight file onto a device, as f32.
///
/// The configuration is `given`, else the file's own, else inferred from the shapes. All shapes are checked against it
/// before any tensor is read.
pub fn load(path: &Path, given: Option<&ModelConfig>, device: &Device) -> Result<(ModelConfig, Tensors), ModelError> {
    read(&mut *open(path)?, given, device)
}

/// As [`load`], from a safetensors file that was built into the program; `name` is for messages.
pub fn load_built_in(
    name: &str,
    bytes: &'static [u8],
    given: Option<&ModelConfig>,
    device: &Device,
) -> Result<(ModelConfig, Tensors), ModelError> {
    read(&mut safetensors::SafetensorsFile::built_in(name, bytes)?, given, device)
}

fn read(
    source: &mut dyn Source,
    given: Option<&ModelConfig>,
    device: &Device,
) -> Result<(ModelConfig, Tensors), ModelError> {
    // The network's name -> the file's name.
    let mut names = BTreeMap::new();
    let mut shapes = BTreeMap::new();
    for (raw, shape) in source.shapes() {
        let name = unwrapped(&raw).to_owned();
        if shapes.insert(name.clone(), shape).is_some() {
            return Err(WeightsError::tensor(&name, "appears twice, with and without a wrapper's prefix").into());
        }
        names.insert(name, raw);
    }
    let own = if given.is_some() { None } else { source.config()? };
    let config = match (given, own) {
        (Some(config), _) => config.clone(),
        (None, Some(config)) => config,
        (None, None) => {
            let mut columns = || match names.get(BUFFERS[0]) {
                Some(raw) => source.read(raw).map(Some),
                None => Ok(None),
            };
            infer_config(&shapes, columns()?.as_deref())?
        }
    };
    config.validate()?;
    let read = |name: &str| !BUFFERS.contains(&name);
    check_shapes(&config, shapes.iter().filter(|(name, _)| read(name)).map(|(name, s)| (name.as_str(), &s[..])))?;
    let mut tensors = Tensors::new();
    for (name, raw) in names.iter().filter(|(name, _)| read(name)) {
        let values = source.read(raw)?;
        tensors.insert(name.clone(), Tensor::from_vec(values, &shapes[name][..], device)?);
    }
    if !tensors.contains_key("max_scale") {
        tensors.insert("max_scale".into(), Tensor::from_vec(vec![config.max_scale as f32], 1, device)?);
    }
    Ok((config, tensors))
}

fn open(path: &Path) -> Result<Box<dyn Source>, WeightsError> {
    let mut magic = [0u8; 8];
    let read = std::fs::File::open(path).and_then(|mut file| {
        let mut filled = 0;
        while filled < magic.len() {
            match std::io::Read::read(&mut file, &mut magic[filled..])? {
                0 => break,
                n => filled += n,
            }
        }
        Ok(filled)
    });
    let filled = read.map_err(|e| WeightsError::io(path, e))?;
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    if magic.starts_with(b"PK\x03\x04") {
        Ok(Box::new(torch::TorchFile::open(path)?))
    } else if magic == LEGACY_MAGIC || (magic[0] == 0x80 && matches!(extension.as_str(), "pth" | "pt" | "ckpt")) {
        let reason = "PyTorch's old format (before 1.6) is not read; in Python, torch.load it and torch.save it again";
        Err(WeightsError::format(path, reason))
    } else if filled == 8 && u64::from_le_bytes(magic) < MAX_TENSOR_BYTES as u64 {
        Ok(Box::new(safetensors::SafetensorsFile::open(path)?))
    } else {
        let reason = "neither safetensors nor a PyTorch zip checkpoint (or cut off at the very start)";
        Err(WeightsError::format(path, reason))
    }
}

/// Affine tokens for windows of up to `cameras` cameras: further cameras begin with the exposure of the trained ones in turn.
/// Changes nothing where there are enough, or none at all.
pub fn for_cameras(config: &mut ModelConfig, tensors: &mut Tensors, cameras: usize) -> Result<(), ModelError> {
    let Some(tokens) = tensors.get("affine_token").filter(|_| cameras > config.num_cams) else { return Ok(()) };
    let rows = (0..cameras).map(|k| tokens.narrow(1, k % config.num_cams, 1)).collect::<Result<Vec<_>, _>>()?;
    let more = Tensor::cat(&rows, 1)?;
    tensors.insert("affine_token".into(), more);
    config.num_cams = cameras;
    Ok(())
}

fn unwrapped(name: &str) -> &str {
    let mut name = name;
    while let Some(rest) = WRAPPERS.iter().find_map(|w| name.strip_prefix(w)) {
        name = rest;
    }
    name
}

/// The frozen `max_scale` of a set of weights, metres.
pub(crate) fn frozen_max_scale(tensors: &Tensors) -> Result<f64, ModelError> {
    let tensor = tensors.get("max_scale").ok_or_else(|| WeightsError::missing("max_scale"))?;
    let value = tensor.flatten_all()?.get(0)?.to_dtype(DType::F64)?.to_scalar::<f64>()?;
    if value.is_finite() && value > 0.0 {
        return Ok(value);
    }
    Err(WeightsError::tensor("max_scale", format!("is {value}, expected a positive number of metres")).into())
}

#[cfg(test)]
mod tests;
