//! Floats to tiles.

use std::arch::x86_64::*;

use super::{Parts, STEP, TILE, TILE_FLOATS};

/// Bits of a float that are its leading bf16.
const HIGH: i32 = 0xffff_0000_u32 as i32;

/// Sixteen floats as three parts, each in the high half of its word: leading bits, those after, and the rest.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub(in crate::kernels) fn split(x: __m512) -> [__m512; 3] {
    let mask = _mm512_set1_epi32(HIGH);
    let leading = |x: __m512| _mm512_castsi512_ps(_mm512_and_si512(_mm512_castps_si512(x), mask));
    let high = leading(x);
    let rest = _mm512_sub_ps(x, high);
    let middle = leading(rest);
    [high, middle, _mm512_sub_ps(rest, middle)]
}

/// Two times sixteen values rounded to bf16, those of `low` first.
#[inline]
#[target_feature(enable = "avx512f,avx512bf16")]
fn rounded(low: __m512, high: __m512) -> __m512i {
    // SAFETY: both are 512 bits without a meaning of their own.
    unsafe { std::mem::transmute::<__m512bh, __m512i>(_mm512_cvtne2ps_pbh(high, low)) }
}

/// Two times sixteen values as one row of each part.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub(in crate::kernels) fn words_of(parts: Parts, low: __m512, high: __m512) -> [__m512i; 3] {
    match parts {
        Parts::One => [rounded(low, high); 3],
        Parts::Two => {
            let large = rounded(low, high);
            let float = |half: __m256i| _mm512_castsi512_ps(_mm512_slli_epi32::<16>(_mm512_cvtepu16_epi32(half)));
            let (of_low, of_high) =
                (float(_mm512_castsi512_si256(large)), float(_mm512_extracti64x4_epi64::<1>(large)));
            let rest = rounded(_mm512_sub_ps(low, of_low), _mm512_sub_ps(high, of_high));
            [large, rest, rest]
        }
        Parts::Three => {
            // The high half of each word, first of `low`, then of `high`.
            let odd = odd_halves();
            let (a, b) = (split(low), split(high));
            let join = |k: usize| _mm512_permutex2var_epi16(_mm512_castps_si512(a[k]), odd, _mm512_castps_si512(b[k]));
            [join(0), join(1), join(2)]
        }
    }
}

#[inline]
#[target_feature(enable = "avx512f,avx512bw")]
fn odd_halves() -> __m512i {
    const ODD: [i16; 32] = {
        let mut odd = [0; 32];
        let mut i = 0;
        while i < 32 {
            odd[i] = 2 * i as i16 + 1;
            i += 1;
        }
        odd
    };
    // SAFETY: as many bits.
    unsafe { std::mem::transmute::<[i16; 32], __m512i>(ODD) }
}

/// Two rows of the summed dimension as one row of a right tile of each part: words of a value of `first` below one of `second`.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub(in crate::kernels) fn interleaved(parts: Parts, first: __m512, second: __m512) -> [__m512i; 3] {
    let join = |first: __m512i, second: __m512i| {
        let second = _mm512_and_si512(second, _mm512_set1_epi32(HIGH));
        _mm512_or_si512(_mm512_srli_epi32::<16>(first), second)
    };
    match parts {
        Parts::One | Parts::Two => {
            // First values in the low half of the result, second ones in the high half; then word by word.
            let both = words_of(parts, first, second);
            const PAIRS: [i16; 32] = {
                let mut order = [0; 32];
                let mut i = 0;
                while i < 32 {
                    order[i] = (i as i16 & 1) * 16 + i as i16 / 2;
                    i += 1;
                }
                order
            };
            // SAFETY: as many bits.
            let order = unsafe { std::mem::transmute::<[i16; 32], __m512i>(PAIRS) };
            both.map(|both| _mm512_permutexvar_epi16(order, both))
        }
        Parts::Three => {
            let (a, b) = (split(first), split(second));
            let part = |k: usize| join(_mm512_castps_si512(a[k]), _mm512_castps_si512(b[k]));
            [part(0), part(1), part(2)]
        }
    }
}

/// A row of each part to its place in a step of a panel: row `row` of the tile pairs' `half` (0 or 1).
#[inline]
#[target_feature(enable = "avx512f")]
pub(in crate::kernels) fn put(parts: Parts, words: [__m512i; 3], half: usize, row: usize, step: &mut [f32]) {
    for (part, words) in words.into_iter().take(parts.count()).enumerate() {
        let to = &mut step[(2 * part + half) * TILE_FLOATS + row * TILE..][..TILE];
        // SAFETY: 16 words, as just cut.
        unsafe { _mm512_storeu_si512(to.as_mut_ptr().cast(), words) };
    }
}

/// The first `count` of 16 floats, zeros after them.
#[inline]
#[target_feature(enable = "avx512f")]
fn some(values: &[f32], count: usize) -> __m512 {
    let count = count.min(TILE).min(values.len());
    // SAFETY: no more are read than there are.
    unsafe { _mm512_maskz_loadu_ps(((1u32 << count) - 1) as u16, values.as_ptr()) }
}

/// A left panel's steps for 16 rows, the tile pairs' `half` (0 or 1): row `r` is `row(r)` times `scale`, all of one length;
/// rows that are `None` are zeros. `to` is the panel.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub(in crate::kernels) fn row_tiles<'a>(
    parts: Parts,
    half: usize,
    depth: usize,
    scale: f32,
    row: impl Fn(usize) -> Option<&'a [f32]>,
    to: &mut [f32],
) {
    assert!(to.len() >= parts.panel_floats(depth) && half < 2, "panel of depth {depth}");
    let factor = _mm512_set1_ps(scale);
    for r in 0..TILE {
        let values = row(r).unwrap_or_default();
        for (step, to) in to.chunks_exact_mut(parts.step_floats()).take(depth.div_ceil(STEP)).enumerate() {
            let rest = &values[(step * STEP).min(values.len())..];
            let (low, high) = match rest.first_chunk::<STEP>() {
                // SAFETY: so many there are.
                Some(all) => unsafe { (_mm512_loadu_ps(all.as_ptr()), _mm512_loadu_ps(all.as_ptr().add(TILE))) },
                None => (some(rest, TILE), some(&rest[TILE.min(rest.len())..], TILE)),
            };
            let words = words_of(parts, _mm512_mul_ps(low, factor), _mm512_mul_ps(high, factor));
            put(parts, words, half, r, to);
        }
    }
}

/// A right panel's steps for 16 columns: `row(p)` are the values of the summed dimension's entry `p < depth`, of which the
/// first 16 at most are taken. `to` is the panel.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub(in crate::kernels) fn column_tiles<'a>(
    parts: Parts,
    half: usize,
    depth: usize,
    row: impl Fn(usize) -> &'a [f32],
    to: &mut [f32],
) {
    assert!(to.len() >= parts.panel_floats(depth) && half < 2, "panel of depth {depth}");
    for (step, to) in to.chunks_exact_mut(parts.step_floats()).take(depth.div_ceil(STEP)).enumerate() {
        for pair in 0..TILE {
            let at = |p: usize| match p < depth {
                true => some(row(p), TILE),
                false => _mm512_setzero_ps(),
            };
            let p = step * STEP + 2 * pair;
            put(parts, interleaved(parts, at(p), at(p + 1)), half, pair, to);
        }
    }
}

/// Every tile of 16x16 words in place.
#[inline]
#[target_feature(enable = "avx512f,avx512bw")]
pub(in crate::kernels) fn transpose(tiles: &mut [f32]) {
    for tile in tiles.chunks_exact_mut(TILE_FLOATS) {
        let at = tile.as_mut_ptr();
        // SAFETY: 16 rows of 16 words.
        let mut rows: [__m512i; 16] =
            std::array::from_fn(|r| unsafe { _mm512_loadu_si512(at.add(r * TILE).cast::<__m512i>()) });
        let mut next = rows;
        // Words, then pairs of words, within quarters of a register; then the quarters.
        for r in (0..16).step_by(2) {
            next[r] = _mm512_unpacklo_epi32(rows[r], rows[r + 1]);
            next[r + 1] = _mm512_unpackhi_epi32(rows[r], rows[r + 1]);
        }
        for r in (0..16).step_by(4) {
            rows[r] = _mm512_unpacklo_epi64(next[r], next[r + 2]);
            rows[r + 1] = _mm512_unpackhi_epi64(next[r], next[r + 2]);
            rows[r + 2] = _mm512_unpacklo_epi64(next[r + 1], next[r + 3]);
            rows[r + 3] = _mm512_unpackhi_epi64(next[r + 1], next[r + 3]);
        }
        for r in 0..4 {
            let (a, b, c, d) = (rows[r], rows[r + 4], rows[r + 8], rows[r + 12]);
            let (low, high) = (_mm512_shuffle_i32x4::<0x88>(a, b), _mm512_shuffle_i32x4::<0xdd>(a, b));
            let (low2, high2) = (_mm512_shuffle_i32x4::<0x88>(c, d), _mm512_shuffle_i32x4::<0xdd>(c, d));
            next[r] = _mm512_shuffle_i32x4::<0x88>(low, low2);
            next[r + 8] = _mm512_shuffle_i32x4::<0xdd>(low, low2);
            next[r + 4] = _mm512_shuffle_i32x4::<0x88>(high, high2);
            next[r + 12] = _mm512_shuffle_i32x4::<0xdd>(high, high2);
        }
        for (r, row) in next.into_iter().enumerate() {
            // SAFETY: 16 rows of 16 words.
            unsafe { _mm512_storeu_si512(at.add(r * TILE).cast::<__m512i>(), row) };
        }
    }
}
