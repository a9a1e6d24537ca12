//! The operations the network is written in. Each picks the kernel where one covers the device and type, else the
//! plain candle version in [`crate::plain`].
//!
//! Kernels ([`crate::kernels`]) take f32 tensors on the CPU that are not part of a gradient's graph; tensors that do not
//! lie in row-major order are copied first. Everything else goes to [`crate::plain`]: other types (f64, f16, bf16), other
//! devices, and whatever candle must differentiate (a variable, or a tensor computed from one). For inference with
//! weights that are variables, detach them once (`Tensor::detach`) when the model is loaded.

use std::sync::{Arc, OnceLock};

use candle_core::{D, Result, Tensor, TensorId};

use crate::kernels::gemm::{self, Epilogue, PackedWeight};
use crate::kernels::math::Function;
use crate::kernels::tensors::{covered, with_optional, with_values};
use crate::kernels::{self, Isa};
use crate::plain;

/// A linear layer: weight `(out, in)` as PyTorch stores it, optional bias `(out)`.
///
/// The kernel's layout of the weight is made at first use and shared by clones (it doubles the layer's memory). It
/// belongs to this `weight` tensor: replacing the field is noticed, but writing into the storage of a tensor detached
/// from a variable is not, so make a new `Linear` after such a change.
#[derive(Debug, Clone)]
pub struct Linear {
    /// `(out, in)`.
    pub weight: Tensor,
    /// `(out)`.
    pub bias: Option<Tensor>,
    packed: Arc<OnceLock<(TensorId, PackedWeight)>>,
}

impl Linear {
    /// A layer of a weight `(out, in)` and a bias `(out)`.
    pub fn new(weight: Tensor, bias: Option<Tensor>) -> Self {
        Self { weight, bias, packed: Arc::default() }
    }

    /// Makes the kernel's layout now, so that the first step is not slower than the others. Nothing to do for weights
    /// the kernels do not cover.
    pub fn prepare(&self) -> Result<()> {
        match covered([&self.weight]) {
            true => self.with_packed(|_| Ok(())),
            false => Ok(()),
        }
    }

    fn pack(&self) -> Result<PackedWeight> {
        let (n, k) = self.weight.dims2()?;
        with_values(&self.weight, |values| Ok(PackedWeight::new(Isa::detect(), values, n, k)))
    }

    fn with_packed<R>(&self, f: impl FnOnce(&PackedWeight) -> Result<R>) -> Result<R> {
        let id = self.weight.id();
        if self.packed.get().is_none() {
            // Two threads may both get here; the first to finish wins and the other's work is dropped.
            let _ = self.packed.set((id, self.pack()?));
        }
        match self.packed.get() {
            Some((packed_id, packed)) if *packed_id == id => f(packed),
            _ => f(&self.pack()?),
        }
    }

    fn with_parts<R>(&self, f: impl FnOnce(&PackedWeight, Option<&[f32]>) -> Result<R>) -> Result<R> {
        with_optional(self.bias.as_ref(), |bias| self.with_packed(|packed| f(packed, bias)))
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
    let (batch, tokens, d3) = qkv.dims3()?;
    if heads == 0 || d3 == 0 || d3 % (3 * heads) != 0 {
        candle_core::bail!("attention: {d3} channels are not 3 x {heads} heads x a whole head size");
    }
    if !covered([qkv]) || batch * tokens == 0 {
        return plain::attention(qkv, heads);
    }
    let shape = kernels::attention::Shape { batch, tokens, heads, head_dim: d3 / 3 / heads };
    let mut out = vec![0f32; batch * tokens * d3 / 3];
    with_values(qkv, |values| {
        kernels::attention::attention(Isa::detect(), values, shape, &mut out);
        Ok(())
    })?;
    Tensor::from_vec(out, (batch, tokens, d3 / 3), qkv.device())
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
    let mut out = vec![0f32; dims.iter().product()];
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
    let mut out = vec![0f32; dims.iter().product()];
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
    let mut out = vec![0f32; x.elem_count()];
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
        true => map(x, Function::Gelu),
        false => x.gelu_erf(),
    }
}

/// `x * sigmoid(x)` of every element.
pub fn silu(x: &Tensor) -> Result<Tensor> {
    match covered([x]) {
        true => map(x, Function::Silu),
        false => x.silu(),
    }
}

fn map(x: &Tensor, function: Function) -> Result<Tensor> {
    let mut out = vec![0f32; x.elem_count()];
    with_values(x, |values| {
        kernels::rows::map(Isa::detect(), function, values, &mut out);
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
    let mut out = vec![0f32; x.elem_count()];
    with_values(x, |values| {
        kernels::rows::softmax(Isa::detect(), values, width, tau as f32, &mut out);
        Ok(())
    })?;
    Tensor::from_vec(out, x.dims(), x.device())
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{DType, Device, Var};
    use proptest::prelude::*;

    /// Kernel and plain version sum in different orders: a few roundings of results of a few units.
    const TOLERANCE: f32 = 2e-5;

    fn noise(seed: u64, dims: &[usize], scale: f32) -> Tensor {
        let values = crate::kernels::tests::noise(seed, dims.iter().product(), scale);
        Tensor::from_vec(values, dims, &Device::Cpu).unwrap()
    }

    #[track_caller]
    fn same(a: &Tensor, b: &Tensor) {
        assert_eq!(a.dims(), b.dims());
        let worst = (a - b).unwrap().abs().unwrap().flatten_all().unwrap().max(0).unwrap();
        let worst = worst.to_dtype(DType::F32).unwrap().to_scalar::<f32>().unwrap();
        assert!(worst < TOLERANCE, "{worst:e}");
    }

    fn layer(seed: u64, n: usize, k: usize, bias: bool) -> Linear {
        Linear::new(noise(seed, &[n, k], (k as f32).powf(-0.5)), bias.then(|| noise(seed + 1, &[n], 0.5)))
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn attention_is_the_plain_one(
            b in 1usize..3, n in 1usize..140, heads in 1usize..4, d in 1usize..40, seed in 0u64..1000,
        ) {
            let qkv = noise(seed, &[b, n, 3 * heads * d], 2.0);
            same(&attention(&qkv, heads).unwrap(), &plain::attention(&qkv, heads).unwrap());
        }

        #[test]
        fn linear_is_the_plain_one(
            b in 1usize..3, m in 1usize..120, n in 1usize..70, k in 1usize..300, seed in 0u64..1000,
            bias: bool, add: bool, act in 0usize..3,
        ) {
            let (x, layer) = (noise(seed, &[b, m, k], 1.0), layer(seed + 1, n, k, bias));
            let act = [Activation::None, Activation::Gelu, Activation::Silu][act];
            let residual = add.then(|| noise(seed + 3, &[b, m, n], 1.0));
            let got = linear(&x, &layer, act, residual.as_ref()).unwrap();
            same(&got, &plain::linear(&x, &layer, act, residual.as_ref()).unwrap());
            // Again, now with the weight packed.
            let again = linear(&x, &layer, act, residual.as_ref()).unwrap();
            prop_assert_eq!(got.flatten_all().unwrap().to_vec1::<f32>().unwrap(),
                again.flatten_all().unwrap().to_vec1::<f32>().unwrap());
        }

        #[test]
        fn mlp_is_two_layers(m in 1usize..60, k in 1usize..40, h in 1usize..90, n in 1usize..40, add: bool, seed in 0u64..1000) {
            let x = noise(seed, &[2, m, k], 1.0);
            let (one, two) = (layer(seed + 1, h, k, true), layer(seed + 3, n, h, add));
            let residual = add.then(|| noise(seed + 5, &[2, m, n], 1.0));
            let got = mlp(&x, &one, Activation::Gelu, &two, residual.as_ref()).unwrap();
            let between = plain::linear(&x, &one, Activation::Gelu, None).unwrap();
            same(&got, &plain::linear(&between, &two, Activation::None, residual.as_ref()).unwrap());
        }

        #[test]
        fn rows_are_the_plain_ones(m in 1usize..50, n in 1usize..200, seed in 0u64..1000, learned: bool) {
            let x = noise(seed, &[2, m, n], 3.0);
            let (w, b) = (noise(seed + 1, &[n], 1.0), noise(seed + 2, &[n], 1.0));
            let (w, b) = (learned.then_some(&w), learned.then_some(&b));
            // A single column, or nearly equal values, divides rounding by rounding: a usual eps keeps it apart.
            same(&layer_norm(&x, w, b, 1e-3).unwrap(), &plain::layer_norm(&x, w, b, 1e-3).unwrap());
            same(&softmax(&x, 0.5).unwrap(), &plain::softmax(&x, 0.5).unwrap());
            same(&gelu(&x).unwrap(), &x.gelu_erf().unwrap());
            same(&silu(&x).unwrap(), &x.silu().unwrap());
        }
    }

    #[test]
    fn any_layout_and_type() {
        let x = noise(1, &[40, 2, 30], 1.0).transpose(0, 1).unwrap();
        let layer = layer(2, 24, 30, true);
        assert!(!x.is_contiguous());
        same(
            &linear(&x, &layer, Activation::Gelu, None).unwrap(),
            &plain::linear(&x, &layer, Activation::Gelu, None).unwrap(),
        );
        let narrow = noise(3, &[1, 50, 24], 1.0).narrow(1, 7, 20).unwrap();
        same(&layer_norm(&narrow, None, None, 1e-6).unwrap(), &plain::layer_norm(&narrow, None, None, 1e-6).unwrap());
        let qkv = noise(4, &[1, 33, 48], 1.0);
        let wide = attention(&qkv.to_dtype(DType::F64).unwrap(), 2).unwrap();
        assert_eq!(wide.dtype(), DType::F64);
        same(&attention(&qkv, 2).unwrap(), &wide.to_dtype(DType::F32).unwrap());
        let transposed = Linear::new(noise(5, &[30, 24], 0.2).t().unwrap(), None);
        same(
            &linear(&x, &transposed, Activation::None, None).unwrap(),
            &plain::linear(&x, &transposed, Activation::None, None).unwrap(),
        );
    }

    #[test]
    fn gradients_still_flow() {
        let w = Var::from_tensor(&noise(1, &[8, 6], 1.0)).unwrap();
        let x = noise(2, &[5, 6], 1.0);
        let layer = Linear::new(w.as_tensor().clone(), None);
        layer.prepare().unwrap();
        let y = linear(&x, &layer, Activation::Gelu, None).unwrap();
        let y = softmax(&layer_norm(&y, None, None, 1e-6).unwrap(), 0.5).unwrap();
        let grads = y.sqr().unwrap().sum_all().unwrap().backward().unwrap();
        assert!(grads.get(&w).is_some());
        // An optimiser's step in place is seen at once.
        let before = linear(&x, &layer, Activation::None, None).unwrap();
        w.set(&(w.as_tensor() * 2.0).unwrap()).unwrap();
        same(&linear(&x, &layer, Activation::None, None).unwrap(), &(before * 2.0).unwrap());
    }

    #[test]
    fn a_replaced_weight_is_noticed() {
        let x = noise(1, &[5, 6], 1.0);
        let mut layer = layer(2, 8, 6, false);
        let before = linear(&x, &layer, Activation::None, None).unwrap();
        layer.weight = (&layer.weight * 3.0).unwrap();
        same(&linear(&x, &layer, Activation::None, None).unwrap(), &(before * 3.0).unwrap());
    }

    #[test]
    fn wrong_shapes_are_errors() {
        let x = noise(1, &[5, 6], 1.0);
        assert!(linear(&x, &layer(2, 8, 7, false), Activation::None, None).is_err());
        let wrong_bias = Linear::new(noise(1, &[8, 6], 1.0), Some(noise(1, &[7], 1.0)));
        assert!(linear(&x, &wrong_bias, Activation::None, None).is_err());
        assert!(linear(&x, &layer(2, 8, 6, false), Activation::None, Some(&noise(3, &[5, 7], 1.0))).is_err());
        assert!(mlp(&x, &layer(2, 8, 6, true), Activation::None, &layer(3, 4, 9, true), None).is_err());
        assert!(mlp(&x, &layer(2, 8, 7, true), Activation::None, &layer(3, 4, 8, true), None).is_err());
        assert!(mlp(&x, &layer(2, 8, 6, true), Activation::None, &layer(3, 4, 8, true), Some(&x)).is_err());
        assert!(attention(&noise(1, &[1, 5, 6], 1.0), 4).is_err());
        assert!(attention(&noise(1, &[1, 5, 6], 1.0), 0).is_err());
        assert!(layer_norm(&x, Some(&noise(1, &[5], 1.0)), None, 1e-6).is_err());
    }
}
