//! The slow, obvious versions of the network's operations, in candle's own ops: the reference the kernels are tested
//! against, and the path taken on devices and types the kernels do not cover.

use candle_core::{D, Result, Tensor};

use crate::ops::{Activation, Linear};

/// Multi-head self-attention (paper section 3.1, "Transformer"): `softmax(q k^T / sqrt(head_dim)) v`.
///
/// `qkv` is `(b, n, 3 * heads * head_dim)` with rows `[q | k | v]`, each split into heads; the result `(b, n, heads * head_dim)`.
pub fn attention(qkv: &Tensor, heads: usize) -> Result<Tensor> {
    let (b, n, d3) = qkv.dims3()?;
    let head_dim = d3 / 3 / heads;
    let parts = qkv.reshape((b, n, 3, heads, head_dim))?.permute((2, 0, 3, 1, 4))?;
    let q = (parts.get(0)?.contiguous()? * (head_dim as f64).powf(-0.5))?;
    let k = parts.get(1)?.contiguous()?;
    let v = parts.get(2)?.contiguous()?;
    let logits = q.matmul(&k.transpose(2, 3)?.contiguous()?)?;
    let weights = candle_nn::ops::softmax(&logits, D::Minus1)?;
    weights.matmul(&v)?.transpose(1, 2)?.reshape((b, n, heads * head_dim))
}

/// [`attention`] of queries `(b, n, heads * head_dim)` on other tokens' keys and values `(b, m, 2 * heads * head_dim)`, rows
/// `[k | v]`. A key that stands for `sizes[i]` tokens counts as many times (Bolya et al., "Token Merging", 2023, section 3).
pub fn cross_attention(queries: &Tensor, keys_values: &Tensor, sizes: Option<&[f32]>, heads: usize) -> Result<Tensor> {
    let (b, n, d) = queries.dims3()?;
    let (m, head_dim) = (keys_values.dim(1)?, d / heads);
    let q = queries.reshape((b, n, heads, head_dim))?.transpose(1, 2)?.contiguous()?;
    let q = (q * (head_dim as f64).powf(-0.5))?;
    let parts = keys_values.reshape((b, m, 2, heads, head_dim))?.permute((2, 0, 3, 1, 4))?;
    let (k, v) = (parts.get(0)?.contiguous()?, parts.get(1)?.contiguous()?);
    let logits = q.matmul(&k.transpose(2, 3)?.contiguous()?)?;
    let logits = match sizes {
        Some(sizes) => {
            let sizes = Tensor::from_slice(sizes, m, q.device())?.to_dtype(q.dtype())?;
            logits.broadcast_add(&sizes.log()?)?
        }
        None => logits,
    };
    let weights = candle_nn::ops::softmax(&logits, D::Minus1)?;
    weights.matmul(&v)?.transpose(1, 2)?.reshape((b, n, d))
}

/// `act(x w^T + bias) + residual`; `x` is `(..., k)`, `w` `(n, k)`.
pub fn linear(x: &Tensor, layer: &Linear, act: Activation, residual: Option<&Tensor>) -> Result<Tensor> {
    let dims = x.dims().to_vec();
    let k = dims[dims.len() - 1];
    let y = x.reshape(((), k))?.matmul(&layer.weight.t()?)?;
    let y = match &layer.bias {
        Some(bias) => y.broadcast_add(bias)?,
        None => y,
    };
    let y = match act {
        Activation::None => y,
        Activation::Gelu => y.gelu_erf()?,
        Activation::Silu => y.silu()?,
    };
    let mut out = dims;
    if let Some(last) = out.last_mut() {
        *last = layer.weight.dim(0)?;
    }
    let y = y.reshape(out)?;
    match residual {
        Some(r) => y + r,
        None => Ok(y),
    }
}

/// Layer norm over the last axis, with or without learned gain and offset.
pub fn layer_norm(x: &Tensor, weight: Option<&Tensor>, bias: Option<&Tensor>, eps: f64) -> Result<Tensor> {
    let mean = x.mean_keepdim(D::Minus1)?;
    let centred = x.broadcast_sub(&mean)?;
    let var = centred.sqr()?.mean_keepdim(D::Minus1)?;
    let y = centred.broadcast_div(&(var + eps)?.sqrt()?)?;
    let y = match weight {
        Some(w) => y.broadcast_mul(w)?,
        None => y,
    };
    match bias {
        Some(b) => y.broadcast_add(b),
        None => Ok(y),
    }
}

/// `softmax(x / tau)` over the last axis.
pub fn softmax(x: &Tensor, tau: f64) -> Result<Tensor> {
    candle_nn::ops::softmax(&(x / tau)?, D::Minus1)
}
