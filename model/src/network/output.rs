//! What the network says about a batch of windows, as tensors.

use std::sync::Arc;

use candle_core::{D, DType, Device, Tensor};
use rayon::prelude::*;
use storm_render::Gaussians;

use super::sky::SkyHead;
use super::tokens::Grid;
use crate::clip::cat_valid;
use crate::config::{AffineKind, ModelConfig};
use crate::error::ModelError;
use crate::kernels::tensors::with_values;
use crate::scene::{Affine, Scene, SceneShape, SkyModel};

/// Tensors of a forward pass; metres, seconds, m/s, in the window's world. Gradients flow through all of them.
#[derive(Debug, Clone)]
pub struct ClipOutput {
    /// `(b, t, v, h, w, 3)` centres at the pixel's own time.
    pub means: Tensor,
    /// `(b, t, v, h, w, 3)` linear scales.
    pub scales: Tensor,
    /// `(b, t, v, h, w, 4)` quaternions w, x, y, z, not normalised.
    pub quats: Tensor,
    /// `(b, t, v, h, w)`, 0-1.
    pub opacities: Tensor,
    /// `(b, t, v, h, w, 3)`, network range: -1..1 is black to white.
    pub colors: Tensor,
    /// `(b, t, v, h, w)` z-depth or ray distance, see [`crate::config::DepthMeaning`].
    pub depths: Tensor,
    /// `(b, t, v, h, w, 3)` velocity for earlier times (paper: `-v-`).
    pub velocity_backward: Tensor,
    /// `(b, t, v, h, w, 3)` velocity for later times; the same tensor for one-velocity networks.
    pub velocity_forward: Tensor,
    /// `(b, t, v, h, w, M)` soft motion groups; none without motion tokens.
    pub motion_weights: Option<Tensor>,
    /// `(b, M, 3 | 6)` velocity bases as the network states them; none without motion tokens.
    pub motion_bases: Option<Tensor>,
    /// `(b, t, v, rows, cols)` of cells (a quarter of a patch): depths a velocity sweep was made at, metres as `depths`; none without.
    pub swept_depths: Option<Tensor>,
    /// `(b, v, 3, 4)` exposure matrices, see [`crate::config::AffineKind`].
    pub affine: Option<Tensor>,
    /// `(b, 1, embed_dim)`; colours the sky through [`ClipOutput::sky_color`].
    pub sky_token: Option<Tensor>,
    /// `(b, t, v)` seconds, as given.
    pub time_sec: Tensor,
    /// `(b, t, v, h, w)`: 0 where the camera saw nothing, so that there is no Gaussian (opacity and velocity are 0 there), else
    /// 1; none: 1 everywhere.
    pub valid: Option<Tensor>,
    /// The network's configuration.
    pub config: Arc<ModelConfig>,
    pub(super) sky: Option<Arc<SkyHead>>,
}

impl ClipOutput {
    /// Sky colours `(b, n, 3)` of world directions `(b, n, 3)` that have z = 1 in their camera; none without a sky token.
    pub fn sky_color(&self, directions: &Tensor) -> Result<Option<Tensor>, ModelError> {
        match (&self.sky, &self.sky_token) {
            (Some(head), Some(token)) => Ok(Some(head.forward(directions, token)?)),
            _ => Ok(None),
        }
    }

    /// Exposure applied to colours `(b, v, n, 3)`, cameras in the window's order; unchanged without affine tokens.
    pub fn apply_affine(&self, colors: &Tensor) -> Result<Tensor, ModelError> {
        let Some(affine) = &self.affine else {
            return Ok(colors.clone());
        };
        Ok(match self.config.affine {
            AffineKind::Gain => colors.broadcast_mul(&affine.sum(D::Minus1)?.unsqueeze(2)?)?,
            AffineKind::MatrixBias => {
                let matrix = affine.narrow(D::Minus1, 0, 3)?.transpose(2, 3)?.contiguous()?;
                let bias = affine.narrow(D::Minus1, 3, 1)?.squeeze(D::Minus1)?.unsqueeze(2)?;
                colors.contiguous()?.matmul(&matrix)?.broadcast_add(&bias)?
            }
        })
    }

    /// The last `timesteps` timesteps.
    pub(super) fn last(&self, timesteps: usize) -> Result<Self, ModelError> {
        let part = |x: &Tensor| x.narrow(1, x.dim(1)?.saturating_sub(timesteps), timesteps);
        Ok(Self {
            means: part(&self.means)?,
            scales: part(&self.scales)?,
            quats: part(&self.quats)?,
            opacities: part(&self.opacities)?,
            colors: part(&self.colors)?,
            depths: part(&self.depths)?,
            velocity_backward: part(&self.velocity_backward)?,
            velocity_forward: part(&self.velocity_forward)?,
            motion_weights: self.motion_weights.as_ref().map(part).transpose()?,
            time_sec: part(&self.time_sec)?,
            valid: self.valid.as_ref().map(part).transpose()?,
            ..self.clone()
        })
    }

    /// Earlier timesteps and then this output's; sky, exposure and velocity bases are this one's.
    pub(super) fn after(self, earlier: &Self) -> Result<Self, ModelError> {
        self.joined(&[earlier, &self], 1)
    }

    /// What these outputs say of pixels, one after the other along an axis; what they say of windows is this one's.
    fn joined(&self, each: &[&Self], axis: usize) -> Result<Self, ModelError> {
        let cat = |pick: fn(&Self) -> &Tensor| Tensor::cat(&each.iter().map(|o| pick(o)).collect::<Vec<_>>(), axis);
        let weights: Option<Vec<&Tensor>> = each.iter().map(|o| o.motion_weights.as_ref()).collect();
        Ok(Self {
            means: cat(|o| &o.means)?,
            scales: cat(|o| &o.scales)?,
            quats: cat(|o| &o.quats)?,
            opacities: cat(|o| &o.opacities)?,
            colors: cat(|o| &o.colors)?,
            depths: cat(|o| &o.depths)?,
            velocity_backward: cat(|o| &o.velocity_backward)?,
            velocity_forward: cat(|o| &o.velocity_forward)?,
            motion_weights: weights.map(|all| Tensor::cat(&all, axis)).transpose()?,
            time_sec: cat(|o| &o.time_sec)?,
            valid: cat_valid(each.iter().map(|o| (o.valid.as_ref(), &o.opacities)), axis)?,
            ..self.clone()
        })
    }

    /// Bytes of its tensors.
    pub(super) fn bytes(&self) -> usize {
        let parts = [&self.means, &self.scales, &self.quats, &self.opacities, &self.colors, &self.depths];
        let motion = [&self.velocity_backward, &self.velocity_forward].into_iter().chain(&self.motion_weights);
        parts.into_iter().chain(motion).map(|x| x.elem_count() * x.dtype().size_in_bytes()).sum()
    }

    /// Several windows' outputs as one batch.
    pub(super) fn stack(each: &[Self]) -> Result<Self, ModelError> {
        let Some(first) = each.first() else { return Err(ModelError::Input("no windows to stack".into())) };
        let some = |pick: fn(&Self) -> Option<&Tensor>| {
            let all: Option<Vec<&Tensor>> = each.iter().map(pick).collect();
            all.map(|all| Tensor::cat(&all, 0)).transpose()
        };
        Ok(Self {
            motion_bases: some(|o| o.motion_bases.as_ref())?,
            affine: some(|o| o.affine.as_ref())?,
            sky_token: some(|o| o.sky_token.as_ref())?,
            ..first.joined(&each.iter().collect::<Vec<_>>(), 0)?
        })
    }

    /// Makes the pixels of patches that were not computed transparent and still. `keep` is of all the window's timesteps, of
    /// which the output may have the last ones.
    pub(super) fn hide(&mut self, keep: &[bool], grid: Grid) -> Result<(), ModelError> {
        let &[_, t, v, h, w] = self.opacities.dims() else {
            return Err(ModelError::Input("opacities are not (b, t, v, h, w)".into()));
        };
        let (down, across) = (h / grid.rows, w / grid.cols);
        let first = (grid.timesteps - t) * v;
        let pixels: Vec<f32> = (0..t * v * h * w)
            .map(|i| {
                let (picture, row, col) = (first + i / (h * w), i / w % h, i % w);
                let patch = (picture * grid.rows + row / down) * grid.cols + col / across;
                if keep.get(patch).copied().unwrap_or(true) { 1.0 } else { 0.0 }
            })
            .collect();
        self.show_only(&Tensor::from_vec(pixels, (1, t, v, h, w), self.opacities.device())?)
    }

    /// Makes what `shown` `(b or 1, t, v, h, w)` has a 0 for transparent and still.
    pub(super) fn show_only(&mut self, shown: &Tensor) -> Result<(), ModelError> {
        let mask = shown.to_dtype(self.opacities.dtype())?;
        self.opacities = self.opacities.broadcast_mul(&mask)?;
        let mask = mask.unsqueeze(D::Minus1)?;
        self.velocity_backward = self.velocity_backward.broadcast_mul(&mask)?;
        self.velocity_forward = self.velocity_forward.broadcast_mul(&mask)?;
        Ok(())
    }

    /// Window `index` of the batch as plain numbers, ready to render or publish.
    ///
    /// # Errors
    /// [`ModelError::NonFinite`] names the first tensor that holds a NaN or an infinity.
    pub fn scene(&self, index: usize) -> Result<Scene, ModelError> {
        let &[b, t, v, h, w] = self.opacities.dims() else {
            return Err(ModelError::Input("opacities are not (b, t, v, h, w)".into()));
        };
        if index >= b {
            return Err(ModelError::Input(format!("window {index} of a batch of {b}")));
        }
        let read = |name: &str, x: &Tensor| plain(name, &x.get(index)?);
        let triples = |name: &str, x: &Tensor| rows::<3>(name, &x.get(index)?);
        let times = read("time_sec", &self.time_sec)?;
        let (motion_count, motion_weights) = match &self.motion_weights {
            Some(weights) => (weights.dim(D::Minus1)?, read("motion_weights", weights)?),
            None => (0, Vec::new()),
        };
        let gaussians = Gaussians {
            means: triples("means", &self.means)?,
            quats: rows::<4>("quats", &self.quats.get(index)?)?,
            scales: triples("scales", &self.scales)?,
            opacities: read("opacities", &self.opacities)?,
            colors: triples("colors", &self.colors)?,
            velocity_backward: triples("velocity_backward", &self.velocity_backward)?,
            velocity_forward: triples("velocity_forward", &self.velocity_forward)?,
            time_sec: times.iter().flat_map(|&time| std::iter::repeat_n(time, h * w)).collect(),
            motion_count,
            motion_weights,
        };
        let sky = match (&self.sky, &self.sky_token) {
            (Some(head), Some(token)) => {
                let token = token.narrow(0, index, 1)?;
                plain("sky_token", &token)?;
                Some(sky_model(&self.config, head, &token)?)
            }
            _ => None,
        };
        let affine = match &self.affine {
            Some(affine) => {
                read("affine", affine)?.chunks_exact(12).map(|a| Affine::new(self.config.affine, a)).collect()
            }
            None => Vec::new(),
        };
        let motion_bases = match &self.motion_bases {
            Some(bases) => read("motion_bases", bases)?.chunks(bases.dim(2)?).map(<[f32]>::to_vec).collect(),
            None => Vec::new(),
        };
        let valid = match &self.valid {
            Some(valid) => read("valid", valid)?.into_iter().map(|x| x > 0.5).collect(),
            None => Vec::new(),
        };
        Ok(Scene {
            gaussians,
            shape: SceneShape { timesteps: t, cameras: v, height: h, width: w },
            depths: read("depths", &self.depths)?,
            valid,
            sky,
            affine,
            motion_bases,
            config: Arc::clone(&self.config),
        })
    }
}

/// Values a task checks and copies.
const TASK_FLOATS: usize = 64 * 1024;

/// All values of a tensor on the host, refused when one is not finite.
fn plain(name: &str, x: &Tensor) -> Result<Vec<f32>, ModelError> {
    Ok(rows::<1>(name, x)?.into_iter().map(|[x]| x).collect())
}

/// All values of a tensor on the host in rows of `N`, refused when one is not finite.
fn rows<const N: usize>(name: &str, x: &Tensor) -> Result<Vec<[f32; N]>, ModelError>
where
    [f32; N]: bytemuck::Pod,
{
    let host = x.to_device(&Device::Cpu)?.to_dtype(DType::F32)?;
    let values = with_values(&host, |values| {
        let Ok(values) = bytemuck::try_cast_slice::<f32, [f32; N]>(values) else {
            candle_core::bail!("{name}: {} values are no rows of {N}", values.len());
        };
        let bad = |part: &[[f32; N]]| part.as_flattened().iter().map(|x| usize::from(!x.is_finite())).sum::<usize>();
        let count: usize = values.par_chunks(TASK_FLOATS / N).map(bad).sum();
        Ok(if count == 0 { Ok(values.to_vec()) } else { Err(count) })
    })?;
    values.map_err(|count| ModelError::NonFinite { tensor: name.to_owned(), count })
}

fn sky_model(config: &ModelConfig, head: &SkyHead, token: &Tensor) -> Result<SkyModel, ModelError> {
    let (shift, scale) = head.modulate(token)?;
    let bias = |layer: &crate::ops::Linear, name: &str| match &layer.bias {
        Some(bias) => plain(name, bias),
        None => Ok(vec![0.0; layer.weight.dim(0)?]),
    };
    Ok(SkyModel::collapse(
        config.sky,
        &plain("sky_head.linear.weight", &head.linear.weight)?,
        &bias(&head.linear, "sky_head.linear.bias")?,
        &plain("sky shift", &shift)?,
        &plain("sky scale", &scale)?,
        &plain("sky_head.output.weight", &head.output.weight)?,
        &bias(&head.output, "sky_head.output.bias")?,
    ))
}
