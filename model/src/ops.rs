//! The operations the network is written in. Each picks the kernel where one covers the device and type, else the
//! plain candle version in [`crate::plain`].
//!
//! Kernels ([`crate::kernels`]) take f32 tensors on the CPU; tensors that do not lie in row-major order are copied first.
//! Tensors that carry gradients (a variable, or a tensor computed from one) take the same kernels and become nodes of
//! candle's graph, whose `backward` runs kernels too. Other types (f64, f16, bf16) and devices go to [`crate::plain`].
//!
//! Gradients are first order: the gradient of a gradient is not tracked. Inference with weights that are variables packs
//! them at every use and keeps what a backward pass would need: detach them once (`Tensor::detach`) when the model is
//! loaded for inference alone.

mod arrange;
mod chain;
mod graph;
mod precision;
mod process;
mod training;

use std::sync::{Arc, OnceLock};

use candle_core::{D, Result, Tensor, TensorId};

use crate::kernels::attention::{Inputs, Rows, Shape};
use crate::kernels::gemm::{self, Epilogue, PackedWeight};
use crate::kernels::tensors::{covered, tracked, with_all, with_optional, with_values};
use crate::kernels::{self, Isa};
use crate::plain;
use process::zeros;

pub(crate) use arrange::{gaussians, patches, unnest};
pub use chain::{Step, chain};
pub use precision::Precision;
pub use process::{give_back_freed_memory, keep_freed_memory, set_up_training, share_one_heap};

/// A linear layer: weight `(out, in)` as PyTorch stores it, optional bias `(out)`.
///
/// The kernel's layout of the weight is made at first use and shared by clones (it doubles the layer's memory). It
/// belongs to this `weight` tensor: replacing the field is noticed, but writing into the storage of a tensor detached
/// from a variable is not, so make a new `Linear` after such a change. For a weight that carries gradients nothing is
/// kept: an optimiser's step in place is seen by the next use.
#[derive(Debug, Clone)]
pub struct Linear {
    /// `(out, in)`.
    pub weight: Tensor,
    /// `(out)`.
    pub bias: Option<Tensor>,
    precision: Precision,
    /// By precision.
    packed: Arc<[Packing; Precision::ALL.len()]>,
}

/// A kernel's layout, once made, and the weight it was made of.
type Packing = OnceLock<(TensorId, Arc<PackedWeight>)>;

impl Linear {
    /// A layer of a weight `(out, in)` and a bias `(out)`.
    pub fn new(weight: Tensor, bias: Option<Tensor>) -> Self {
        Self { weight, bias, precision: Precision::F32, packed: Arc::default() }
    }

    /// The same layer, its products taken in this precision.
    #[must_use]
    pub fn at(&self, precision: Precision) -> Self {
        Self { precision, ..self.clone() }
    }

    /// Makes the kernel's layout now, so that the first step is not slower than the others. Nothing to do for weights
    /// the kernels do not cover.
    pub fn prepare(&self) -> Result<()> {
        match covered([&self.weight]) && !self.weight.track_op() {
            true => self.packed().map(drop),
            false => Ok(()),
        }
    }

    fn pack(&self) -> Result<Arc<PackedWeight>> {
        let (n, k) = self.weight.dims2()?;
        let precision = if self.weight.track_op() { Precision::F32 } else { self.precision };
        with_values(&self.weight, |values| {
            Ok(Arc::new(PackedWeight::in_precision(Isa::detect(), precision, values, n, k)))
        })
    }

    /// The kernel's layout of the weight as it is now.
    fn packed(&self) -> Result<Arc<PackedWeight>> {
        if self.weight.track_op() {
            return self.pack();
        }
        let id = self.weight.id();
        let slot = &self.packed[self.precision as usize];
        if slot.get().is_none() {
            // Two threads may both get here; the first to finish wins and the other's work is dropped.
            let _ = slot.set((id, self.pack()?));
        }
        match slot.get() {
            Some((packed_id, packed)) if *packed_id == id => Ok(Arc::clone(packed)),
            _ => self.pack(),
        }
    }

    fn with_parts<R>(&self, f: impl FnOnce(&PackedWeight, Option<&[f32]>) -> Result<R>) -> Result<R> {
        with_optional(self.bias.as_ref(), |bias| f(&*self.packed()?, bias))
    }

    /// Whether weight and bias fit each other and an input of these dimensions.
    fn takes(&self, dims: &[usize]) -> bool {
        match (self.weight.dims(), dims.last()) {
            (&[n, k], Some(&last)) => k == last && self.bias.as_ref().is_none_or(|b| b.dims() == [n]),
            _ => false,
        }
    }
}

/// What follows a linear layer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Activation {
    /// Nothing.
    None,
    /// Exact (erf) GELU.
    Gelu,
    /// `x * sigmoid(x)`.
    Silu,
}

/// See [`plain::attention`]. The kernel never holds the `n x n` weights.
pub fn attention(qkv: &Tensor, heads: usize) -> Result<Tensor> {
    attention_at(qkv, heads, Precision::F32)
}

/// The same with products in this precision.
pub fn attention_at(qkv: &Tensor, heads: usize, precision: Precision) -> Result<Tensor> {
    let (batch, tokens, d3) = qkv.dims3()?;
    if heads == 0 || d3 == 0 || d3 % (3 * heads) != 0 {
        candle_core::bail!("attention: {d3} channels are not 3 x {heads} heads x a whole head size");
    }
    if !covered([qkv]) || batch * tokens == 0 {
        return plain::attention(qkv, heads);
    }
    let shape = Shape { batch, tokens, heads, head_dim: d3 / 3 / heads };
    if qkv.track_op() {
        return training::attention(qkv, shape);
    }
    let mut out = zeros(batch * tokens * d3 / 3);
    with_values(qkv, |values| {
        let rows = |part: usize| Rows { values, stride: d3, first: part * d3 / 3 };
        let inputs = Inputs { queries: rows(0), keys: rows(1), values: rows(2), count: tokens, bias: None };
        attend(precision, &inputs, shape, &mut out);
        Ok(())
    })?;
    Tensor::from_vec(out, (batch, tokens, d3 / 3), qkv.device())
}

fn attend(precision: Precision, inputs: &Inputs<'_>, shape: Shape, out: &mut [f32]) {
    match precision {
        Precision::F32 => kernels::attention::attention_of(Isa::detect(), inputs, shape, out),
        Precision::Bf16 => kernels::attention::attention_in_bf16(Isa::detect(), inputs, shape, out),
        Precision::Int16 | Precision::Int8 => kernels::attention::attention_in_pairs(Isa::detect(), inputs, shape, out),
    }
}

/// See [`plain::cross_attention`]; products in this precision.
pub fn cross_attention(
    queries: &Tensor,
    keys_values: &Tensor,
    sizes: Option<&[f32]>,
    heads: usize,
    precision: Precision,
) -> Result<Tensor> {
    let (batch, tokens, d) = queries.dims3()?;
    let (b, count, d2) = keys_values.dims3()?;
    if heads == 0 || d == 0 || d % heads != 0 || d2 != 2 * d || b != batch || count == 0 {
        candle_core::bail!(
            "attention: queries {:?} of {heads} heads and keys with values {:?}",
            queries.dims(),
            keys_values.dims()
        );
    }
    if let Some(sizes) = sizes
        && sizes.len() != count
    {
        candle_core::bail!("attention: {} sizes for {count} keys", sizes.len());
    }
    let inputs = [queries, keys_values];
    if !covered(inputs) || tracked(inputs) || queries.elem_count() == 0 {
        return plain::cross_attention(queries, keys_values, sizes, heads);
    }
    let shape = Shape { batch, tokens, heads, head_dim: d / heads };
    let bias: Option<Vec<f32>> = sizes.map(|sizes| sizes.iter().map(|s| s.log2()).collect());
    let mut out = zeros(queries.elem_count());
    with_all(inputs, |[queries, kv]| {
        let half = |first: usize| Rows { values: kv, stride: d2, first };
        let queries = Rows { values: queries, stride: d, first: 0 };
        let inputs = Inputs { queries, keys: half(0), values: half(d), count, bias: bias.as_deref() };
        attend(precision, &inputs, shape, &mut out);
        Ok(())
    })?;
    Tensor::from_vec(out, (batch, tokens, d), queries.device())
}

/// See [`plain::linear`]. The kernel adds the bias, the activation and the residual while the sums are in cache.
pub fn linear(x: &Tensor, layer: &Linear, act: Activation, residual: Option<&Tensor>) -> Result<Tensor> {
    let (n, k) = layer.weight.dims2()?;
    let mut dims = x.dims().to_vec();
    match dims.last_mut() {
        Some(last) if *last == k => *last = n,
        _ => candle_core::bail!("linear: input {:?} does not end in the weight's {k} inputs", x.dims()),
    }
    if let Some(bias) = &layer.bias
        && bias.dims() != [n]
    {
        candle_core::bail!("linear: bias {:?} for {n} outputs", bias.dims());
    }
    let same_shape = residual.is_none_or(|r| r.dims() == dims);
    let inputs = [Some(x), Some(&layer.weight), layer.bias.as_ref(), residual];
    if !same_shape || x.elem_count() == 0 || n == 0 || !covered(inputs.into_iter().flatten()) {
        return plain::linear(x, layer, act, residual);
    }
    if tracked(inputs.into_iter().flatten()) {
        return training::linear(x, layer, act, residual, &dims);
    }
    let mut out = zeros(dims.iter().product());
    with_values(x, |x| {
        with_optional(residual, |residual| {
            layer.with_parts(|packed, bias| {
                gemm::linear(x, packed, Epilogue { bias, act, residual }, &mut out);
                Ok(())
            })
        })
    })?;
    Tensor::from_vec(out, dims, x.device())
}

/// `linear(linear(x, first, act), second) + residual`. The kernel goes through both layers a block of rows at a time, so the
/// wide tensor between them is never in memory.
pub fn mlp(x: &Tensor, first: &Linear, act: Activation, second: &Linear, residual: Option<&Tensor>) -> Result<Tensor> {
    let mut dims = x.dims().to_vec();
    let n = second.weight.dim(0)?;
    if let Some(last) = dims.last_mut() {
        *last = n;
    }
    let inputs =
        [Some(x), Some(&first.weight), first.bias.as_ref(), Some(&second.weight), second.bias.as_ref(), residual];
    let fits = first.takes(x.dims())
        && second.takes(first.weight.dims().get(..1).unwrap_or_default())
        && residual.is_none_or(|r| r.dims() == dims);
    if !fits || x.elem_count() == 0 || second.weight.elem_count() == 0 || !covered(inputs.into_iter().flatten()) {
        return linear(&linear(x, first, act, None)?, second, Activation::None, residual);
    }
    if tracked(inputs.into_iter().flatten()) {
        return training::mlp(x, first, act, second, residual, &dims);
    }
    let mut out = zeros(dims.iter().product());
    with_values(x, |x| {
        with_optional(residual, |residual| {
            first.with_parts(|w1, bias| {
                let one = Epilogue { bias, act, residual: None };
                second.with_parts(|w2, bias| {
                    let two = Epilogue { bias, act: Activation::None, residual };
                    gemm::mlp(x, (w1, one), (w2, two), &mut out);
                    Ok(())
                })
            })
        })
    })?;
    Tensor::from_vec(out, dims, x.device())
}

/// See [`plain::layer_norm`]. The kernel takes mean and variance in f64.
pub fn layer_norm(x: &Tensor, weight: Option<&Tensor>, bias: Option<&Tensor>, eps: f64) -> Result<Tensor> {
    let width = x.dim(D::Minus1)?;
    for (name, learned) in [("weight", weight), ("bias", bias)] {
        if let Some(learned) = learned
            && learned.dims() != [width]
        {
            candle_core::bail!("layer norm: {name} {:?} for rows of {width}", learned.dims());
        }
    }
    if x.elem_count() == 0 || !covered([Some(x), weight, bias].into_iter().flatten()) {
        return plain::layer_norm(x, weight, bias, eps);
    }
    if tracked([Some(x), weight, bias].into_iter().flatten()) {
        return training::layer_norm(x, weight, bias, eps);
    }
    let mut out = zeros(x.elem_count());
    with_values(x, |x| {
        with_optional(weight, |weight| {
            with_optional(bias, |bias| {
                kernels::norm::layer_norm(Isa::detect(), x, width, weight, bias, eps, &mut out);
                Ok(())
            })
        })
    })?;
    Tensor::from_vec(out, x.dims(), x.device())
}

/// Exact (erf) GELU of every element.
pub fn gelu(x: &Tensor) -> Result<Tensor> {
    match covered([x]) {
        true => map(x, Activation::Gelu),
        false => x.gelu_erf(),
    }
}

/// `x * sigmoid(x)` of every element.
pub fn silu(x: &Tensor) -> Result<Tensor> {
    match covered([x]) {
        true => map(x, Activation::Silu),
        false => x.silu(),
    }
}

fn map(x: &Tensor, act: Activation) -> Result<Tensor> {
    if x.track_op() {
        return training::map(x, act);
    }
    let mut out = zeros(x.elem_count());
    with_values(x, |values| {
        kernels::rows::activate(Isa::detect(), act, values, None, &mut out);
        Ok(())
    })?;
    Tensor::from_vec(out, x.dims(), x.device())
}

/// `softmax(x / tau)` over the last axis (motion weights: paper section 3.2, `tau` 0.5).
pub fn softmax(x: &Tensor, tau: f64) -> Result<Tensor> {
    let width = x.dim(D::Minus1)?;
    if x.elem_count() == 0 || !covered([x]) {
        return plain::softmax(x, tau);
    }
    if x.track_op() {
        return training::softmax(x, tau);
    }
    let mut out = zeros(x.elem_count());
    with_values(x, |values| {
        kernels::rows::softmax(Isa::detect(), values, width, tau as f32, &mut out);
        Ok(())
    })?;
    Tensor::from_vec(out, x.dims(), x.device())
}

#[cfg(test)]
mod gradient_tests;
#[cfg(test)]
mod tests;
