//! The Gaussian head's numbers to Gaussians, many rows of pixels at a time (paper appendix A.2, "Gaussian Parameterization").

use std::f32::consts::LOG2_E;

use rayon::prelude::*;

use super::Isa;
use super::math::exp2;
use super::simd::{Kernel, Simd, dispatch};

/// Numbers the head gives per pixel.
pub const CHANNELS: usize = 12;

/// What the numbers mean.
#[derive(Debug, Clone, Copy)]
pub struct Meaning {
    /// Pixels along a patch's side.
    pub patch: usize,
    /// Nearest depth, metres.
    pub near: f64,
    /// Farthest.
    pub far: f64,
    /// Depth between them by its logarithm.
    pub log_depth: bool,
    /// Added before the exponential.
    pub scale_offset: f64,
    /// The most an exponential gives, metres.
    pub max_scale: f32,
    /// Added before the sigmoid.
    pub opacity_offset: f64,
    /// Colours through `2 sigmoid - 1`.
    pub squash_colors: bool,
    /// Colours added to the picture's.
    pub residual_colors: bool,
}

/// What the head saw, and where its pixels look.
#[derive(Debug, Clone, Copy)]
pub struct Input<'a> {
    /// `(views rows cols, patch, patch, CHANNELS)`.
    pub raw: &'a [f32],
    /// `(views, 3, h, w)`.
    pub image: &'a [f32],
    /// `(views, 3)`.
    pub origins: &'a [f32],
    /// `(views, h, w, 3)`.
    pub directions: &'a [f32],
    /// Views, height, width.
    pub dims: [usize; 3],
}

/// Gaussians, one per pixel in the order `(views, h, w)`.
#[derive(Debug)]
pub struct Output<'a> {
    /// Centres, 3 each.
    pub means: &'a mut [f32],
    /// 3 each.
    pub scales: &'a mut [f32],
    /// w, x, y, z.
    pub quats: &'a mut [f32],
    /// 1 each.
    pub opacities: &'a mut [f32],
    /// 3 each.
    pub colors: &'a mut [f32],
    /// 1 each.
    pub depths: &'a mut [f32],
}

/// `e^x`, at most 2^127.
#[inline(always)]
fn exp<S: Simd>(x: S::V) -> S::V {
    let top = S::splat(127.0);
    let x = S::mul(x, S::splat(LOG2_E));
    exp2::<S>(S::select_lt(top, x, top, x))
}

/// `1 / (1 + e^-x)`.
#[inline(always)]
fn sigmoid<S: Simd>(x: S::V) -> S::V {
    let e = exp2::<S>(S::mul(S::abs(x), S::splat(-LOG2_E)));
    S::div(S::select_lt(x, S::zero(), e, S::splat(1.0)), S::add(S::splat(1.0), e))
}

/// One row of patches of one view.
struct PatchRow<'a> {
    meaning: &'a Meaning,
    input: &'a Input<'a>,
    view: usize,
    row: usize,
    out: Output<'a>,
}

impl Kernel for PatchRow<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd, const MR: usize>(self) {
        let Self { meaning: m, input, view, row, out } = self;
        let ([_, h, w], p) = (input.dims, m.patch);
        let cols = w / p;
        let raw = &input.raw[(view * (h / p) + row) * cols * p * p * CHANNELS..][..cols * p * p * CHANNELS];
        let origin: [f32; 3] = std::array::from_fn(|i| input.origins[3 * view + i]);
        let (span, start) = match m.log_depth {
            true => ((m.far / m.near).ln() as f32, m.near.ln() as f32),
            false => ((m.far - m.near) as f32, m.near as f32),
        };
        for y in 0..p {
            for x0 in (0..w).step_by(S::W) {
                let count = S::W.min(w - x0);
                let mut lanes = [[0f32; 16]; CHANNELS];
                for l in 0..count {
                    let (col, x) = ((x0 + l) / p, (x0 + l) % p);
                    let pixel = &raw[((col * p + y) * p + x) * CHANNELS..][..CHANNELS];
                    for c in 0..CHANNELS {
                        lanes[c][l] = pixel[c];
                    }
                }
                macro_rules! map {
                    ($c:expr, |$v:ident| $e:expr) => {
                        // SAFETY: no vector has more than 16 lanes.
                        unsafe {
                            let $v = S::load(lanes[$c].as_ptr());
                            S::store(lanes[$c].as_mut_ptr(), $e);
                        }
                    };
                }
                let (span, start) = (S::splat(span), S::splat(start));
                match m.log_depth {
                    true => map!(0, |v| exp::<S>(S::add(S::mul(sigmoid::<S>(v), span), start))),
                    false => map!(0, |v| S::add(S::mul(sigmoid::<S>(v), span), start)),
                }
                let (offset, most) = (S::splat(m.scale_offset as f32), S::splat(m.max_scale));
                for c in 1..4 {
                    map!(c, |v| {
                        let scale = exp::<S>(S::add(v, offset));
                        S::select_lt(most, scale, most, scale)
                    });
                }
                map!(8, |v| sigmoid::<S>(S::add(v, S::splat(m.opacity_offset as f32))));
                if m.squash_colors {
                    for c in 9..12 {
                        map!(c, |v| S::add(S::mul(sigmoid::<S>(v), S::splat(2.0)), S::splat(-1.0)));
                    }
                }
                if m.residual_colors {
                    for c in 0..3 {
                        let line = &input.image[((view * 3 + c) * h + row * p + y) * w + x0..][..count];
                        line.iter().zip(&mut lanes[9 + c]).for_each(|(image, color)| *color += image);
                    }
                }
                let first = y * w + x0;
                let directions = &input.directions[((view * h + row * p + y) * w + x0) * 3..][..3 * count];
                for l in 0..count {
                    let at = first + l;
                    for i in 0..3 {
                        out.means[3 * at + i] = origin[i] + directions[3 * l + i] * lanes[0][l];
                        out.scales[3 * at + i] = lanes[1 + i][l];
                        out.colors[3 * at + i] = lanes[9 + i][l];
                    }
                    for i in 0..4 {
                        out.quats[4 * at + i] = lanes[4 + i][l];
                    }
                }
                out.depths[first..first + count].copy_from_slice(&lanes[0][..count]);
                out.opacities[first..first + count].copy_from_slice(&lanes[8][..count]);
            }
        }
    }
}

/// Makes the Gaussians.
///
/// Panics when the lengths disagree (callers take them from tensor shapes).
pub fn gaussians(isa: Isa, meaning: &Meaning, input: &Input<'_>, out: Output<'_>) {
    let ([views, h, w], p) = (input.dims, meaning.patch);
    let pixels = views * h * w;
    assert!(p > 0 && h.is_multiple_of(p) && w.is_multiple_of(p), "{w} x {h} in patches of {p}");
    assert!(input.raw.len() == pixels * CHANNELS && input.image.len() == 3 * pixels, "input of {pixels} pixels");
    assert!(input.origins.len() == 3 * views && input.directions.len() == 3 * pixels, "rays of {pixels} pixels");
    let Output { means, scales, quats, opacities, colors, depths } = out;
    assert!(
        [means.len(), scales.len(), colors.len()] == [3 * pixels; 3] && quats.len() == 4 * pixels,
        "{pixels} pixels"
    );
    assert!([opacities.len(), depths.len()] == [pixels; 2], "{pixels} pixels");
    if pixels == 0 {
        return;
    }
    let row = p * w;
    (
        means.par_chunks_mut(3 * row),
        scales.par_chunks_mut(3 * row),
        quats.par_chunks_mut(4 * row),
        opacities.par_chunks_mut(row),
        colors.par_chunks_mut(3 * row),
        depths.par_chunks_mut(row),
    )
        .into_par_iter()
        .enumerate()
        .for_each(|(index, (means, scales, quats, opacities, colors, depths))| {
            let (view, row) = (index / (h / p), index % (h / p));
            let out = Output { means, scales, quats, opacities, colors, depths };
            dispatch(isa, PatchRow { meaning, input, view, row, out });
        });
}
