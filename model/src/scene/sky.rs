//! The sky of one window, collapsed.
//!
//! With the window's sky token known, the sky head is linear layer, layer norm, gain and shift, linear layer. The layer
//! norm only divides by one number per direction, so with `e` the encoded direction and a one behind it the whole head is
//! `A e / sqrt(e' G e + eps) + c`, with `A` 3 x k, `G` k x k and `c` 3 numbers: exact, and some 500 times less work per pixel
//! than the 512-wide layers. The layers themselves (`network::sky`) are the reference it is tested against.

use crate::config::SkyKind;
use crate::network::NORM_EPS;
use crate::rays::unit;
use crate::weights::names::{SKY_OCTAVES, sky_widths};

/// Colour of the sky in every direction.
#[derive(Debug, Clone, PartialEq)]
pub struct SkyModel {
    kind: SkyKind,
    /// Three rows of k: `W_out diag(1 + scale) [W_in - mean | b_in - mean]`.
    mix: Vec<f64>,
    /// k x k: mean over the hidden units of the products of the centred first layer's columns.
    gram: Vec<f64>,
    base: [f64; 3],
}

impl SkyModel {
    /// Collapses the head's layers; all matrices row-major `(out, in)`, `shift` and `scale` from the sky token.
    pub(crate) fn collapse(
        kind: SkyKind,
        weight: &[f32],
        bias: &[f32],
        shift: &[f32],
        scale: &[f32],
        out_weight: &[f32],
        out_bias: &[f32],
    ) -> Self {
        let (inputs, hidden) = sky_widths(kind);
        let k = inputs + 1;
        let mut x = vec![0f64; hidden * k];
        for unit in 0..hidden {
            for i in 0..inputs {
                x[unit * k + i] = f64::from(weight[unit * inputs + i]);
            }
            x[unit * k + inputs] = f64::from(bias[unit]);
        }
        for column in 0..k {
            let mean = (0..hidden).map(|u| x[u * k + column]).sum::<f64>() / hidden as f64;
            (0..hidden).for_each(|u| x[u * k + column] -= mean);
        }
        let mut gram = vec![0f64; k * k];
        for row in x.chunks_exact(k) {
            for i in 0..k {
                (0..k).for_each(|j| gram[i * k + j] += row[i] * row[j] / hidden as f64);
            }
        }
        let mut mix = vec![0f64; 3 * k];
        let mut base = [0f64; 3];
        for p in 0..3 {
            base[p] = f64::from(out_bias[p]);
            for u in 0..hidden {
                let w = f64::from(out_weight[p * hidden + u]);
                base[p] += w * f64::from(shift[u]);
                let gain = w * (1.0 + f64::from(scale[u]));
                (0..k).for_each(|i| mix[p * k + i] += gain * x[u * k + i]);
            }
        }
        Self { kind, mix, gram, base }
    }

    /// Colour (network range) along a world direction with z = 1 in its camera.
    pub fn color(&self, direction: [f64; 3]) -> [f32; 3] {
        match self.kind {
            SkyKind::Raw512 => self.evaluate(&[direction[0], direction[1], direction[2], 1.0]),
            SkyKind::Frequency64 => {
                let mut e = [1f64; 6 * SKY_OCTAVES + 1];
                let d = unit(direction);
                for i in 0..3 {
                    let (mut sin, mut cos) = (std::f64::consts::PI * d[i]).sin_cos();
                    for octave in 0..SKY_OCTAVES {
                        e[6 * octave + i] = sin;
                        e[6 * octave + 3 + i] = cos;
                        // The next octave is twice the angle.
                        (sin, cos) = (2.0 * sin * cos, 1.0 - 2.0 * sin * sin);
                    }
                }
                self.evaluate(&e)
            }
        }
    }

    fn evaluate(&self, e: &[f64]) -> [f32; 3] {
        let k = e.len();
        let dot = |row: &[f64]| row.iter().zip(e).map(|(a, b)| a * b).sum::<f64>();
        let variance: f64 = self.gram.chunks_exact(k).zip(e).map(|(row, x)| x * dot(row)).sum();
        let share = (variance.max(0.0) + NORM_EPS).sqrt().recip();
        [0, 1, 2].map(|p| (dot(&self.mix[p * k..(p + 1) * k]) * share + self.base[p]) as f32)
    }
}
