//! The register tile every product goes through, and what follows it.

use crate::kernels::math::activate;
use crate::kernels::simd::Simd;
use crate::ops::Activation;

/// What the lanes of a tile are, and how they are multiplied and summed.
pub(crate) trait Product {
    /// Whether lanes are pairs of 16-bit whole numbers with 32-bit sums, seen as bits.
    const PAIRS: bool;
    fn add<S: Simd>(a: S::V, b: S::V, sum: S::V) -> S::V;
}

/// Floats.
pub(crate) struct Floats;
/// Pairs of 16-bit whole numbers, sums in 32 bits.
pub(crate) struct Pairs;

impl Product for Floats {
    const PAIRS: bool = false;
    #[inline(always)]
    fn add<S: Simd>(a: S::V, b: S::V, sum: S::V) -> S::V {
        S::mul_add(a, b, sum)
    }
}

impl Product for Pairs {
    const PAIRS: bool = true;
    #[inline(always)]
    fn add<S: Simd>(a: S::V, b: S::V, sum: S::V) -> S::V {
        S::mul_add_pairs(a, b, sum)
    }
}

/// [`tile_of`] floats.
///
/// # Safety
/// As there.
#[inline(always)]
pub(crate) unsafe fn tile<S: Simd, const MR: usize>(
    depth: usize,
    a: *const f32,
    a_step: usize,
    a_row: usize,
    b: *const f32,
    acc: [[S::V; 2]; MR],
) -> [[S::V; 2]; MR] {
    // SAFETY: the caller's contract.
    unsafe { tile_of::<S, MR, Floats>(depth, a, a_step, a_row, b, acc) }
}

/// `acc + a b` over `depth` products: `a[p * a_step + r * a_row]` for row `r`, `b` a packed panel of two vectors a row.
///
/// # Safety
/// `a` must be readable at those indices for `p < depth`, `r < MR`; `b` for `depth * 2 * W` floats.
#[inline(always)]
pub(crate) unsafe fn tile_of<S: Simd, const MR: usize, P: Product>(
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
                acc[r][0] = P::add::<S>(x, b0, acc[r][0]);
                acc[r][1] = P::add::<S>(x, b1, acc[r][1]);
            }
            a = a.add(a_step);
            b = b.add(2 * S::W);
        }
    }
    acc
}

/// The epilogue on `rows` rows of a tile whose columns are all outputs, `col` being the first of `n`: from the registers to
/// `out`. `residual` and `out` start at the tile's first row.
#[inline(always)]
pub(super) fn finish_tile<S: Simd, const MR: usize>(
    acc: &[[S::V; 2]; MR],
    (rows, n, col): (usize, usize, usize),
    bias: Option<&[f32]>,
    act: Activation,
    residual: Option<&[f32]>,
    out: &mut [f32],
) {
    let inside = (rows - 1) * n + col + 2 * S::W;
    assert!(rows <= MR && col + 2 * S::W <= n && out.len() >= inside, "tile of {rows} rows");
    assert!(bias.is_none_or(|b| b.len() == 2 * S::W) && residual.is_none_or(|r| r.len() >= inside), "epilogue");
    // SAFETY: two vectors of bias, as just checked.
    let bias = bias.map(|b| unsafe { [S::load(b.as_ptr()), S::load(b.as_ptr().add(S::W))] });
    // A macro, not a closure (see `kernels::math`), and one loop per activation instead of a choice per vector.
    macro_rules! rows {
        (|$v:ident| $value:expr) => {
            for r in 0..rows {
                for half in 0..2 {
                    let mut $v = acc[r][half];
                    if let Some(bias) = bias {
                        $v = S::add($v, bias[half]);
                    }
                    let mut value = $value;
                    let at = r * n + col + half * S::W;
                    // SAFETY: `at + W <= inside`, checked above.
                    unsafe {
                        if let Some(residual) = residual {
                            value = S::add(value, S::load(residual.as_ptr().add(at)));
                        }
                        S::store(out.as_mut_ptr().add(at), value);
                    }
                }
            }
        };
    }
    match act {
        Activation::None => rows!(|v| v),
        Activation::Gelu => rows!(|v| activate::<S>(Activation::Gelu, v)),
        Activation::Silu => rows!(|v| activate::<S>(Activation::Silu, v)),
    }
}

/// The epilogue on one row of a tile that the outputs do not fill: `sums` has two whole vectors, the others as many
/// columns as there are outputs.
#[inline(always)]
pub(super) fn finish<S: Simd>(
    sums: &mut [f32],
    bias: Option<&[f32]>,
    act: Activation,
    residual: Option<&[f32]>,
    out: &mut [f32],
) {
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
