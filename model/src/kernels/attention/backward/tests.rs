use super::super::attention_keeping;
use super::*;
use crate::kernels::tests::{noise, worst_difference};

/// Gradients of up to a few units, from sums of a few hundred products.
const TOLERANCE: f64 = 1e-5;
/// Where operands have two parts.
const TILES_TOLERANCE: f64 = 3e-5;

/// Obvious f64 version.
fn reference(qkv: &[f32], grad: &[f32], s: Shape) -> Vec<f64> {
    let (n, d, width) = (s.tokens, s.head_dim, s.width());
    let mut out = vec![0f64; qkv.len()];
    let at = |b: usize, t: usize, part: usize, h: usize, c: usize| (b * n + t) * 3 * width + part * width + h * d + c;
    let value = |i: usize| f64::from(qkv[i]);
    for b in 0..s.batch {
        for h in 0..s.heads {
            for t in 0..n {
                let logits: Vec<f64> = (0..n)
                    .map(|u| (0..d).map(|c| value(at(b, t, 0, h, c)) * value(at(b, u, 1, h, c))).sum::<f64>())
                    .map(|l| l / (d as f64).sqrt())
                    .collect();
                let top = logits.iter().fold(f64::NEG_INFINITY, |a, &l| a.max(l));
                let total: f64 = logits.iter().map(|l| (l - top).exp()).sum();
                let weights: Vec<f64> = logits.iter().map(|l| (l - top).exp() / total).collect();
                let g: Vec<f64> = (0..d).map(|c| grad[(b * n + t) * width + h * d + c].into()).collect();
                let along: Vec<f64> = (0..n).map(|u| (0..d).map(|c| g[c] * value(at(b, u, 2, h, c))).sum()).collect();
                let mean: f64 = weights.iter().zip(&along).map(|(w, a)| w * a).sum();
                for u in 0..n {
                    let ds = weights[u] * (along[u] - mean) / (d as f64).sqrt();
                    for c in 0..d {
                        out[at(b, u, 2, h, c)] += weights[u] * g[c];
                        out[at(b, t, 0, h, c)] += ds * value(at(b, u, 1, h, c));
                        out[at(b, u, 1, h, c)] += ds * value(at(b, t, 0, h, c));
                    }
                }
            }
        }
    }
    out
}

fn run(isa: Isa, qkv: &[f32], grad: &[f32], shape: Shape) -> Vec<f32> {
    let mut result = vec![0.0; grad.len()];
    let log_sums = attention_keeping(isa, qkv, shape, &mut result);
    let mut out = vec![f32::NAN; qkv.len()];
    attention_backward(isa, Source { qkv, result: &result, log_sums: &log_sums, grad, shape }, &mut out);
    out
}

#[test]
fn every_shape() {
    let shapes =
        [(1, 1, 1, 1), (1, 2, 3, 8), (2, 20, 4, 16), (1, 97, 1, 64), (1, 255, 2, 24), (2, 193, 2, 7), (1, 300, 1, 40)];
    for isa in Isa::tested() {
        for (i, &(batch, tokens, heads, head_dim)) in shapes.iter().enumerate() {
            let s = Shape { batch, tokens, heads, head_dim };
            let mut qkv = noise(i as u64, batch * tokens * 3 * s.width(), 1.0);
            qkv.iter_mut().step_by(7).for_each(|x| *x *= 3.0);
            let grad = noise(i as u64 + 50, batch * tokens * s.width(), 1.0);
            let worst = worst_difference(&run(isa, &qkv, &grad, s), &reference(&qkv, &grad, s));
            let tolerance = if isa == Isa::Amx { TILES_TOLERANCE } else { TOLERANCE };
            assert!(worst < tolerance, "{isa:?} {s:?}: {worst:e}");
        }
    }
}

#[test]
fn big_logits_stay_finite() {
    let s = Shape { batch: 1, tokens: 150, heads: 2, head_dim: 16 };
    let mut qkv = noise(5, s.tokens * 3 * s.width(), 1.0);
    for row in qkv.chunks_exact_mut(3 * s.width()) {
        row[..2 * s.width()].iter_mut().for_each(|x| *x *= 100.0);
    }
    let grad = noise(6, s.tokens * s.width(), 1.0);
    for isa in Isa::tested() {
        assert!(run(isa, &qkv, &grad, s).iter().all(|x| x.is_finite()));
    }
}

#[test]
fn same_bits_for_any_thread_count() {
    let s = Shape { batch: 2, tokens: 233, heads: 3, head_dim: 20 };
    let qkv = noise(7, s.batch * s.tokens * 3 * s.width(), 2.0);
    let grad = noise(8, s.batch * s.tokens * s.width(), 1.0);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| run(Isa::detect(), &qkv, &grad, s)).iter().map(|v| v.to_bits()).collect::<Vec<_>>()
    };
    let one = with(1);
    for threads in [2, 3, 8] {
        assert!(with(threads) == one, "{threads} threads");
    }
}
