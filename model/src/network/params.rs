//! Layers by their name in the weight file.

use candle_core::Tensor;

use crate::error::ModelError;
use crate::ops::{Activation, Linear, Step, chain, layer_norm};
use crate::weights::{Tensors, WeightsError};

/// Epsilon of every layer norm.
pub(crate) const NORM_EPS: f64 = 1e-6;

/// Looks tensors up by name.
pub(crate) struct Params<'a>(pub &'a Tensors);

impl Params<'_> {
    pub fn get(&self, name: &str) -> Result<Tensor, ModelError> {
        self.0.get(name).cloned().ok_or_else(|| WeightsError::missing(name).into())
    }

    pub fn linear(&self, name: &str) -> Result<Linear, ModelError> {
        Ok(Linear::new(self.get(&format!("{name}.weight"))?, Some(self.get(&format!("{name}.bias"))?)))
    }

    pub fn norm(&self, name: &str) -> Result<Norm, ModelError> {
        Ok(Norm { weight: self.get(&format!("{name}.weight"))?, bias: self.get(&format!("{name}.bias"))? })
    }

    /// `fc1`, `fc2`, ... as many as there are.
    pub fn mlp(&self, name: &str) -> Result<Mlp, ModelError> {
        let count = (1..).take_while(|k| self.0.contains_key(&format!("{name}.fc{k}.weight"))).count();
        let layers = (1..=count.max(1)).map(|k| self.linear(&format!("{name}.fc{k}")));
        Ok(Mlp(layers.collect::<Result<_, _>>()?))
    }
}

/// Layer norm with gain and offset.
#[derive(Debug, Clone)]
pub(crate) struct Norm {
    weight: Tensor,
    bias: Tensor,
}

impl Norm {
    pub fn forward(&self, x: &Tensor) -> candle_core::Result<Tensor> {
        layer_norm(x, Some(&self.weight), Some(&self.bias), NORM_EPS)
    }

    /// The same as part of a chain.
    pub fn step(&self, act: Activation) -> Step<'_> {
        Step::Norm { weight: &self.weight, bias: &self.bias, eps: NORM_EPS, act }
    }
}

/// A linear layer whose matrix is a stored weight in another arrangement (convolutions written as matrix products).
///
/// Arranged once, at loading, so that kernels can keep their own copy of it; but while the weight is a variable in
/// training, at every use, so that it is followed and differentiated.
#[derive(Debug, Clone)]
pub(crate) struct Arranged {
    stored: Linear,
    arrange: fn(&Linear) -> candle_core::Result<Linear>,
    ready: Option<Linear>,
}

impl Arranged {
    pub fn new(stored: Linear, arrange: fn(&Linear) -> candle_core::Result<Linear>) -> candle_core::Result<Self> {
        let variable = stored.weight.is_variable() || stored.bias.as_ref().is_some_and(Tensor::is_variable);
        let ready = if variable { None } else { Some(arrange(&stored)?) };
        Ok(Self { stored, arrange, ready })
    }

    pub fn layer(&self) -> candle_core::Result<Linear> {
        match &self.ready {
            Some(layer) => Ok(layer.clone()),
            None => (self.arrange)(&self.stored),
        }
    }
}

/// Linear layers with GELU between them.
#[derive(Debug, Clone)]
pub(crate) struct Mlp(Vec<Linear>);

impl Mlp {
    pub fn forward(&self, x: &Tensor) -> candle_core::Result<Tensor> {
        chain(x, &self.steps().collect::<Vec<_>>(), None)
    }

    /// The layers as part of a chain.
    pub fn steps(&self) -> impl Iterator<Item = Step<'_>> {
        let act = |k: usize| if k + 1 < self.0.len() { Activation::Gelu } else { Activation::None };
        self.0.iter().enumerate().map(move |(k, layer)| Step::Linear(layer, act(k)))
    }
}
