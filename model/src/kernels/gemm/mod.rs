//! Linear layers: `act(x w^T + bias) + residual`, cache-blocked around one register tile.
//!
//! Blocking, from the inside out (the usual one, after Goto and van de Geijn, "Anatomy of High-Performance Matrix
//! Multiplication", 2008): a tile of `tile_rows x tile_cols` accumulators stays in registers over `panel_depth`
//! products; its right-hand panel (16 KiB) stays in the first-level cache while all row panels of the block pass by;
//! the block of `x` (at most `block_rows`) is packed once and stays in the second level; partial sums wait in a
//! block `BLOCK_COLS` wide. Weights are packed once per layer ([`PackedWeight`]).
//!
//! Every output is summed in the order of `k`, in blocks fixed by `k` alone: neither the split over threads nor the
//! row's place in `x` changes its bits.

mod backward;
pub(crate) mod integer;
mod pack;
mod tile;
#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
mod tiles;

use std::cell::RefCell;

use rayon::prelude::*;

use super::Isa;
use super::aligned::Aligned;
use super::math::bf16;
use super::simd::{Kernel, Simd, dispatch, prefetch};
use crate::ops::Activation;
use integer::IntegerScales;
use pack::{Depths, Numbers, pack_columns, pack_rows};
use tile::{Product, finish, finish_tile};

pub use backward::{Mlp, MlpGradients, column_sums, mlp_backward, mlp_keeping, weight_gradient};
pub use pack::PackedWeight;
pub(crate) use tile::{Floats, Pairs, tile, tile_of};

/// Rows of `x` a task works on at most: a multiple of every tile's height.
fn block_rows(isa: Isa) -> usize {
    match isa {
        // Tile units are so fast that fetching weights would take longer with fewer rows.
        Isa::Amx => 192,
        _ => 96,
    }
}

/// Columns of partial sums kept at a time (`96 x 512` floats are 192 KiB).
const BLOCK_COLS: usize = 512;
/// Floats of a cache line.
const LINE_FLOATS: usize = 16;
/// Depth up to which whole row panels are read where they lie: packing would cost as much as a good part of the products.
const DIRECT_DEPTH: usize = 64;
/// Tasks per thread that keep threads busy to the end.
const TASKS_PER_THREAD: usize = 4;

/// What happens to a finished sum.
#[derive(Debug, Clone, Copy)]
pub struct Epilogue<'a> {
    /// Added to each row first, `(n)`.
    pub bias: Option<&'a [f32]>,
    /// Then applied.
    pub act: Activation,
    /// Added last, `(m, n)`.
    pub residual: Option<&'a [f32]>,
}

/// Working memory of a thread: packed rows of `x` and partial sums. Kept, because clearing it anew for every block costs
/// as much as a few percent of the products.
#[derive(Default)]
struct Scratch {
    blocks: BlockScratch,
    /// Rows between the two layers of [`mlp`].
    hidden: Aligned,
}

#[derive(Default)]
pub(super) struct BlockScratch {
    packed: Aligned,
    /// Of rows in whole numbers.
    scales: Aligned,
    partial: Aligned,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// The left-hand rows of a task.
#[derive(Clone, Copy)]
enum Rows<'a> {
    /// As they are.
    Lying(&'a [f32]),
    /// Columns from `first` on of values with `stride` columns.
    Standing { values: &'a [f32], stride: usize, first: usize },
}

/// One task: some rows of the output.
struct Block<'a> {
    scratch: &'a mut BlockScratch,
    x: Rows<'a>,
    w: &'a PackedWeight,
    epilogue: Epilogue<'a>,
    out: &'a mut [f32],
}

impl Kernel for Block<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd, const MR: usize>(self) {
        match &self.w.numbers {
            Numbers::Pairs(scales) => {
                let scales = Some(scales);
                self.run_in::<S, MR, Pairs>(scales)
            }
            Numbers::Floats | Numbers::Rounded => self.run_in::<S, MR, Floats>(None),
            #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
            Numbers::Tiles(parts) => self.run_tiles::<S>(*parts),
        }
    }
}

impl<'a> Block<'a> {
    #[inline(always)]
    fn run_in<S: Simd, const MR: usize, P: Product>(self, scales: Option<&'a IntegerScales>) {
        // Depths are counted in packed rows: inputs, or pairs of them.
        let (n, k) = (self.w.n, self.w.depth());
        let Epilogue { bias, act, residual } = self.epilogue;
        let nr = 2 * S::W;
        let m = self.out.len() / n;
        let row_panels = m.div_ceil(MR);
        let packed = self.scratch.packed.at_least(row_panels * MR * k);
        // Row panels that are not packed.
        let rounded = matches!(self.w.numbers, Numbers::Rounded);
        let row_scales = self.scratch.scales.at_least(row_panels * MR);
        let direct = match (self.x, scales) {
            // Rows in whole numbers lie one after the other, and are read so.
            (Rows::Lying(x), Some(scales)) => {
                integer::quantise_rows(x, self.w.k, scales.largest_input(), packed, row_scales);
                &[]
            }
            (Rows::Standing { .. }, Some(_)) => unreachable!("only weights as floats meet standing rows"),
            (Rows::Lying(x), None) if k <= DIRECT_DEPTH && !rounded => {
                let whole = m / MR;
                pack_rows::<MR>(&x[whole * MR * k..], k, &mut packed[whole * MR * k..]);
                &x[..whole * MR * k]
            }
            (Rows::Lying(x), None) => {
                pack_rows::<MR>(x, k, packed);
                &[]
            }
            (Rows::Standing { values, stride, first }, None) => {
                pack_columns::<MR>(values, stride, first, m, packed);
                &[]
            }
        };
        if rounded {
            packed.iter_mut().for_each(|x| *x = bf16(*x));
        }
        let weights = self.w.data.as_slice();
        let block_panels = BLOCK_COLS / nr;
        let depths = Depths::new(self.w.isa, k);
        let partial_panels = if depths.single() { 1 } else { n.div_ceil(nr).min(block_panels) };
        let partial = self.scratch.partial.at_least(row_panels * MR * partial_panels * nr);

        let col_panels = n.div_ceil(nr);
        for first_panel in (0..col_panels).step_by(block_panels) {
            let panels = block_panels.min(col_panels - first_panel);
            for (at, depth) in depths.ranges() {
                let last = at + depth == k;
                for j in 0..panels {
                    let b = &weights[((first_panel + j) * k + at) * nr..][..depth * nr];
                    // The next panel is fetched while this one is used: each tile asks for a part of it.
                    let ahead = if j + 1 < panels { &weights[((first_panel + j + 1) * k + at) * nr..] } else { &[] };
                    let ahead = &ahead[..ahead.len().min(depth * nr)];
                    let part = (depth * nr).div_ceil(row_panels).next_multiple_of(LINE_FLOATS);
                    let col = (first_panel + j) * nr;
                    let width = nr.min(n - col);
                    for i in 0..row_panels {
                        let a = &packed[(i * k + at) * MR..][..depth * MR];
                        let sums = &mut partial[(j % partial_panels * row_panels + i) * MR * nr..][..MR * nr];
                        let mut acc = [[S::zero(); 2]; MR];
                        for line in ahead.iter().skip(i * part).take(part).step_by(LINE_FLOATS) {
                            prefetch(line);
                        }
                        // SAFETY: `sums` has MR rows of two vectors; `a` has `depth * MR`, `b` `depth * 2 W` floats.
                        unsafe {
                            if at > 0 {
                                for r in 0..MR {
                                    acc[r][0] = S::load(sums.as_ptr().add(r * nr));
                                    acc[r][1] = S::load(sums.as_ptr().add(r * nr + S::W));
                                }
                            }
                            acc = match direct.get(i * MR * k..(i + 1) * MR * k) {
                                _ if P::PAIRS => {
                                    let rows = &packed[i * MR * k..(i + 1) * MR * k];
                                    tile_of::<S, MR, P>(depth, rows.as_ptr().add(at), 1, k, b.as_ptr(), acc)
                                }
                                // Only for depths that are taken at once.
                                Some(rows) => tile::<S, MR>(depth, rows.as_ptr(), 1, k, b.as_ptr(), acc),
                                None => tile::<S, MR>(depth, a.as_ptr(), MR, 1, b.as_ptr(), acc),
                            };
                        }
                        let rows = MR.min(m - i * MR);
                        if let Some(scales) = scales.filter(|_| last) {
                            scales.to_floats::<S, MR>(&mut acc, &row_scales[i * MR..(i + 1) * MR], col);
                        }
                        if last && width == nr {
                            let bias = bias.map(|b| &b[col..col + nr]);
                            let residual = residual.map(|x| &x[i * MR * n..]);
                            finish_tile::<S, MR>(
                                &acc,
                                (rows, n, col),
                                bias,
                                act,
                                residual,
                                &mut self.out[i * MR * n..],
                            );
                            continue;
                        }
                        for r in 0..MR {
                            // SAFETY: `sums` has MR rows of two vectors.
                            unsafe {
                                S::store(sums.as_mut_ptr().add(r * nr), acc[r][0]);
                                S::store(sums.as_mut_ptr().add(r * nr + S::W), acc[r][1]);
                            }
                        }
                        if last {
                            for r in 0..rows {
                                let row = i * MR + r;
                                let place = row * n + col..row * n + col + width;
                                finish::<S>(
                                    &mut sums[r * nr..(r + 1) * nr],
                                    bias.map(|b| &b[col..col + width]),
                                    act,
                                    residual.map(|x| &x[place.clone()]),
                                    &mut self.out[place],
                                );
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Panics unless the lengths fit `m` rows through the layer.
fn check(x: &[f32], w: &PackedWeight, epilogue: &Epilogue<'_>, m: usize, out: usize) {
    let (n, k) = (w.n, w.k);
    assert_eq!(out, m * n, "output of {m} x {n}");
    assert_eq!(x.len(), m * k, "input of {m} x {k}");
    assert!(epilogue.bias.is_none_or(|b| b.len() == n), "bias of {n}");
    assert!(epilogue.residual.is_none_or(|r| r.len() == m * n), "residual of {m} x {n}");
}

/// Rows of a task: few enough that every thread gets several, at most a block.
pub(super) fn task_rows(isa: Isa, m: usize) -> usize {
    m.div_ceil(TASKS_PER_THREAD * rayon::current_num_threads()).next_multiple_of(isa.row_step()).min(block_rows(isa))
}

impl<'a> Epilogue<'a> {
    /// The same for `count` values of the output from `at` on.
    fn part(&self, at: usize, count: usize) -> Self {
        Self { residual: self.residual.map(|r| &r[at..at + count]), ..*self }
    }
}

/// `out = act(x w^T + bias) + residual` for row-major `x` `(m, k)` and `out` `(m, n)`.
///
/// Panics when the lengths disagree (callers take them from tensor shapes).
pub fn linear(x: &[f32], w: &PackedWeight, epilogue: Epilogue<'_>, out: &mut [f32]) {
    let (n, k) = (w.n, w.k);
    if n == 0 || out.is_empty() {
        return;
    }
    let m = out.len() / n;
    check(x, w, &epilogue, m, out.len());
    let rows = task_rows(w.isa, m);
    out.par_chunks_mut(rows * n).zip(x.par_chunks(rows * k)).enumerate().for_each(|(i, (out, x))| {
        let epilogue = epilogue.part(i * rows * n, out.len());
        // No rayon call happens inside, so a thread cannot come back here while it holds its scratch.
        SCRATCH.with_borrow_mut(|scratch| {
            dispatch(w.isa, Block { scratch: &mut scratch.blocks, x: Rows::Lying(x), w, epilogue, out });
        });
    });
}

/// [`linear`] on this thread alone, any number of rows at once.
pub(super) fn block(x: &[f32], w: &PackedWeight, epilogue: Epilogue<'_>, scratch: &mut BlockScratch, out: &mut [f32]) {
    if w.n == 0 || out.is_empty() {
        return;
    }
    check(x, w, &epilogue, out.len() / w.n, out.len());
    dispatch(w.isa, Block { scratch, x: Rows::Lying(x), w, epilogue, out });
}

/// Two layers, `out = linear(linear(x, first), second)`, block of rows by block of rows: what lies between them, several
/// times as wide as `x` in a transformer, never leaves the cache. Same bits as two calls of [`linear`].
///
/// Panics when the lengths disagree (callers take them from tensor shapes).
pub fn mlp(
    x: &[f32],
    (w1, first): (&PackedWeight, Epilogue<'_>),
    (w2, second): (&PackedWeight, Epilogue<'_>),
    out: &mut [f32],
) {
    let (n, hidden, k) = (w2.n, w1.n, w1.k);
    if n == 0 || out.is_empty() {
        return;
    }
    let m = out.len() / n;
    assert!(w1.isa == w2.isa && w2.k == hidden, "{hidden} outputs into {} inputs", w2.k);
    check(x, w1, &first, m, m * hidden);
    assert!(second.residual.is_none_or(|r| r.len() == m * n) && out.len() == m * n, "output of {m} x {n}");
    assert!(second.bias.is_none_or(|b| b.len() == n), "bias of {n}");
    let rows = task_rows(w1.isa, m);
    out.par_chunks_mut(rows * n).zip(x.par_chunks(rows * k)).enumerate().for_each(|(i, (out, x))| {
        let count = out.len() / n;
        let first = first.part(i * rows * hidden, count * hidden);
        let second = second.part(i * rows * n, out.len());
        SCRATCH.with_borrow_mut(|Scratch { blocks, hidden: between }| {
            let between = between.at_least(count * hidden);
            dispatch(w1.isa, Block { scratch: blocks, x: Rows::Lying(x), w: w1, epilogue: first, out: between });
            let x = Rows::Lying(between);
            dispatch(w2.isa, Block { scratch: blocks, x, w: w2, epilogue: second, out });
        });
    });
}

#[cfg(test)]
mod tests;
