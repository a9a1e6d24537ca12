//! Matching evidence in mid-network: after some blocks a coarse depth is read off the tokens, every cell's surface is looked for in
//! the neighbouring images as if it moved with each of a few velocities ([`cost`]), and what was found is added to the tokens.
//!
//! Beyond the paper: its network has to find correspondences by attention alone, which takes far more training than is to be had
//! here. The last layer starts at zero, so a network that gets a sweep begins as what it was.

mod cost;

use candle_core::{DType, Device, Tensor};
use candle_nn::ops::sigmoid;
use rayon::prelude::*;

pub(crate) use cost::CANDIDATES;
use cost::{Frame, Source, sweep};

use super::params::{Norm, Params};
use crate::clip::ClipBatch;
use crate::config::{DepthActivation, DepthMeaning, ModelConfig};
use crate::error::ModelError;
use crate::ops::{Activation, Linear, linear};

/// Cells a patch is divided into, down and across.
pub(crate) const CELLS: usize = 4;

/// Images each one is compared with: the same camera's at the timestep before, at the one after, and shortly before its own.
pub(crate) const SOURCES: usize = 3;

/// Numbers of evidence per patch.
pub(crate) const EVIDENCE: usize = CELLS * CELLS * SOURCES * CANDIDATES;

/// The layers.
#[derive(Debug, Clone)]
pub(crate) struct SweepHead {
    norm: Norm,
    depth: Linear,
    inject: Linear,
}

/// What a sweep gives.
pub(crate) struct Swept {
    /// `(b, patches, d)`, to be added to the tokens.
    pub added: Tensor,
    /// `(b, t, v, rows, cols)` of cells: the depths swept at, as the network states depth, metres.
    pub depths: Tensor,
}

impl SweepHead {
    pub fn new(params: &Params<'_>) -> Result<Self, ModelError> {
        Ok(Self {
            norm: params.norm("sweep.norm")?,
            depth: params.linear("sweep.depth")?,
            inject: Linear::new(params.get("sweep.inject.weight")?, None),
        })
    }

    /// `patches`: image tokens `(b, n, d)` of the timesteps of `batch` from `first` on.
    pub fn forward(
        &self,
        config: &ModelConfig,
        batch: &ClipBatch,
        first: usize,
        patches: &Tensor,
    ) -> Result<Swept, ModelError> {
        let [b, t, v, h, w] = batch.dims()?;
        let (rows, cols) = (h / config.patch_size, w / config.patch_size);
        let raw = linear(&self.norm.forward(patches)?, &self.depth, Activation::None, None)?;
        let raw = raw
            .reshape(vec![b * (t - first) * v, rows, cols, CELLS, CELLS])?
            .permute(vec![0, 1, 3, 2, 4])?
            .contiguous()?
            .reshape((b, t - first, v, rows * CELLS, cols * CELLS))?;
        let depth = sigmoid(&raw)?;
        let depths = match config.depth_activation {
            DepthActivation::Sigmoid => depth.affine(config.far - config.near, config.near)?,
            DepthActivation::Log => depth.affine((config.far / config.near).ln(), config.near.ln())?.exp()?,
        };
        let evidence = evidence(config, batch, first, &host(&depths)?)?;
        let shape = (b, (t - first) * v * rows * cols, EVIDENCE);
        let evidence =
            Tensor::from_vec(evidence, shape, &Device::Cpu)?.to_device(patches.device())?.to_dtype(patches.dtype())?;
        Ok(Swept { added: linear(&evidence, &self.inject, Activation::None, None)?, depths })
    }
}

fn host(x: &Tensor) -> candle_core::Result<Vec<f32>> {
    x.detach().to_device(&Device::Cpu)?.to_dtype(DType::F32)?.flatten_all()?.to_vec1()
}

/// Every view of a batch on the grid of cells, in order.
fn frames(batch: &ClipBatch, side: usize) -> Result<Vec<Frame>, ModelError> {
    let [_, _, _, h, w] = batch.dims()?;
    let (images, ks, poses) = (host(&batch.image)?, host(&batch.intrinsics)?, host(&batch.world_from_camera)?);
    let times = host(&batch.time_sec)?;
    let valid = batch.valid.as_ref().map(host).transpose()?;
    let view = |(i, &time_sec): (usize, &f32)| {
        let source = Source {
            image: &images[i * 3 * h * w..(i + 1) * 3 * h * w],
            valid: valid.as_ref().map(|valid| &valid[i * h * w..(i + 1) * h * w]),
            size: [h, w],
            intrinsics: &ks[9 * i..9 * i + 9],
            pose: &poses[16 * i..16 * i + 16],
            time_sec,
        };
        Frame::new(&source, side)
    };
    Ok(times.par_iter().enumerate().map(view).collect())
}

/// Evidence of every patch of the timesteps from `first` on, `(b, t, v, row, col, cell, source, candidate)`.
fn evidence(config: &ModelConfig, batch: &ClipBatch, first: usize, depths: &[f32]) -> Result<Vec<f32>, ModelError> {
    let [b, t, v, h, w] = batch.dims()?;
    // Patches of fewer pixels than cells are refused with the configuration.
    let side = config.patch_size / CELLS;
    let (rows, cols) = (h / config.patch_size, w / config.patch_size);
    let cells = rows * cols * CELLS * CELLS;
    let own = frames(batch, side)?;
    let prior = batch.prior.as_ref().map(|prior| frames(prior, side)).transpose()?;
    let along_ray = config.depth_meaning == DepthMeaning::RayDistance;
    let steps = t - first;
    let mut out = vec![0f32; b * steps * v * rows * cols * EVIDENCE];
    out.par_chunks_mut(rows * cols * EVIDENCE).zip(depths.par_chunks(cells)).enumerate().for_each(
        |(i, (out, depth))| {
            let (window, step, camera) = (i / (steps * v), first + i / v % steps, i % v);
            let at = |step: usize| (window * t + step) * v + camera;
            let Some(frame) = own.get(at(step)) else { return };
            let before = step.checked_sub(1).and_then(|step| own.get(at(step)));
            let after = if step + 1 < t { own.get(at(step + 1)) } else { None };
            // An image of the same moment stands for one that is missing.
            let shortly = prior.as_ref().and_then(|prior| prior.get(at(step))).filter(|p| !p.taken_with(frame));
            for (source, other) in [before, after, shortly].into_iter().enumerate() {
                let Some(other) = other else { continue };
                let scores = sweep(frame, depth, along_ray, other);
                for (cell, row) in scores.chunks_exact(CANDIDATES).enumerate() {
                    let (y, x) = (cell / (cols * CELLS), cell % (cols * CELLS));
                    let patch = y / CELLS * cols + x / CELLS;
                    let within = y % CELLS * CELLS + x % CELLS;
                    let start = (patch * CELLS * CELLS + within) * SOURCES + source;
                    out[start * CANDIDATES..(start + 1) * CANDIDATES].copy_from_slice(row);
                }
            }
        },
    );
    Ok(out)
}
