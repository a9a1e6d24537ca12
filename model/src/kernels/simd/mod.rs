//! Vectors of `f32` for kernels written once: a trait, its AVX2, AVX-512 and array versions, and the run-time choice.
//!
//! The vector types are private: kernels only ever see `S: Simd`, and only [`dispatch`] names an implementation, after
//! the instruction set was detected. That is what makes the safe methods of the AVX versions sound.

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;

use super::Isa;
#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
pub(super) use avx512::Avx512;

/// A vector of `W` floats. Every method is a few instructions and inlined into a function compiled for the set.
pub(crate) trait Simd: Copy + 'static {
    /// The register.
    type V: Copy;
    /// Floats in it.
    const W: usize;

    fn splat(x: f32) -> Self::V;
    /// # Safety
    /// `p` must be readable for `W` floats; no alignment is asked for.
    unsafe fn load(p: *const f32) -> Self::V;
    /// # Safety
    /// `p` must be writable for `W` floats; no alignment is asked for.
    unsafe fn store(p: *mut f32, v: Self::V);
    fn add(a: Self::V, b: Self::V) -> Self::V;
    fn sub(a: Self::V, b: Self::V) -> Self::V;
    fn mul(a: Self::V, b: Self::V) -> Self::V;
    fn div(a: Self::V, b: Self::V) -> Self::V;
    /// `a * b + c`, rounded once where the set has FMA.
    fn mul_add(a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// The larger of `floor` and `x`; NaN in `x` stays NaN.
    fn max_of(floor: Self::V, x: Self::V) -> Self::V;
    fn abs(a: Self::V) -> Self::V;
    /// Per lane: `a < b ? x : y` (false for NaN).
    fn select_lt(a: Self::V, b: Self::V, x: Self::V, y: Self::V) -> Self::V;
    /// `2^n` for `t = 1.5 * 2^23 + n`, `-126 <= n <= 127`, by shifting `n` into the exponent.
    fn exponent(t: Self::V) -> Self::V;
    /// `p 2^n` for `t = 1.5 * 2^23 + n`, by adding `n` to the exponent: `p` and the result must be normal numbers.
    fn scale(p: Self::V, t: Self::V) -> Self::V;
    /// Per lane, all three seen as bits: `c` plus the sum of the two products of the 16-bit whole numbers in `a` and `b`,
    /// in 32 bits that wrap.
    fn mul_add_pairs(a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// Per lane: the 32-bit whole number that the bits are, as a float.
    fn whole_to_float(a: Self::V) -> Self::V;
    /// Per lane: the low 16 bits of `low`, and above them those of `high`.
    fn pair(low: Self::V, high: Self::V) -> Self::V;

    fn zero() -> Self::V {
        Self::splat(0.0)
    }
    /// Sum of the lanes, by halves.
    #[inline(always)]
    fn sum(v: Self::V) -> f32 {
        let mut lanes = [0f32; 16];
        // SAFETY: no vector has more than 16 lanes.
        unsafe { Self::store(lanes.as_mut_ptr(), v) };
        let mut half = Self::W / 2;
        while half > 0 {
            for i in 0..half {
                lanes[i] += lanes[i + half];
            }
            half /= 2;
        }
        lanes[0]
    }
    /// Largest lane, for lanes that are not NaN.
    #[inline(always)]
    fn largest(v: Self::V) -> f32 {
        let mut lanes = [0f32; 16];
        // SAFETY: no vector has more than 16 lanes.
        unsafe { Self::store(lanes.as_mut_ptr(), v) };
        let mut half = Self::W / 2;
        while half > 0 {
            for i in 0..half {
                lanes[i] = if lanes[i + half] > lanes[i] { lanes[i + half] } else { lanes[i] };
            }
            half /= 2;
        }
        lanes[0]
    }
}

/// Asks for the cache line of `value` in the second level; a hint that changes no result.
#[inline(always)]
pub(crate) fn prefetch(value: &f32) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: part of the x86-64 baseline, and of a readable address.
    unsafe {
        use std::arch::x86_64::{_MM_HINT_T1, _mm_prefetch};
        _mm_prefetch::<_MM_HINT_T1>(std::ptr::from_ref(value).cast());
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = value;
}

/// `W` floats in an array; the compiler finds the vectors. `FMA` only where the target has the instruction, else
/// `mul_add` would be a library call.
#[derive(Clone, Copy)]
struct Lanes<const W: usize, const FMA: bool>;

macro_rules! lanewise {
    ($w:ident, |$i:ident| $e:expr) => {{
        let mut out = [0f32; $w];
        for $i in 0..$w {
            out[$i] = $e;
        }
        out
    }};
}

impl<const W: usize, const FMA: bool> Simd for Lanes<W, FMA> {
    type V = [f32; W];
    const W: usize = W;

    #[inline(always)]
    fn splat(x: f32) -> Self::V {
        [x; W]
    }
    #[inline(always)]
    unsafe fn load(p: *const f32) -> Self::V {
        // SAFETY: the caller gives `W` readable floats; the read asks for no alignment.
        unsafe { p.cast::<[f32; W]>().read_unaligned() }
    }
    #[inline(always)]
    unsafe fn store(p: *mut f32, v: Self::V) {
        // SAFETY: the caller gives `W` writable floats; the write asks for no alignment.
        unsafe { p.cast::<[f32; W]>().write_unaligned(v) }
    }
    #[inline(always)]
    fn add(a: Self::V, b: Self::V) -> Self::V {
        lanewise!(W, |i| a[i] + b[i])
    }
    #[inline(always)]
    fn sub(a: Self::V, b: Self::V) -> Self::V {
        lanewise!(W, |i| a[i] - b[i])
    }
    #[inline(always)]
    fn mul(a: Self::V, b: Self::V) -> Self::V {
        lanewise!(W, |i| a[i] * b[i])
    }
    #[inline(always)]
    fn div(a: Self::V, b: Self::V) -> Self::V {
        lanewise!(W, |i| a[i] / b[i])
    }
    #[inline(always)]
    fn mul_add(a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        if FMA { lanewise!(W, |i| a[i].mul_add(b[i], c[i])) } else { lanewise!(W, |i| a[i] * b[i] + c[i]) }
    }
    #[inline(always)]
    fn max_of(floor: Self::V, x: Self::V) -> Self::V {
        lanewise!(W, |i| if floor[i] > x[i] { floor[i] } else { x[i] })
    }
    #[inline(always)]
    fn abs(a: Self::V) -> Self::V {
        lanewise!(W, |i| a[i].abs())
    }
    #[inline(always)]
    fn select_lt(a: Self::V, b: Self::V, x: Self::V, y: Self::V) -> Self::V {
        lanewise!(W, |i| if a[i] < b[i] { x[i] } else { y[i] })
    }
    #[inline(always)]
    fn exponent(t: Self::V) -> Self::V {
        lanewise!(W, |i| f32::from_bits(t[i].to_bits().wrapping_add(127) << 23))
    }
    #[inline(always)]
    fn scale(p: Self::V, t: Self::V) -> Self::V {
        lanewise!(W, |i| f32::from_bits(p[i].to_bits().wrapping_add(t[i].to_bits() << 23)))
    }
    #[inline(always)]
    fn mul_add_pairs(a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        let halves = |x: f32| (i32::from(x.to_bits() as i16), (x.to_bits() as i32) >> 16);
        lanewise!(W, |i| {
            let ((a0, a1), (b0, b1)) = (halves(a[i]), halves(b[i]));
            let sum = (a0 * b0).wrapping_add(a1 * b1);
            f32::from_bits((c[i].to_bits() as i32).wrapping_add(sum) as u32)
        })
    }
    #[inline(always)]
    fn whole_to_float(a: Self::V) -> Self::V {
        lanewise!(W, |i| a[i].to_bits() as i32 as f32)
    }
    #[inline(always)]
    fn pair(low: Self::V, high: Self::V) -> Self::V {
        lanewise!(W, |i| f32::from_bits(low[i].to_bits() & 0xffff | high[i].to_bits() << 16))
    }
}

/// Work written once: `run` must be `#[inline(always)]`, so that it is compiled inside the function that enables the
/// instruction set. `MR` is [`Isa::tile_rows`].
pub(crate) trait Kernel {
    type Out;
    fn run<S: Simd, const MR: usize>(self) -> Self::Out;
}

/// Runs `kernel` compiled for `isa`; panics if the machine lacks it (layouts were made for that set's tiles).
pub(crate) fn dispatch<K: Kernel>(isa: Isa, kernel: K) -> K::Out {
    // aarch64 always has fused multiply-add; the x86-64 baseline never has.
    const BASELINE_FMA: bool = cfg!(target_arch = "aarch64");
    #[cfg(target_arch = "x86_64")]
    {
        if isa == Isa::Avx2 && is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            // SAFETY: both features were just detected.
            return unsafe { run_avx2(kernel) };
        }
        if matches!(isa, Isa::Avx512 | Isa::Amx) && has_avx512() {
            return match is_x86_feature_detected!("avx512vnni") {
                // SAFETY: all features were just detected.
                true => unsafe { run_avx512_vnni(kernel) },
                // SAFETY: all features were just detected.
                false => unsafe { run_avx512(kernel) },
            };
        }
    }
    #[cfg(all(test, target_arch = "x86_64"))]
    if isa == Isa::Avx512 && is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
        // SAFETY: both features were just detected.
        return unsafe { run_wide(kernel) };
    }
    assert!(isa == Isa::Portable, "{isa:?} is not available on this machine");
    kernel.run::<Lanes<4, BASELINE_FMA>, 6>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn run_avx2<K: Kernel>(kernel: K) -> K::Out {
    kernel.run::<avx2::Avx2, 6>()
}

/// Whether the machine has what [`Isa::Avx512`] stands for: what all processors with AVX-512 since 2017 have.
#[cfg(target_arch = "x86_64")]
pub(super) fn has_avx512() -> bool {
    is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512dq")
        && is_x86_feature_detected!("avx512vl")
        && is_x86_feature_detected!("fma")
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2,fma")]
fn run_avx512<K: Kernel>(kernel: K) -> K::Out {
    kernel.run::<avx512::Avx512<false>, 12>()
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni,avx2,fma")]
fn run_avx512_vnni<K: Kernel>(kernel: K) -> K::Out {
    kernel.run::<avx512::Avx512<true>, 12>()
}

/// The AVX-512 build's vectors and tiles on AVX2 registers: what a machine without AVX-512 can test of it.
#[cfg(all(test, target_arch = "x86_64"))]
#[target_feature(enable = "avx2,fma")]
fn run_wide<K: Kernel>(kernel: K) -> K::Out {
    kernel.run::<Lanes<16, true>, 12>()
}
