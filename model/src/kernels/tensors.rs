//! Between candle's tensors and the kernels' slices.

use candle_core::{CpuStorage, DType, Result, Storage, Tensor};

/// Whether the kernels cover `tensors`: f32, on the CPU, none of them part of a gradient's graph.
pub(crate) fn covered<'a>(tensors: impl IntoIterator<Item = &'a Tensor>) -> bool {
    tensors.into_iter().all(|t| t.dtype() == DType::F32 && t.device().is_cpu() && !t.track_op())
}

/// Runs `f` on the values of a [`covered`] tensor, in row-major order (copied first if they do not lie so).
pub(crate) fn with_values<R>(tensor: &Tensor, f: impl FnOnce(&[f32]) -> Result<R>) -> Result<R> {
    let tensor = tensor.contiguous()?;
    let (storage, layout) = tensor.storage_and_layout();
    let Storage::Cpu(CpuStorage::F32(values)) = &*storage else {
        candle_core::bail!("kernels take f32 on the CPU, this is {:?} on {:?}", tensor.dtype(), tensor.device())
    };
    let Some((start, end)) = layout.contiguous_offsets() else {
        candle_core::bail!("tensor of {:?} is not contiguous after being made so", tensor.dims())
    };
    match values.get(start..end) {
        Some(values) => f(values),
        None => candle_core::bail!("layout {start}..{end} is outside the storage of {} values", values.len()),
    }
}

/// As [`with_values`], for one that may be absent.
pub(crate) fn with_optional<R>(tensor: Option<&Tensor>, f: impl FnOnce(Option<&[f32]>) -> Result<R>) -> Result<R> {
    match tensor {
        Some(tensor) => with_values(tensor, |values| f(Some(values))),
        None => f(None),
    }
}
