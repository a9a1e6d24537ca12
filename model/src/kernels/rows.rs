//! Element-wise functions and row softmax over large slices, in parallel.

use rayon::prelude::*;

use super::Isa;
use super::math::{activation, backward, exp2};
use super::simd::{Kernel, Simd, dispatch};
use crate::ops::Activation;

/// Elements a task works on at least.
const TASK_FLOATS: usize = 16 * 1024;

struct Softmax<'a> {
    x: &'a [f32],
    width: usize,
    scale: f32,
    out: &'a mut [f32],
}

impl Kernel for Softmax<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd, const MR: usize>(self) {
        let scale = S::splat(self.scale);
        for (x, out) in self.x.chunks_exact(self.width).zip(self.out.chunks_exact_mut(self.width)) {
            let top = x.iter().fold(f32::MIN, |a, &b| if b > a { b } else { a });
            let top_vector = S::splat(top);
            let mut total = 0f32;
            if self.width.is_multiple_of(S::W) {
                let mut sum = S::zero();
                for (x, out) in x.chunks_exact(S::W).zip(out.chunks_exact_mut(S::W)) {
                    // SAFETY: both chunks have one vector.
                    unsafe {
                        let v = exp2::<S>(S::mul(S::sub(S::load(x.as_ptr()), top_vector), scale));
                        S::store(out.as_mut_ptr(), v);
                        sum = S::add(sum, v);
                    }
                }
                let inverse = 1.0 / S::sum(sum);
                out.iter_mut().for_each(|o| *o *= inverse);
                continue;
            }
            for (x, out) in x.chunks(S::W).zip(out.chunks_mut(S::W)) {
                let mut lanes = [f32::MIN; 16];
                lanes[..x.len()].copy_from_slice(x);
                // SAFETY: no vector has more than 16 lanes.
                unsafe {
                    let v = S::sub(S::load(lanes.as_ptr()), top_vector);
                    S::store(lanes.as_mut_ptr(), exp2::<S>(S::mul(v, scale)));
                }
                out.copy_from_slice(&lanes[..out.len()]);
                total += out.iter().sum::<f32>();
            }
            let inverse = 1.0 / total;
            out.iter_mut().for_each(|o| *o *= inverse);
        }
    }
}

/// `softmax(x / tau)` over each row of `width` values (`tau > 0`).
///
/// Panics when the lengths disagree (callers take them from tensor shapes).
pub fn softmax(isa: Isa, x: &[f32], width: usize, tau: f32, out: &mut [f32]) {
    if width == 0 {
        return;
    }
    assert!(x.len() == out.len() && x.len().is_multiple_of(width), "rows of {width}");
    let task = (TASK_FLOATS / width).max(1) * width;
    let scale = std::f32::consts::LOG2_E / tau;
    out.par_chunks_mut(task).zip(x.par_chunks(task)).for_each(|(out, x)| {
        dispatch(isa, Softmax { x, width, scale, out });
    });
}

/// [`softmax`] on this thread alone, for lengths that were checked.
pub(super) fn softmax_rows(isa: Isa, x: &[f32], width: usize, tau: f32, out: &mut [f32]) {
    dispatch(isa, Softmax { x, width, scale: std::f32::consts::LOG2_E / tau, out });
}

/// `out = act(x) + residual`, element by element.
///
/// Panics when the lengths disagree.
pub fn activate(isa: Isa, act: Activation, x: &[f32], residual: Option<&[f32]>, out: &mut [f32]) {
    assert!(x.len() == out.len() && residual.is_none_or(|r| r.len() == x.len()), "{} values", x.len());
    out.par_chunks_mut(TASK_FLOATS).zip(x.par_chunks(TASK_FLOATS)).enumerate().for_each(|(i, (out, x))| {
        out.copy_from_slice(x);
        activation(isa, act, out);
        if let Some(residual) = residual {
            out.iter_mut().zip(&residual[i * TASK_FLOATS..]).for_each(|(o, r)| *o += r);
        }
    });
}

/// `grad *= act'(x)`, element by element.
///
/// Panics when the lengths disagree.
pub fn map_backward(isa: Isa, act: Activation, x: &[f32], grad: &mut [f32]) {
    assert_eq!(x.len(), grad.len());
    grad.par_chunks_mut(TASK_FLOATS).zip(x.par_chunks(TASK_FLOATS)).for_each(|(grad, x)| {
        backward(isa, act, x, grad, None);
    });
}

struct SoftmaxBackward<'a> {
    y: &'a [f32],
    width: usize,
    scale: f32,
    grad: &'a mut [f32],
}

impl Kernel for SoftmaxBackward<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd, const MR: usize>(self) {
        for (y, grad) in self.y.chunks_exact(self.width).zip(self.grad.chunks_exact_mut(self.width)) {
            let whole = self.width / S::W * S::W;
            let mut sums = S::zero();
            for at in (0..whole).step_by(S::W) {
                // SAFETY: `at + W <= whole`, and both rows are that long.
                unsafe { sums = S::mul_add(S::load(y.as_ptr().add(at)), S::load(grad.as_ptr().add(at)), sums) };
            }
            let mut mean = S::sum(sums);
            for at in whole..self.width {
                mean += y[at] * grad[at];
            }
            grad.iter_mut().zip(y).for_each(|(g, y)| *g = y * (*g - mean) * self.scale);
        }
    }
}

/// The gradient of [`softmax`]'s input from its result `y`, in place of the result's gradient.
///
/// Panics when the lengths disagree.
pub fn softmax_backward(isa: Isa, y: &[f32], width: usize, tau: f32, grad: &mut [f32]) {
    if width == 0 {
        return;
    }
    assert!(y.len() == grad.len() && y.len().is_multiple_of(width), "rows of {width}");
    let task = (TASK_FLOATS / width).max(1) * width;
    grad.par_chunks_mut(task).zip(y.par_chunks(task)).for_each(|(grad, y)| {
        dispatch(isa, SoftmaxBackward { y, width, scale: 1.0 / tau, grad });
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::tests::{noise, worst_difference};

    /// Weights of at most 1: their own rounding and that of exponents up to a few tens.
    const TOLERANCE: f64 = 1e-6;

    #[test]
    fn softmax_of_any_width() {
        for isa in Isa::tested() {
            for width in [1, 3, 8, 16, 17, 100] {
                let x = noise(width as u64, 50 * width, 6.0);
                let mut out = vec![f32::NAN; x.len()];
                softmax(isa, &x, width, 0.5, &mut out);
                let mut want = Vec::new();
                for row in x.chunks_exact(width) {
                    let e: Vec<f64> = row.iter().map(|&v| (f64::from(v) / 0.5).exp()).collect();
                    let total: f64 = e.iter().sum();
                    want.extend(e.iter().map(|v| v / total));
                }
                assert!(worst_difference(&out, &want) < TOLERANCE, "{isa:?} {width}");
            }
            let mut out = [0.0; 3];
            softmax(isa, &[1e30, -1e30, 1e30], 3, 0.5, &mut out);
            assert_eq!(out, [0.5, f32::MIN_POSITIVE / 2.0, 0.5]);
            softmax(isa, &[1.0, f32::NAN, 0.0], 3, 0.5, &mut out);
            assert!(out.iter().all(|v| v.is_nan()));
        }
    }
}
