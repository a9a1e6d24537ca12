//! Muon: momentum whose singular values are made equal before it is applied (Jordan et al. 2024), for the matrices of the
//! transformer's blocks. Every direction a matrix has seen then moves at the same pace, which on a small budget learns more
//! per sample than AdamW; everything that is not such a matrix stays with AdamW.

use candle_core::{Device, Result, Tensor};
use serde::{Deserialize, Serialize};

/// Which rule moves the matrices of the transformer's blocks.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Optimizer {
    /// AdamW for all weights (the paper's).
    #[default]
    AdamW,
    /// Muon for the blocks' matrices, AdamW for the rest.
    Muon,
}

/// Decay of the momentum.
const MOMENTUM: f32 = 0.95;

/// Root mean square of an update over the learning rate: AdamW's usual one, so that one rate serves both (Liu et al. 2025).
const UPDATE_RMS: f64 = 0.2;

/// Quintic Newton-Schulz iteration towards the nearest orthogonal matrix: `a X + (b A + c A^2) X` with `A = X X^T`.
const QUINTIC: [f64; 3] = [3.4445, -4.7750, 2.0315];

/// Enough for singular values between about 0.7 and 1.2; more would not help.
const ITERATIONS: usize = 5;

/// Keeps the norm of a zero matrix from being divided by.
const EPS: f64 = 1e-7;

/// Whether a weight is one of the matrices Muon is for.
pub(super) fn takes(name: &str, shape: &[usize]) -> bool {
    shape.len() == 2 && name.starts_with("transformer.blocks.")
}

/// Adds the clipped gradient to the momentum and returns the update to be multiplied by the learning rate.
///
/// `name` and `shape` are the weight's: queries, keys and values share one stored matrix but are three.
pub(super) fn update(name: &str, shape: &[usize], gradient: &[f32], momentum: &mut [f32]) -> Result<Vec<f32>> {
    let mut ahead = Vec::with_capacity(gradient.len());
    for (m, &g) in momentum.iter_mut().zip(gradient) {
        *m = MOMENTUM * *m + g;
        ahead.push(g + MOMENTUM * *m);
    }
    let &[rows, cols] = shape else { return Ok(ahead) };
    let parts = if name.ends_with("attn.qkv.weight") && rows.is_multiple_of(3) { 3 } else { 1 };
    let part = rows / parts;
    let scale = UPDATE_RMS * (part.max(cols) as f64).sqrt();
    let all = Tensor::from_vec(ahead, (parts, part, cols), &Device::Cpu)?;
    let made = (0..parts).map(|k| (orthogonal(&all.get(k)?)? * scale)?.flatten_all()?.to_vec1());
    Ok(made.collect::<Result<Vec<Vec<f32>>>>()?.concat())
}

/// The matrix with the same singular vectors and all singular values near 1.
fn orthogonal(x: &Tensor) -> Result<Tensor> {
    let (rows, cols) = x.dims2()?;
    let tall = rows > cols;
    let x = if tall { x.t()?.contiguous()? } else { x.clone() };
    let norm = f64::from(x.sqr()?.sum_all()?.to_scalar::<f32>()?).sqrt();
    let mut x = (x * (norm + EPS).recip())?;
    let [a, b, c] = QUINTIC;
    for _ in 0..ITERATIONS {
        let square = x.matmul(&x.t()?)?;
        let inner = ((&square * b)? + (square.matmul(&square)? * c)?)?;
        x = ((&x * a)? + inner.matmul(&x)?)?;
    }
    if tall { x.t()?.contiguous() } else { Ok(x) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wave(n: usize, step: f32) -> Vec<f32> {
        (0..n).map(|i| (step * (i * i) as f32).sin()).collect()
    }

    /// What five iterations leave of singular values between the largest and a hundredth of it.
    const SINGULAR: std::ops::RangeInclusive<f32> = 0.3..=1.3;

    #[test]
    fn rows_of_a_wide_matrix_and_columns_of_a_tall_one_become_orthonormal() {
        for (rows, cols) in [(6, 40), (40, 6), (8, 8)] {
            let x = Tensor::from_vec(wave(rows * cols, 0.73), (rows, cols), &Device::Cpu).unwrap();
            let y = orthogonal(&x).unwrap();
            let gram = if rows > cols { y.t().unwrap().matmul(&y) } else { y.matmul(&y.t().unwrap()) };
            let gram = gram.unwrap().to_vec2::<f32>().unwrap();
            let trace: f32 = (0..gram.len()).map(|i| gram[i][i]).sum();
            let mean = (trace / gram.len() as f32).sqrt();
            assert!(SINGULAR.contains(&mean), "{rows}x{cols}: {mean}");
            // The same singular vectors: the product with x is positive definite in the sense of its trace.
            let along = (&x * &y).unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap();
            let length = x.sqr().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap().sqrt();
            assert!(along > 0.5 * length, "{rows}x{cols}: {along} of {length}");
        }
    }

    #[test]
    fn queries_keys_and_values_are_made_orthogonal_apart() {
        let (d, n) = (6, 3 * 6 * 6);
        // Values a hundred times larger than queries: one joint matrix would hardly move the queries.
        let gradient: Vec<f32> =
            wave(n, 0.41).iter().enumerate().map(|(i, g)| if i < n / 3 { *g } else { 100.0 * g }).collect();
        let mut momentum = vec![0.0; n];
        let out = update("transformer.blocks.0.attn.qkv.weight", &[3 * d, d], &gradient, &mut momentum).unwrap();
        let rms = |x: &[f32]| (x.iter().map(|x| x * x).sum::<f32>() / x.len() as f32).sqrt();
        let wanted = (UPDATE_RMS as f32, rms(&out[..n / 3]), rms(&out[n / 3..]));
        assert!((wanted.1 / wanted.0 - 1.0).abs() < 0.4 && (wanted.2 / wanted.0 - 1.0).abs() < 0.4, "{wanted:?}");
        assert_eq!(momentum, gradient);
    }

    #[test]
    fn a_zero_gradient_moves_nothing() {
        let mut momentum = vec![0.0; 12];
        let out = update("transformer.blocks.0.mlp.fc1.weight", &[3, 4], &[0.0; 12], &mut momentum).unwrap();
        assert!(out.iter().all(|&x| x == 0.0));
        assert!(
            takes("transformer.blocks.0.mlp.fc1.weight", &[3, 4]) && !takes("transformer.blocks.0.norm1.weight", &[4])
        );
        assert!(!takes("gs_pred.weight", &[3, 4]));
    }
}
