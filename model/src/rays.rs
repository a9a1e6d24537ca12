//! Camera rays: the part of the input that carries 3D (paper section 3.1, "Network and input").

use candle_core::{DType, Device, Tensor, WithDType};
use rayon::prelude::*;

use crate::clip::ClipBatch;
use crate::config::{DepthMeaning, ModelConfig, RayPixelOffset};
use crate::error::ModelError;

/// Added to a direction's length before dividing by it, as the authors' program does.
const LENGTH_EPS: f64 = 1e-8;

/// The rays of every pixel of a batch.
pub(crate) struct Rays {
    /// `(b, t, v, 1, 1, 3)`: camera centres, metres.
    pub origins: Tensor,
    /// `(b, t, v, h, w, 3)`: what a depth multiplies; z = 1 in the camera, or unit length for ray distance.
    pub directions: Tensor,
    /// `(b t v, 6, h, w)`: moment `o x d` (scaled), then unit direction `d`.
    pub plucker: Tensor,
}

/// Offset of the ray inside its pixel.
pub(crate) fn pixel_offset(config: &ModelConfig) -> f64 {
    match config.ray_pixel_offset {
        RayPixelOffset::DoubleHalf => 1.0,
        RayPixelOffset::Half => 0.5,
    }
}

/// One camera: `k` row-major 3 x 3, `pose` row-major 4 x 4 (world from camera).
pub(crate) struct RayCamera {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    rotation: [[f64; 3]; 3],
    offset: f64,
}

impl RayCamera {
    pub fn new(k: [f64; 4], rotation: [[f64; 3]; 3], offset: f64) -> Self {
        Self { fx: k[0], fy: k[1], cx: k[2], cy: k[3], rotation, offset }
    }

    /// World direction through pixel (row, col), with z = 1 in the camera.
    pub fn direction(&self, row: usize, col: usize) -> [f64; 3] {
        let x = (col as f64 + self.offset - self.cx) / self.fx;
        let y = (row as f64 + self.offset - self.cy) / self.fy;
        let r = &self.rotation;
        [0, 1, 2].map(|i| r[i][0] * x + r[i][1] * y + r[i][2])
    }
}

/// Unit vector along `d` (nearly: see [`LENGTH_EPS`]).
pub(crate) fn unit(d: [f64; 3]) -> [f64; 3] {
    let length = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt() + LENGTH_EPS;
    d.map(|x| x / length)
}

fn host(tensor: &Tensor) -> Result<Vec<f64>, ModelError> {
    Ok(tensor.flatten_all()?.to_dtype(candle_core::DType::F64)?.to_vec1::<f64>()?)
}

impl Rays {
    /// One timestep's, without what the embedding took.
    pub fn timestep(&self, t: usize) -> Result<Self, ModelError> {
        Ok(Self {
            origins: self.origins.narrow(1, t, 1)?.contiguous()?,
            directions: self.directions.narrow(1, t, 1)?.contiguous()?,
            plucker: self.plucker.clone(),
        })
    }

    /// Rays of a batch in f64 on the host, rounded once to the type of its pictures.
    pub fn new(config: &ModelConfig, batch: &ClipBatch) -> Result<Self, ModelError> {
        match batch.image.dtype() {
            DType::F64 => Self::rounded::<f64>(config, batch),
            _ => Self::rounded::<f32>(config, batch),
        }
    }

    fn rounded<T: WithDType>(config: &ModelConfig, batch: &ClipBatch) -> Result<Self, ModelError> {
        let [b, t, v, h, w] = batch.dims()?;
        let (ks, poses) = (host(&batch.intrinsics)?, host(&batch.world_from_camera)?);
        check_cameras(&ks, &poses, t, v)?;
        let (views, pixels) = (b * t * v, h * w);
        let mut origins = vec![T::zero(); views * 3];
        let mut directions = vec![T::zero(); views * pixels * 3];
        let mut plucker = vec![T::zero(); views * pixels * 6];
        let offset = pixel_offset(config);
        for view in 0..views {
            let m = &poses[16 * view..16 * view + 16];
            [m[3], m[7], m[11]].iter().enumerate().for_each(|(i, &o)| origins[3 * view + i] = T::from_f64(o));
        }
        // Pictures without pixels have no rays.
        let each = directions.par_chunks_mut(3 * pixels.max(1)).zip(plucker.par_chunks_mut(6 * pixels.max(1)));
        each.enumerate().for_each(|(view, (out, planes))| {
            let (k, m) = (&ks[9 * view..9 * view + 9], &poses[16 * view..16 * view + 16]);
            let rotation = [0, 1, 2].map(|i| [m[4 * i], m[4 * i + 1], m[4 * i + 2]]);
            let camera = RayCamera::new([k[0], k[4], k[2], k[5]], rotation, offset);
            let o = [m[3], m[7], m[11]];
            for pixel in 0..pixels {
                let d = camera.direction(pixel / w, pixel % w);
                let u = unit(d);
                let along = match config.depth_meaning {
                    DepthMeaning::ZDepth => d,
                    DepthMeaning::RayDistance => u,
                };
                let moment = [o[1] * u[2] - o[2] * u[1], o[2] * u[0] - o[0] * u[2], o[0] * u[1] - o[1] * u[0]];
                for i in 0..3 {
                    out[3 * pixel + i] = T::from_f64(along[i]);
                    planes[i * pixels + pixel] = T::from_f64(config.ray_moment_scale * moment[i]);
                    planes[(3 + i) * pixels + pixel] = T::from_f64(u[i]);
                }
            }
        });
        let (device, dtype): (&Device, DType) = (batch.image.device(), batch.image.dtype());
        Ok(Self {
            origins: Tensor::from_vec(origins, (b, t, v, 1, 1, 3), device)?.to_dtype(dtype)?,
            directions: Tensor::from_vec(directions, (b, t, v, h, w, 3), device)?.to_dtype(dtype)?,
            plucker: Tensor::from_vec(plucker, (views, 6, h, w), device)?.to_dtype(dtype)?,
        })
    }
}

fn check_cameras(ks: &[f64], poses: &[f64], t: usize, v: usize) -> Result<(), ModelError> {
    let groups = [("intrinsics", ks, 9), ("pose", poses, 16)];
    for (what, values, size) in groups {
        for (view, group) in values.chunks(size).enumerate() {
            let count = group.iter().filter(|x| !x.is_finite()).count();
            if count > 0 {
                return Err(ModelError::NonFiniteInput { what, camera: view % v, timestep: view / v % t, count });
            }
        }
    }
    for (view, k) in ks.chunks(9).enumerate() {
        if !(k[0] > 0.0 && k[4] > 0.0) {
            let place = format!("camera {} at timestep {}", view % v, view / v % t);
            let text = format!("{place} has focal lengths {} and {}; both must be positive", k[0], k[4]);
            return Err(ModelError::Input(text));
        }
    }
    Ok(())
}
