//! Linear layers on AMX tile units: the same blocks of rows, their products from [`crate::kernels::amx`], the same epilogues.
//!
//! Blocking: sums of 32x32 outputs stay in four tiles over a part of the depth whose right-hand panel stays in the first-level cache
//! while all row panels of the block pass by from the second; where the depth is too large for that, the block is packed
//! slice by slice and sums wait in between. Tiles are fast enough to wait for the third-level cache, which weights come
//! from, so blocks are of more rows than elsewhere.

use rayon::prelude::*;

use super::tile::{finish, finish_tile};
use super::{Block, Epilogue, PackedWeight, Rows};
use crate::kernels::Isa;
use crate::kernels::aligned::Aligned;
use crate::kernels::amx::{
    Configured, Parts, SIDE, STEP, TILE, column_tiles, product, product_onto, row_tiles, transpose,
};
use crate::kernels::gemm::pack::Numbers;
use crate::kernels::simd::Simd;

/// Floats of a left-hand panel's slice of the depth: those of all rows of a block, 384, are 1.7 MiB at most and stay in the
/// second-level cache.
const SLICE_FLOATS: usize = 36 * 1024;
/// Floats of a right-hand panel that all rows pass before the next: 24 KiB, half of the first-level cache.
const NEAR_FLOATS: usize = 6 * 1024;
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

/// Left-hand panels of some rows, `steps` steps from step `at` on.
fn pack_left(parts: Parts, x: Rows<'_>, (m, k): (usize, usize), (at, steps): (usize, usize), packed: &mut [f32]) {
    let (from, to) = (at * STEP, k.min((at + steps) * STEP));
    for (panel, packed) in packed.chunks_exact_mut(steps * parts.step_floats()).take(m.div_ceil(SIDE)).enumerate() {
        for half in 0..2 {
            let first = panel * SIDE + half * TILE;
            match x {
                Rows::Lying(x) => {
                    let row = |r: usize| x.get((first + r) * k + from..(first + r) * k + to);
                    // SAFETY: `Isa::Amx`, under which alone this runs, exists only where the features were detected.
                    unsafe { row_tiles(parts, half, to - from, 1.0, row, packed) };
                }
                Rows::Standing { values, stride, first: column } => {
                    let column = column + first.min(m);
                    let end = column + TILE.min(m.saturating_sub(first));
                    let row = |p: usize| &values[(from + p) * stride + column..(from + p) * stride + end];
                    // SAFETY: as above.
                    unsafe { column_tiles(parts, half, to - from, row, packed) };
                }
            }
        }
        if matches!(x, Rows::Standing { .. }) {
            // SAFETY: as above.
            unsafe { transpose(packed) };
        }
    }
}

impl Block<'_> {
    #[inline(always)]
    pub(super) fn run_tiles<S: Simd>(self, parts: Parts) {
        let Self { scratch, x, w, epilogue, out } = self;
        let (n, k) = (w.n, w.k);
        let m = out.len() / n;
        let (floats, step) = (parts.panel_floats(k), parts.step_floats());
        let (all, row_panels, col_panels) = (floats / step, m.div_ceil(SIDE), n.div_ceil(SIDE));
        let weights = &w.data.as_slice()[..col_panels * floats];
        // As equal slices of the depth as there have to be.
        let slice = all.div_ceil(all.div_ceil(SLICE_FLOATS / step));
        let packed = scratch.packed.at_least(row_panels * slice * step);
        // Sums of one column panel, or of all where they wait for another slice.
        let kept = if slice == all { 1 } else { col_panels };
        let sums = scratch.partial.at_least(kept * row_panels * SIDE * SIDE);
        let tiles = Configured::new();
        for at in (0..all).step_by(slice) {
            let steps = slice.min(all - at);
            let packed = &mut packed[..row_panels * steps * step];
            pack_left(parts, x, (m, k), (at, steps), packed);
            for (j, b) in weights.chunks_exact(floats).enumerate() {
                let sums = &mut sums[j % kept * row_panels * SIDE * SIDE..][..row_panels * SIDE * SIDE];
                let near = NEAR_FLOATS / step;
                for from in (0..steps).step_by(near) {
                    let count = near.min(steps - from);
                    let b = &b[(at + from) * step..][..count * step];
                    for (a, sums) in packed.chunks_exact(steps * step).zip(sums.chunks_exact_mut(SIDE * SIDE)) {
                        let both = (a[from * step..][..count * step].as_ptr(), b.as_ptr());
                        // SAFETY: both have `count` steps, at least one as `k > 0`; `sums` 32 rows of 32 floats.
                        unsafe {
                            match at + from {
                                0 => product(&tiles, parts, count, both, sums.as_mut_ptr(), SIDE),
                                _ => product_onto(&tiles, parts, count, both, sums.as_mut_ptr(), SIDE),
                            }
                        }
                    }
                }
                if at + steps == all {
                    finish_panel::<S>(sums, (m, n, j * SIDE), &epilogue, out);
                }
            }
        }
    }
}

/// The epilogue on the 32 columns from `col` on, of all `m` rows.
#[inline(always)]
fn finish_panel<S: Simd>(
    sums: &mut [f32],
    (m, n, col): (usize, usize, usize),
    epilogue: &Epilogue<'_>,
    out: &mut [f32],
) {
    let Epilogue { bias, act, residual } = *epilogue;
    let width = SIDE.min(n - col);
    let bias = bias.map(|b| &b[col..col + width]);
    for (first, sums) in sums.chunks_exact_mut(EPILOGUE_ROWS * SIDE).enumerate() {
        let row = first * EPILOGUE_ROWS;
        let count = EPILOGUE_ROWS.min(m.saturating_sub(row));
        if width == SIDE && count > 0 {
            let mut acc = [[S::zero(); 2]; EPILOGUE_ROWS];
            for (acc, sums) in acc.iter_mut().zip(sums.chunks_exact(SIDE)) {
                // SAFETY: rows of 32 floats, two vectors.
                *acc = unsafe { [S::load(sums.as_ptr()), S::load(sums.as_ptr().add(S::W))] };
            }
            let residual = residual.map(|x| &x[row * n..]);
            finish_tile::<S, EPILOGUE_ROWS>(&acc, (count, n, col), bias, act, residual, &mut out[row * n..]);
            continue;
        }
        for (r, sums) in sums.chunks_exact_mut(SIDE).take(count).enumerate() {
            let place = (row + r) * n + col..(row + r) * n + col + width;
            finish::<S>(sums, bias, act, residual.map(|x| &x[place.clone()]), &mut out[place]);
        }
    }
}
