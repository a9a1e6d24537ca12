//! The layouts the kernel reads: weights in panels of tile columns, rows of the input in panels of tile rows.

use rayon::prelude::*;

use super::integer::{self, IntegerScales};
use crate::kernels::Isa;
use crate::kernels::aligned::Aligned;
#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
use crate::kernels::amx::Parts;
use crate::kernels::math::bf16;
use crate::ops::Precision;

/// Equal-sized slices of the summed dimension, none deeper than the panel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Depths {
    k: usize,
    step: usize,
}

impl Depths {
    pub(super) fn new(isa: Isa, k: usize) -> Self {
        Self { k, step: k.div_ceil(k.div_ceil(isa.panel_depth())) }
    }

    /// Whether there is one slice.
    pub(super) fn single(self) -> bool {
        self.step == self.k
    }

    pub(super) fn ranges(self) -> impl Iterator<Item = (usize, usize)> {
        (0..self.k).step_by(self.step).map(move |at| (at, self.step.min(self.k - at)))
    }
}

/// What the numbers of a packed weight are.
#[derive(Debug)]
pub(super) enum Numbers {
    /// As they were.
    Floats,
    /// Floats rounded to bf16, which the rows that meet them are too.
    Rounded,
    /// Pairs of 16-bit whole numbers, see [`super::integer`].
    Pairs(IntegerScales),
    /// Tiles of bf16, see [`crate::kernels::amx`].
    #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
    Tiles(Parts),
}

/// A weight `(n, k)` laid out as the kernel reads it (on tile units as `kernels::amx` says); elsewhere per panel of `tile_cols` outputs, `k` rows of that many floats (or
/// half as many rows of pairs of whole numbers), zeros past `n`.
#[derive(Debug)]
pub struct PackedWeight {
    pub(super) isa: Isa,
    pub(super) n: usize,
    pub(super) k: usize,
    pub(super) data: Aligned,
    pub(super) numbers: Numbers,
}

impl PackedWeight {
    /// Packs a row-major `(n, k)` weight, `k > 0`.
    pub fn new(isa: Isa, weight: &[f32], n: usize, k: usize) -> Self {
        assert!(k > 0 && weight.len() == n * k, "weight of {n} x {k}");
        #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
        if isa == Isa::Amx {
            return Self::tiles(Parts::Three, weight, n, k);
        }
        let nr = isa.tile_cols();
        let mut data = Aligned::zeroed(n.div_ceil(nr) * nr * k);
        data.as_mut_slice().par_chunks_mut(nr * k).zip(weight.par_chunks(nr * k)).for_each(|(panel, rows)| {
            for (j, row) in rows.chunks_exact(k).enumerate() {
                for (p, &w) in row.iter().enumerate() {
                    panel[p * nr + j] = w;
                }
            }
        });
        Self { isa, n, k, data, numbers: Numbers::Floats }
    }

    /// Packs a row-major `(n, k)` weight, `k > 0`, for products in this precision.
    pub fn in_precision(isa: Isa, precision: Precision, weight: &[f32], n: usize, k: usize) -> Self {
        match precision {
            Precision::F32 => Self::new(isa, weight, n, k),
            #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
            Precision::Bf16 if isa == Isa::Amx => Self::tiles(Parts::One, weight, n, k),
            Precision::Bf16 => {
                let mut packed = Self::new(isa, weight, n, k);
                packed.data.as_mut_slice().iter_mut().for_each(|x| *x = bf16(*x));
                Self { numbers: Numbers::Rounded, ..packed }
            }
            Precision::Int16 => Self::whole(isa, weight, n, k, integer::balanced(weight, k)),
            Precision::Int8 => Self::whole(isa, weight, n, k, integer::EIGHT_BITS),
        }
    }

    /// With weights in whole numbers up to `largest`.
    fn whole(isa: Isa, weight: &[f32], n: usize, k: usize, largest: f32) -> Self {
        assert!(k > 0 && weight.len() == n * k, "weight of {n} x {k}");
        let isa = isa.for_pairs();
        let nr = isa.tile_cols();
        let pairs = k.div_ceil(2);
        let mut data = Aligned::zeroed(n.div_ceil(nr) * nr * pairs);
        let scales = integer::quantise_weight(weight, k, largest, nr, |row, p, pair| {
            data.as_mut_slice()[row / nr * nr * pairs + p * nr + row % nr] = f32::from_bits(pair);
        });
        Self { isa, n, k, data, numbers: Numbers::Pairs(scales) }
    }

    /// Rows of a packed panel: inputs, or pairs of them.
    pub(super) fn depth(&self) -> usize {
        match self.numbers {
            Numbers::Pairs(_) => self.k.div_ceil(2),
            _ => self.k,
        }
    }

    /// Packs the transpose of row-major `values` `(k, n)`: the layer that goes back through a weight `(k, n)`, or a sum
    /// over rows. `k > 0`. Tile units take it in two parts: gradients need no more.
    pub fn transposed(isa: Isa, values: &[f32], n: usize, k: usize) -> Self {
        let mut packed = Self { isa, n, k, data: Aligned::default(), numbers: Numbers::Floats };
        packed.pack_transposed(values, n, k);
        packed
    }

    /// [`PackedWeight::transposed`] into the memory of an earlier one.
    pub(super) fn pack_transposed(&mut self, values: &[f32], n: usize, k: usize) {
        assert!(k > 0 && values.len() == n * k, "weight of {k} x {n}");
        #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
        if self.isa == Isa::Amx {
            return self.pack_tiles_transposed(Parts::Two, values, n, k);
        }
        let nr = self.isa.tile_cols();
        (self.n, self.k) = (n, k);
        let panels = self.data.at_least(n.div_ceil(nr) * nr * k);
        panels.par_chunks_mut(nr * k).enumerate().for_each(|(index, panel)| {
            let first = index * nr;
            let width = nr.min(n - first);
            for (to, row) in panel.chunks_exact_mut(nr).zip(values.chunks_exact(n)) {
                to[..width].copy_from_slice(&row[first..first + width]);
                to[width..].fill(0.0);
            }
        });
    }

    /// Outputs of the layer.
    pub fn outputs(&self) -> usize {
        self.n
    }

    /// Inputs of the layer.
    pub fn inputs(&self) -> usize {
        self.k
    }
}

/// Row panels of `MR`, each `k` columns of `MR` floats; rows past the end are zeros.
#[inline(always)]
pub(super) fn pack_rows<const MR: usize>(x: &[f32], k: usize, packed: &mut [f32]) {
    for (panel, rows) in packed.chunks_exact_mut(MR * k).zip(x.chunks(MR * k)) {
        if rows.len() == MR * k {
            let rows: [&[f32]; MR] = std::array::from_fn(|r| &rows[r * k..(r + 1) * k]);
            for (p, column) in panel.chunks_exact_mut(MR).enumerate() {
                for r in 0..MR {
                    column[r] = rows[r][p];
                }
            }
        } else {
            panel.fill(0.0);
            for (r, row) in rows.chunks_exact(k).enumerate() {
                for (p, &v) in row.iter().enumerate() {
                    panel[p * MR + r] = v;
                }
            }
        }
    }
}

/// As [`pack_rows`], for rows that are columns `first..first + m` of row-major `x` with `stride` columns.
#[inline(always)]
pub(super) fn pack_columns<const MR: usize>(x: &[f32], stride: usize, first: usize, m: usize, packed: &mut [f32]) {
    let k = x.len() / stride;
    for (p, row) in x.chunks_exact(stride).enumerate() {
        let row = &row[first..first + m];
        let mut at = p * MR;
        let mut panels = row.chunks_exact(MR);
        for part in &mut panels {
            packed[at..at + MR].copy_from_slice(part);
            at += k * MR;
        }
        let rest = panels.remainder();
        if !rest.is_empty() {
            packed[at..at + MR].fill(0.0);
            packed[at..at + rest.len()].copy_from_slice(rest);
        }
    }
}
