//! One source, several compilations: which vector instructions the machine has, and the arithmetic that differs.
//!
//! The inner loops are plain code over lane arrays, `#[inline(always)]` and generic over `FMA`; [`dispatch!`] compiles
//! them again inside a function that enables AVX2, where the compiler turns each lane loop into vectors. With AVX-512 enabled it
//! makes worse ones of the same loops: blending took 2.3 times as long on a Sapphire Rapids, so that set is left alone.

/// Instruction sets the kernels are compiled for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Isa {
    /// What the build target guarantees.
    Portable,
    /// x86 with AVX2 and FMA.
    #[cfg(target_arch = "x86_64")]
    Avx2,
}

impl Isa {
    /// The widest this machine runs.
    pub(crate) fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            return Self::Avx2;
        }
        Self::Portable
    }
}

/// True when the build target itself has a fused multiply-add (then `mul_add` is one instruction, not a call).
pub(crate) const TARGET_FMA: bool = cfg!(any(target_feature = "fma", target_arch = "aarch64"));

/// Defines `fn $name(isa, args...)`, which runs the `#[inline(always)]` generic `$kernel::<FMA>(args...)` compiled for `isa`.
macro_rules! dispatch {
    ($(#[$doc:meta])* $name:ident, $kernel:ident, ($($arg:ident: $ty:ty),* $(,)?)) => {
        $(#[$doc])*
        pub(crate) fn $name(isa: $crate::raster::simd::Isa, $($arg: $ty),*) {
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma")]
            fn avx2($($arg: $ty),*) {
                $kernel::<true>($($arg),*)
            }
            match isa {
                $crate::raster::simd::Isa::Portable => $kernel::<{ $crate::raster::simd::TARGET_FMA }>($($arg),*),
                #[cfg(target_arch = "x86_64")]
                // SAFETY: `Isa::Avx2` is only made by `Isa::detect` after the CPU reported these features.
                $crate::raster::simd::Isa::Avx2 => unsafe { avx2($($arg),*) },
            }
        }
    };
}
pub(crate) use dispatch;

/// Asks for the cache line of `values[at]`, which will be read soon; does nothing where there is no such element.
#[inline(always)]
pub(crate) fn prefetch<T>(values: &[T], at: usize) {
    #[cfg(target_arch = "x86_64")]
    if let Some(value) = values.get(at) {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        // SAFETY: the address is that of a live element, and a prefetch is only a hint; SSE is part of x86_64.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(std::ptr::from_ref(value).cast()) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (values, at);
}

/// `a * b + c`, fused where that is one instruction.
#[inline(always)]
pub(crate) fn fma<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// `a * b + c` in f64, fused where that is one instruction.
#[inline(always)]
pub(crate) fn fma64<const FMA: bool>(a: f64, b: f64, c: f64) -> f64 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// [`exp2_neg`] goes no lower than `2^-EXP2_END`: far below 1/255 for any opacity up to `OPACITY_CEILING`, and far above
/// the denormal numbers, whose products cost the processor a hundred cycles.
const EXP2_END: f32 = 100.0;

/// Relative error bound of [`exp2_neg`] on `0 <= x <= EXP2_END`: 0.9e-7 from the polynomial, the rest f32 rounding.
#[cfg(test)]
pub(crate) const EXP2_TOLERANCE: f64 = 2e-7;

/// `2^-x` for `x >= 0`, relative error at most 2e-7, exactly 1 at 0; beyond `EXP2_END` (infinity and NaN
/// included) it stays at `2^-EXP2_END`.
///
/// `2^-x = 2^n 2^r` with `n` the nearest integer and a degree-5 minimax polynomial in `r`, `|r| <= 1/2`.
#[inline(always)]
pub(crate) fn exp2_neg<const FMA: bool>(x: f32) -> f32 {
    // Adding 1.5 * 2^23 rounds to an integer and leaves it in the low mantissa bits.
    const ROUND: f32 = 12_582_912.0;
    // Near ln 2, but the minimax coefficient, which is three ulps off.
    #[allow(clippy::approx_constant)]
    const LINEAR: f32 = 0.693_147;
    let y = -(if x < EXP2_END { x } else { EXP2_END });
    let shifted = y + ROUND;
    let r = y - (shifted - ROUND);
    let mut p = 1.326_472_2e-3;
    p = fma::<FMA>(p, r, 9.671_513e-3);
    p = fma::<FMA>(p, r, 5.550_734e-2);
    p = fma::<FMA>(p, r, 2.402_224_2e-1);
    p = fma::<FMA>(p, r, LINEAR);
    p = fma::<FMA>(p, r, 1.0);
    // 2^n: n added to the exponent field; the bits of ROUND itself are shifted out.
    f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// [`exp2_neg`] of each lane.
#[inline(always)]
pub(crate) fn exp2_neg_lanes<const FMA: bool>(x: &mut [f32; 8]) {
    for l in 0..8 {
        x[l] = exp2_neg::<FMA>(x[l]);
    }
}

/// Relative error bound of [`ln_lanes`] next to the library's: a few roundings.
#[cfg(test)]
pub(crate) const LN_TOLERANCE: f64 = 1e-15;

/// Natural logarithm of each lane, all of them 1 or more, finite and below 2^100; exactly 0 at 1.
///
/// `ln x = e ln 2 + 2 artanh(s)`, `s = (m - 1) / (m + 1)`, with `x = m 2^e` and `m` from sqrt(1/2) to sqrt(2), so that
/// `s^2 < 0.0295`: ten terms of the series in `s^2` reach rounding. No call and no table: the loop becomes vectors.
#[inline(always)]
pub(crate) fn ln_lanes(x: &mut [f64; 8]) {
    /// Bits of sqrt(1/2) rounded to the upper word, so that the exponent of `x / sqrt(1/2)` is `e`.
    const HALF_ROOT: u64 = 0x3fe6_a09e_0000_0000;
    const MANTISSA: u64 = (1 << 52) - 1;
    /// 2^52: its low mantissa bits hold a small whole number.
    const WHOLE: u64 = 0x4330_0000_0000_0000;
    /// `1 / (2 k + 3)`.
    const TERMS: [f64; 10] =
        [1.0 / 3.0, 0.2, 1.0 / 7.0, 1.0 / 9.0, 1.0 / 11.0, 1.0 / 13.0, 1.0 / 15.0, 1.0 / 17.0, 1.0 / 19.0, 1.0 / 21.0];
    let (mut m, mut e) = ([0.0; 8], [0.0; 8]);
    for l in 0..8 {
        let shifted = x[l].to_bits().wrapping_sub(HALF_ROOT);
        e[l] = f64::from_bits(WHOLE | (shifted >> 52)) - f64::from_bits(WHOLE);
        m[l] = f64::from_bits((shifted & MANTISSA).wrapping_add(HALF_ROOT));
    }
    for l in 0..8 {
        let s = (m[l] - 1.0) / (m[l] + 1.0);
        let z = s * s;
        // In two halves, so that no addition waits for all others.
        let w = z * z;
        let even = TERMS[0] + w * (TERMS[2] + w * (TERMS[4] + w * (TERMS[6] + w * TERMS[8])));
        let odd = TERMS[1] + w * (TERMS[3] + w * (TERMS[5] + w * (TERMS[7] + w * TERMS[9])));
        let sum = even + z * odd;
        x[l] = e[l] * std::f64::consts::LN_2 + 2.0 * (s + s * z * sum);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp2_stays_within_its_stated_error() {
        let mut worst = 0.0f64;
        for step in 0..1_000_000u32 {
            let x = step as f32 * 1e-4;
            let exact = (-f64::from(x)).exp2();
            for got in [exp2_neg::<false>(x), exp2_neg::<true>(x)] {
                worst = worst.max((f64::from(got) / exact - 1.0).abs());
            }
        }
        println!("worst relative error {worst:e}");
        assert!(worst <= EXP2_TOLERANCE, "{worst:e}");
        assert_eq!(exp2_neg::<true>(0.0), 1.0);
    }

    #[test]
    fn ln_is_that_of_the_library() {
        for step in 0..200_000u32 {
            let x = if step < 100_000 { 1.0 + f64::from(step) * 0.0027 } else { (f64::from(step) * 3.4e-4).exp2() };
            let mut lanes = [x; 8];
            ln_lanes(&mut lanes);
            let exact = x.ln();
            assert!((lanes[3] - exact).abs() <= LN_TOLERANCE * exact.abs().max(0.1), "{x}: {} {exact}", lanes[3]);
        }
        let mut one = [1.0; 8];
        ln_lanes(&mut one);
        assert_eq!(one, [0.0; 8]);
    }

    #[test]
    fn exp2_never_leaves_the_finite_numbers() {
        for x in [100.0, 127.0, 1e30, f32::MAX, f32::INFINITY, f32::NAN] {
            let y = exp2_neg::<false>(x);
            assert!(y > 0.0 && y < 1e-30, "{x} gave {y}");
        }
    }
}
