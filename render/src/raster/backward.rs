//! The backward pass: gradients of a loss with respect to the Gaussians from its gradients with respect to the pictures.
//!
//! The data's way: [`PictureGradient`] -> `unblend` (each tile back to front; one row of sums per (tile, splat) pair)
//! -> `unproject` (each Gaussian adds its pairs in a fixed order and passes them on) -> [`SplatGradients`]. Every row has
//! one writer, so the result is the same for any number of threads.

use super::grid::{TILE_H, TILE_W};
use super::project::Camera;
use super::tile::{FeatureRows, TileInput};
use super::tiles::ChunkView;
use super::unblend::{MOMENTS, UnblendScratch, UpstreamRow, unblend_tile};
use super::unproject::{ChunkGradients, UnprojectInput, unproject_chunk};
use super::{ALPHA_FLOOR, CpuRasterizer, Picture, RasterError, Rendered, Splats};
use crate::camera::View;
use rayon::prelude::*;

/// Most numbers the rows of all (tile, splat) pairs may hold (4 GiB).
pub const MAX_PAIR_SUMS: usize = 1 << 30;

/// Gradient of a loss with respect to one picture; an empty array stands for zeros.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PictureGradient {
    /// As [`Picture::features`].
    pub features: Vec<f32>,
    /// As [`Picture::alpha`].
    pub alpha: Vec<f32>,
    /// As [`Picture::depth`], per metre.
    pub depth: Vec<f32>,
}

/// Gradient of a loss with respect to the Gaussians, summed over the views; always finite.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SplatGradients {
    /// Per metre of the centres.
    pub means: Vec<[f32; 3]>,
    /// With respect to the quaternions as given, through their normalisation (so orthogonal to them).
    pub quats: Vec<[f32; 4]>,
    /// Per metre of standard deviation.
    pub scales: Vec<[f32; 3]>,
    /// Per unit of opacity.
    pub opacities: Vec<f32>,
    /// As [`Splats::features`], row-major `n x feature_count`.
    pub features: Vec<f32>,
    /// Gaussians whose gradients overflowed f32 sums and were set to zero.
    pub overflowed: usize,
}

impl CpuRasterizer {
    /// Gradients with respect to the Gaussians of the last [`render`](Self::render), which must have had these very
    /// `splats` and `views`; `pictures` are its result and `upstream` the loss's gradients with respect to them.
    ///
    /// What a pixel skipped (alpha below 1/255, behind a full pixel, culled) gets no gradient from it; a capped alpha
    /// passes none on; beyond the field of view clamp the Jacobian's tangent is a constant.
    ///
    /// # Errors
    /// No such render, arrays whose sizes do not fit or that are not finite, or too many channels for the pairs.
    pub fn backward(
        &mut self,
        splats: &Splats,
        views: &[View],
        pictures: &[Picture],
        upstream: &[PictureGradient],
    ) -> Result<SplatGradients, RasterError> {
        let mut gradients = SplatGradients::default();
        self.backward_into(splats, views, pictures, upstream, &mut gradients)?;
        Ok(gradients)
    }

    /// [`backward`](Self::backward) into gradients whose memory is reused; on error they are left as they were.
    ///
    /// # Errors
    /// As `backward`.
    pub fn backward_into(
        &mut self,
        splats: &Splats,
        views: &[View],
        pictures: &[Picture],
        upstream: &[PictureGradient],
        gradients: &mut SplatGradients,
    ) -> Result<(), RasterError> {
        splats.validate()?;
        let Self { settings, isa, chunks, tiles, rendered, .. } = self;
        let rendered = rendered.as_ref().ok_or(RasterError::NotRendered { what: "nothing" })?;
        check_request(rendered, splats, views)?;
        check_upstream(views, splats.feature_count, pictures, upstream)?;
        let row_len = MOMENTS + splats.feature_count;
        let pairs: usize = chunks.iter().flat_map(|chunk| &chunk.views).map(ChunkView::box_tiles).sum();
        let pair_sums = pairs.saturating_mul(row_len);
        if pair_sums > MAX_PAIR_SUMS {
            return Err(RasterError::TooMany { name: "sums of pairs", value: pair_sums, limit: MAX_PAIR_SUMS });
        }
        chunks.par_iter_mut().for_each(|chunk| chunk.views.iter_mut().for_each(|view| view.clear_sums(row_len)));

        let shares: Vec<Vec<f32>> = pictures.iter().zip(upstream).map(|(p, g)| depth_shares(p, g)).collect();
        let jobs: Vec<(usize, usize, usize)> = views
            .iter()
            .enumerate()
            .flat_map(|(view, v)| {
                let (width, height) = (v.intrinsics.width, v.intrinsics.height);
                let rows = (0..height).step_by(TILE_H);
                rows.flat_map(move |y0| (0..width).step_by(TILE_W).map(move |x0| (view, x0, y0)))
            })
            .collect();
        let (chunks, isa) = (&*chunks, *isa);
        let alpha_cap = settings.convention.alpha_cap();
        jobs.par_iter().zip(&*tiles).for_each_init(UnblendScratch::new, |scratch, (&(view, x0, y0), memory)| {
            let (picture, gradient) = (&pictures[view], &upstream[view]);
            let input = TileInput {
                x0,
                y0,
                width: TILE_W.min(picture.width - x0),
                height: TILE_H.min(picture.height - y0),
                keys: &memory.keys,
                chunks,
                chunk_bits: rendered.chunk_bits,
                view,
                features: FeatureRows::all(splats.features, splats.feature_count),
                alpha_cap,
            };
            scratch.reset(&input, &memory.end);
            for y in 0..input.height {
                let first = (y0 + y) * picture.width + x0;
                let row = |values: &'_ [f32], channels: usize| -> std::ops::Range<usize> {
                    if values.is_empty() { 0..0 } else { first * channels..(first + input.width) * channels }
                };
                let source = UpstreamRow {
                    features: &gradient.features[row(&gradient.features, splats.feature_count)],
                    alpha: &gradient.alpha[row(&gradient.alpha, 1)],
                    depth_share: &shares[view][row(&shares[view], 1)],
                    depth: &picture.depth[row(&picture.depth, 1)],
                };
                scratch.set_upstream(y, splats.feature_count, &source);
            }
            unblend_tile(isa, &input, &memory.end, scratch);
        });

        let n = splats.len();
        gradients.means.resize(n, [0.0; 3]);
        gradients.quats.resize(n, [0.0; 4]);
        gradients.scales.resize(n, [0.0; 3]);
        gradients.opacities.resize(n, 0.0);
        gradients.features.resize(n * splats.feature_count, 0.0);
        let cameras: Vec<Camera> = views.iter().map(|v| Camera::new(v, settings.convention)).collect();
        let input = UnprojectInput { splats: *splats, cameras: &cameras, blur: f64::from(settings.blur) };
        let len = 1usize << rendered.chunk_bits;
        let mut jobs = split(gradients, len, splats.feature_count);
        jobs.par_iter_mut().zip(chunks).enumerate().for_each(|(index, (out, chunk))| {
            unproject_chunk(isa, &input, index * len..(index * len + out.means.len()), chunk, out);
        });
        let overflowed = jobs.iter().map(|job| job.overflowed).sum();
        drop(jobs);
        gradients.overflowed = overflowed;
        Ok(())
    }
}

/// Cuts the gradients into the chunks' shares.
fn split(gradients: &mut SplatGradients, len: usize, feature_count: usize) -> Vec<ChunkGradients<'_>> {
    let mut features = gradients.features.as_mut_slice();
    let arrays = gradients.means.chunks_mut(len).zip(gradients.quats.chunks_mut(len));
    let arrays = arrays.zip(gradients.scales.chunks_mut(len).zip(gradients.opacities.chunks_mut(len)));
    arrays
        .map(|((means, quats), (scales, opacities))| {
            let (own, rest) = std::mem::take(&mut features).split_at_mut(means.len() * feature_count);
            features = rest;
            ChunkGradients { means, quats, scales, opacities, features: own, overflowed: 0 }
        })
        .collect()
}

/// `g_depth / A` per pixel; 0 where nothing was hit, empty when there is no depth gradient.
fn depth_shares(picture: &Picture, gradient: &PictureGradient) -> Vec<f32> {
    let pixels = gradient.depth.iter().zip(&picture.alpha);
    pixels.map(|(&g, &alpha)| if alpha > ALPHA_FLOOR { g / alpha } else { 0.0 }).collect()
}

fn check_request(rendered: &Rendered, splats: &Splats, views: &[View]) -> Result<(), RasterError> {
    let what = if rendered.splats != splats.len() {
        "another number of Gaussians"
    } else if rendered.feature_count != splats.feature_count {
        "another number of channels"
    } else if rendered.views != views {
        "other views"
    } else {
        return Ok(());
    };
    Err(RasterError::NotRendered { what })
}

fn check_upstream(
    views: &[View],
    feature_count: usize,
    pictures: &[Picture],
    upstream: &[PictureGradient],
) -> Result<(), RasterError> {
    for (name, len) in [("pictures", pictures.len()), ("upstream", upstream.len())] {
        if len != views.len() {
            let what = format!("there are {len} {name} for {} views; pass one for each", views.len());
            return Err(RasterError::View { view: len.min(views.len()), what });
        }
    }
    for (index, ((view, picture), gradient)) in views.iter().zip(pictures).zip(upstream).enumerate() {
        let (width, height) = (view.intrinsics.width, view.intrinsics.height);
        let pixels = width * height;
        let arrays = [
            ("picture alpha", &picture.alpha, pixels, false),
            ("picture depth", &picture.depth, pixels, false),
            ("upstream features", &gradient.features, pixels * feature_count, true),
            ("upstream alpha", &gradient.alpha, pixels, true),
            ("upstream depth", &gradient.depth, pixels, true),
        ];
        if (picture.width, picture.height) != (width, height) {
            let what = format!("its picture is {}x{}, the view {width}x{height}", picture.width, picture.height);
            return Err(RasterError::View { view: index, what });
        }
        for (name, values, expected, may_be_empty) in arrays {
            if values.len() != expected && !(may_be_empty && values.is_empty()) {
                let what = format!("{name} holds {} values, {expected} were expected", values.len());
                return Err(RasterError::View { view: index, what });
            }
            if let Some(at) = values.iter().position(|x| !x.is_finite()) {
                let what = format!("{name} is {} at {at}; every value must be finite", values[at]);
                return Err(RasterError::View { view: index, what });
            }
        }
    }
    Ok(())
}
