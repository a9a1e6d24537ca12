//! A scene to pictures (paper sections 3.1 and 3.2): move, splat, put the sky behind, apply the camera's exposure.

use std::borrow::Cow;

use rayon::prelude::*;
use storm_render::View;
use storm_render::raster::{Convention, CpuRasterizer, Picture, RasterSettings, Splats};

use super::{Affine, Scene, SkyModel};
use crate::config::{GsplatConvention, ModelConfig};
use crate::error::ModelError;
use crate::rays::{RayCamera, pixel_offset};

/// Which extra channels to draw.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Want {
    /// Scene flow.
    pub flow: bool,
    /// Motion groups; ignored for networks without motion tokens.
    pub motion: bool,
}

/// One picture of a scene, row-major. Every number is finite.
#[derive(Debug, Clone, PartialEq)]
pub struct RenderedView {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Colours in the network range: -1..1 is black to white, values may lie outside.
    pub color: Vec<[f32; 3]>,
    /// Opacity of the Gaussians, 0-1; the sky fills the rest.
    pub alpha: Vec<f32>,
    /// Expected z-depth, metres; 0 where nothing is hit.
    pub depth: Vec<f32>,
    /// Velocity summed by weight, not divided by alpha, m/s; slower Gaussians than the gate count as still.
    pub flow: Option<Vec<[f32; 3]>>,
    /// Motion token with the largest summed weight; the first wins ties, 0 where nothing is hit.
    pub motion_id: Option<Vec<u16>>,
}

/// Channels before the extra ones.
const COLOR_CHANNELS: usize = 3;
const FLOW_CHANNELS: usize = 3;

impl ModelConfig {
    /// How scenes of this network want to be rasterised.
    pub fn raster_settings(&self) -> RasterSettings {
        let convention = match self.gsplat {
            GsplatConvention::Pinned => Convention::Pinned,
            GsplatConvention::Latest => Convention::Latest,
        };
        RasterSettings {
            convention,
            near: self.near as f32,
            far: self.far as f32,
            blur: self.screen_blur_px2 as f32,
            ..RasterSettings::default()
        }
    }
}

impl RenderedView {
    /// The colours as 8-bit RGB, row-major, clamped.
    pub fn rgb8(&self) -> Vec<u8> {
        // `as u8` saturates.
        self.color.iter().flatten().map(|c| ((0.5 * c + 0.5) * 255.0).round() as u8).collect()
    }
}

impl Scene {
    /// How the network this scene comes from wants to be rasterised.
    pub fn raster_settings(&self) -> RasterSettings {
        self.config.raster_settings()
    }

    /// Renders the scene at `time_sec` (seconds since the window's first timestep) into every target.
    ///
    /// A target names the camera of the window whose exposure it gets; `None` gets the mean exposure. Gaussians move by
    /// their raw velocity whatever the flow gate: the gate only concerns the drawn flow.
    ///
    /// # Errors
    /// A camera the window does not have, a view or time that cannot be rendered, or a non-finite result.
    pub fn render(
        &self,
        rasterizer: &mut CpuRasterizer,
        targets: &[(View, Option<usize>)],
        time_sec: f32,
        want: Want,
    ) -> Result<Vec<RenderedView>, ModelError> {
        if !time_sec.is_finite() {
            return Err(ModelError::Input(format!("render time is {time_sec} s; use a finite number")));
        }
        let exposures = targets.iter().map(|(_, camera)| self.exposure(*camera)).collect::<Result<Vec<_>, _>>()?;
        let motion_count = if want.motion { self.gaussians.motion_count } else { 0 };
        let want = Want { motion: motion_count > 0, ..want };
        let means = self.means_at(time_sec);
        let (features, feature_count) = self.features(time_sec, want, motion_count);
        let splats = Splats {
            means: &means,
            quats: &self.gaussians.quats,
            scales: &self.gaussians.scales,
            opacities: &self.opacities_at(time_sec),
            features: &features,
            feature_count,
        };
        let views: Vec<View> = targets.iter().map(|(view, _)| *view).collect();
        let pictures = rasterizer.render(&splats, &views).map_err(|e| ModelError::Render(e.to_string()))?;
        let finish = |((picture, view), exposure): ((Picture, &View), &Affine)| {
            let rendered = self.finish(picture, view, exposure, want);
            rendered.check().map(|()| rendered)
        };
        pictures.into_iter().zip(&views).zip(&exposures).map(finish).collect()
    }

    /// Centres at a time, in order (paper eq. 1).
    pub fn means_at(&self, time_sec: f32) -> Vec<[f32; 3]> {
        (0..self.gaussians.len()).into_par_iter().map(|i| self.gaussians.mean_at(i, time_sec)).collect()
    }

    /// Opacities for drawing at a time, in order: those of Gaussians nearer to it count for more (`time_fade_sec`).
    ///
    /// What a window says of one place in different timesteps disagrees (movers most of all), and what was seen nearest to the
    /// time is least wrong about it. Weights multiply optical depths and their mean is 1, so that surfaces stay as dense.
    pub fn opacities_at(&self, time_sec: f32) -> Cow<'_, [f32]> {
        let opacities = &self.gaussians.opacities;
        let pixels = self.shape.height * self.shape.width;
        let pictures = self.shape.timesteps * self.shape.cameras;
        if pixels * pictures != opacities.len() {
            return Cow::Borrowed(opacities);
        }
        let own: Vec<f32> = self.gaussians.time_sec.iter().step_by(pixels.max(1)).copied().collect();
        let Some(weights) = fade_weights(&own, time_sec, self.config.time_fade_sec) else {
            return Cow::Borrowed(opacities);
        };
        let mut faded = opacities.clone();
        faded.par_chunks_mut(pixels).zip(&weights).for_each(|(picture, weight)| {
            picture.iter_mut().filter(|a| **a < 1.0).for_each(|a| *a = -(weight * (-*a).ln_1p()).exp_m1());
        });
        Cow::Owned(faded)
    }

    fn exposure(&self, camera: Option<usize>) -> Result<Affine, ModelError> {
        let Some(camera) = camera else { return Ok(Affine::mean(&self.affine)) };
        if camera >= self.shape.cameras {
            let text = format!("camera {camera} of a window with {} cameras", self.shape.cameras);
            return Err(ModelError::Input(text));
        }
        Ok(self.affine.get(camera).copied().unwrap_or(Affine::IDENTITY))
    }

    /// Rows of `[colour | flow | motion weights]`, the last two where wanted.
    fn features(&self, time_sec: f32, want: Want, motion_count: usize) -> (Vec<f32>, usize) {
        let flow_count = if want.flow { FLOW_CHANNELS } else { 0 };
        let count = COLOR_CHANNELS + flow_count + motion_count;
        let gate = self.config.flow_gate_mps as f32;
        let g = &self.gaussians;
        let mut features = vec![0f32; g.len() * count];
        features.par_chunks_exact_mut(count).enumerate().for_each(|(i, row)| {
            row[..COLOR_CHANNELS].copy_from_slice(&g.colors[i]);
            if want.flow {
                let earlier = time_sec < g.time_sec[i];
                let v = if earlier { g.velocity_backward[i] } else { g.velocity_forward[i] };
                let speed = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
                let drawn = if speed < gate { [0.0; 3] } else { v };
                row[COLOR_CHANNELS..COLOR_CHANNELS + FLOW_CHANNELS].copy_from_slice(&drawn);
            }
            let weights = &g.motion_weights[i * g.motion_count..i * g.motion_count + motion_count];
            row[COLOR_CHANNELS + flow_count..].copy_from_slice(weights);
        });
        (features, count)
    }

    fn finish(&self, picture: Picture, view: &View, exposure: &Affine, want: Want) -> RenderedView {
        let Picture { width, height, feature_count, features, alpha, depth } = picture;
        let pose = view.world_from_camera();
        let r = pose.matrix3.transpose();
        let rotation = [r.x_axis, r.y_axis, r.z_axis].map(|row| row.to_array().map(f64::from));
        let k = &view.intrinsics;
        let numbers = [k.fx, k.fy, k.cx, k.cy].map(f64::from);
        let camera = RayCamera::new(numbers, rotation, pixel_offset(&self.config));
        let pixel = |index: usize| &features[index * feature_count..(index + 1) * feature_count];
        let color = (0..width * height).into_par_iter().map(|index| {
            let f = pixel(index);
            let mut c = [f[0], f[1], f[2]];
            if let Some(sky) = &self.sky {
                let behind = sky_color(sky, &camera, index / width, index % width);
                let gap = 1.0 - alpha[index];
                (0..3).for_each(|p| c[p] += gap * behind[p]);
            }
            exposure.apply(c)
        });
        let color = color.collect();
        let flow = want.flow.then(|| (0..width * height).map(|i| [pixel(i)[3], pixel(i)[4], pixel(i)[5]]).collect());
        let motion_at = COLOR_CHANNELS + if want.flow { FLOW_CHANNELS } else { 0 };
        let motion_id =
            want.motion.then(|| (0..width * height).map(|i| first_largest(&pixel(i)[motion_at..])).collect());
        RenderedView { width, height, color, alpha, depth, flow, motion_id }
    }
}

/// What the optical depths of images taken at `own_sec` are multiplied by when `time_sec` is drawn; their mean is 1. None where all
/// count alike: no fade, or fewer than two images.
pub(crate) fn fade_weights(own_sec: &[f32], time_sec: f32, fade_sec: f64) -> Option<Vec<f32>> {
    if fade_sec <= 0.0 || own_sec.len() < 2 {
        return None;
    }
    // Not 0 where it was too small for f32: that would make the nearest NaN.
    let fade = (fade_sec as f32).max(f32::MIN_POSITIVE);
    let apart: Vec<f32> = own_sec.iter().map(|own| (time_sec - own).abs()).collect();
    // Relative to the nearest, so that not all can vanish.
    let least = apart.iter().copied().fold(f32::INFINITY, f32::min);
    let weights: Vec<f32> = apart.iter().map(|apart| ((least - apart) / fade).exp()).collect();
    let mean = weights.iter().sum::<f32>() / weights.len() as f32;
    Some(weights.into_iter().map(|weight| weight / mean).collect())
}

fn sky_color(sky: &SkyModel, camera: &RayCamera, row: usize, col: usize) -> [f32; 3] {
    sky.color(camera.direction(row, col))
}

/// Index of the largest value; the first of equals.
fn first_largest(values: &[f32]) -> u16 {
    let mut best = 0;
    for (k, &x) in values.iter().enumerate() {
        if x > values[best] {
            best = k;
        }
    }
    best as u16
}

impl RenderedView {
    fn check(&self) -> Result<(), ModelError> {
        let triples = |x: &[[f32; 3]]| x.iter().flatten().filter(|x| !x.is_finite()).count();
        let singles = |x: &[f32]| x.iter().filter(|x| !x.is_finite()).count();
        let counts = [
            ("rendered color", triples(&self.color)),
            ("rendered alpha", singles(&self.alpha)),
            ("rendered depth", singles(&self.depth)),
            ("rendered flow", self.flow.as_deref().map_or(0, triples)),
        ];
        match counts.into_iter().find(|(_, count)| *count > 0) {
            Some((tensor, count)) => Err(ModelError::NonFinite { tensor: tensor.to_owned(), count }),
            None => Ok(()),
        }
    }
}
