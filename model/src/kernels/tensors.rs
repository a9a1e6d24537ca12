//! Between candle's tensors and the kernels' slices.

use candle_core::{CpuStorage, DType, Layout, Result, Storage, Tensor};

/// Whether the kernels cover `tensors`: f32, on the CPU.
pub(crate) fn covered<'a>(tensors: impl IntoIterator<Item = &'a Tensor>) -> bool {
    tensors.into_iter().all(|t| t.dtype() == DType::F32 && t.device().is_cpu())
}

/// Whether any of `tensors` is part of a gradient's graph.
pub(crate) fn tracked<'a>(tensors: impl IntoIterator<Item = &'a Tensor>) -> bool {
    tensors.into_iter().any(Tensor::track_op)
}

/// The values of a contiguous f32 tensor on the CPU, in its storage.
fn slice<'a>(tensor: &Tensor, storage: &'a Storage, layout: &Layout) -> Result<&'a [f32]> {
    let Storage::Cpu(CpuStorage::F32(values)) = storage else {
        candle_core::bail!("kernels take f32 on the CPU, this is {:?} on {:?}", tensor.dtype(), tensor.device())
    };
    let Some((start, end)) = layout.contiguous_offsets() else {
        candle_core::bail!("tensor of {:?} is not contiguous after being made so", tensor.dims())
    };
    match values.get(start..end) {
        Some(values) => Ok(values),
        None => candle_core::bail!("layout {start}..{end} is outside the storage of {} values", values.len()),
    }
}

/// Runs `f` on the values of a [`covered`] tensor, in row-major order (copied first if they do not lie so).
pub(crate) fn with_values<R>(tensor: &Tensor, f: impl FnOnce(&[f32]) -> Result<R>) -> Result<R> {
    let tensor = tensor.contiguous()?;
    let (storage, layout) = tensor.storage_and_layout();
    f(slice(&tensor, &storage, layout)?)
}

/// As [`with_values`], for one that may be absent.
pub(crate) fn with_optional<R>(tensor: Option<&Tensor>, f: impl FnOnce(Option<&[f32]>) -> Result<R>) -> Result<R> {
    match tensor {
        Some(tensor) => with_values(tensor, |values| f(Some(values))),
        None => f(None),
    }
}

/// As [`with_values`], for any number.
pub(crate) fn with_each<R>(tensors: &[&Tensor], f: impl FnOnce(&[&[f32]]) -> Result<R>) -> Result<R> {
    let tensors = tensors.iter().map(|t| t.contiguous()).collect::<Result<Vec<_>>>()?;
    let guards: Vec<_> = tensors.iter().map(Tensor::storage_and_layout).collect();
    let values = tensors.iter().zip(&guards).map(|(t, (storage, layout))| slice(t, storage, layout));
    f(&values.collect::<Result<Vec<_>>>()?)
}

/// As [`with_values`], for several.
pub(crate) fn with_all<const N: usize, R>(
    tensors: [&Tensor; N],
    f: impl FnOnce([&[f32]; N]) -> Result<R>,
) -> Result<R> {
    let tensors = tensors.iter().map(|t| t.contiguous()).collect::<Result<Vec<_>>>()?;
    let guards: Vec<_> = tensors.iter().map(Tensor::storage_and_layout).collect();
    let mut values = [&[][..]; N];
    for ((to, tensor), (storage, layout)) in values.iter_mut().zip(&tensors).zip(&guards) {
        *to = slice(tensor, storage, layout)?;
    }
    f(values)
}
