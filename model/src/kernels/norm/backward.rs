//! Gradients of layer norm, from row statistics kept by the forward pass.

use rayon::prelude::*;

use super::{Isa, Kernel, Simd, dispatch};

/// Rows whose shares of the gain's and offset's gradients are summed before the shares are: fixed, so that the sums do
/// not depend on the number of threads.
const ROWS: usize = 32;
/// Independent partial sums of a row.
const LANES: usize = 16;

/// What the backward pass needs of a row: its mean in two parts, because rows far from zero would lose their spread in
/// the rounding of one, and `1 / sqrt(variance + eps)`.
#[derive(Debug, Clone, Copy, Default)]
pub struct RowStatistics {
    mean: f32,
    /// What `mean` lacks.
    mean_rest: f32,
    scale: f32,
}

impl RowStatistics {
    #[inline(always)]
    pub(super) fn new(mean: f64, scale: f64) -> Self {
        let rounded = mean as f32;
        Self { mean: rounded, mean_rest: (mean - f64::from(rounded)) as f32, scale: scale as f32 }
    }
}

/// The tensors of a [`layer_norm`](super::layer_norm) whose gradients are wanted.
#[derive(Debug, Clone, Copy)]
pub struct Source<'a> {
    /// The input, rows of `width`.
    pub x: &'a [f32],
    /// Columns.
    pub width: usize,
    /// The gain, `(width)`.
    pub weight: Option<&'a [f32]>,
    /// One per row.
    pub statistics: &'a [RowStatistics],
    /// Gradient of the result.
    pub grad: &'a [f32],
}

struct Rows<'a> {
    source: Source<'a>,
    /// The normalised row, then its gradient.
    scratch: &'a mut [f32],
    /// Gradient of the input.
    out: &'a mut [f32],
    /// Shares of the gain's and the offset's gradients, `2 width`, zeros.
    shares: &'a mut [f32],
}

/// Sums of `a` and of `a b`.
#[inline(always)]
fn sums(a: &[f32], b: &[f32]) -> (f32, f32) {
    let (mut one, mut two) = ([0f32; LANES], [0f32; LANES]);
    let whole = a.len() / LANES * LANES;
    for (a, b) in a[..whole].chunks_exact(LANES).zip(b[..whole].chunks_exact(LANES)) {
        for l in 0..LANES {
            one[l] += a[l];
            two[l] += a[l] * b[l];
        }
    }
    for (l, (a, b)) in a[whole..].iter().zip(&b[whole..]).enumerate() {
        one[l] += a;
        two[l] += a * b;
    }
    (one.iter().sum(), two.iter().sum())
}

impl Kernel for Rows<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd, const MR: usize>(self) {
        let Source { x, width, weight, statistics, grad } = self.source;
        let (normal, grown) = self.scratch.split_at_mut(width);
        let (gains, offsets) = self.shares.split_at_mut(width);
        let rows = x.chunks_exact(width).zip(grad.chunks_exact(width)).zip(self.out.chunks_exact_mut(width));
        for (((x, grad), out), row) in rows.zip(statistics) {
            for c in 0..width {
                normal[c] = (x[c] - row.mean - row.mean_rest) * row.scale;
            }
            for c in 0..width {
                gains[c] += grad[c] * normal[c];
                offsets[c] += grad[c];
            }
            match weight {
                Some(weight) => {
                    for c in 0..width {
                        grown[c] = grad[c] * weight[c];
                    }
                }
                None => grown.copy_from_slice(grad),
            }
            let (sum, along) = sums(grown, normal);
            let (mean, slope) = (sum / width as f32, along / width as f32);
            for c in 0..width {
                out[c] = row.scale * (grown[c] - mean - normal[c] * slope);
            }
        }
    }
}

/// Gradients of the input (into `out`), and of gain and offset, `(2, width)`, which are returned.
///
/// Panics when the lengths disagree (callers take them from tensor shapes).
pub fn layer_norm_backward(isa: Isa, source: Source<'_>, out: &mut [f32]) -> Vec<f32> {
    let Source { x, width, weight, statistics, grad } = source;
    if width == 0 {
        return Vec::new();
    }
    assert!(x.len() == grad.len() && x.len() == out.len() && x.len() == statistics.len() * width, "rows of {width}");
    assert!(weight.is_none_or(|w| w.len() == width), "gain of {width}");
    let mut shares = vec![0f32; statistics.len().div_ceil(ROWS) * 2 * width];
    let inputs = x.par_chunks(ROWS * width).zip(grad.par_chunks(ROWS * width)).zip(statistics.par_chunks(ROWS));
    let outputs = out.par_chunks_mut(ROWS * width).zip(shares.par_chunks_mut(2 * width));
    inputs.zip(outputs).for_each_init(
        || vec![0f32; 2 * width],
        |scratch, (((x, grad), statistics), (out, shares))| {
            dispatch(isa, Rows { source: Source { x, width, weight, statistics, grad }, scratch, out, shares });
        },
    );
    let mut total = vec![0f32; 2 * width];
    for share in shares.chunks_exact(2 * width) {
        total.iter_mut().zip(share).for_each(|(t, s)| *t += s);
    }
    total
}
