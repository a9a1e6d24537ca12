//! The kernel against the definition in f64.

use super::*;
use crate::kernels::tests::{noise, worst_difference};

/// For values up to 1: the weights' own rounding, and that of logits of a few units.
const TOLERANCE: f64 = 2e-6;
/// Logits of 1e4 carry a rounding of up to 1e-3 each, and weights follow it.
const BIG_LOGITS_TOLERANCE: f64 = 2e-2;

/// For logits of tens: a rounding of 2e-6 each, and weights follow it.
pub(super) const NEARLY: f64 = 3e-5;

pub(super) fn reference(inputs: &Inputs<'_>, s: Shape) -> Vec<f64> {
    let (d, width) = (s.head_dim, s.width());
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(&x, &y)| f64::from(x) * f64::from(y)).sum::<f64>();
    let bias = |u: usize| inputs.bias.map_or(0.0, |bias| f64::from(bias[u]) * std::f64::consts::LN_2);
    let mut out = vec![0f64; s.batch * s.tokens * width];
    for b in 0..s.batch {
        for h in 0..s.heads {
            for t in 0..s.tokens {
                let query = inputs.queries.head(b * s.tokens + t, h, d);
                let key = |u: usize| inputs.keys.head(b * inputs.count + u, h, d);
                let logits: Vec<f64> =
                    (0..inputs.count).map(|u| dot(query, key(u)) / (d as f64).sqrt() + bias(u)).collect();
                let top = logits.iter().fold(f64::NEG_INFINITY, |a, &l| a.max(l));
                let weights: Vec<f64> = logits.iter().map(|l| (l - top).exp()).collect();
                let total: f64 = weights.iter().sum();
                for c in 0..d {
                    let value = |u: usize| f64::from(inputs.values.head(b * inputs.count + u, h, d)[c]);
                    let sum: f64 = weights.iter().enumerate().map(|(u, w)| w * value(u)).sum();
                    out[(b * s.tokens + t) * width + h * d + c] = sum / total;
                }
            }
        }
    }
    out
}

fn shapes() -> Vec<Shape> {
    let list = [
        (1, 1, 1, 1),
        (1, 2, 3, 8),
        (2, 20, 4, 16),
        (1, 97, 1, 64),
        (1, 255, 2, 24),
        (1, 256, 1, 33),
        (2, 259, 2, 7),
        (1, 700, 1, 72),
    ];
    list.iter().map(|&(batch, tokens, heads, head_dim)| Shape { batch, tokens, heads, head_dim }).collect()
}

#[test]
fn every_shape() {
    for isa in Isa::tested() {
        for (i, s) in shapes().into_iter().enumerate() {
            let mut qkv = noise(i as u64, s.batch * s.tokens * 3 * s.width(), 1.0);
            // Some structure, so that weights are not all alike.
            qkv.iter_mut().step_by(7).for_each(|x| *x *= 3.0);
            let mut out = vec![f32::NAN; s.batch * s.tokens * s.width()];
            attention(isa, &qkv, s, &mut out);
            let worst = worst_difference(&out, &reference(&Inputs::joined(&qkv, &s), s));
            assert!(worst < TOLERANCE, "{isa:?} {s:?}: {worst:e}");
        }
    }
}

#[test]
fn either_way_to_the_weights_in_used_memory() {
    let s = Shape { batch: 1, tokens: 301, heads: 2, head_dim: 20 };
    let row = 3 * s.width();
    for isa in Isa::tested() {
        // Each head's queries times this: lengths bound the logits of neither, one or both heads.
        for (i, scales) in [[0.5, 0.5], [0.5, 30.0], [30.0, 30.0]].into_iter().enumerate() {
            let mut qkv = noise(40 + i as u64, s.tokens * row, 1.0);
            for (j, x) in qkv.iter_mut().enumerate().filter(|(j, _)| j % row < s.width()) {
                *x *= scales[j % row / s.head_dim];
            }
            let mut out = vec![f32::NAN; s.tokens * s.width()];
            let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
            pool.install(|| {
                PACKED.with_borrow_mut(|memory| memory.at_least(1 << 17).fill(f32::NAN));
                SCRATCH.with_borrow_mut(|Scratch { queries, weights, sums, totals }| {
                    for memory in [queries, weights, sums, totals] {
                        memory.at_least(1 << 16).fill(f32::NAN);
                    }
                });
                attention(isa, &qkv, s, &mut out);
            });
            let worst = worst_difference(&out, &reference(&Inputs::joined(&qkv, &s), s));
            assert!(worst < 10.0 * TOLERANCE, "{isa:?} {scales:?}: {worst:e}");
        }
    }
}

#[test]
fn logits_of_ten_thousand_stay_finite() {
    let s = Shape { batch: 1, tokens: 300, heads: 2, head_dim: 16 };
    let mut qkv = noise(5, s.tokens * 3 * s.width(), 1.0);
    for row in qkv.chunks_exact_mut(3 * s.width()) {
        row[..2 * s.width()].iter_mut().for_each(|x| *x *= 100.0);
    }
    for isa in Isa::tested() {
        let mut out = vec![f32::NAN; s.tokens * s.width()];
        attention(isa, &qkv, s, &mut out);
        assert!(out.iter().all(|x| x.is_finite() && x.abs() <= 1.0001));
        let worst = worst_difference(&out, &reference(&Inputs::joined(&qkv, &s), s));
        assert!(worst < BIG_LOGITS_TOLERANCE, "{isa:?}: {worst:e}");
    }
}

#[test]
fn nan_reaches_its_outputs_only() {
    let s = Shape { batch: 1, tokens: 40, heads: 2, head_dim: 8 };
    let mut qkv = noise(6, s.tokens * 3 * s.width(), 1.0);
    qkv[17 * 3 * s.width() + 3] = f32::NAN;
    for isa in Isa::tested() {
        let mut out = vec![0.0; s.tokens * s.width()];
        attention(isa, &qkv, s, &mut out);
        for (i, x) in out.iter().enumerate() {
            assert_eq!(x.is_nan(), i / s.width() == 17 && i % s.width() < 8, "element {i}");
        }
        let mut poisoned = qkv.clone();
        poisoned[20 * 3 * s.width() + s.width() + 9] = f32::NAN;
        attention(isa, &poisoned, s, &mut out);
        assert!(out.chunks_exact(s.width()).all(|row| row[8..].iter().all(|x| x.is_nan())), "a key reaches all rows");
    }
}

#[test]
fn same_bits_for_any_thread_count() {
    let s = Shape { batch: 2, tokens: 333, heads: 3, head_dim: 20 };
    let qkv = noise(7, s.batch * s.tokens * 3 * s.width(), 2.0);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut out = vec![0.0; s.batch * s.tokens * s.width()];
        pool.install(|| attention(Isa::detect(), &qkv, s, &mut out));
        out
    };
    let one = run(1);
    for threads in [2, 3, 8] {
        assert!(one.iter().zip(&run(threads)).all(|(a, b)| a.to_bits() == b.to_bits()), "{threads} threads");
    }
}

/// Rounding 2^-9 of operands, of logits of a few units and of the weights that follow them.
const BF16_TOLERANCE: f64 = 5e-2;

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig::with_cases(24))]

    #[test]
    fn in_bf16_everything_is_rounded_and_nothing_lost(
        tokens in 1usize..300, count in 1usize..600, heads in 1usize..4, head_dim in 1usize..70, biased: bool, seed in 0u64..1000,
    ) {
        let s = Shape { batch: 2, tokens, heads, head_dim };
        let width = s.width();
        let queries = noise(seed, 2 * tokens * width, 1.0);
        let kv = noise(seed + 1, 2 * count * 2 * width, 1.0);
        let bias = noise(seed + 2, count, 2.0);
        let rows = |first| Rows { values: &kv, stride: 2 * width, first };
        let queries = Rows { values: &queries, stride: width, first: 0 };
        let bias = biased.then_some(&bias[..]);
        let inputs = Inputs { queries, keys: rows(0), values: rows(width), count, bias };
        let want = reference(&inputs, s);
        for isa in Isa::tested() {
            let mut out = vec![f32::NAN; 2 * tokens * width];
            attention_in_bf16(isa, &inputs, s, &mut out);
            let worst = worst_difference(&out, &want);
            proptest::prop_assert!(worst < BF16_TOLERANCE, "{:?} {:?} {}: {:e}", isa, s, count, worst);
        }
    }
}

#[test]
fn nan_is_not_lost_in_bf16() {
    let s = Shape { batch: 1, tokens: 130, heads: 1, head_dim: 40 };
    for isa in Isa::tested() {
        // A query reaches its own result; a key and a value all.
        for (at, reaches) in [(7 * 120 + 3, 1), (7 * 120 + 43, 130), (7 * 120 + 83, 130)] {
            let mut qkv = noise(1, s.tokens * 120, 1.0);
            qkv[at] = f32::NAN;
            let mut out = vec![0.0; s.tokens * s.width()];
            attention_in_bf16(isa, &Inputs::joined(&qkv, &s), s, &mut out);
            let rows = out.chunks_exact(40).filter(|row| row.iter().any(|x| !x.is_finite())).count();
            assert_eq!(rows, reaches, "{isa:?} {at}");
        }
    }
}
