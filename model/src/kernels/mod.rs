//! Fast f32 CPU kernels behind the network's operations: tiled attention, linear layers with fused epilogues, layer
//! norm, row softmax.
//!
//! One source, several compilations: every kernel is one generic body over `simd::Simd`, compiled for AVX2+FMA, for
//! AVX-512 (with and without VNNI) and for the target's baseline, and picked at run time by [`Isa::detect`]. The baseline's
//! vectors are plain arrays the compiler turns into registers, the others intrinsics. Products of matrices have a version of
//! their own for AMX tile units (`amx`).
//!
//! Every sum is taken in an order fixed by the shapes and the instruction set alone, so results have the same bits for
//! any number of threads. Between instruction sets they differ by rounding.
//!
//! Backward passes take what the forward pass kept; [`crate::ops`] puts both into candle's gradient graph.

mod aligned;
#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
mod amx;
pub mod arrange;
pub mod attention;
pub mod chain;
pub mod gaussians;
pub mod gemm;
pub mod math;
pub mod norm;
pub mod peak;
pub mod rows;
mod simd;
pub(crate) mod tensors;

use std::sync::OnceLock;

/// The instruction set a kernel is compiled for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Isa {
    /// The target's baseline (SSE2 on x86-64, NEON on aarch64).
    Portable,
    /// x86-64 with AVX2 and FMA.
    Avx2,
    /// x86-64 with AVX-512 (F, BW, DQ, VL).
    Avx512,
    /// The same with AMX tile units, for products; everything else is AVX-512's.
    Amx,
}

impl Isa {
    /// The widest set this machine runs, or the one that `STORM_ISA` names (`portable`, `avx2`, `avx512`, `amx`: to measure one, or
    /// to get another machine's bits) where the machine has it ([`Isa::asked_for`] says when not); looked up once.
    pub fn detect() -> Self {
        static FOUND: OnceLock<Isa> = OnceLock::new();
        *FOUND.get_or_init(|| {
            let widest = Self::available().last().copied().unwrap_or(Isa::Portable);
            Self::asked_for().ok().flatten().unwrap_or(widest)
        })
    }

    /// The set that `STORM_ISA` names; none where it is empty or not there.
    ///
    /// # Errors
    /// When it names something else than one of this machine's sets.
    pub fn asked_for() -> Result<Option<Self>, String> {
        Self::named(&std::env::var("STORM_ISA").unwrap_or_default(), &Self::available())
    }

    fn named(name: &str, sets: &[Self]) -> Result<Option<Self>, String> {
        if name.is_empty() {
            return Ok(None);
        }
        let names: Vec<_> = sets.iter().map(|isa| format!("{isa:?}").to_lowercase()).collect();
        let found = names.iter().position(|have| have.eq_ignore_ascii_case(name));
        found.map(|i| Some(sets[i])).ok_or_else(|| {
            let have = names.join(", ");
            format!(
                "STORM_ISA={name}: this machine has {have}; name one of them, or leave STORM_ISA empty for the last"
            )
        })
    }

    /// Every set this machine runs, narrowest first.
    pub fn available() -> Vec<Self> {
        #[allow(unused_mut)]
        let mut sets = vec![Isa::Portable];
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            sets.push(Isa::Avx2);
            if simd::has_avx512() {
                sets.push(Isa::Avx512);
                #[cfg(target_os = "linux")]
                if amx::available() {
                    sets.push(Isa::Amx);
                }
            }
        }
        sets
    }

    /// The sets tests run: those available, and AVX-512's vectors and tiles on AVX2 where only that is (see
    /// `simd::run_wide`).
    #[cfg(test)]
    pub(crate) fn tested() -> Vec<Self> {
        let mut sets = Self::available();
        if sets.last() == Some(&Isa::Avx2) {
            sets.push(Isa::Avx512);
        }
        sets
    }

    /// Floats in one vector register.
    pub(crate) fn lanes(self) -> usize {
        match self {
            Isa::Portable => 4,
            Isa::Avx2 => 8,
            Isa::Avx512 | Isa::Amx => 16,
        }
    }

    /// Rows of a register tile: with two vectors a row they fill the register file, less two for the right-hand
    /// side and one for the broadcast.
    pub(crate) fn tile_rows(self) -> usize {
        match self {
            Isa::Portable | Isa::Avx2 => 6,
            Isa::Avx512 | Isa::Amx => 12,
        }
    }

    /// Rows that tasks come in multiples of.
    pub(crate) fn row_step(self) -> usize {
        match self {
            Isa::Amx => 32,
            _ => self.tile_rows(),
        }
    }

    /// The set that products of pairs of 16-bit whole numbers run on: tile units have none.
    pub(crate) fn for_pairs(self) -> Self {
        if self == Isa::Amx { Isa::Avx512 } else { self }
    }

    /// Columns of a register tile.
    pub(crate) fn tile_cols(self) -> usize {
        2 * self.lanes()
    }

    /// Depth of one packed right-hand panel: `depth x tile_cols` floats are 16 KiB, half of a small first-level cache.
    pub(crate) fn panel_depth(self) -> usize {
        (4096 / self.tile_cols()).min(256)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Seeded values in `-scale..scale`.
    pub(crate) fn noise(seed: u64, len: usize, scale: f32) -> Vec<f32> {
        use rand::{RngExt, SeedableRng};
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
        (0..len).map(|_| rng.random_range(-scale..scale)).collect()
    }

    #[test]
    fn a_set_is_named_or_refused() {
        let sets = [Isa::Portable, Isa::Avx2];
        assert_eq!(Isa::named("", &sets), Ok(None));
        assert_eq!(Isa::named("AVX2", &sets), Ok(Some(Isa::Avx2)));
        for missing in ["amx", "avx", "2"] {
            let said = Isa::named(missing, &sets).unwrap_err();
            assert!(said.contains(missing) && said.contains("portable, avx2"), "{said}");
        }
    }

    /// Largest absolute difference, infinite for NaN.
    pub(crate) fn worst_difference(got: &[f32], want: &[f64]) -> f64 {
        assert_eq!(got.len(), want.len());
        let differences = got.iter().zip(want).map(|(&g, &w)| (f64::from(g) - w).abs());
        differences.fold(0.0, |a, d| if d <= a { a } else { if d.is_nan() { f64::INFINITY } else { d } })
    }

    #[test]
    fn tiles_divide_the_blocks() {
        for isa in [Isa::Portable, Isa::Avx2, Isa::Avx512, Isa::Amx] {
            assert_eq!(96 % isa.tile_rows(), 0);
            assert_eq!(96 % isa.row_step(), 0);
            assert!(isa.panel_depth() * isa.tile_cols() <= 4096);
        }
    }
}
