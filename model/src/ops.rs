//! The operations the network is written in. Each picks the kernel where one covers the device and type, else the
//! plain candle version in [`crate::plain`].

use candle_core::{Result, Tensor};

use crate::plain;

/// A linear layer: weight `(out, in)` as PyTorch stores it, optional bias `(out)`.
#[derive(Debug, Clone)]
pub struct Linear {
    /// `(out, in)`.
    pub weight: Tensor,
    /// `(out)`.
    pub bias: Option<Tensor>,
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

/// See [`plain::attention`].
pub fn attention(qkv: &Tensor, heads: usize) -> Result<Tensor> {
    plain::attention(qkv, heads)
}

/// See [`plain::linear`].
pub fn linear(x: &Tensor, layer: &Linear, act: Activation, residual: Option<&Tensor>) -> Result<Tensor> {
    plain::linear(x, layer, act, residual)
}

/// See [`plain::layer_norm`].
pub fn layer_norm(x: &Tensor, weight: Option<&Tensor>, bias: Option<&Tensor>, eps: f64) -> Result<Tensor> {
    plain::layer_norm(x, weight, bias, eps)
}
