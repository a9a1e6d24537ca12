//! Older timesteps taken again: a window that goes on where an earlier one ended computes its newest timestep alone.
//!
//! A forward pass leaves the keys and values of its image tokens in every block, and its Gaussians. The next window, in the
//! same frame and on the same clock (the anchor stays where it was, times go on), has as queries the newest timestep's tokens
//! and those that are no patches; its keys are theirs and the kept ones. Older timesteps do not see newer ones, so that this
//! approximates the full pass; and as the anchor falls behind, poses and times leave what the network was trained with, so
//! that a full pass is due now and then (`storm train --anchor-lead` trains for it).

use candle_core::Tensor;

use super::stages::Stages;
use super::transformer::Taken;
use super::{ClipOutput, Storm};
use crate::clip::ClipBatch;
use crate::error::ModelError;
use crate::ops::Precision;
use crate::rays::Rays;

/// What a forward pass leaves for one that goes on from it.
#[derive(Debug, Clone)]
pub struct Kept {
    /// Keys and values of the image tokens, one `(b, n, 2 d)` per block.
    keys_values: Vec<Tensor>,
    output: ClipOutput,
    /// `(b, t, v, h, w)` of the window.
    dims: [usize; 5],
}

impl Kept {
    /// Bytes it holds.
    pub fn bytes(&self) -> usize {
        let keys_values: usize = self.keys_values.iter().map(|x| x.elem_count() * x.dtype().size_in_bytes()).sum();
        keys_values + self.output.bytes()
    }
}

/// What is taken of the timesteps before the newest one.
struct Older {
    keys_values: Vec<Tensor>,
    output: ClipOutput,
}

impl Storm {
    /// As [`Storm::forward`] with products in `precision`, leaving what [`Storm::forward_reusing`] goes on from.
    ///
    /// # Errors
    /// Those of [`Storm::forward`].
    pub fn forward_keeping(&self, batch: &ClipBatch, precision: Precision) -> Result<(ClipOutput, Kept), ModelError> {
        self.pass(batch, batch, None, precision)
    }

    /// The newest timestep of `batch`, whose older timesteps are the last ones of the window that left `kept`: the same
    /// pictures, and poses and times in the same frame and on the same clock as there. The output has all timesteps.
    ///
    /// # Errors
    /// Those of [`Storm::forward`], and a window that cannot go on from the one before: of another shape, or of more than one
    /// timestep more.
    pub fn forward_reusing(
        &self,
        batch: &ClipBatch,
        kept: &Kept,
        precision: Precision,
    ) -> Result<(ClipOutput, Kept), ModelError> {
        let dims @ [b, t, v, h, w] = batch.dims()?;
        let [kept_b, kept_t, kept_v, kept_h, kept_w] = kept.dims;
        if [b, v, h, w] != [kept_b, kept_v, kept_h, kept_w] || t < 2 || t > kept_t + 1 {
            let text = format!("a window {dims:?} (b, t, v, h, w) cannot go on from one of {:?}", kept.dims);
            return Err(ModelError::Input(text));
        }
        let (older, patch) = (t - 1, self.config.patch_size);
        let count = older * v * (h / patch) * (w / patch);
        let last = |x: &Tensor| x.narrow(1, x.dim(1)?.saturating_sub(count), count)?.contiguous();
        let keys_values = kept.keys_values.iter().map(last).collect::<Result<Vec<_>, _>>()?;
        let older = Older { keys_values, output: kept.output.last(older)? };
        self.pass(batch, &batch.timestep(t - 1)?, Some(older), precision)
    }

    /// `new`: the timesteps of `whole` that are computed.
    fn pass(
        &self,
        whole: &ClipBatch,
        new: &ClipBatch,
        older: Option<Older>,
        precision: Precision,
    ) -> Result<(ClipOutput, Kept), ModelError> {
        let dims @ [_, _, v, h, w] = whole.dims()?;
        self.check_sizes(v, h, w)?;
        let stages = &mut Stages::none();
        let rays = Rays::new(&self.config, new)?;
        let image = self.embed.forward(new, &rays, stages)?;
        let patches = image.dim(1)?;
        let tokens = self.with_extra_tokens(image, v)?;
        let extra = tokens.dim(1)? - patches;
        let taken = Taken { extra, older: older.as_ref().map(|older| &older.keys_values[..]) };
        let first = whole.dims()?[1] - new.dims()?[1];
        let between = &mut |blocks: usize, x: Tensor| -> Result<Tensor, ModelError> {
            let config = &*self.config;
            let Some(head) = self.sweep.as_ref().filter(|_| blocks == config.sweep_after_block) else { return Ok(x) };
            let images = x.narrow(1, extra, patches)?.contiguous()?;
            let images = (&images + head.forward(config, whole, first, &images)?.added)?;
            Ok(Tensor::cat(&[&x.narrow(1, 0, extra)?, &images], 1)?)
        };
        let (tokens, keys_values) = self.transformer.forward_taking(tokens, &taken, precision, between)?;
        let output = self.decode(new, rays, &tokens, None, stages)?;
        let output = match older {
            Some(older) => output.after(&older.output)?,
            None => output,
        };
        Ok((output.clone(), Kept { keys_values, output, dims }))
    }
}
