//! The register tile every product goes through, and what follows it.

use crate::kernels::math::activate;
use crate::kernels::simd::Simd;
use crate::ops::Activation;

/// `acc + a b` over `depth` products: `a[p * a_step + r * a_row]` for row `r`, `b` a packed panel of two vectors a row.
///
/// # Safety
/// `a` must be readable at those indices for `p < depth`, `r < MR`; `b` for `depth * 2 * W` floats.
#[inline(always)]
pub(crate) unsafe fn tile<S: Simd, const MR: usize>(
    depth: usize,
    a: *const f32,
    a_step: usize,
    a_row: usize,
    b: *const f32,
    mut acc: [[S::V; 2]; MR],
) -> [[S::V; 2]; MR] {
    let (mut a, mut b) = (a, b);
    for _ in 0..depth {
        // SAFETY: the caller's contract; the pointers advance once per product.
        unsafe {
            let (b0, b1) = (S::load(b), S::load(b.add(S::W)));
            for r in 0..MR {
                let x = S::splat(*a.add(r * a_row));
                acc[r][0] = S::mul_add(x, b0, acc[r][0]);
                acc[r][1] = S::mul_add(x, b1, acc[r][1]);
            }
            a = a.add(a_step);
            b = b.add(2 * S::W);
        }
    }
    acc
}

/// The epilogue on one tile row: `sums` has two whole vectors, the others as many columns as there are outputs.
#[inline(always)]
pub(super) fn finish<S: Simd>(
    sums: &mut [f32],
    bias: Option<&[f32]>,
    act: Activation,
    residual: Option<&[f32]>,
    out: &mut [f32],
) {
    if out.len() == 2 * S::W && sums.len() == out.len() {
        for at in [0, S::W] {
            // SAFETY: all four have two vectors' worth of floats.
            unsafe {
                let mut v = S::load(sums.as_ptr().add(at));
                if let Some(bias) = bias {
                    v = S::add(v, S::load(bias.as_ptr().add(at)));
                }
                v = activate::<S>(act, v);
                if let Some(residual) = residual {
                    v = S::add(v, S::load(residual.as_ptr().add(at)));
                }
                S::store(out.as_mut_ptr().add(at), v);
            }
        }
        return;
    }
    if let Some(bias) = bias {
        sums.iter_mut().zip(bias).for_each(|(s, b)| *s += b);
    }
    for half in sums.chunks_exact_mut(S::W) {
        // SAFETY: each half is one vector.
        unsafe { S::store(half.as_mut_ptr(), activate::<S>(act, S::load(half.as_ptr()))) };
    }
    if let Some(residual) = residual {
        sums.iter_mut().zip(residual).for_each(|(s, r)| *s += r);
    }
    let width = out.len();
    out.copy_from_slice(&sums[..width]);
}
