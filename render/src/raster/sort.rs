//! Depth order of one tile: a stable least-significant-digit radix sort on the depth half of the keys.

/// Sort key of a splat in a view: depth bits above, slot below; slots ascend with the Gaussian's index, so that keys
/// in ascending order are "nearest first, equal depths in index order".
#[inline(always)]
pub(crate) fn key(depth: f32, slot: u32) -> u64 {
    // Positive floats order as their bits do.
    (u64::from(depth.to_bits()) << 32) | u64::from(slot)
}

/// Depth of a key.
#[inline(always)]
pub(crate) fn key_depth(key: u64) -> f32 {
    f32::from_bits((key >> 32) as u32)
}

/// Slot of a key.
#[inline(always)]
pub(crate) fn key_slot(key: u64) -> usize {
    (key & 0xffff_ffff) as usize
}

/// Below this many keys the comparison sort is faster than clearing histograms.
const RADIX_FROM: usize = 200;
/// Bits per radix pass: 2048 counters stay in the first-level cache.
const MAX_DIGIT_BITS: u32 = 11;

/// Sorts keys whose slots ascend already; `spare` is scratch of any length.
pub(crate) fn sort_keys(keys: &mut Vec<u64>, spare: &mut Vec<u64>) {
    if keys.len() < RADIX_FROM {
        keys.sort_unstable();
        return;
    }
    let (mut low, mut high) = (u64::MAX, 0);
    for &k in keys.iter() {
        low = low.min(k >> 32);
        high = high.max(k >> 32);
    }
    let bits = u64::BITS - (high - low).leading_zeros();
    if bits == 0 {
        return;
    }
    let passes = bits.div_ceil(MAX_DIGIT_BITS);
    let digit_bits = bits.div_ceil(passes);
    let mask = (1u64 << digit_bits) - 1;
    spare.clear();
    spare.resize(keys.len(), 0);
    for pass in 0..passes {
        let shift = pass * digit_bits;
        let digit = |k: u64| ((((k >> 32) - low) >> shift) & mask) as usize;
        let mut starts = [0u32; 1 << MAX_DIGIT_BITS];
        for &k in keys.iter() {
            starts[digit(k)] += 1;
        }
        let mut sum = 0;
        for s in starts.iter_mut().take(1 << digit_bits) {
            (*s, sum) = (sum, sum + *s);
        }
        for &k in keys.iter() {
            let start = &mut starts[digit(k)];
            spare[*start as usize] = k;
            *start += 1;
        }
        std::mem::swap(keys, spare);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn radix_order_is_comparison_order(depths in prop::collection::vec(prop_oneof![0.2f32..400.0, Just(7.0f32)], 0..3000)) {
            let mut keys: Vec<u64> = depths.iter().enumerate().map(|(i, &d)| key(d, i as u32)).collect();
            let mut expected = keys.clone();
            expected.sort();
            sort_keys(&mut keys, &mut Vec::new());
            prop_assert_eq!(keys, expected);
        }
    }

    #[test]
    fn equal_depths_keep_index_order() {
        let mut keys: Vec<u64> = (0..5000).map(|i| key(12.5, i)).collect();
        let expected = keys.clone();
        sort_keys(&mut keys, &mut Vec::new());
        assert_eq!(keys, expected);
        assert_eq!((key_depth(keys[17]), key_slot(keys[17])), (12.5, 17));
    }
}
