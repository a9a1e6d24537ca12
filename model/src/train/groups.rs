//! Ground-truth flow as a choice between the motion tokens: which token's velocity a pixel should take.
//!
//! The error of a velocity alone has a trap: while direction and speed are still unknown, standing still is the best answer, and
//! the network stays there for long. Which token is right can be told apart much earlier, like a class.

use candle_core::{D, Tensor};

use super::losses::masked_mean;
use crate::error::ModelError;
use crate::network::ClipOutput;

/// How far from a pixel's velocity a token's may be and still take a good share of it, m/s: half the distance between
/// neighbours of the spread bases.
const SHARE_MPS: f64 = 1.5;

/// Keeps the logarithm of a share finite.
const EPS: f64 = 1e-6;

/// Cross-entropy of the motion weights against shares of the true velocity between the tokens' present velocities, weighted
/// by `weights` `(b, t, v, h, w)`. `flow` is `(b, t, v, h, w, 3)`, m/s. None without motion tokens.
pub(super) fn group_loss(output: &ClipOutput, flow: &Tensor, weights: &Tensor) -> Result<Option<Tensor>, ModelError> {
    let (Some(shares), Some(bases)) = (&output.motion_weights, &output.motion_bases) else { return Ok(None) };
    let (b, m, channels) = bases.dims3()?;
    // The forward velocity is the last one.
    let bases = bases.detach().narrow(D::Minus1, channels - 3, 3)?.contiguous()?;
    let pixels = flow.elem_count() / (3 * b);
    let wanted = wanted_shares(&flow.reshape((b, pixels, 3))?, &bases)?;
    let shares = shares.reshape((b, pixels, m))?;
    let right = (wanted * shares.affine(1.0 - EPS, EPS)?.log()?)?.sum(D::Minus1)?.neg()?;
    Ok(masked_mean(&right, &weights.reshape((b, pixels))?)?)
}

/// `(b, n, M)`: how velocities `(b, n, 3)` would be shared between bases `(b, M, 3)`; rows sum to 1.
fn wanted_shares(flow: &Tensor, bases: &Tensor) -> candle_core::Result<Tensor> {
    // -|f - v|^2 without |f|^2, which all tokens have in common.
    let along = flow.matmul(&bases.t()?.contiguous()?)?;
    let length = bases.sqr()?.sum(D::Minus1)?.unsqueeze(1)?;
    let near = (along * 2.0)?.broadcast_sub(&length)?;
    candle_nn::ops::softmax_last_dim(&(near / (2.0 * SHARE_MPS * SHARE_MPS))?)
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;

    #[test]
    fn a_velocity_goes_to_the_token_that_has_it_and_between_two_to_both() {
        let tensor = |x: &[f32]| Tensor::from_slice(x, (1, x.len() / 3, 3), &Device::Cpu).unwrap();
        let bases = tensor(&[0.0, 0.0, 0.0, 6.0, 0.0, 0.0, -6.0, 0.0, 0.0, 0.0, 9.0, 0.0]);
        let flow = tensor(&[6.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 40.0, 0.0, 0.0]);
        let shares = wanted_shares(&flow, &bases).unwrap().get(0).unwrap().to_vec2::<f32>().unwrap();
        assert!(shares[0][1] > 0.99 && shares[2][0] > 0.99 && shares[3][1] > 0.99, "{shares:?}");
        assert!((shares[1][0] - 0.5).abs() < 1e-3 && (shares[1][1] - 0.5).abs() < 1e-3, "{shares:?}");
    }
}
