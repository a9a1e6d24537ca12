//! Layer norm over rows: mean and variance in f64, so that rows far from zero lose nothing.

mod backward;

use rayon::prelude::*;

use super::Isa;
use super::simd::{Kernel, Simd, dispatch};

pub use backward::{RowStatistics, Source, layer_norm_backward};

/// Independent partial sums; fixed, so the statistics have the same bits on every instruction set.
const LANES: usize = 8;
/// Elements a task works on at least.
const TASK_FLOATS: usize = 16 * 1024;

struct Rows<'a> {
    x: &'a [f32],
    width: usize,
    weight: Option<&'a [f32]>,
    bias: Option<&'a [f32]>,
    eps: f64,
    out: &'a mut [f32],
    /// One per row, where they are kept.
    statistics: &'a mut [RowStatistics],
}

/// `sum f(x)` in f64 over [`LANES`] interleaved partial sums.
#[inline(always)]
fn sum(x: &[f32], f: impl Fn(f64) -> f64) -> f64 {
    let mut partial = [0f64; LANES];
    let mut chunks = x.chunks_exact(LANES);
    for chunk in &mut chunks {
        for l in 0..LANES {
            partial[l] += f(chunk[l].into());
        }
    }
    let rest: f64 = chunks.remainder().iter().map(|&v| f(v.into())).sum();
    partial.iter().sum::<f64>() + rest
}

impl Kernel for Rows<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd, const MR: usize>(self) {
        let n = self.width as f64;
        let rows = self.x.chunks_exact(self.width).zip(self.out.chunks_exact_mut(self.width));
        for (row, (x, out)) in rows.enumerate() {
            let mean = sum(x, |v| v) / n;
            let variance = sum(x, |v| (v - mean) * (v - mean)) / n;
            let scale = 1.0 / (variance + self.eps).sqrt();
            if let Some(statistics) = self.statistics.get_mut(row) {
                *statistics = RowStatistics::new(mean, scale);
            }
            let normal = |v: f32| ((f64::from(v) - mean) * scale) as f32;
            if let (Some(weight), Some(bias)) = (self.weight, self.bias) {
                let learned = weight.iter().zip(bias);
                out.iter_mut().zip(x).zip(learned).for_each(|((o, &v), (w, b))| *o = normal(v) * w + b);
                continue;
            }
            out.iter_mut().zip(x).for_each(|(o, &v)| *o = normal(v));
            if let Some(weight) = self.weight {
                out.iter_mut().zip(weight).for_each(|(o, w)| *o *= w);
            }
            if let Some(bias) = self.bias {
                out.iter_mut().zip(bias).for_each(|(o, b)| *o += b);
            }
        }
    }
}

/// [`layer_norm`] on this thread alone, for lengths that were checked.
pub(super) fn rows(
    isa: Isa,
    x: &[f32],
    width: usize,
    (weight, bias, eps): (Option<&[f32]>, Option<&[f32]>, f64),
    out: &mut [f32],
) {
    dispatch(isa, Rows { x, width, weight, bias, eps, out, statistics: &mut [] });
}

/// `(x - mean) / sqrt(variance + eps) * weight + bias` for each row of `width` values.
///
/// Panics when the lengths disagree (callers take them from tensor shapes).
pub fn layer_norm(
    isa: Isa,
    x: &[f32],
    width: usize,
    weight: Option<&[f32]>,
    bias: Option<&[f32]>,
    eps: f64,
    out: &mut [f32],
) {
    run(isa, x, width, (weight, bias, eps), out, &mut []);
}

/// As [`layer_norm`], keeping what [`layer_norm_backward`] needs of each row.
///
/// Panics when the lengths disagree (callers take them from tensor shapes).
pub fn layer_norm_keeping(
    isa: Isa,
    x: &[f32],
    width: usize,
    (weight, bias, eps): (Option<&[f32]>, Option<&[f32]>, f64),
    out: &mut [f32],
) -> Vec<RowStatistics> {
    let mut statistics = vec![RowStatistics::default(); x.len().checked_div(width).unwrap_or(0)];
    run(isa, x, width, (weight, bias, eps), out, &mut statistics);
    statistics
}

fn run(
    isa: Isa,
    x: &[f32],
    width: usize,
    (weight, bias, eps): (Option<&[f32]>, Option<&[f32]>, f64),
    out: &mut [f32],
    statistics: &mut [RowStatistics],
) {
    if width == 0 {
        return;
    }
    assert!(x.len() == out.len() && x.len().is_multiple_of(width), "rows of {width}");
    assert!(
        weight.is_none_or(|w| w.len() == width) && bias.is_none_or(|b| b.len() == width),
        "gain and offset of {width}"
    );
    let rows = (TASK_FLOATS / width).max(1);
    let tasks = out.par_chunks_mut(rows * width).zip(x.par_chunks(rows * width));
    if statistics.is_empty() {
        return tasks
            .for_each(|(out, x)| dispatch(isa, Rows { x, width, weight, bias, eps, out, statistics: &mut [] }));
    }
    tasks.zip(statistics.par_chunks_mut(rows)).for_each(|((out, x), statistics)| {
        dispatch(isa, Rows { x, width, weight, bias, eps, out, statistics });
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::tests::{noise, worst_difference};

    /// Results of a few units: two roundings of the gain and offset, one of the normalised value.
    const TOLERANCE: f64 = 1e-6;

    #[test]
    fn rows_of_any_width_far_from_zero() {
        for isa in Isa::tested() {
            for (i, &(rows, width)) in [(1, 1), (3, 5), (7, 8), (2, 768), (40, 33), (1, 1000)].iter().enumerate() {
                for offset in [0.0, 1000.0] {
                    let x: Vec<f32> = noise(i as u64, rows * width, 1.0).iter().map(|v| v + offset).collect();
                    let w = noise(50, width, 1.0);
                    let b = noise(51, width, 1.0);
                    for learned in [false, true] {
                        let (w, b) = if learned { (Some(&w[..]), Some(&b[..])) } else { (None, None) };
                        let mut out = vec![f32::NAN; rows * width];
                        layer_norm(isa, &x, width, w, b, 1e-6, &mut out);
                        let mut want = Vec::new();
                        for row in x.chunks_exact(width) {
                            let n = width as f64;
                            let mean = row.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
                            let var = row.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>() / n;
                            want.extend(row.iter().enumerate().map(|(c, &v)| {
                                let y = (f64::from(v) - mean) / (var + 1e-6).sqrt();
                                y * w.map_or(1.0, |w| w[c].into()) + b.map_or(0.0, |b| b[c].into())
                            }));
                        }
                        let worst = worst_difference(&out, &want);
                        assert!(worst < TOLERANCE, "{isa:?} {rows}x{width} +{offset}: {worst:e}");
                    }
                }
            }
        }
    }
}
