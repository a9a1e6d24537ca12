//! Kernels against the plain versions, forward.

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
    fn attention_on_other_tokens_is_the_plain_one(
        b in 1usize..3, n in 1usize..140, m in 1usize..300, heads in 1usize..4, d in 1usize..40, seed in 0u64..1000,
        sized: bool,
    ) {
        let queries = noise(seed, &[b, n, heads * d], 2.0);
        let both = noise(seed + 1, &[b, m, 2 * heads * d], 2.0);
        let sizes: Vec<f32> = (0..m).map(|i| (1 + i % 4) as f32).collect();
        let sizes = sized.then_some(&sizes[..]);
        let want = plain::cross_attention(&queries, &both, sizes, heads).unwrap();
        same(&cross_attention(&queries, &both, sizes, heads, Precision::F32).unwrap(), &want);
        for precision in [Precision::Int16, Precision::Int8, Precision::Bf16] {
            let got = cross_attention(&queries, &both, sizes, heads, precision).unwrap();
            let worst = (got - &want).unwrap().abs().unwrap().flatten_all().unwrap().max(0).unwrap();
            prop_assert!(worst.to_scalar::<f32>().unwrap() < 4e-2, "{}", precision);
        }
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
    let (queries, both) = (noise(1, &[1, 5, 6], 1.0), noise(2, &[1, 4, 12], 1.0));
    assert!(cross_attention(&queries, &both, None, 4, Precision::F32).is_err());
    assert!(cross_attention(&queries, &both, Some(&[1.0; 5]), 2, Precision::F32).is_err());
    assert!(cross_attention(&queries, &queries, None, 2, Precision::F32).is_err());
    assert!(layer_norm(&x, Some(&noise(1, &[5], 1.0)), None, 1e-6).is_err());
}
