//! Pictures, rays and times to image tokens (paper section 3.1, "Network and input").

use candle_core::{DType, Device, Tensor};

use super::params::{Arranged, Params};
use super::resample::resample;
use super::stages::Stages;
use crate::clip::ClipBatch;
use crate::config::ModelConfig;
use crate::error::ModelError;
use crate::ops::{Activation, Linear, linear, patches};
use crate::rays::Rays;
use crate::weights::names::TIME_CHANNELS;

/// Longest period of the time encoding over its shortest.
const TIME_PERIODS: f64 = 1e4;

/// Patch, position and time embedding.
#[derive(Debug, Clone)]
pub(crate) struct Embed {
    patch: usize,
    grid: (usize, usize),
    proj: Arranged,
    width: usize,
    position: Option<Tensor>,
    time: [Linear; 2],
}

impl Embed {
    pub fn new(config: &ModelConfig, params: &Params<'_>) -> Result<Self, ModelError> {
        let position = if config.disable_pos_embed { None } else { Some(params.get("pos_embed")?) };
        Ok(Self {
            patch: config.patch_size,
            grid: config.grid(),
            proj: Arranged::new(params.linear("patch_embed.proj")?, patches_as_rows)?,
            width: config.embed_dim,
            position,
            time: [params.linear("time_embedder.mlp.0")?, params.linear("time_embedder.mlp.2")?],
        })
    }

    /// `(b, t v rows cols, d)`.
    pub fn forward(&self, batch: &ClipBatch, rays: &Rays, stages: &mut Stages) -> Result<Tensor, ModelError> {
        let [b, t, v, h, w] = batch.dims()?;
        let (p, d) = (self.patch, self.width);
        let (rows, cols) = (h / p, w / p);
        let views = b * t * v;
        let patches = patches(&batch.image.reshape((views, 3, h, w))?, &rays.plucker, p)?;
        let proj = self.proj.layer()?;
        if stages.wants("patch_embed") {
            let tokens = linear(&patches, &proj, Activation::None, None)?;
            stages.keep("patch_embed", &tokens.reshape((views, rows, cols, d))?);
        }
        let time = self.time(batch, stages)?.reshape((views, 1, d))?;
        let added = match self.position(rows, cols)? {
            Some(position) => time.broadcast_add(&position)?,
            None => time.broadcast_as((views, rows * cols, d))?,
        };
        let added = added.contiguous()?.reshape((views * rows * cols, d))?;
        let tokens = linear(&patches, &proj, Activation::None, Some(&added))?;
        Ok(tokens.reshape((b, t * v * rows * cols, d))?)
    }

    /// `(1, rows cols, d)` for a patch grid, or none when the network has no position embedding.
    pub fn position(&self, rows: usize, cols: usize) -> Result<Option<Tensor>, ModelError> {
        Ok(self.position.as_ref().map(|x| resample(x, self.grid, (rows, cols))).transpose()?)
    }

    /// `(b, t, v, d)`.
    fn time(&self, batch: &ClipBatch, stages: &mut Stages) -> Result<Tensor, ModelError> {
        let shape = batch.time_sec.dims().to_vec();
        let times = batch.time_sec.flatten_all()?.to_dtype(DType::F64)?.to_vec1::<f64>()?;
        if let Some(index) = times.iter().position(|t| !t.is_finite()) {
            let (timestep, camera) = (index / shape[2] % shape[1], index % shape[2]);
            return Err(ModelError::NonFiniteInput { what: "time", camera, timestep, count: 1 });
        }
        let half = TIME_CHANNELS / 2;
        let mut waves = Vec::with_capacity(times.len() * TIME_CHANNELS);
        for time in times {
            let angles = (0..half).map(|k| {
                let frequency = (-TIME_PERIODS.ln() * k as f64 / half as f64).exp();
                time / batch.timespan_sec * frequency
            });
            waves.extend(angles.clone().map(f64::cos));
            waves.extend(angles.map(f64::sin));
        }
        let frequency_shape = [&shape[..], &[TIME_CHANNELS]].concat();
        let waves = Tensor::from_vec(waves, frequency_shape, &Device::Cpu)?.to_dtype(batch.image.dtype())?;
        let waves = waves.to_device(batch.image.device())?;
        stages.keep("time_freq", &waves);
        let x = linear(&waves, &self.time[0], Activation::Silu, None)?;
        let x = linear(&x, &self.time[1], Activation::None, None)?;
        stages.keep("time_embed", &x);
        Ok(x)
    }
}

/// A convolution whose stride is its kernel: one row of weights per output channel over a flattened patch.
fn patches_as_rows(conv: &Linear) -> candle_core::Result<Linear> {
    let outputs = conv.weight.dim(0)?;
    Ok(Linear::new(conv.weight.reshape((outputs, ()))?, conv.bias.clone()))
}
