//! Linear layers in whole numbers: operands in 16 bits, products of pairs summed in 32 (`pmaddwd`), so that nothing is
//! rounded between quantising and the last conversion. A sum cannot overflow: inputs are as fine as the layer's largest sum
//! of absolute weights allows.
//!
//! Weights have one scale per output, inputs one per row, found anew at every use. The whole numbers and their sums are the
//! same on every instruction set.

use crate::kernels::math::ROUND;
use crate::kernels::simd::Simd;

/// Largest weight of 8 bits.
pub(super) const EIGHT_BITS: f32 = 127.0;
/// Largest whole number of 16 bits.
const SIXTEEN_BITS: f32 = 32767.0;
/// Largest sum.
const LARGEST_SUM: f64 = i32::MAX as f64;
/// Rows whose values are all smaller are taken as zeros: their scale would not be a normal number.
const TINY: f32 = 1e-30;

/// What brings sums back to floats.
#[derive(Debug)]
pub(super) struct IntegerScales {
    /// One per output, zeros up to whole tiles.
    outputs: Vec<f32>,
    largest_input: f32,
}

impl IntegerScales {
    /// Largest whole number an input may be.
    pub(super) fn largest_input(&self) -> f32 {
        self.largest_input
    }

    /// A tile's sums as floats; `rows` are the scales of its rows, `col` its first output.
    #[inline(always)]
    pub(super) fn to_floats<S: Simd, const MR: usize>(&self, acc: &mut [[S::V; 2]; MR], rows: &[f32], col: usize) {
        let columns = &self.outputs[col..col + 2 * S::W];
        // SAFETY: two vectors, as just cut.
        let columns = unsafe { [S::load(columns.as_ptr()), S::load(columns.as_ptr().add(S::W))] };
        for (sums, &row) in acc.iter_mut().zip(rows) {
            for (sum, column) in sums.iter_mut().zip(columns) {
                *sum = S::mul(S::whole_to_float(*sum), S::mul(S::splat(row), column));
            }
        }
    }
}

/// Largest absolute value; NaN where there is one.
#[inline(always)]
pub(crate) fn largest_of(x: &[f32]) -> f32 {
    // As bits: absolute values are ordered like them, and NaN is past all.
    f32::from_bits(x.iter().fold(0, |top, x| top.max(x.to_bits() & 0x7fff_ffff)))
}

/// What a row is multiplied by to become whole numbers up to `largest`, and what those are multiplied by. Neither is finite
/// where the row is not, so that its results are not either.
#[inline(always)]
pub(crate) fn row_factors(top: f32, largest: f32) -> (f32, f32) {
    if top < TINY { (0.0, 0.0) } else { (largest / top, top / largest) }
}

/// Whole numbers nearest to `x * factor`, ties to even.
#[inline(always)]
pub(crate) fn quantise(x: &[f32], factor: f32, to: &mut [i16]) {
    for (to, x) in to.iter_mut().zip(x) {
        *to = (x * factor + ROUND).to_bits() as i16;
    }
}

/// [`row_factors`] of a row.
#[inline(always)]
pub(crate) fn factors_of(x: &[f32], largest: f32) -> (f32, f32) {
    row_factors(largest_of(x), largest)
}

/// Rows of `k` values as pairs of whole numbers, one row after the other; the second of a last odd one is 0.
#[inline(always)]
pub(super) fn quantise_rows(x: &[f32], k: usize, largest: f32, to: &mut [f32], scales: &mut [f32]) {
    let pairs = k.div_ceil(2);
    scales.fill(0.0);
    for ((x, to), scale) in x.chunks_exact(k).zip(to.chunks_exact_mut(pairs)).zip(scales) {
        let (factor, back) = factors_of(x, largest);
        *scale = back;
        // Always of whole size: a float is two of them.
        let to: &mut [i16] = bytemuck::cast_slice_mut(to);
        quantise(x, factor, &mut to[..k]);
        to[k..].fill(0);
    }
}

/// The largest weight with which weights and inputs are about equally fine.
pub(super) fn balanced(weight: &[f32], k: usize) -> f32 {
    let row = |row: &[f32]| {
        let top = largest_of(row);
        if top > TINY { row.iter().map(|w| f64::from(w.abs())).sum::<f64>() / f64::from(top) } else { 0.0 }
    };
    // Sums in units of the row's largest weight; those that are not finite are passed over.
    let sums = weight.chunks_exact(k).map(row).fold(1.0, f64::max);
    ((LARGEST_SUM / sums).sqrt().floor() as f32).clamp(1.0, SIXTEEN_BITS)
}

/// Quantises a row-major `(n, k)` weight to whole numbers up to `largest`: `put` gets output, number and bits of each pair.
pub(super) fn quantise_weight(
    weight: &[f32],
    k: usize,
    largest: f32,
    tile_cols: usize,
    mut put: impl FnMut(usize, usize, u32),
) -> IntegerScales {
    let n = weight.len() / k;
    let mut outputs = vec![0f32; n.next_multiple_of(tile_cols)];
    let mut whole = vec![0i16; 2 * k.div_ceil(2)];
    let mut largest_sum = 1i64;
    for ((index, row), scale) in weight.chunks_exact(k).enumerate().zip(&mut outputs) {
        let (factor, back) = factors_of(row, largest);
        *scale = back;
        quantise(row, factor, &mut whole[..k]);
        for (p, pair) in whole.chunks_exact(2).enumerate() {
            put(index, p, u32::from(pair[0] as u16) | u32::from(pair[1] as u16) << 16);
        }
        largest_sum = largest_sum.max(whole.iter().map(|&w| i64::from(w).abs()).sum());
    }
    let largest_input = (LARGEST_SUM / largest_sum as f64).floor().min(f64::from(SIXTEEN_BITS)) as f32;
    IntegerScales { outputs, largest_input }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use crate::kernels::Isa;
    use crate::kernels::gemm::{Epilogue, PackedWeight, linear};
    use crate::kernels::tests::noise;
    use crate::ops::{Activation, Precision};

    const PLAIN: Epilogue<'static> = Epilogue { bias: None, act: Activation::None, residual: None };

    /// The obvious version: quantise, multiply in 64 bits, scale back. Panics where a sum leaves 32 bits.
    fn obvious(x: &[f32], w: &[f32], (m, n, k): (usize, usize, usize), weight_top: f32, input_top: f32) -> Vec<f32> {
        let quantised = |row: &[f32], largest: f32| {
            let top = row.iter().fold(0f32, |a, x| a.max(x.abs()));
            let factor = if top < super::TINY { 0.0 } else { largest / top };
            let whole: Vec<i64> = row.iter().map(|x| (x * factor).round_ties_even() as i64).collect();
            (whole, if top < super::TINY { 0.0 } else { top / largest })
        };
        let weights: Vec<_> = w.chunks_exact(k).map(|row| quantised(row, weight_top)).collect();
        let mut out = Vec::with_capacity(m * n);
        for row in x.chunks_exact(k) {
            let (a, row_scale) = quantised(row, input_top);
            for (b, scale) in &weights {
                let sum: i64 = a.iter().zip(b).map(|(a, b)| a * b).sum();
                out.push(i32::try_from(sum).unwrap() as f32 * (row_scale * scale));
            }
        }
        out
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]

        #[test]
        fn the_kernel_is_the_obvious_version_bit_for_bit(
            m in 1usize..110, n in 1usize..80, k in 1usize..700, seed in 0u64..1000, eight: bool,
        ) {
            let mut x = noise(seed, m * k, 3.0);
            x[..k].fill(0.0);
            let w = noise(seed + 1, n * k, 0.2);
            let precision = if eight { Precision::Int8 } else { Precision::Int16 };
            for isa in Isa::tested() {
                let packed = PackedWeight::in_precision(isa, precision, &w, n, k);
                let super::super::Numbers::Pairs(scales) = &packed.numbers else { unreachable!() };
                let top = if eight { super::EIGHT_BITS } else { super::balanced(&w, k) };
                let want = obvious(&x, &w, (m, n, k), top, scales.largest_input());
                let mut got = vec![f32::NAN; m * n];
                linear(&x, &packed, PLAIN, &mut got);
                prop_assert!(got.iter().zip(&want).all(|(a, b)| a == b), "{:?} {} {} {}", isa, m, n, k);
            }
        }
    }

    /// Root mean square of the difference over that of the exact result.
    fn relative(precision: Precision, k: usize) -> f64 {
        let (m, n) = (50, 60);
        let (x, w) = (noise(1, m * k, 1.0), noise(2, n * k, 0.1));
        let (mut got, mut want) = (vec![0.0; m * n], vec![0.0; m * n]);
        linear(&x, &PackedWeight::in_precision(Isa::detect(), precision, &w, n, k), PLAIN, &mut got);
        linear(&x, &PackedWeight::new(Isa::detect(), &w, n, k), PLAIN, &mut want);
        let square = |x: f32| f64::from(x) * f64::from(x);
        let apart: f64 = got.iter().zip(&want).map(|(a, b)| square(a - b)).sum();
        (apart / want.iter().map(|&b| square(b)).sum::<f64>()).sqrt()
    }

    #[test]
    fn how_fine_each_precision_is() {
        for k in [192, 3072] {
            let (int16, int8, bf16) =
                (relative(Precision::Int16, k), relative(Precision::Int8, k), relative(Precision::Bf16, k));
            // Uniform noise: steps of 1/127 of the largest are 0.4 % of the root mean square, of 8 bits mantissa 0.2 % and more.
            assert!((1e-5..1e-3).contains(&int16) && (1e-3..6e-3).contains(&int8), "{k}: {int16:e} {int8:e}");
            assert!((1e-3..4e-3).contains(&bf16), "{k}: {bf16:e}");
        }
    }

    #[test]
    fn the_largest_sums_do_not_overflow() {
        // All of one sign at the largest value: the worst case there is.
        for k in [2, 63, 3072] {
            let (x, w) = (vec![7.0f32; 3 * k], vec![-0.3f32; 5 * k]);
            for precision in [Precision::Int8, Precision::Int16] {
                let mut out = vec![0.0; 15];
                linear(&x, &PackedWeight::in_precision(Isa::detect(), precision, &w, 5, k), PLAIN, &mut out);
                let want = -2.1 * k as f32;
                assert!(out.iter().all(|y| (y / want - 1.0).abs() < 1e-3), "{k} {precision}: {out:?}");
            }
        }
    }

    #[test]
    fn what_is_not_finite_stays_so() {
        let (n, k) = (20, 9);
        for bad in [f32::NAN, f32::INFINITY] {
            let mut x = noise(1, 8 * k, 1.0);
            x[4 * k + 3] = bad;
            let w = noise(2, n * k, 1.0);
            let mut broken = w.clone();
            broken[7 * k + 2] = bad;
            let run = |x: &[f32], w: &[f32]| {
                let mut out = vec![0.0; 8 * n];
                linear(x, &PackedWeight::in_precision(Isa::detect(), Precision::Int8, w, n, k), PLAIN, &mut out);
                out
            };
            assert!(run(&x, &w).iter().enumerate().all(|(i, y)| y.is_finite() != (i / n == 4)));
            let good = noise(1, 8 * k, 1.0);
            assert!(run(&good, &broken).iter().enumerate().all(|(i, y)| y.is_finite() != (i % n == 7)));
        }
    }
}
