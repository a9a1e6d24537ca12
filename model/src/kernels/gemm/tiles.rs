//! Linear layers on AMX tile units: the same blocks of rows, their products from [`crate::kernels::amx`], the same epilogues.
//!
//! Sums of 32x32 outputs are taken over the whole depth in the tiles: they are read and written once. The right-hand panels
//! of a layer pass by for every panel of 32 rows, from the second-level cache.

use rayon::prelude::*;

use super::tile::{finish, finish_tile};
use super::{Block, Epilogue, PackedWeight, Rows};
use crate::kernels::Isa;
use crate::kernels::aligned::Aligned;
use crate::kernels::amx::{Configured, Parts, SIDE, TILE, column_tiles, product, row_tiles, transpose};
use crate::kernels::gemm::pack::Numbers;
use crate::kernels::simd::Simd;

/// Rows that go through the epilogue at a time: two vectors each stay in registers.
const EPILOGUE_ROWS: usize = 8;

impl PackedWeight {
    /// A row-major `(n, k)` weight in right-hand panels.
    pub(super) fn tiles(parts: Parts, weight: &[f32], n: usize, k: usize) -> Self {
        assert!(k > 0 && weight.len() == n * k, "weight of {n} x {k}");
        let floats = parts.panel_floats(k);
        let mut data = Aligned::zeroed(n.div_ceil(SIDE) * floats);
        data.as_mut_slice().par_chunks_mut(floats).enumerate().for_each(|(panel, to)| {
            for half in 0..2 {
                let first = panel * SIDE + half * TILE;
                let row = |r: usize| weight.get((first + r) * k..(first + r + 1) * k);
                // SAFETY: `Isa::Amx`, which this layout is for, exists only where the features were detected.
                unsafe { row_tiles(parts, half, k, 1.0, row, to) };
            }
            // SAFETY: as above.
            unsafe { transpose(to) };
        });
        Self { isa: Isa::Amx, n, k, data, numbers: Numbers::Tiles(parts) }
    }

    /// The transpose of row-major `values` `(k, n)`, into the memory of an earlier one.
    pub(super) fn pack_tiles_transposed(&mut self, parts: Parts, values: &[f32], n: usize, k: usize) {
        let floats = parts.panel_floats(k);
        (self.n, self.k, self.numbers) = (n, k, Numbers::Tiles(parts));
        let panels = self.data.at_least(n.div_ceil(SIDE) * floats);
        panels.par_chunks_mut(floats).enumerate().for_each(|(panel, to)| {
            for half in 0..2 {
                let first = (panel * SIDE + half * TILE).min(n);
                let row = |p: usize| &values[p * n + first..(p + 1) * n];
                // SAFETY: `Isa::Amx` exists only where the features were detected.
                unsafe { column_tiles(parts, half, k, row, to) };
            }
        });
    }
}

impl Block<'_> {
    #[inline(always)]
    pub(super) fn run_tiles<S: Simd>(self, parts: Parts) {
        let Self { scratch, x, w, epilogue: Epilogue { bias, act, residual }, out } = self;
        let (n, k) = (w.n, w.k);
        let m = out.len() / n;
        let floats = parts.panel_floats(k);
        let row_panels = m.div_ceil(SIDE);
        let packed = scratch.packed.at_least(row_panels * floats);
        for (panel, to) in packed.chunks_exact_mut(floats).enumerate() {
            for half in 0..2 {
                let first = panel * SIDE + half * TILE;
                match x {
                    Rows::Lying(x) => {
                        let row = |r: usize| x.get((first + r) * k..(first + r + 1) * k);
                        // SAFETY: `Isa::Amx` exists only where the features were detected.
                        unsafe { row_tiles(parts, half, k, 1.0, row, to) };
                    }
                    Rows::Standing { values, stride, first: column } => {
                        let column = column + first.min(m);
                        let end = column + TILE.min(m.saturating_sub(first));
                        let row = |p: usize| &values[p * stride + column..p * stride + end];
                        // SAFETY: as above.
                        unsafe { column_tiles(parts, half, k, row, to) };
                    }
                }
            }
            if matches!(x, Rows::Standing { .. }) {
                // SAFETY: as above.
                unsafe { transpose(to) };
            }
        }
        let weights = &w.data.as_slice()[..n.div_ceil(SIDE) * floats];
        let sums = &mut scratch.partial.at_least(SIDE * SIDE)[..SIDE * SIDE];
        let steps = floats / parts.step_floats();
        let tiles = Configured::new();
        for (j, b) in weights.chunks_exact(floats).enumerate() {
            let col = j * SIDE;
            let width = SIDE.min(n - col);
            let bias = bias.map(|b| &b[col..col + width]);
            for (i, a) in packed.chunks_exact(floats).enumerate() {
                // SAFETY: both panels have `steps` steps, at least one as `k > 0`; `sums` has 32 rows of 32 floats.
                unsafe { product(&tiles, parts, steps, (a.as_ptr(), b.as_ptr()), sums.as_mut_ptr(), SIDE) };
                let rows = SIDE.min(m - i * SIDE);
                for first in (0..rows).step_by(EPILOGUE_ROWS) {
                    let row = i * SIDE + first;
                    let count = EPILOGUE_ROWS.min(rows - first);
                    if width == SIDE {
                        let mut acc = [[S::zero(); 2]; EPILOGUE_ROWS];
                        for (acc, sums) in acc.iter_mut().zip(sums[first * SIDE..].chunks_exact(SIDE)) {
                            // SAFETY: rows of 32 floats, two vectors.
                            *acc = unsafe { [S::load(sums.as_ptr()), S::load(sums.as_ptr().add(S::W))] };
                        }
                        let residual = residual.map(|x| &x[row * n..]);
                        finish_tile::<S, EPILOGUE_ROWS>(&acc, (count, n, col), bias, act, residual, &mut out[row * n..]);
                        continue;
                    }
                    for r in 0..count {
                        let place = (row + r) * n + col..(row + r) * n + col + width;
                        let sums = &mut sums[(first + r) * SIDE..][..SIDE];
                        finish::<S>(sums, bias, act, residual.map(|x| &x[place.clone()]), &mut out[place]);
                    }
                }
            }
        }
    }
}
