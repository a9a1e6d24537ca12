//! Safetensors files: our own, with the configuration in the header, and anyone's under the same names.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::ops::Deref;
use std::path::Path;

use candle_core::Tensor;
use half::{bf16, f16};
use memmap2::Mmap;
use safetensors::tensor::{Dtype, SafeTensors, View};

use super::error::WeightsError;
use super::{MAX_TENSOR_BYTES, Source, Tensors};
use crate::config::ModelConfig;
use crate::error::ModelError;

/// Key of the configuration (JSON) in the header's metadata.
const CONFIG_KEY: &str = "storm_config";

/// Key of the free text on where the weights come from.
const PROVENANCE_KEY: &str = "provenance";

pub(super) struct SafetensorsFile {
    path: std::path::PathBuf,
    bytes: Bytes,
}

/// Where a file's bytes are.
enum Bytes {
    Mapped(Mmap),
    Built(&'static [u8]),
}

impl Deref for Bytes {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match self {
            Self::Mapped(map) => map,
            Self::Built(bytes) => bytes,
        }
    }
}

impl SafetensorsFile {
    pub fn open(path: &Path) -> Result<Self, WeightsError> {
        let file = File::open(path).map_err(|e| WeightsError::io(path, e))?;
        // SAFETY: the map is only read, as bytes, for as long as `self` lives; like every program that maps weights we
        // rely on nobody shortening the file meanwhile (we write files by renaming, never in place).
        let map = unsafe { Mmap::map(&file) }.map_err(|e| WeightsError::io(path, e))?;
        Self::checked(path, Bytes::Mapped(map))
    }

    /// A file that was built into the program; `name` is for messages.
    pub fn built_in(name: &str, bytes: &'static [u8]) -> Result<Self, WeightsError> {
        Self::checked(Path::new(name), Bytes::Built(bytes))
    }

    fn checked(path: &Path, bytes: Bytes) -> Result<Self, WeightsError> {
        let this = Self { path: path.to_owned(), bytes };
        this.parse()?;
        Ok(this)
    }

    /// The header is checked against the file's length here, so no view reaches past it.
    fn parse(&self) -> Result<SafeTensors<'_>, WeightsError> {
        SafeTensors::deserialize(&self.bytes)
            .map_err(|e| WeightsError::format(&self.path, format!("not valid safetensors: {e}")))
    }
}

impl Source for SafetensorsFile {
    fn shapes(&self) -> BTreeMap<String, Vec<usize>> {
        let Ok(tensors) = self.parse() else { return BTreeMap::new() };
        tensors.iter().map(|(name, view)| (name.to_owned(), view.shape().to_vec())).collect()
    }

    fn read(&mut self, name: &str) -> Result<Vec<f32>, WeightsError> {
        let tensors = self.parse()?;
        let view = tensors.tensor(name).map_err(|e| WeightsError::tensor(name, e.to_string()))?;
        let bytes = view.data();
        if bytes.len() > MAX_TENSOR_BYTES {
            return Err(WeightsError::tensor(name, format!("has {} bytes, more than any STORM", bytes.len())));
        }
        match view.dtype() {
            Dtype::F32 => Ok(bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()),
            Dtype::F16 => Ok(bytes.chunks_exact(2).map(|b| f16::from_le_bytes([b[0], b[1]]).to_f32()).collect()),
            Dtype::BF16 => Ok(bytes.chunks_exact(2).map(|b| bf16::from_le_bytes([b[0], b[1]]).to_f32()).collect()),
            other => Err(WeightsError::tensor(name, format!("has type {other:?}; f32, f16 and bf16 are read"))),
        }
    }

    fn config(&self) -> Result<Option<ModelConfig>, WeightsError> {
        let bad = |reason: String| WeightsError::format(&self.path, reason);
        let (_, metadata) = SafeTensors::read_metadata(&self.bytes).map_err(|e| bad(e.to_string()))?;
        let text = metadata.metadata().as_ref().and_then(|m| m.get(CONFIG_KEY));
        let parse = |text: &String| {
            serde_json::from_str(text).map_err(|e| bad(format!("metadata '{CONFIG_KEY}' is not a configuration: {e}")))
        };
        text.map(parse).transpose()
    }
}

/// The text on where weights come from, in the bytes of a safetensors file we wrote; `None` where there is none.
pub(crate) fn provenance(bytes: &[u8]) -> Option<String> {
    let (_, metadata) = SafeTensors::read_metadata(bytes).ok()?;
    metadata.metadata().as_ref()?.get(PROVENANCE_KEY).cloned()
}

/// Number type of a saved file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SavedType {
    /// 4 bytes per weight, exact.
    F32,
    /// 2 bytes per weight; `max_scale` stays f32.
    F16,
}

struct Saved {
    shape: Vec<usize>,
    dtype: Dtype,
    bytes: Vec<u8>,
}

impl View for &Saved {
    fn dtype(&self) -> Dtype {
        self.dtype
    }
    fn shape(&self) -> &[usize] {
        &self.shape
    }
    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(&self.bytes)
    }
    fn data_len(&self) -> usize {
        self.bytes.len()
    }
}

/// Writes weights with their configuration and a free text on where they come from. The file appears whole or not at
/// all (written beside its place, then renamed); the same weights give the same bytes.
///
/// # Errors
/// Tensors that do not make the configured network, a value that is not finite (or leaves f16's range), or no write access.
pub fn save_safetensors(
    path: &Path,
    config: &ModelConfig,
    tensors: &Tensors,
    dtype: SavedType,
    provenance: &str,
) -> Result<(), ModelError> {
    config.validate()?;
    super::check_shapes(config, tensors.iter().map(|(name, x)| (name.as_str(), x.dims())))?;
    let saved: Vec<(&str, Saved)> = tensors
        .iter()
        .map(|(name, x)| Ok((name.as_str(), encode(name, x, dtype)?)))
        .collect::<Result<_, ModelError>>()?;
    let json = serde_json::to_string(config).map_err(|e| WeightsError::format(path, e.to_string()))?;
    let mut metadata = HashMap::from([(CONFIG_KEY.to_owned(), json)]);
    if !provenance.is_empty() {
        metadata.insert(PROVENANCE_KEY.to_owned(), provenance.to_owned());
    }
    let parts = saved.iter().map(|(name, x)| (*name, x));
    let bytes = sorted_header(
        safetensors::serialize(parts, Some(metadata))
            .map_err(|e| WeightsError::format(path, format!("cannot be written: {e}")))?,
    );
    write_atomically(path, &bytes).map_err(|e| WeightsError::io(path, e))?;
    Ok(())
}

/// The library writes metadata in hash order, which differs between runs; with sorted keys files are reproducible.
fn sorted_header(bytes: Vec<u8>) -> Vec<u8> {
    let header = bytes.get(..8).and_then(|b| <[u8; 8]>::try_from(b).ok()).map(u64::from_le_bytes);
    let Some(end) = header.and_then(|n| usize::try_from(n).ok()).and_then(|n| n.checked_add(8)) else { return bytes };
    let Some(json) = bytes.get(8..end) else { return bytes };
    // Ordered maps; offsets are values, so the data stays where it is.
    type Header = BTreeMap<String, BTreeMap<String, serde_json::Value>>;
    let Ok(value) = serde_json::from_slice::<Header>(json) else { return bytes };
    let Ok(text) = serde_json::to_vec(&value) else { return bytes };
    let mut text = text;
    text.resize(text.len().next_multiple_of(8), b' ');
    let mut out = (text.len() as u64).to_le_bytes().to_vec();
    out.extend_from_slice(&text);
    out.extend_from_slice(&bytes[end..]);
    out
}

fn encode(name: &str, tensor: &Tensor, dtype: SavedType) -> Result<Saved, ModelError> {
    let values = tensor.to_dtype(candle_core::DType::F32)?.flatten_all()?.to_vec1::<f32>()?;
    let exact = dtype == SavedType::F32 || name == "max_scale";
    let count = if exact {
        values.iter().filter(|x| !x.is_finite()).count()
    } else {
        values.iter().filter(|&&x| !f16::from_f32(x).is_finite()).count()
    };
    if count > 0 {
        return Err(ModelError::NonFinite { tensor: name.to_owned(), count });
    }
    let (dtype, bytes) = if exact {
        (Dtype::F32, values.iter().flat_map(|x| x.to_le_bytes()).collect())
    } else {
        (Dtype::F16, values.iter().flat_map(|&x| f16::from_f32(x).to_le_bytes()).collect())
    };
    Ok(Saved { shape: tensor.dims().to_vec(), dtype, bytes })
}

fn write_atomically(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}.part", std::process::id()));
    let temporary = path.with_file_name(name);
    let result = std::fs::write(&temporary, bytes).and_then(|()| std::fs::rename(&temporary, path));
    if result.is_err() {
        // Nothing more can be done about a leftover; the first error is the one to report.
        let _ = std::fs::remove_file(&temporary);
    }
    result
}
