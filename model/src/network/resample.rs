//! Resampling of the position embedding to other patch grids.

use candle_core::{Device, Result, Tensor};

/// Keys' cubic with a = -0.5.
fn cubic(x: f64) -> f64 {
    const A: f64 = -0.5;
    let x = x.abs();
    if x < 1.0 {
        ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0
    } else if x < 2.0 {
        ((A * x - 5.0 * A) * x + 8.0 * A) * x - 4.0 * A
    } else {
        0.0
    }
}

/// Row-major `(to, from)` weights of antialiased bicubic resampling with pixel centres at half integers
/// (`align_corners = False`): the filter widens when shrinking, and each row sums to 1.
fn weights(from: usize, to: usize) -> Vec<f64> {
    let ratio = from as f64 / to as f64;
    let stretch = ratio.max(1.0);
    let support = 2.0 * stretch;
    let mut out = vec![0f64; to * from];
    for i in 0..to {
        let centre = ratio * (i as f64 + 0.5);
        let low = (centre - support + 0.5).max(0.0) as usize;
        let high = ((centre + support + 0.5).max(0.0) as usize).min(from);
        let taps: Vec<f64> = (low..high).map(|j| cubic((j as f64 + 0.5 - centre) / stretch)).collect();
        let sum: f64 = taps.iter().sum();
        for (j, tap) in (low..high).zip(taps) {
            out[i * from + j] = tap / sum;
        }
    }
    out
}

/// `(1, rows * cols, d)` on grid `from` to grid `to`, both `(rows, cols)`.
pub(crate) fn resample(embedding: &Tensor, from: (usize, usize), to: (usize, usize)) -> Result<Tensor> {
    if from == to {
        return Ok(embedding.clone());
    }
    let d = embedding.dim(2)?;
    let matrix = |from: usize, to: usize| {
        let weights = Tensor::from_vec(weights(from, to), (to, from), &Device::Cpu)?;
        weights.to_dtype(embedding.dtype())?.to_device(embedding.device())
    };
    let (vertical, horizontal) = (matrix(from.0, to.0)?, matrix(from.1, to.1)?);
    let x = vertical.matmul(&embedding.reshape((from.0, from.1 * d))?)?;
    let x = x.reshape((to.0, from.1, d))?.transpose(0, 1)?.contiguous()?.reshape((from.1, to.0 * d))?;
    let x = horizontal.matmul(&x)?.reshape((to.1, to.0, d))?.transpose(0, 1)?;
    x.contiguous()?.reshape((1, to.0 * to.1, d))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_sum_to_one_and_the_same_size_is_the_identity() {
        for (from, to) in [(3, 6), (5, 9), (9, 5), (20, 3), (1, 4), (4, 1)] {
            for row in weights(from, to).chunks(from) {
                assert!((row.iter().sum::<f64>() - 1.0).abs() < 1e-6, "{from} -> {to}: {row:?}");
            }
        }
        let same = weights(4, 4);
        assert!((0..16).all(|i| same[i] == if i % 5 == 0 { 1.0 } else { 0.0 }));
    }
}
