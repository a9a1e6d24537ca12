//! The kernel against the definition in f64.

use super::*;
use crate::kernels::tests::{noise, worst_difference};

/// Relative to `sum |x w|`: the rounding of a sum of up to 256 products in a row, then of the blocks.
const GEMM_RELATIVE: f64 = 2e-6;

/// Obvious f64 version; also gives the size of the sums.
fn reference(x: &[f32], w: &[f32], m: usize, n: usize, k: usize, e: Epilogue<'_>) -> Vec<f64> {
    let mut out = vec![0f64; m * n];
    for i in 0..m {
        for j in 0..n {
            let mut s: f64 = (0..k).map(|p| f64::from(x[i * k + p]) * f64::from(w[j * k + p])).sum();
            s += e.bias.map_or(0.0, |b| b[j].into());
            s = match e.act {
                Activation::None => s,
                Activation::Gelu => 0.5 * s * (1.0 + candle_core::cpu::erf::erf_f64(s / 2f64.sqrt())),
                Activation::Silu => s / (1.0 + (-s).exp()),
            };
            out[i * n + j] = s + e.residual.map_or(0.0, |r| r[i * n + j].into());
        }
    }
    out
}

#[test]
fn every_shape_and_epilogue() {
    let shapes =
        [(1, 1, 1), (1, 17, 3), (5, 16, 8), (6, 33, 257), (7, 31, 513), (97, 50, 64), (200, 530, 19), (13, 48, 1030)];
    for isa in Isa::tested() {
        for (s, &(m, n, k)) in shapes.iter().enumerate() {
            let scale = 1.0 / (k as f32).sqrt();
            let x = noise(s as u64, m * k, 1.0);
            let w = noise(s as u64 + 100, n * k, scale);
            let bias = noise(s as u64 + 200, n, 0.5);
            let residual = noise(s as u64 + 300, m * n, 1.0);
            let packed = PackedWeight::new(isa, &w, n, k);
            for act in [Activation::None, Activation::Gelu, Activation::Silu] {
                for (bias, residual) in [(None, None), (Some(&bias[..]), Some(&residual[..]))] {
                    let e = Epilogue { bias, act, residual };
                    let mut out = vec![f32::NAN; m * n];
                    linear(&x, &packed, e, &mut out);
                    let worst = worst_difference(&out, &reference(&x, &w, m, n, k, e));
                    assert!(worst < GEMM_RELATIVE, "{isa:?} {m}x{n}x{k} {act:?}: {worst:e}");
                }
            }
        }
    }
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig::with_cases(40))]

    /// Operands rounded to bf16 have exact products: only sums differ between those who take them.
    #[test]
    fn in_bf16_all_sets_round_alike(m in 1usize..110, n in 1usize..80, k in 1usize..700, seed in 0u64..1000) {
        let (x, w) = (noise(seed, m * k, 1.0), noise(seed + 1, n * k, 1.0 / (k as f32).sqrt()));
        let rounded = |x: &[f32]| x.iter().map(|&x| bf16(x)).collect::<Vec<f32>>();
        let none = Epilogue { bias: None, act: Activation::None, residual: None };
        let want = reference(&rounded(&x), &rounded(&w), m, n, k, none);
        for isa in Isa::tested() {
            let packed = PackedWeight::in_precision(isa, crate::ops::Precision::Bf16, &w, n, k);
            let mut out = vec![f32::NAN; m * n];
            linear(&x, &packed, none, &mut out);
            let worst = worst_difference(&out, &want);
            proptest::prop_assert!(worst < GEMM_RELATIVE, "{:?} {} {} {}: {:e}", isa, m, n, k, worst);
        }
    }
}

#[test]
fn two_layers_at_once_are_two_calls() {
    let (m, k, hidden, n) = (130, 40, 300, 50);
    let (x, residual) = (noise(1, m * k, 1.0), noise(2, m * n, 1.0));
    let (b1, b2) = (noise(3, hidden, 1.0), noise(4, n, 1.0));
    for isa in Isa::tested() {
        let w1 = PackedWeight::new(isa, &noise(5, hidden * k, 0.2), hidden, k);
        let w2 = PackedWeight::new(isa, &noise(6, n * hidden, 0.1), n, hidden);
        let first = Epilogue { bias: Some(&b1), act: Activation::Gelu, residual: None };
        let second = Epilogue { bias: Some(&b2), act: Activation::None, residual: Some(&residual) };
        let (mut between, mut want, mut got) = (vec![0.0; m * hidden], vec![0.0; m * n], vec![0.0; m * n]);
        linear(&x, &w1, first, &mut between);
        linear(&between, &w2, second, &mut want);
        mlp(&x, (&w1, first), (&w2, second), &mut got);
        assert_eq!(got, want);
    }
}

#[test]
fn same_bits_for_any_thread_count() {
    let (m, n, k) = (331, 70, 300);
    let x = noise(1, m * k, 1.0);
    let packed = PackedWeight::new(Isa::detect(), &noise(2, n * k, 0.1), n, k);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut out = vec![0.0; m * n];
        let e = Epilogue { bias: None, act: Activation::Gelu, residual: None };
        pool.install(|| linear(&x, &packed, e, &mut out));
        out
    };
    let one = run(1);
    for threads in [2, 3, 8] {
        assert!(one.iter().zip(&run(threads)).all(|(a, b)| a.to_bits() == b.to_bits()), "{threads} threads");
    }
}

#[test]
fn nan_is_not_lost() {
    let packed = PackedWeight::new(Isa::detect(), &noise(2, 20 * 9, 1.0), 20, 9);
    let mut x = noise(1, 8 * 9, 1.0);
    x[4 * 9 + 3] = f32::NAN;
    let mut out = vec![0.0; 8 * 20];
    linear(&x, &packed, Epilogue { bias: None, act: Activation::Gelu, residual: None }, &mut out);
    for (i, v) in out.iter().enumerate() {
        assert_eq!(v.is_nan(), i / 20 == 4, "row {}", i / 20);
    }
}
