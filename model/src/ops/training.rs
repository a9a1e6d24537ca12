//! The operations on tensors that carry gradients: the same kernels, keeping what their backward passes need.
//!
//! Shapes were checked by the callers in [`crate::ops`]. Weights are packed at every use, because an optimiser writes
//! into a variable in place.

use candle_core::{Result, Tensor};

use super::graph::{Backward, node};
use super::process::zeros;
use super::{Activation, Linear};
use crate::kernels::attention::{BackwardSource, Shape, attention_backward, attention_keeping};
use crate::kernels::gemm::{self, Epilogue, MlpGradients, PackedWeight};
use crate::kernels::norm::{self, RowStatistics};
use crate::kernels::tensors::{with_all, with_optional, with_values};
use crate::kernels::{Isa, rows};

/// A copy of a tensor's values.
fn values(tensor: &Tensor) -> Result<Vec<f32>> {
    with_values(tensor, |values| Ok(values.to_vec()))
}

/// Runs `f` on zeros of the shape of `like`, and makes them a tensor.
fn filled(like: &Tensor, f: impl FnOnce(&mut [f32]) -> Result<()>) -> Result<Tensor> {
    let mut out = zeros(like.elem_count());
    f(&mut out)?;
    Tensor::from_vec(out, like.dims(), like.device())
}

/// `(rows, columns)` of a tensor seen as a matrix of its last axis.
fn matrix(tensor: &Tensor) -> (usize, usize) {
    let columns = tensor.dims().last().copied().unwrap_or(1);
    (tensor.elem_count().checked_div(columns).unwrap_or(0), columns)
}

const NOTHING: Epilogue<'static> = Epilogue { bias: None, act: Activation::None, residual: None };

/// A tensor `like x` of `grad w`, the gradient of `x` in `x w^T`.
fn input_gradient(x: &Tensor, weight: &Tensor, grad: &[f32]) -> Result<Tensor> {
    let (n, k) = weight.dims2()?;
    let packed = with_values(weight, |weight| Ok(PackedWeight::transposed(Isa::detect(), weight, k, n)))?;
    filled(x, |out| {
        gemm::linear(grad, &packed, NOTHING, out);
        Ok(())
    })
}

/// A tensor like `weight` of its gradient in `x w^T`.
fn weight_gradient(x: &Tensor, weight: &Tensor, grad: &[f32]) -> Result<Tensor> {
    let (n, k) = weight.dims2()?;
    let (m, _) = matrix(x);
    filled(weight, |out| {
        with_values(x, |x| {
            gemm::weight_gradient(Isa::detect(), grad, x, (m, n, k), out);
            Ok(())
        })
    })
}

struct LinearBackward {
    x: Tensor,
    layer: Linear,
    act: Activation,
    /// The sums before the activation, where there is one.
    before: Option<Vec<f32>>,
    residual: bool,
}

impl Backward for LinearBackward {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn gradients(&self, _: &Tensor, grad: &Tensor) -> Result<Vec<Option<Tensor>>> {
        let residual = self.residual.then(|| grad.clone());
        let through = match &self.before {
            None => None,
            Some(before) => {
                let mut through = values(grad)?;
                rows::map_backward(Isa::detect(), self.act, before, &mut through);
                Some(through)
            }
        };
        let rest = |grad: &[f32]| -> Result<_> {
            let Linear { weight, bias, .. } = &self.layer;
            let x = self.x.track_op().then(|| input_gradient(&self.x, weight, grad)).transpose()?;
            let bias = bias
                .as_ref()
                .filter(|b| b.track_op())
                .map(|bias| Tensor::from_vec(gemm::column_sums(grad, bias.elem_count()), bias.dims(), bias.device()));
            let weight = weight.track_op().then(|| weight_gradient(&self.x, weight, grad)).transpose()?;
            Ok((x, weight, bias.transpose()?))
        };
        let (x, weight, bias) = match &through {
            Some(through) => rest(through)?,
            None => with_values(grad, rest)?,
        };
        Ok(vec![x, weight, bias, residual])
    }
}

/// See [`super::linear`]; `dims` is the result's shape.
pub(super) fn linear(
    x: &Tensor,
    layer: &Linear,
    act: Activation,
    residual: Option<&Tensor>,
    dims: &[usize],
) -> Result<Tensor> {
    let mut out = zeros(dims.iter().product());
    let before = with_values(x, |x| {
        with_optional(residual, |residual| {
            layer.with_parts(|packed, bias| {
                if act == Activation::None {
                    gemm::linear(x, packed, Epilogue { bias, act, residual }, &mut out);
                    return Ok(None);
                }
                let mut before = zeros(out.len());
                gemm::linear(x, packed, Epilogue { bias, ..NOTHING }, &mut before);
                rows::activate(Isa::detect(), act, &before, residual, &mut out);
                Ok(Some(before))
            })
        })
    })?;
    let inputs = [Some(x), Some(&layer.weight), layer.bias.as_ref(), residual];
    let kept = LinearBackward { x: x.clone(), layer: layer.clone(), act, before, residual: residual.is_some() };
    node(out, dims, &inputs, kept)
}

struct MlpBackward {
    x: Tensor,
    first: Linear,
    act: Activation,
    second: Linear,
    before: Vec<f32>,
    residual: bool,
}

impl Backward for MlpBackward {
    fn name(&self) -> &'static str {
        "mlp"
    }

    fn gradients(&self, _: &Tensor, grad: &Tensor) -> Result<Vec<Option<Tensor>>> {
        let ((hidden, k), n) = (self.first.weight.dims2()?, self.second.weight.dim(0)?);
        let (m, _) = matrix(&self.x);
        let wanted = |tensor: &Tensor| tensor.track_op().then(|| zeros(tensor.elem_count()));
        let (mut x, mut w1, mut w2) = (wanted(&self.x), wanted(&self.first.weight), wanted(&self.second.weight));
        let biases = [&self.first.bias, &self.second.bias].map(|b| b.as_ref().filter(|b| b.track_op()));
        let mut b1 = biases[0].map(|_| Vec::new());
        let b2 = with_all(
            [&self.x, &self.first.weight, &self.second.weight, grad],
            |[x_values, w1_values, w2_values, grad]| {
                let mlp =
                    gemm::Mlp { x: x_values, w1: w1_values, act: self.act, w2: w2_values, before: &self.before, grad };
                let to =
                    MlpGradients { x: x.as_deref_mut(), w1: w1.as_deref_mut(), b1: b1.as_mut(), w2: w2.as_deref_mut() };
                gemm::mlp_backward(Isa::detect(), mlp, (m, k, hidden, n), to);
                Ok(biases[1].map(|_| gemm::column_sums(grad, n)))
            },
        )?;
        let tensor = |values: Option<Vec<f32>>, like: Option<&Tensor>| {
            values.zip(like).map(|(values, like)| Tensor::from_vec(values, like.dims(), like.device())).transpose()
        };
        Ok(vec![
            tensor(x, Some(&self.x))?,
            tensor(w1, Some(&self.first.weight))?,
            tensor(b1, biases[0])?,
            tensor(w2, Some(&self.second.weight))?,
            tensor(b2, biases[1])?,
            self.residual.then(|| grad.clone()),
        ])
    }
}

/// See [`super::mlp`]; `dims` is the result's shape.
pub(super) fn mlp(
    x: &Tensor,
    first: &Linear,
    act: Activation,
    second: &Linear,
    residual: Option<&Tensor>,
    dims: &[usize],
) -> Result<Tensor> {
    let hidden = first.weight.dim(0)?;
    let mut out = zeros(dims.iter().product());
    let mut before = zeros(matrix(x).0 * hidden);
    with_values(x, |x| {
        with_optional(residual, |residual| {
            first.with_parts(|w1, bias| {
                let one = Epilogue { bias, act, residual: None };
                second.with_parts(|w2, bias| {
                    let two = Epilogue { bias, act: Activation::None, residual };
                    gemm::mlp_keeping(x, (w1, one), (w2, two), &mut before, &mut out);
                    Ok(())
                })
            })
        })
    })?;
    let inputs =
        [Some(x), Some(&first.weight), first.bias.as_ref(), Some(&second.weight), second.bias.as_ref(), residual];
    let (first, second, residual) = (first.clone(), second.clone(), residual.is_some());
    node(out, dims, &inputs, MlpBackward { x: x.clone(), first, act, second, before, residual })
}

struct AttentionBackward {
    qkv: Tensor,
    shape: Shape,
    log_sums: Vec<f32>,
}

impl Backward for AttentionBackward {
    fn name(&self) -> &'static str {
        "attention"
    }

    fn gradients(&self, result: &Tensor, grad: &Tensor) -> Result<Vec<Option<Tensor>>> {
        let out = filled(&self.qkv, |out| {
            with_all([&self.qkv, result, grad], |[qkv, result, grad]| {
                let source = BackwardSource { qkv, result, log_sums: &self.log_sums, grad, shape: self.shape };
                attention_backward(Isa::detect(), source, out);
                Ok(())
            })
        })?;
        Ok(vec![Some(out)])
    }
}

/// See [`super::attention`].
pub(super) fn attention(qkv: &Tensor, shape: Shape) -> Result<Tensor> {
    let width = shape.heads * shape.head_dim;
    let mut out = zeros(shape.batch * shape.tokens * width);
    let log_sums = with_values(qkv, |values| Ok(attention_keeping(Isa::detect(), values, shape, &mut out)))?;
    let kept = AttentionBackward { qkv: qkv.clone(), shape, log_sums };
    node(out, (shape.batch, shape.tokens, width), &[Some(qkv)], kept)
}

struct NormBackward {
    x: Tensor,
    weight: Option<Tensor>,
    statistics: Vec<RowStatistics>,
}

impl Backward for NormBackward {
    fn name(&self) -> &'static str {
        "layer-norm"
    }

    fn gradients(&self, _: &Tensor, grad: &Tensor) -> Result<Vec<Option<Tensor>>> {
        let (_, width) = matrix(&self.x);
        let mut learned = Vec::new();
        let x = filled(&self.x, |out| {
            with_optional(self.weight.as_ref(), |weight| {
                with_all([&self.x, grad], |[x, grad]| {
                    let source = norm::Source { x, width, weight, statistics: &self.statistics, grad };
                    learned = norm::layer_norm_backward(Isa::detect(), source, out);
                    Ok(())
                })
            })
        })?;
        let offsets = learned.split_off(width);
        let tensor = |values| Tensor::from_vec(values, width, self.x.device());
        Ok(vec![Some(x), Some(tensor(learned)?), Some(tensor(offsets)?)])
    }
}

/// See [`super::layer_norm`].
pub(super) fn layer_norm(x: &Tensor, weight: Option<&Tensor>, bias: Option<&Tensor>, eps: f64) -> Result<Tensor> {
    let (_, width) = matrix(x);
    let mut out = zeros(x.elem_count());
    let statistics = with_values(x, |x| {
        with_optional(weight, |weight| {
            with_optional(bias, |bias| {
                Ok(norm::layer_norm_keeping(Isa::detect(), x, width, (weight, bias, eps), &mut out))
            })
        })
    })?;
    let kept = NormBackward { x: x.clone(), weight: weight.cloned(), statistics };
    node(out, x.dims(), &[Some(x), weight, bias], kept)
}

struct MapBackward {
    x: Tensor,
    act: Activation,
}

impl Backward for MapBackward {
    fn name(&self) -> &'static str {
        "activation"
    }

    fn gradients(&self, _: &Tensor, grad: &Tensor) -> Result<Vec<Option<Tensor>>> {
        let mut out = values(grad)?;
        with_values(&self.x, |x| {
            rows::map_backward(Isa::detect(), self.act, x, &mut out);
            Ok(())
        })?;
        Ok(vec![Some(Tensor::from_vec(out, self.x.dims(), self.x.device())?)])
    }
}

/// `act` of every element.
pub(super) fn map(x: &Tensor, act: Activation) -> Result<Tensor> {
    let mut out = zeros(x.elem_count());
    with_values(x, |x| {
        rows::activate(Isa::detect(), act, x, None, &mut out);
        Ok(())
    })?;
    node(out, x.dims(), &[Some(x)], MapBackward { x: x.clone(), act })
}

struct SoftmaxBackward {
    tau: f32,
}

impl Backward for SoftmaxBackward {
    fn name(&self) -> &'static str {
        "softmax"
    }

    fn gradients(&self, result: &Tensor, grad: &Tensor) -> Result<Vec<Option<Tensor>>> {
        let mut out = values(grad)?;
        with_values(result, |y| {
            rows::softmax_backward(Isa::detect(), y, matrix(result).1, self.tau, &mut out);
            Ok(())
        })?;
        Ok(vec![Some(Tensor::from_vec(out, result.dims(), result.device())?)])
    }
}

/// See [`super::softmax`].
pub(super) fn softmax(x: &Tensor, tau: f64) -> Result<Tensor> {
    let mut out = zeros(x.elem_count());
    with_values(x, |values| {
        rows::softmax(Isa::detect(), values, matrix(x).1, tau as f32, &mut out);
        Ok(())
    })?;
    node(out, x.dims(), &[Some(x)], SoftmaxBackward { tau: tau as f32 })
}
