//! Several row-wise layers as one operation.

use candle_core::{D, Result, Tensor};

use super::process::zeros;
use super::{Activation, Linear, gelu, layer_norm, linear, mlp, silu, softmax};
use crate::kernels::tensors::{covered, tracked, with_each};
use crate::kernels::{self, Isa};

/// A layer of a [`chain`].
#[derive(Debug, Clone, Copy)]
pub enum Step<'a> {
    /// [`linear`], without a residual.
    Linear(&'a Linear, Activation),
    /// [`layer_norm`] over rows as wide as `weight`, then an activation.
    Norm {
        /// `(width)`.
        weight: &'a Tensor,
        /// `(width)`.
        bias: &'a Tensor,
        /// Added to the variance.
        eps: f64,
        /// What follows.
        act: Activation,
    },
    /// [`softmax`] over rows of `width`.
    Softmax {
        /// Values of a row.
        width: usize,
        /// Temperature.
        tau: f64,
    },
}

impl<'a> Step<'a> {
    fn widths(&self) -> Result<(usize, usize)> {
        Ok(match self {
            Self::Linear(layer, _) => {
                let (n, k) = layer.weight.dims2()?;
                if let Some(bias) = &layer.bias
                    && bias.dims() != [n]
                {
                    candle_core::bail!("chain: bias {:?} for {n} outputs", bias.dims());
                }
                (k, n)
            }
            Self::Norm { weight, bias, .. } => {
                if weight.dims() != bias.dims() {
                    candle_core::bail!("chain: gain {:?} and offset {:?} of a norm", weight.dims(), bias.dims());
                }
                (weight.dims1()?, weight.dims1()?)
            }
            Self::Softmax { width, .. } => (*width, *width),
        })
    }

    fn tensors(&self) -> Vec<&'a Tensor> {
        match *self {
            Self::Linear(layer, _) => std::iter::once(&layer.weight).chain(&layer.bias).collect(),
            Self::Norm { weight, bias, .. } => vec![weight, bias],
            Self::Softmax { .. } => Vec::new(),
        }
    }
}

fn activated(x: Tensor, act: Activation) -> Result<Tensor> {
    match act {
        Activation::None => Ok(x),
        Activation::Gelu => gelu(&x),
        Activation::Silu => silu(&x),
    }
}

/// One layer after the other; two linear layers that follow each other and the last sum are one operation.
fn one_by_one(x: &Tensor, steps: &[Step<'_>], residual: Option<&Tensor>) -> Result<Tensor> {
    let mut x = x.clone();
    let mut left = steps;
    while let [step, rest @ ..] = left {
        let width = step.widths()?.0;
        if x.dim(D::Minus1)? != width {
            x = x.contiguous()?.reshape(((), width))?;
        }
        // The residual has the shape of the last step's result.
        let last = |result: &[Step<'_>]| residual.filter(|_| result.is_empty());
        (x, left) = match (step, rest) {
            (Step::Linear(first, act), [Step::Linear(second, Activation::None), after @ ..])
                if second.weight.dim(1)? == first.weight.dim(0)? && x.dim(D::Minus1)? == width =>
            {
                (mlp(&x, first, *act, second, last(after))?, after)
            }
            (Step::Linear(layer, act), _) => (linear(&x, layer, *act, last(rest))?, rest),
            (Step::Norm { weight, bias, eps, act }, _) => {
                (activated(layer_norm(&x, Some(weight), Some(bias), *eps)?, *act)?, rest)
            }
            (Step::Softmax { tau, .. }, _) => (softmax(&x, *tau)?, rest),
        };
    }
    match (residual, steps.last()) {
        (Some(residual), Some(Step::Norm { .. } | Step::Softmax { .. })) => x + residual,
        _ => Ok(x),
    }
}

/// Takes the rows of `x` through all steps; every step cuts the values that reach it anew into rows of its own width, so a
/// row may become several. Adds `residual`, which has the result's shape: that of `x` but for its last axis where rows stay
/// rows, else `(rows, width)`.
///
/// Where no gradients are tracked the kernel keeps what lies between the layers in the cache.
pub fn chain(x: &Tensor, steps: &[Step<'_>], residual: Option<&Tensor>) -> Result<Tensor> {
    let width = x.dim(D::Minus1)?;
    let mut count = width;
    let mut splits = false;
    for step in steps {
        let (from, to) = step.widths()?;
        if from == 0 || !count.is_multiple_of(from) {
            candle_core::bail!("chain: rows of {width} become {count} values, which are no whole rows of {from}");
        }
        splits |= count != from;
        count = count / from * to;
    }
    let last = steps.last().map(Step::widths).transpose()?.map_or(width, |(_, to)| to);
    let mut dims = x.dims().to_vec();
    match dims.last_mut() {
        Some(end) if !splits => *end = last,
        _ => dims = vec![(x.elem_count() / width.max(1) * count).checked_div(last).unwrap_or(0), last],
    }
    if let Some(residual) = residual
        && residual.dims() != dims
    {
        candle_core::bail!("chain: residual {:?} for a result {dims:?}", residual.dims());
    }
    let mut inputs = vec![x];
    steps.iter().for_each(|step| inputs.extend(step.tensors()));
    inputs.extend(residual);
    let empty = x.elem_count() == 0 || count == 0 || steps.is_empty();
    if empty || !covered(inputs.iter().copied()) || tracked(inputs.iter().copied()) {
        return one_by_one(x, steps, residual);
    }
    let weights = steps.iter().map(|step| match step {
        Step::Linear(layer, _) => layer.packed().map(Some),
        _ => Ok(None),
    });
    let weights = weights.collect::<Result<Vec<_>>>()?;
    let mut out = zeros(dims.iter().product());
    with_each(&inputs, |values| {
        let mut values = values.iter().copied();
        let input = values.next().unwrap_or_default();
        let mut plain = Vec::with_capacity(steps.len());
        for (step, weight) in steps.iter().zip(&weights) {
            plain.push(match (step, weight) {
                (Step::Linear(layer, act), Some(weight)) => {
                    values.next();
                    let bias = layer.bias.is_some().then(|| values.next()).flatten();
                    kernels::chain::Step::Linear { weight, bias, act: *act }
                }
                (Step::Norm { eps, act, .. }, _) => {
                    let (weight, bias) = (values.next(), values.next());
                    kernels::chain::Step::Norm { width: step.widths()?.0, weight, bias, eps: *eps, act: *act }
                }
                (Step::Softmax { width, tau }, _) => kernels::chain::Step::Softmax { width: *width, tau: *tau as f32 },
                (Step::Linear(..), None) => candle_core::bail!("chain: a linear layer without its weight"),
            });
        }
        kernels::chain::chain(Isa::detect(), input, width, &plain, values.next(), &mut out);
        Ok(())
    })?;
    Tensor::from_vec(out, dims, x.device())
}
