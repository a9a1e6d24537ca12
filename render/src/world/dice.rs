//! Counter-based random numbers: the same key always rolls the same values, whatever was rolled before or on which thread.

/// SplitMix64's finaliser: a bijection of `u64` with good avalanche.
pub(crate) fn mix(x: u64) -> u64 {
    let x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    x ^ (x >> 31)
}

/// Folds a key into a seed.
pub(crate) fn fold(seed: u64, key: &[u64]) -> u64 {
    key.iter().fold(mix(seed ^ 0x5704), |h, k| mix(h.wrapping_add(0x9e37_79b9_7f4a_7c15) ^ mix(k.wrapping_add(0x632b))))
}

/// A small generator whose whole stream follows from its key.
#[derive(Debug, Clone)]
pub(crate) struct Dice(u64);

impl Dice {
    pub(crate) fn new(seed: u64, key: &[u64]) -> Self {
        Self(fold(seed, key))
    }

    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        mix(self.0)
    }

    /// Uniform in [0, 1).
    pub(crate) fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    pub(crate) fn range(&mut self, lo: f64, hi: f64) -> f64 {
        lo + (hi - lo) * self.unit()
    }

    pub(crate) fn range32(&mut self, lo: f32, hi: f32) -> f32 {
        lo + (hi - lo) * self.unit() as f32
    }

    pub(crate) fn chance(&mut self, p: f64) -> bool {
        self.unit() < p
    }

    /// Uniform in `0..n` (0 for n = 0).
    pub(crate) fn below(&mut self, n: usize) -> usize {
        ((self.unit() * n as f64) as usize).min(n.saturating_sub(1))
    }

    /// -1 or 1.
    pub(crate) fn sign(&mut self) -> f64 {
        if self.chance(0.5) { 1.0 } else { -1.0 }
    }

    /// One of a fixed, non-empty list.
    pub(crate) fn pick<T: Copy, const N: usize>(&mut self, from: &[T; N]) -> T {
        from[self.below(N)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn same_key_same_stream_and_uniform() {
        let (mut a, mut b) = (Dice::new(3, &[1, 2]), Dice::new(3, &[1, 2]));
        assert!((0..100).all(|_| a.next() == b.next()));
        assert_ne!(Dice::new(3, &[1, 2]).next(), Dice::new(3, &[2, 1]).next());
        let mean = (0..20_000).map(|_| a.unit()).sum::<f64>() / 20_000.0;
        assert!((mean - 0.5).abs() < 0.01, "{mean}"); // five sigma of the mean of 20 000 uniforms
    }
}
