//! PyTorch checkpoints: a zip with a pickle of the structure and one entry per storage.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use half::{bf16, f16};
use zip::{CompressionMethod, ZipArchive};

use super::error::WeightsError;
use super::pickle::{Id, Node, Pickle};
use super::{MAX_TENSOR_BYTES, Source};
use crate::config::ModelConfig;

/// Largest pickle read: STORM's, optimiser included, is under 1 MB.
const MAX_PICKLE_BYTES: u64 = 64 << 20;

/// Keys under which training checkpoints keep the network; the first one found is read, everything else ignored.
const MODEL_KEYS: [&str; 3] = ["model", "state_dict", "model_state_dict"];

/// Most axes of a tensor.
const MAX_AXES: usize = 8;

#[derive(Debug, Clone, Copy)]
enum Number {
    F32,
    F16,
    Bf16,
}

impl Number {
    fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::F16 | Self::Bf16 => 2,
        }
    }

    fn read(self, b: &[u8]) -> f32 {
        match self {
            Self::F32 => f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
            Self::F16 => f16::from_le_bytes([b[0], b[1]]).to_f32(),
            Self::Bf16 => bf16::from_le_bytes([b[0], b[1]]).to_f32(),
        }
    }
}

/// Where a tensor's numbers lie.
#[derive(Debug, Clone)]
struct TensorRef {
    storage: String,
    /// The storage's class, e.g. `FloatStorage`.
    class: String,
    numel: usize,
    offset: usize,
    shape: Vec<usize>,
    strides: Vec<usize>,
}

pub(super) struct TorchFile {
    path: PathBuf,
    zip: ZipArchive<BufReader<File>>,
    /// Folder all entries are in.
    folder: String,
    tensors: BTreeMap<String, TensorRef>,
}

impl TorchFile {
    pub fn open(path: &Path) -> Result<Self, WeightsError> {
        let bad = |reason: String| WeightsError::format(path, reason);
        let file = File::open(path).map_err(|e| WeightsError::io(path, e))?;
        let mut zip = ZipArchive::new(BufReader::new(file)).map_err(|e| bad(format!("damaged zip: {e}")))?;
        let is_pickle = |n: &String| n == "data.pkl" || n.ends_with("/data.pkl");
        let pickle_name = zip.file_names().filter_map(|n| Some(n.ok()?.into_owned())).find(is_pickle);
        let name = pickle_name.ok_or_else(|| bad("a zip without data.pkl: not saved by torch.save".into()))?;
        let folder = name.trim_end_matches("data.pkl").to_owned();
        // Files from before PyTorch 2.1 have no such entry and are little-endian.
        if entry(&mut zip, &format!("{folder}byteorder"), 16).is_ok_and(|order| order != b"little") {
            return Err(bad("was saved on a big-endian machine; save it on a little-endian one".into()));
        }
        let bytes = entry(&mut zip, &name, MAX_PICKLE_BYTES).map_err(bad)?;
        let pickle = Pickle::read(&bytes).map_err(|e| bad(format!("at byte {} of its pickle: {}", e.at, e.reason)))?;
        let tensors = state_dict(path, &pickle)?;
        Ok(Self { path: path.to_owned(), zip, folder, tensors })
    }
}

/// A whole entry; its size is checked against `limit` before anything is allocated.
fn entry(zip: &mut ZipArchive<BufReader<File>>, name: &str, limit: u64) -> Result<Vec<u8>, String> {
    let entry = zip.by_name(name).map_err(|e| format!("entry '{name}': {e}"))?;
    if entry.compression() != CompressionMethod::Stored {
        return Err(format!("entry '{name}' is compressed, which torch.save never does"));
    }
    let size = entry.size();
    if size > limit {
        return Err(format!("entry '{name}' has {size} bytes, more than the {limit} expected at most"));
    }
    // Stored entries are as long in the file as in memory, so a lying size ends at the end of the file.
    let mut bytes = Vec::new();
    entry.take(limit).read_to_end(&mut bytes).map_err(|e| format!("entry '{name}': {e}"))?;
    if bytes.len() as u64 == size { Ok(bytes) } else { Err(format!("entry '{name}' is cut off")) }
}

fn state_dict(path: &Path, pickle: &Pickle) -> Result<BTreeMap<String, TensorRef>, WeightsError> {
    let root = pickle.root();
    let dict = MODEL_KEYS.iter().find_map(|key| pickle.item(root, key)).unwrap_or(root);
    let Node::Dict(items) = pickle.node(dict) else {
        let reason = "holds no state dict; save model.state_dict(), alone or under the key 'model'";
        return Err(WeightsError::format(path, reason));
    };
    let mut tensors = BTreeMap::new();
    for &(key, value) in items {
        let Node::Str(name) = pickle.node(key) else {
            return Err(WeightsError::format(path, "a tensor's name is no string"));
        };
        let Node::Tensor(args) = *pickle.node(value) else {
            return Err(WeightsError::tensor(name, "is not a tensor; a state dict has only tensors"));
        };
        let tensor = tensor_ref(pickle, args).map_err(|reason| WeightsError::tensor(name, reason))?;
        tensors.insert(name.clone(), tensor);
    }
    if tensors.is_empty() {
        return Err(WeightsError::format(path, "its state dict is empty"));
    }
    Ok(tensors)
}

/// Reads `(storage, offset, shape, strides, ...)` and proves that every element lies inside the storage.
fn tensor_ref(pickle: &Pickle, args: Id) -> Result<TensorRef, String> {
    let tuple = |id: Id| match pickle.node(id) {
        Node::Tuple(ids) => Ok(ids.as_slice()),
        other => Err(format!("expected a tuple, found {other:?}")),
    };
    let number = |id: Id| match *pickle.node(id) {
        Node::Int(n) => usize::try_from(n).map_err(|_| format!("has a negative size {n}")),
        _ => Err("has a size that is no number".into()),
    };
    let numbers = |id: Id| tuple(id)?.iter().map(|&n| number(n)).collect::<Result<Vec<_>, String>>();
    let &[storage, offset, shape, strides, ..] = tuple(args)? else {
        return Err("has too few arguments".into());
    };
    let Node::Storage(storage) = *pickle.node(storage) else { return Err("has no storage".into()) };
    let &[_, class, key, _, numel, ..] = tuple(storage)? else { return Err("has an unknown kind of storage".into()) };
    let (Node::Class(_, class), Node::Str(key)) = (pickle.node(class), pickle.node(key)) else {
        return Err("has an unknown kind of storage".into());
    };
    let (shape, strides) = (numbers(shape)?, numbers(strides)?);
    let (offset, numel) = (number(offset)?, number(numel)?);
    if shape.len() != strides.len() || shape.len() > MAX_AXES {
        return Err(format!("has shape {shape:?} and strides {strides:?}"));
    }
    let count = shape.iter().try_fold(1usize, |n, &side| n.checked_mul(side));
    let last = shape
        .iter()
        .zip(&strides)
        .try_fold(offset, |at, (&side, &stride)| at.checked_add(side.saturating_sub(1).checked_mul(stride)?));
    match (count, last) {
        // Fewer elements than the storage also rules out axes repeated with stride 0, whose size nothing would bound.
        (Some(count), Some(last)) if count <= numel && (last < numel || count == 0) => {
            Ok(TensorRef { storage: key.clone(), class: class.clone(), numel, offset, shape, strides })
        }
        _ => Err(format!("with shape {shape:?} does not fit its storage of {numel} numbers")),
    }
}

impl Source for TorchFile {
    fn shapes(&self) -> BTreeMap<String, Vec<usize>> {
        self.tensors.iter().map(|(name, tensor)| (name.clone(), tensor.shape.clone())).collect()
    }

    fn read(&mut self, name: &str) -> Result<Vec<f32>, WeightsError> {
        let bad = |reason: String| WeightsError::tensor(name, reason);
        let tensor = self.tensors.get(name).ok_or_else(|| WeightsError::missing(name))?;
        let number = match tensor.class.as_str() {
            "FloatStorage" => Number::F32,
            "HalfStorage" => Number::F16,
            "BFloat16Storage" => Number::Bf16,
            other => return Err(bad(format!("has type {other}; float32, float16 and bfloat16 are read"))),
        };
        let expected = tensor.numel.checked_mul(number.bytes()).filter(|&n| n <= MAX_TENSOR_BYTES);
        let expected = expected.ok_or_else(|| bad(format!("claims {} numbers, more than any STORM", tensor.numel)))?;
        let name = format!("{}data/{}", self.folder, tensor.storage);
        let bytes = entry(&mut self.zip, &name, MAX_TENSOR_BYTES as u64).map_err(bad)?;
        if bytes.len() < expected {
            return Err(bad(format!("needs {expected} bytes, '{}' has {} of it", self.path.display(), bytes.len())));
        }
        Ok(gather(tensor, number, &bytes))
    }

    fn config(&self) -> Result<Option<ModelConfig>, WeightsError> {
        Ok(None)
    }
}

/// The tensor's elements in row-major order; all lie inside `bytes` by [`tensor_ref`]'s check.
fn gather(tensor: &TensorRef, number: Number, bytes: &[u8]) -> Vec<f32> {
    let count: usize = tensor.shape.iter().product();
    let size = number.bytes();
    if count == 0 {
        return Vec::new();
    }
    let mut step = 1;
    let row_major = tensor.shape.iter().zip(&tensor.strides).rev().all(|(&side, &stride)| {
        let expected = step;
        step *= side;
        side == 1 || stride == expected
    });
    if row_major {
        let own = &bytes[tensor.offset * size..(tensor.offset + count) * size];
        return own.chunks_exact(size).map(|b| number.read(b)).collect();
    }
    let mut index = vec![0usize; tensor.shape.len()];
    let mut out = Vec::with_capacity(count);
    for _ in 0..count {
        let at = tensor.offset + index.iter().zip(&tensor.strides).map(|(i, s)| i * s).sum::<usize>();
        out.push(number.read(&bytes[at * size..(at + 1) * size]));
        for axis in (0..index.len()).rev() {
            index[axis] += 1;
            if index[axis] < tensor.shape[axis] {
                break;
            }
            index[axis] = 0;
        }
    }
    out
}
