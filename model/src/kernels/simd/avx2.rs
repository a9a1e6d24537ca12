//! AVX2 and FMA registers.

use std::arch::x86_64::*;

/// Eight floats to a register.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Avx2;

// SAFETY (every block in this impl): the type is only named by `dispatch` under `Isa::Avx2`, which exists only
// after the features were detected, and every method is inlined into `run_avx2`.
impl super::Simd for Avx2 {
    type V = __m256;
    const W: usize = 8;

    #[inline(always)]
    fn splat(x: f32) -> __m256 {
        // SAFETY: AVX2 was detected (see the impl).
        unsafe { _mm256_set1_ps(x) }
    }
    #[inline(always)]
    unsafe fn load(p: *const f32) -> __m256 {
        // SAFETY: AVX2 was detected; the caller gives 8 readable floats.
        unsafe { _mm256_loadu_ps(p) }
    }
    #[inline(always)]
    unsafe fn store(p: *mut f32, v: __m256) {
        // SAFETY: AVX2 was detected; the caller gives 8 writable floats.
        unsafe { _mm256_storeu_ps(p, v) }
    }
    #[inline(always)]
    fn add(a: __m256, b: __m256) -> __m256 {
        // SAFETY: AVX2 was detected (see the impl).
        unsafe { _mm256_add_ps(a, b) }
    }
    #[inline(always)]
    fn sub(a: __m256, b: __m256) -> __m256 {
        // SAFETY: AVX2 was detected (see the impl).
        unsafe { _mm256_sub_ps(a, b) }
    }
    #[inline(always)]
    fn mul(a: __m256, b: __m256) -> __m256 {
        // SAFETY: AVX2 was detected (see the impl).
        unsafe { _mm256_mul_ps(a, b) }
    }
    #[inline(always)]
    fn div(a: __m256, b: __m256) -> __m256 {
        // SAFETY: AVX2 was detected (see the impl).
        unsafe { _mm256_div_ps(a, b) }
    }
    #[inline(always)]
    fn mul_add(a: __m256, b: __m256, c: __m256) -> __m256 {
        // SAFETY: FMA was detected (see the impl).
        unsafe { _mm256_fmadd_ps(a, b, c) }
    }
    #[inline(always)]
    fn max_of(floor: __m256, x: __m256) -> __m256 {
        // SAFETY: AVX2 was detected. maxps gives its second operand when either is NaN.
        unsafe { _mm256_max_ps(floor, x) }
    }
    #[inline(always)]
    fn abs(a: __m256) -> __m256 {
        // SAFETY: AVX2 was detected (see the impl).
        unsafe { _mm256_andnot_ps(_mm256_set1_ps(-0.0), a) }
    }
    #[inline(always)]
    fn select_lt(a: __m256, b: __m256, x: __m256, y: __m256) -> __m256 {
        // SAFETY: AVX2 was detected (see the impl).
        unsafe { _mm256_blendv_ps(y, x, _mm256_cmp_ps::<_CMP_LT_OQ>(a, b)) }
    }
    #[inline(always)]
    fn exponent(t: __m256) -> __m256 {
        // SAFETY: AVX2 was detected (see the impl).
        unsafe {
            let n = _mm256_add_epi32(_mm256_castps_si256(t), _mm256_set1_epi32(127));
            _mm256_castsi256_ps(_mm256_slli_epi32::<23>(n))
        }
    }
    #[inline(always)]
    fn scale(p: __m256, t: __m256) -> __m256 {
        // SAFETY: AVX2 was detected (see the impl).
        unsafe {
            let n = _mm256_slli_epi32::<23>(_mm256_castps_si256(t));
            _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(p), n))
        }
    }
    #[inline(always)]
    fn mul_add_pairs(a: __m256, b: __m256, c: __m256) -> __m256 {
        // SAFETY: AVX2 was detected (see the impl).
        unsafe {
            let sums = _mm256_madd_epi16(_mm256_castps_si256(a), _mm256_castps_si256(b));
            _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(c), sums))
        }
    }
    #[inline(always)]
    fn whole_to_float(a: __m256) -> __m256 {
        // SAFETY: AVX2 was detected (see the impl).
        unsafe { _mm256_cvtepi32_ps(_mm256_castps_si256(a)) }
    }
    #[inline(always)]
    fn pair(low: __m256, high: __m256) -> __m256 {
        // SAFETY: AVX2 was detected (see the impl).
        unsafe {
            let high = _mm256_slli_epi32::<16>(_mm256_castps_si256(high));
            _mm256_castsi256_ps(_mm256_blend_epi16::<0xaa>(_mm256_castps_si256(low), high))
        }
    }
}
