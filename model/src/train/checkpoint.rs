//! Training state as one safetensors file: weights, moments, moving average, and in the header the configuration, the
//! options and the step. Samples follow from the options' seed and the step, so nothing else is needed to go on exactly.

use std::collections::HashMap;
use std::path::Path;

use candle_core::{Device, Tensor};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};

use super::adamw::Slot;
use super::error::TrainError;
use super::options::TrainOptions;
use super::trainer::Trainer;
use crate::config::ModelConfig;
use crate::weights::Tensors;

/// Key of the state in the header's metadata.
const STATE_KEY: &str = "storm_training";

/// Version of the layout.
const VERSION: u32 = 1;

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct State {
    version: u32,
    step: u64,
    config: ModelConfig,
    options: TrainOptions,
}

impl Trainer {
    /// Writes the whole state; the file appears whole or not at all.
    pub fn save_checkpoint(&self, path: &Path) -> Result<(), TrainError> {
        let state = State {
            version: VERSION,
            step: self.steps_done(),
            config: ModelConfig::clone(self.config()),
            options: self.options().clone(),
        };
        let json = serde_json::to_string(&state).map_err(|e| TrainError::checkpoint(path, e))?;
        let (slots, frozen) = self.parts();
        let mut views = Vec::new();
        let frozen: Vec<(&String, Vec<usize>, Vec<f32>)> = frozen
            .iter()
            .map(|(name, x)| Ok((name, x.dims().to_vec(), x.flatten_all()?.to_vec1::<f32>()?)))
            .collect::<Result<_, TrainError>>()?;
        for (name, shape, values) in &frozen {
            views.push((format!("frozen.{name}"), shape.clone(), &values[..]));
        }
        for s in slots {
            for (part, values) in
                [("weight", &s.weight), ("first", &s.first), ("second", &s.second), ("average", &s.average)]
            {
                views.push((format!("{part}.{}", s.name), s.shape.clone(), &values[..]));
            }
        }
        let views = views
            .into_iter()
            .map(|(name, shape, values)| Ok((name, TensorView::new(Dtype::F32, shape, bytemuck::cast_slice(values))?)))
            .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()
            .map_err(|e| TrainError::checkpoint(path, e))?;
        // One metadata key, so the header does not depend on a hash map's order.
        let bytes = safetensors::serialize(views, Some(HashMap::from([(STATE_KEY.to_owned(), json)])))
            .map_err(|e| TrainError::checkpoint(path, e))?;
        write_atomically(path, &bytes).map_err(|e| TrainError::checkpoint(path, e))
    }

    /// Goes on where a checkpoint was written.
    pub fn resume(path: &Path, device: &Device) -> Result<Self, TrainError> {
        let bad = |reason: String| TrainError::checkpoint(path, reason);
        let bytes = std::fs::read(path).map_err(|e| bad(e.to_string()))?;
        let (_, metadata) = SafeTensors::read_metadata(&bytes).map_err(|e| bad(e.to_string()))?;
        let json = metadata.metadata().as_ref().and_then(|m| m.get(STATE_KEY));
        let json = json.ok_or_else(|| bad("no training state inside; start from weights with --weights".into()))?;
        let state: State = serde_json::from_str(json).map_err(|e| bad(format!("training state: {e}")))?;
        if state.version != VERSION {
            return Err(bad(format!("has layout {}, this program reads {VERSION}", state.version)));
        }
        let file = SafeTensors::deserialize(&bytes).map_err(|e| bad(e.to_string()))?;
        let read = |name: &str| -> Result<(Vec<usize>, Vec<f32>), TrainError> {
            let view = file.tensor(name).map_err(|e| bad(format!("{name}: {e}")))?;
            if view.dtype() != Dtype::F32 {
                return Err(bad(format!("{name} is {:?}, expected f32", view.dtype())));
            }
            let values: Vec<f32> =
                view.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            if values.iter().any(|x| !x.is_finite()) {
                return Err(bad(format!("{name} holds a value that is not finite")));
            }
            Ok((view.shape().to_vec(), values))
        };
        let mut names: Vec<&str> = file.names().into_iter().collect();
        names.sort_unstable();
        let (mut slots, mut frozen) = (Vec::new(), Tensors::new());
        for name in names {
            if let Some(own) = name.strip_prefix("frozen.") {
                let (shape, values) = read(name)?;
                frozen.insert(own.to_owned(), Tensor::from_vec(values, shape, device)?);
            } else if let Some(own) = name.strip_prefix("weight.") {
                let (shape, weight) = read(name)?;
                let mut slot = Slot::new(own, &shape, weight);
                for (part, place) in
                    [("first", &mut slot.first), ("second", &mut slot.second), ("average", &mut slot.average)]
                {
                    let (other, values) = read(&format!("{part}.{own}"))?;
                    if other != shape {
                        return Err(bad(format!("{part}.{own} has shape {other:?}, the weight {shape:?}")));
                    }
                    *place = values;
                }
                slots.push(slot);
            }
        }
        Self::assemble(&state.config, slots, frozen, state.options, state.step, device)
    }
}

/// The text on where weights come from, in a safetensors file we wrote; `None` where there is none.
pub fn provenance(path: &Path) -> Option<String> {
    crate::weights::provenance(&std::fs::read(path).ok()?)
}

fn write_atomically(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    use std::io::Write;
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}.part", std::process::id()));
    let temporary = path.with_file_name(name);
    let write = || {
        let mut file = std::fs::File::create(&temporary)?;
        file.write_all(bytes)?;
        // The rename must not reach the disk before the content does.
        file.sync_all()?;
        std::fs::rename(&temporary, path)
    };
    let result = write();
    if result.is_err() {
        // Nothing more can be done about a leftover; the first error is the one to report.
        let _ = std::fs::remove_file(&temporary);
    }
    result
}
