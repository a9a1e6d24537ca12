//! A training clip of recorded pictures: no drive behind them, so labels only where the recording has them.

use candle_core::{Device, Tensor};
use glam::{Affine3A, DMat3};
use storm_render::Intrinsics;
use storm_render::world::WorldFrame;

use super::clips::{Shot, TrainClip};
use super::error::TrainError;
use super::truth::{SkySamples, Truth};
use crate::config::ModelConfig;
use crate::error::ModelError;

/// What is known about a pixel and the sky.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum SkyLabel {
    /// The ray meets a surface.
    Surface,
    /// The ray meets the sky.
    Sky,
    /// Nobody said.
    Unknown,
}

/// One recorded picture and where it was taken.
#[derive(Debug, Clone, Copy)]
pub struct RecordedPicture<'a> {
    /// `3 * width * height`, row by row, red, green, blue.
    pub rgb: &'a [u8],
    /// The camera, in pixels of this picture.
    pub intrinsics: Intrinsics,
    /// The camera's pose in the clip's anchor frame.
    pub anchor_from_camera: Affine3A,
    /// Seconds since the clip's first timestep.
    pub time_sec: f32,
    /// z-depth, metres, 0 where unknown; `None` without depth.
    pub depth: Option<&'a [f32]>,
    /// Sky or not; `None`: unknown everywhere.
    pub sky: Option<&'a [SkyLabel]>,
}

impl RecordedPicture<'_> {
    fn check(&self) -> Result<(), TrainError> {
        let Intrinsics { width, height, .. } = self.intrinsics;
        let pixels = width.checked_mul(height).unwrap_or(usize::MAX);
        let wrong = |what: &str, got: usize| {
            Err(TrainError::Source(format!("a recorded picture of {width}x{height} pixels has {got} {what}")))
        };
        if Some(self.rgb.len()) != pixels.checked_mul(3) {
            return wrong("colour values", self.rgb.len());
        }
        match (self.depth, self.sky) {
            (Some(depth), _) if depth.len() != pixels => wrong("depths", depth.len()),
            (_, Some(sky)) if sky.len() != pixels => wrong("sky labels", sky.len()),
            _ => Ok(()),
        }
    }

    /// As the picture of a drive of which neither motion nor, where they are missing, depth and sky are known.
    fn shot(&self) -> Shot {
        let Intrinsics { width, height, .. } = self.intrinsics;
        let pixels = width * height;
        // A depth that is no number, negative or infinite is no depth.
        let depth = |&z: &f32| if z > 0.0 && z.is_finite() { z } else { 0.0 };
        let frame = WorldFrame {
            width,
            height,
            rgb: self.rgb.to_vec(),
            depth: self.depth.map_or_else(|| vec![0.0; pixels], |d| d.iter().map(depth).collect()),
            flow: vec![[0.0; 3]; pixels],
            instance: vec![0; pixels],
            sky: self.sky.map_or_else(
                || vec![0; pixels],
                |labels| labels.iter().map(|&l| u8::from(l == SkyLabel::Sky)).collect(),
            ),
            moving: vec![0; pixels],
        };
        Shot {
            frame,
            intrinsics: self.intrinsics,
            anchor_from_camera: self.anchor_from_camera,
            time_sec: self.time_sec,
        }
    }

    /// 1 where the sky label holds.
    fn sky_known(&self) -> Vec<f32> {
        let pixels = self.intrinsics.width * self.intrinsics.height;
        match self.sky {
            Some(labels) => labels.iter().map(|&l| if l == SkyLabel::Unknown { 0.0 } else { 1.0 }).collect(),
            None => vec![0.0; pixels],
        }
    }
}

/// A clip of recorded pictures `[timestep][camera]`; `target` may be empty. `span_sec` is the network's timespan.
///
/// # Errors
/// Sizes that do not fit, as [`crate::ClipBatch::from_views`] refuses them.
pub fn recorded_clip(
    context: &[Vec<RecordedPicture<'_>>],
    target: &[Vec<RecordedPicture<'_>>],
    span_sec: f64,
    config: &ModelConfig,
) -> Result<TrainClip, TrainError> {
    context.iter().chain(target).flatten().try_for_each(RecordedPicture::check)?;
    let shots = |rows: &[Vec<RecordedPicture<'_>>]| -> Vec<Vec<Shot>> {
        rows.iter().map(|row| row.iter().map(RecordedPicture::shot).collect()).collect()
    };
    let batch = |rows: &[Vec<RecordedPicture<'_>>], shots: &[Vec<Shot>]| -> Result<_, TrainError> {
        let clip = Shot::clip(shots, span_sec)?;
        let mut truth = Truth::of(shots, &DMat3::IDENTITY, config)?;
        let known: Vec<f32> = rows.iter().flatten().flat_map(RecordedPicture::sky_known).collect();
        truth.sky_known = Tensor::from_vec(known, truth.sky.dims(), &Device::Cpu)?;
        truth.flow_known = truth.flow_known.zeros_like()?;
        Ok((clip, truth))
    };
    if context.is_empty() {
        return Err(ModelError::Input("a recorded clip has no timestep".into()).into());
    }
    let made = shots(context);
    let (clip, context_truth) = batch(context, &made)?;
    let target = if target.is_empty() { None } else { Some(batch(target, &shots(target))?) };
    Ok(TrainClip { context: clip, context_truth, sky: SkySamples::of(&made, config)?, target })
}
