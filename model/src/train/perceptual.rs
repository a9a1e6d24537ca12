//! What stands in for LPIPS where no trained feature network is at hand.
//!
//! At three scales (full, half, quarter size) the mean absolute difference of the pictures' horizontal and vertical colour
//! differences: edges have to be where they are and as steep as they are, whatever the mean colour. It is no perceptual
//! metric learned from people, and figures trained with it must say so.

use candle_core::{Result, Tensor};

/// Scales compared; each halves the picture.
const SCALES: usize = 3;

/// Structure difference of two pictures `(b, t, v, h, w, 3)` in the network range.
pub fn structure_loss(pred: &Tensor, truth: &Tensor) -> Result<Tensor> {
    let &[b, t, v, h, w, c] = pred.dims() else {
        candle_core::bail!("structure loss: pictures have shape {:?}, expected (b, t, v, h, w, 3)", pred.dims());
    };
    // Differences are linear, so those of the error picture are the differences' error.
    let mut error = (pred - truth)?.reshape((b * t * v, h, w, c))?;
    let mut sum: Option<Tensor> = None;
    for scale in 0..SCALES {
        if scale > 0 {
            match half(&error)? {
                Some(smaller) => error = smaller,
                None => break,
            }
        }
        for axis in [1, 2] {
            let n = error.dim(axis)?;
            if n < 2 {
                continue;
            }
            let edge = (error.narrow(axis, 1, n - 1)? - error.narrow(axis, 0, n - 1)?)?.abs()?.mean_all()?;
            sum = Some(match sum {
                Some(sum) => (sum + edge)?,
                None => edge,
            });
        }
    }
    match sum {
        Some(sum) => sum / (2 * SCALES) as f64,
        None => (error * 0.0)?.sum_all(),
    }
}

/// Means of 2 x 2 pixels; an odd last row or column is left out; `None` when nothing would be left.
fn half(x: &Tensor) -> Result<Option<Tensor>> {
    let (n, h, w, c) = x.dims4()?;
    if h < 2 || w < 2 {
        return Ok(None);
    }
    let even = x.narrow(1, 0, h / 2 * 2)?.narrow(2, 0, w / 2 * 2)?.contiguous()?;
    Ok(Some(even.reshape((n, h / 2, 2, w / 2, 2, c))?.mean(4)?.mean(2)?))
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;

    fn picture(f: impl Fn(usize, usize) -> f32) -> Tensor {
        let values: Vec<f32> = (0..8 * 12).flat_map(|i| [f(i / 12, i % 12); 3]).collect();
        Tensor::from_vec(values, (1, 1, 1, 8, 12, 3), &Device::Cpu).unwrap()
    }

    fn loss(a: &Tensor, b: &Tensor) -> f32 {
        structure_loss(a, b).unwrap().to_scalar().unwrap()
    }

    #[test]
    fn edges_count_and_brightness_does_not() {
        let edge = picture(|_, x| if x < 5 { -0.5 } else { 0.5 });
        let moved = picture(|_, x| if x < 7 { -0.5 } else { 0.5 });
        let flat = picture(|_, _| 0.0);
        assert_eq!(loss(&edge, &edge), 0.0);
        assert!(loss(&edge, &(&edge + 0.2).unwrap()) < 1e-6);
        assert!(loss(&moved, &edge) > loss(&flat, &edge), "a wrong edge is worse than none");
        assert!(loss(&flat, &edge) > 0.01);
    }
}
