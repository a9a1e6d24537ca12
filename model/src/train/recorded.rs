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
    /// Whether the camera saw the pixel; nothing is learned from others. `None`: it saw all.
    pub valid: Option<&'a [bool]>,
}

impl RecordedPicture<'_> {
    fn check(&self) -> Result<(), TrainError> {
        let Intrinsics { width, height, .. } = self.intrinsics;
        let pixels = width.saturating_mul(height);
        let wrong = |what: &str, got: usize| {
            Err(TrainError::Source(format!("a recorded picture of {width}x{height} pixels has {got} {what}")))
        };
        if Some(self.rgb.len()) != pixels.checked_mul(3) {
            return wrong("colour values", self.rgb.len());
        }
        match (self.depth, self.sky) {
            (Some(depth), _) if depth.len() != pixels => wrong("depths", depth.len()),
            (_, Some(sky)) if sky.len() != pixels => wrong("sky labels", sky.len()),
            _ => match self.valid {
                Some(valid) if valid.len() != pixels => wrong("marks of validity", valid.len()),
                _ => Ok(()),
            },
        }
    }

    /// As the picture of a drive of which neither motion nor, where they are missing, depth and sky are known.
    fn shot(&self) -> Shot {
        let Intrinsics { width, height, .. } = self.intrinsics;
        let pixels = width * height;
        // A depth that is no number, negative or infinite is no depth, and neither is one of a pixel nobody saw.
        let depth = |(i, &z): (usize, &f32)| if z > 0.0 && z.is_finite() && self.is_valid(i) { z } else { 0.0 };
        let sky = |(i, &l): (usize, &SkyLabel)| u8::from(l == SkyLabel::Sky && self.is_valid(i));
        let frame = WorldFrame {
            width,
            height,
            rgb: self.rgb.to_vec(),
            depth: self.depth.map_or_else(|| vec![0.0; pixels], |d| d.iter().enumerate().map(depth).collect()),
            flow: vec![[0.0; 3]; pixels],
            instance: vec![0; pixels],
            sky: self.sky.map_or_else(|| vec![0; pixels], |labels| labels.iter().enumerate().map(sky).collect()),
            moving: vec![0; pixels],
        };
        Shot {
            frame,
            intrinsics: self.intrinsics,
            anchor_from_camera: self.anchor_from_camera,
            time_sec: self.time_sec,
            valid: self.valid.map(<[bool]>::to_vec),
        }
    }

    fn is_valid(&self, i: usize) -> bool {
        self.valid.is_none_or(|valid| valid[i])
    }

    /// 1 where the sky label holds.
    fn sky_known(&self) -> Vec<f32> {
        let pixels = self.intrinsics.width * self.intrinsics.height;
        match self.sky {
            Some(labels) => {
                let known = |(i, &l): (usize, &SkyLabel)| l != SkyLabel::Unknown && self.is_valid(i);
                labels.iter().enumerate().map(|x| f32::from(u8::from(known(x)))).collect()
            }
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

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use storm_render::raster::CpuRasterizer;

    use super::*;
    use crate::network::Storm;
    use crate::train::losses::RenderLossOptions;
    use crate::train::{PixelLossOptions, SharedRenderer, pixel_losses, render_stage_losses};

    const SIZE: (usize, usize) = (24, 16);

    fn config() -> ModelConfig {
        ModelConfig {
            embed_dim: 32,
            depth: 1,
            num_heads: 2,
            image_height: SIZE.1,
            image_width: SIZE.0,
            upsampler_widths: vec![16, 16, 8],
            ..ModelConfig::preset("tiny").unwrap()
        }
    }

    /// Two timesteps of one camera, a target between them, with the labels given.
    fn clip(depth: Option<&[f32]>, sky: Option<&[SkyLabel]>) -> TrainClip {
        let rgb: Vec<u8> = (0..3 * SIZE.0 * SIZE.1).map(|i| (i * 37 % 251) as u8).collect();
        let intrinsics = Intrinsics { fx: 12.0, fy: 12.0, cx: 12.0, cy: 8.0, width: SIZE.0, height: SIZE.1 };
        // Optical axes in a frame of x forward, y left, z up.
        let axes = glam::Mat3::from_cols(glam::Vec3::NEG_Y, glam::Vec3::NEG_Z, glam::Vec3::X);
        let picture = |time_sec: f32| RecordedPicture {
            rgb: &rgb,
            intrinsics,
            anchor_from_camera: Affine3A::from_mat3_translation(axes, glam::Vec3::X * 5.0 * time_sec),
            time_sec,
            depth,
            sky,
            valid: None,
        };
        let rows = |times: &[f32]| times.iter().map(|&t| vec![picture(t)]).collect::<Vec<_>>();
        recorded_clip(&rows(&[0.0, 0.5]), &rows(&[0.2]), 2.0, &config()).unwrap()
    }

    /// Names of the terms of both stages, everything finite, gradients too.
    fn terms(clip: &TrainClip) -> [Vec<&'static str>; 2] {
        let config = config();
        let storm = Storm::untrained(&config, 2, &Device::Cpu).unwrap();
        let output = storm.forward(&clip.context).unwrap();
        let renderer: SharedRenderer = Arc::new(Mutex::new(CpuRasterizer::new(config.raster_settings()).unwrap()));
        let options = RenderLossOptions { structure_from_step: 0, ..RenderLossOptions::default() };
        let render = render_stage_losses(&output, clip, &renderer, &options, None, 0).unwrap();
        let pixel = pixel_losses(&output, clip, &PixelLossOptions::default()).unwrap();
        [pixel, render].map(|terms| {
            let values = terms.values().unwrap();
            assert!(values.iter().all(|(_, x)| x.is_finite()), "{values:?}");
            values.iter().map(|(name, _)| *name).collect()
        })
    }

    #[test]
    fn what_nobody_labelled_teaches_nothing() {
        let [pixel, render] = terms(&clip(None, None));
        assert_eq!(pixel, ["color", "velocity"]);
        assert_eq!(render, ["rgb", "structure", "velocity"]);

        let pixels = SIZE.0 * SIZE.1;
        let ground: Vec<SkyLabel> =
            (0..pixels).map(|i| if i < pixels / 2 { SkyLabel::Unknown } else { SkyLabel::Surface }).collect();
        let [pixel, render] = terms(&clip(None, Some(&ground)));
        assert_eq!(pixel, ["color", "opacity", "velocity"]);
        assert_eq!(render, ["rgb", "structure", "velocity", "sky_opacity"]);

        let mut depth = vec![0.0; pixels];
        (depth[pixels - 1], depth[0], depth[1], depth[2]) = (7.5, f32::NAN, -3.0, f32::INFINITY);
        let sparse = clip(Some(&depth), Some(&ground));
        assert_eq!(sparse.context_truth.measured().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap(), 2.0);
        let [pixel, render] = terms(&sparse);
        assert_eq!(pixel, ["log_depth", "pixel_depth", "color", "opacity", "scale", "velocity"]);
        assert_eq!(render, ["rgb", "depth", "structure", "velocity", "sky_opacity"]);

        let sky: Vec<SkyLabel> =
            (0..pixels).map(|i| if i < pixels / 2 { SkyLabel::Sky } else { SkyLabel::Surface }).collect();
        let [pixel, _] = terms(&clip(None, Some(&sky)));
        assert_eq!(pixel, ["color", "opacity", "sky_color", "velocity"]);
    }

    #[test]
    fn pixels_nobody_saw_teach_nothing() {
        let pixels = SIZE.0 * SIZE.1;
        // The upper third is one patch row that nobody saw; a few pixels more below it.
        let valid: Vec<bool> = (0..pixels).map(|i| i >= SIZE.0 * 8 + 5).collect();
        let config = config();
        let intrinsics = Intrinsics { fx: 12.0, fy: 12.0, cx: 12.0, cy: 8.0, width: SIZE.0, height: SIZE.1 };
        let depth = vec![9.0; pixels];
        let sky = vec![SkyLabel::Sky; pixels];
        let make = |unseen: u8| {
            let colour = |i: usize| if valid[i / 3] { (i * 37 % 251) as u8 } else { unseen };
            let rgb: Vec<u8> = (0..3 * pixels).map(colour).collect();
            let picture = |time_sec: f32| RecordedPicture {
                rgb: &rgb,
                intrinsics,
                anchor_from_camera: Affine3A::from_translation(glam::Vec3::Z * time_sec),
                time_sec,
                depth: Some(&depth),
                sky: Some(&sky),
                valid: Some(&valid),
            };
            let rows = |times: &[f32]| times.iter().map(|&t| vec![picture(t)]).collect::<Vec<_>>();
            recorded_clip(&rows(&[0.0, 0.5]), &rows(&[0.2]), 2.0, &config).unwrap()
        };
        let clip = make(0);
        let count = |x: &Tensor| x.sum_all().unwrap().to_scalar::<f32>().unwrap();
        let seen = valid.iter().filter(|v| **v).count() as f32;
        assert_eq!(count(&clip.context_truth.measured().unwrap()), 2.0 * seen);
        assert_eq!(count(&clip.context_truth.sky_known), 2.0 * seen);
        // Drawn pictures: what stands in unseen pixels of the target changes no term.
        let storm = Storm::untrained(&config, 2, &Device::Cpu).unwrap();
        let output = storm.forward(&clip.context).unwrap();
        let renderer: SharedRenderer = Arc::new(Mutex::new(CpuRasterizer::new(config.raster_settings()).unwrap()));
        let options = RenderLossOptions { structure_from_step: 0, ..RenderLossOptions::default() };
        let render = |clip: &TrainClip| {
            render_stage_losses(&output, clip, &renderer, &options, None, 0).unwrap().values().unwrap()
        };
        let pixel =
            |clip: &TrainClip| pixel_losses(&output, clip, &PixelLossOptions::default()).unwrap().values().unwrap();
        assert_eq!(render(&clip), render(&make(200)));
        assert_eq!(pixel(&clip), pixel(&make(200)));
        let unmarked = TrainClip {
            target: clip.target.clone().map(|(c, t)| (crate::ClipBatch { valid: None, ..c }, t)),
            ..clip.clone()
        };
        assert_ne!(render(&clip), render(&unmarked));
        assert!(
            recorded_clip(
                &[vec![RecordedPicture {
                    rgb: &vec![0; 3 * pixels],
                    intrinsics,
                    anchor_from_camera: Affine3A::IDENTITY,
                    time_sec: 0.0,
                    depth: None,
                    sky: None,
                    valid: Some(&[true]),
                }]],
                &[],
                2.0,
                &config
            )
            .is_err()
        );
    }

    #[test]
    fn pictures_that_do_not_fit_their_size_are_refused() {
        let rgb = vec![0; 3 * SIZE.0 * SIZE.1];
        let intrinsics = Intrinsics { fx: 12.0, fy: 12.0, cx: 12.0, cy: 8.0, width: SIZE.0, height: SIZE.1 };
        let good = RecordedPicture {
            rgb: &rgb,
            intrinsics,
            anchor_from_camera: Affine3A::IDENTITY,
            time_sec: 0.0,
            depth: None,
            sky: None,
            valid: None,
        };
        let make = |picture: RecordedPicture<'_>| recorded_clip(&[vec![picture]], &[], 2.0, &config());
        make(good).unwrap();
        assert!(make(RecordedPicture { rgb: &rgb[1..], ..good }).is_err());
        assert!(make(RecordedPicture { depth: Some(&[1.0]), ..good }).is_err());
        assert!(make(RecordedPicture { sky: Some(&[SkyLabel::Sky]), ..good }).is_err());
        let huge = Intrinsics { width: usize::MAX, height: 2, ..intrinsics };
        assert!(make(RecordedPicture { intrinsics: huge, ..good }).is_err());
        let lost = Affine3A::from_translation(glam::Vec3::NAN);
        assert!(make(RecordedPicture { anchor_from_camera: lost, ..good }).is_err());
        assert!(recorded_clip(&[], &[], 2.0, &config()).is_err());
    }
}
