//! Ground truth of a clip as tensors, and samples of its sky.

use candle_core::{DType, Device, Tensor};
use glam::DMat3;

use super::clips::Shot;
use super::error::TrainError;
use crate::config::{DepthMeaning, ModelConfig};
use crate::rays::{RayCamera, pixel_offset};

/// Sky pixels looked at per camera and clip: the sky is smooth, a few say it all.
const SKY_SAMPLES: usize = 128;

/// What is true of every pixel's surface, all `(b, t, v, h, w)` f32.
#[derive(Debug, Clone)]
pub struct Truth {
    /// z-depth, metres; 0 in the sky.
    pub depth: Tensor,
    /// Depth as the network states it (z-depth or ray distance), metres; 0 in the sky.
    pub distance: Tensor,
    /// `(b, t, v, h, w, 3)` velocity in the anchor's axes, m/s.
    pub flow: Tensor,
    /// 1 in the sky.
    pub sky: Tensor,
    /// 1 where the surface moves.
    pub moving: Tensor,
    /// 1 on road users, moving or not.
    pub user: Tensor,
    /// 1 where `sky` is a label, 0 where nobody said.
    pub sky_known: Tensor,
    /// 1 where `flow` and `moving` are labels.
    pub flow_known: Tensor,
}

/// Distances up to this are no measurement, metres.
const DISTANCE_KNOWN_M: f64 = 0.01;

impl Truth {
    /// 1 where the distance to a surface is known, 0 in the sky and where nobody measured.
    pub fn measured(&self) -> candle_core::Result<Tensor> {
        self.distance.gt(DISTANCE_KNOWN_M)?.to_dtype(self.distance.dtype())
    }

    /// Share of the pixels whose sky label is known, 0 to 1.
    pub fn sky_labelled(&self) -> candle_core::Result<f64> {
        let sum = self.sky_known.sum_all()?.to_dtype(DType::F64)?.to_scalar::<f64>()?;
        Ok(sum / self.sky_known.elem_count().max(1) as f64)
    }
}

impl Truth {
    pub(super) fn of(shots: &[Vec<Shot>], anchor_from_map: &DMat3, config: &ModelConfig) -> Result<Self, TrainError> {
        let (t, v) = (shots.len(), shots.first().map_or(0, Vec::len));
        let (h, w) = shots.first().and_then(|row| row.first()).map_or((0, 0), |s| (s.frame.height, s.frame.width));
        let count = t * v * h * w;
        let mut depth = Vec::with_capacity(count);
        let mut distance = Vec::with_capacity(count);
        let mut flow = Vec::with_capacity(3 * count);
        let (mut sky, mut moving) = (Vec::with_capacity(count), Vec::with_capacity(count));
        let mut user = Vec::with_capacity(count);
        let rotation = anchor_from_map.as_mat3();
        for Shot { frame, intrinsics, .. } in shots.iter().flatten() {
            for (i, &z) in frame.depth.iter().enumerate() {
                depth.push(z);
                distance.push(match config.depth_meaning {
                    DepthMeaning::ZDepth => z,
                    // The drive's truth belongs to the pixel's centre.
                    DepthMeaning::RayDistance => {
                        z * intrinsics.ray((i % w) as f32 + 0.5, (i / w) as f32 + 0.5).length()
                    }
                });
            }
            flow.extend(frame.flow.iter().flat_map(|&f| (rotation * glam::Vec3::from(f)).to_array()));
            sky.extend(frame.sky.iter().map(|&x| f32::from(x)));
            moving.extend(frame.moving.iter().map(|&x| f32::from(x)));
            user.extend(frame.instance.iter().map(|&x| f32::from(u8::from(x != 0))));
        }
        let shape = (1, t, v, h, w);
        let plane = |x: Vec<f32>| Tensor::from_vec(x, shape, &Device::Cpu);
        Ok(Self {
            depth: plane(depth)?,
            distance: plane(distance)?,
            flow: Tensor::from_vec(flow, (1, t, v, h, w, 3), &Device::Cpu)?,
            sky: plane(sky)?,
            moving: plane(moving)?,
            user: plane(user)?,
            sky_known: plane(vec![1.0; count])?,
            flow_known: plane(vec![1.0; count])?,
        })
    }

    pub(super) fn stack<'a>(all: impl Iterator<Item = &'a Self> + Clone) -> candle_core::Result<Self> {
        let cat = |pick: fn(&Self) -> &Tensor| Tensor::cat(&all.clone().map(pick).collect::<Vec<_>>(), 0);
        Ok(Self {
            depth: cat(|x| &x.depth)?,
            distance: cat(|x| &x.distance)?,
            flow: cat(|x| &x.flow)?,
            sky: cat(|x| &x.sky)?,
            moving: cat(|x| &x.moving)?,
            user: cat(|x| &x.user)?,
            sky_known: cat(|x| &x.sky_known)?,
            flow_known: cat(|x| &x.flow_known)?,
        })
    }

    /// The same with every tensor put through `to`.
    pub(super) fn map(&self, to: impl Fn(&Tensor) -> candle_core::Result<Tensor>) -> candle_core::Result<Self> {
        Ok(Self {
            depth: to(&self.depth)?,
            distance: to(&self.distance)?,
            flow: to(&self.flow)?,
            sky: to(&self.sky)?,
            moving: to(&self.moving)?,
            user: to(&self.user)?,
            sky_known: to(&self.sky_known)?,
            flow_known: to(&self.flow_known)?,
        })
    }
}

/// Directions into the sky, per camera, with the colour seen there.
#[derive(Debug, Clone)]
pub struct SkySamples {
    /// `(b, v, n, 3)` world directions with z = 1 in their camera.
    pub directions: Tensor,
    /// `(b, v, n, 3)`, network range.
    pub colors: Tensor,
    /// `(b, v, n, 1)`: 1 for samples, 0 for the filling of cameras that see less sky.
    pub weights: Tensor,
}

impl SkySamples {
    pub(super) fn of(shots: &[Vec<Shot>], config: &ModelConfig) -> Result<Self, TrainError> {
        let v = shots.first().map_or(0, Vec::len);
        let (mut directions, mut colors, mut weights) = (Vec::new(), Vec::new(), Vec::new());
        for camera in 0..v {
            let pixels: Vec<(usize, usize)> = shots
                .iter()
                .enumerate()
                .flat_map(|(t, row)| {
                    let sky = row[camera].frame.sky.iter().enumerate().filter(|(_, s)| **s == 1);
                    sky.map(move |(i, _)| (t, i))
                })
                .collect();
            for k in 0..SKY_SAMPLES {
                // Evenly spread over all of the camera's sky pixels.
                match pixels.get(k * pixels.len() / SKY_SAMPLES) {
                    Some(&(t, i)) => {
                        let (direction, color) = looking_up(&shots[t][camera], i, config);
                        directions.extend(direction);
                        colors.extend(color);
                        weights.push(1.0);
                    }
                    None => {
                        directions.extend([0.0, 0.0, 1.0]);
                        colors.extend([0.0; 3]);
                        weights.push(0.0);
                    }
                }
            }
        }
        let tensor = |x: Vec<f32>, c: usize| Tensor::from_vec(x, (1, v, SKY_SAMPLES, c), &Device::Cpu);
        Ok(Self { directions: tensor(directions, 3)?, colors: tensor(colors, 3)?, weights: tensor(weights, 1)? })
    }

    pub(super) fn stack<'a>(all: impl Iterator<Item = &'a Self> + Clone) -> candle_core::Result<Self> {
        let cat = |pick: fn(&Self) -> &Tensor| Tensor::cat(&all.clone().map(pick).collect::<Vec<_>>(), 0);
        Ok(Self { directions: cat(|x| &x.directions)?, colors: cat(|x| &x.colors)?, weights: cat(|x| &x.weights)? })
    }

    /// The same with every tensor put through `to`.
    pub(super) fn map(&self, to: impl Fn(&Tensor) -> candle_core::Result<Tensor>) -> candle_core::Result<Self> {
        Ok(Self { directions: to(&self.directions)?, colors: to(&self.colors)?, weights: to(&self.weights)? })
    }
}

fn looking_up(shot: &Shot, pixel: usize, config: &ModelConfig) -> ([f32; 3], [f32; 3]) {
    let (w, k) = (shot.frame.width, &shot.intrinsics);
    let r = shot.anchor_from_camera.matrix3.transpose();
    let rotation = [r.x_axis, r.y_axis, r.z_axis].map(|row| row.to_array().map(f64::from));
    let camera = RayCamera::new([k.fx, k.fy, k.cx, k.cy].map(f64::from), rotation, pixel_offset(config));
    let direction = camera.direction(pixel / w, pixel % w).map(|x| x as f32);
    let rgb = &shot.frame.rgb[3 * pixel..3 * pixel + 3];
    (direction, [rgb[0], rgb[1], rgb[2]].map(|x| f32::from(x) / 127.5 - 1.0))
}
