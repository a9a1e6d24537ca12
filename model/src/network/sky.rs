//! The sky head: a view direction to a colour, modulated by the sky token (paper section 3.2 and appendix A.2).

use candle_core::{D, Tensor};

use super::params::{NORM_EPS, Params};
use crate::config::{ModelConfig, SkyKind};
use crate::error::ModelError;
use crate::ops::{Activation, Linear, layer_norm, linear};
use crate::weights::names::SKY_OCTAVES;

/// The head; [`crate::scene::SkyModel`] is its plain, collapsed form for one window.
#[derive(Debug, Clone)]
pub(crate) struct SkyHead {
    kind: SkyKind,
    pub linear: Linear,
    pub modulation: Linear,
    pub condition: Linear,
    pub output: Linear,
}

impl SkyHead {
    pub fn new(config: &ModelConfig, params: &Params<'_>) -> Result<Self, ModelError> {
        Ok(Self {
            kind: config.sky,
            linear: params.linear("sky_head.linear")?,
            modulation: params.linear("sky_head.adaLN_modulation.1")?,
            condition: params.linear("sky_head.condition_mapping")?,
            output: params.linear("sky_head.output")?,
        })
    }

    /// Shift and scale `(b, hidden)` from the sky token `(b, 1, d)`.
    pub fn modulate(&self, token: &Tensor) -> candle_core::Result<(Tensor, Tensor)> {
        let condition = linear(&token.squeeze(1)?, &self.condition, Activation::Silu, None)?;
        let both = linear(&condition, &self.modulation, Activation::None, None)?;
        let hidden = both.dim(1)? / 2;
        Ok((both.narrow(1, 0, hidden)?.contiguous()?, both.narrow(1, hidden, hidden)?.contiguous()?))
    }

    /// Colours `(b, n, 3)` of directions `(b, n, 3)` with z = 1 in their camera.
    pub fn forward(&self, directions: &Tensor, token: &Tensor) -> candle_core::Result<Tensor> {
        let (shift, scale) = self.modulate(token)?;
        let x = match self.kind {
            SkyKind::Raw512 => directions.clone(),
            SkyKind::Frequency64 => encode(directions)?,
        };
        let x = linear(&x, &self.linear, Activation::None, None)?;
        let x = layer_norm(&x, None, None, NORM_EPS)?;
        let x = x.broadcast_mul(&(scale + 1.0)?.unsqueeze(1)?)?.broadcast_add(&shift.unsqueeze(1)?)?;
        linear(&x, &self.output, Activation::None, None)
    }
}

/// NeRF's frequency encoding of unit directions: per octave k, `sin(2^k pi d)` then `cos(2^k pi d)`.
fn encode(directions: &Tensor) -> candle_core::Result<Tensor> {
    let length = directions.sqr()?.sum_keepdim(D::Minus1)?.sqrt()?;
    let unit = directions.broadcast_div(&length)?;
    let mut parts = Vec::with_capacity(2 * SKY_OCTAVES);
    for k in 0..SKY_OCTAVES {
        let angle = (&unit * (f64::from(1 << k) * std::f64::consts::PI))?;
        parts.push(angle.sin()?);
        parts.push(angle.cos()?);
    }
    Tensor::cat(&parts, D::Minus1)
}
