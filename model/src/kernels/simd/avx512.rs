//! AVX-512 registers.

use std::arch::x86_64::*;

/// Sixteen floats to a register; `VNNI`: products of pairs are summed by one instruction.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Avx512<const VNNI: bool>;

// SAFETY (every block in this impl): the type is only named by `dispatch` under `Isa::Avx512`, which exists only after
// the features were detected, and every method is inlined into `run_avx512` or `run_avx512_vnni`.
impl<const VNNI: bool> super::Simd for Avx512<VNNI> {
    type V = __m512;
    const W: usize = 16;

    #[inline(always)]
    fn splat(x: f32) -> __m512 {
        // SAFETY: AVX-512 was detected (see the impl).
        unsafe { _mm512_set1_ps(x) }
    }
    #[inline(always)]
    unsafe fn load(p: *const f32) -> __m512 {
        // SAFETY: AVX-512 was detected; the caller gives 16 readable floats.
        unsafe { _mm512_loadu_ps(p) }
    }
    #[inline(always)]
    unsafe fn store(p: *mut f32, v: __m512) {
        // SAFETY: AVX-512 was detected; the caller gives 16 writable floats.
        unsafe { _mm512_storeu_ps(p, v) }
    }
    #[inline(always)]
    fn add(a: __m512, b: __m512) -> __m512 {
        // SAFETY: AVX-512 was detected (see the impl).
        unsafe { _mm512_add_ps(a, b) }
    }
    #[inline(always)]
    fn sub(a: __m512, b: __m512) -> __m512 {
        // SAFETY: AVX-512 was detected (see the impl).
        unsafe { _mm512_sub_ps(a, b) }
    }
    #[inline(always)]
    fn mul(a: __m512, b: __m512) -> __m512 {
        // SAFETY: AVX-512 was detected (see the impl).
        unsafe { _mm512_mul_ps(a, b) }
    }
    #[inline(always)]
    fn div(a: __m512, b: __m512) -> __m512 {
        // SAFETY: AVX-512 was detected (see the impl).
        unsafe { _mm512_div_ps(a, b) }
    }
    #[inline(always)]
    fn mul_add(a: __m512, b: __m512, c: __m512) -> __m512 {
        // SAFETY: AVX-512 was detected (see the impl).
        unsafe { _mm512_fmadd_ps(a, b, c) }
    }
    #[inline(always)]
    fn max_of(floor: __m512, x: __m512) -> __m512 {
        // SAFETY: AVX-512 was detected. maxps gives its second operand when either is NaN.
        unsafe { _mm512_max_ps(floor, x) }
    }
    #[inline(always)]
    fn abs(a: __m512) -> __m512 {
        // SAFETY: AVX-512 was detected (see the impl).
        unsafe { _mm512_abs_ps(a) }
    }
    #[inline(always)]
    fn select_lt(a: __m512, b: __m512, x: __m512, y: __m512) -> __m512 {
        // SAFETY: AVX-512 was detected (see the impl).
        unsafe { _mm512_mask_blend_ps(_mm512_cmp_ps_mask::<_CMP_LT_OQ>(a, b), y, x) }
    }
    #[inline(always)]
    fn exponent(t: __m512) -> __m512 {
        // SAFETY: AVX-512 was detected (see the impl).
        unsafe {
            let n = _mm512_add_epi32(_mm512_castps_si512(t), _mm512_set1_epi32(127));
            _mm512_castsi512_ps(_mm512_slli_epi32::<23>(n))
        }
    }
    #[inline(always)]
    fn scale(p: __m512, t: __m512) -> __m512 {
        // SAFETY: AVX-512 was detected (see the impl).
        unsafe {
            let n = _mm512_slli_epi32::<23>(_mm512_castps_si512(t));
            _mm512_castsi512_ps(_mm512_add_epi32(_mm512_castps_si512(p), n))
        }
    }
    #[inline(always)]
    fn mul_add_pairs(a: __m512, b: __m512, c: __m512) -> __m512 {
        // SAFETY: AVX-512 (with BW, and VNNI where that is so) was detected (see the impl).
        unsafe {
            let (a, b, c) = (_mm512_castps_si512(a), _mm512_castps_si512(b), _mm512_castps_si512(c));
            _mm512_castsi512_ps(match VNNI {
                true => _mm512_dpwssd_epi32(c, a, b),
                false => _mm512_add_epi32(c, _mm512_madd_epi16(a, b)),
            })
        }
    }
    #[inline(always)]
    fn whole_to_float(a: __m512) -> __m512 {
        // SAFETY: AVX-512 was detected (see the impl).
        unsafe { _mm512_cvtepi32_ps(_mm512_castps_si512(a)) }
    }
    #[inline(always)]
    fn pair(low: __m512, high: __m512) -> __m512 {
        // SAFETY: AVX-512 was detected (see the impl).
        unsafe {
            let high = _mm512_slli_epi32::<16>(_mm512_castps_si512(high));
            let low = _mm512_and_si512(_mm512_castps_si512(low), _mm512_set1_epi32(0xffff));
            _mm512_castsi512_ps(_mm512_or_si512(low, high))
        }
    }
    #[inline(always)]
    fn sum(v: __m512) -> f32 {
        // SAFETY: AVX-512 was detected (see the impl).
        unsafe {
            let half = _mm256_add_ps(_mm512_castps512_ps256(v), _mm512_extractf32x8_ps::<1>(v));
            let quarter = _mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps::<1>(half));
            let two = _mm_add_ps(quarter, _mm_movehl_ps(quarter, quarter));
            _mm_cvtss_f32(_mm_add_ss(two, _mm_shuffle_ps::<1>(two, two)))
        }
    }
}
