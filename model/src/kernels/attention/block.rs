//! One block of queries on vectors: logits, weights and sums in register tiles.

use super::pack::{Layout, Sizes, Source};
use super::{BLOCK_KEYS, BLOCK_QUERIES, FLAT_LOGITS, FLAT_VALUES, Output, Scratch};
use crate::kernels::gemm::tile;
use crate::kernels::math::{exp2, exp2_short};
use crate::kernels::simd::{Kernel, Simd};

/// One block of queries of one head, and what it needs.
pub(super) struct Task<'a> {
    pub(super) source: Source<'a>,
    pub(super) layout: &'a Layout,
    /// Packed blocks of this head.
    pub(super) blocks: &'a [f32],
    /// The largest of them.
    pub(super) sizes: Sizes,
    /// Added to the logits, for whole blocks of keys; and its largest size.
    pub(super) bias: Option<(&'a [f32], f32)>,
    pub(super) scratch: &'a mut Scratch,
    pub(super) out: Output,
    /// Log-sum-exp of each query's logits in units of log 2, `(batch, heads, tokens)`, where it is kept.
    pub(super) log_sums: Option<Output>,
}

impl Kernel for Task<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd, const MR: usize>(self) {
        let Source { shape, batch, head, first, .. } = self.source;
        let layout = self.layout;
        let (d, nr) = (shape.head_dim, 2 * S::W);
        let queries = BLOCK_QUERIES.min(shape.tokens - first);
        let panels = queries.div_ceil(MR);
        let Scratch { queries: q, weights, sums, totals } = self.scratch;
        let q = q.at_least(BLOCK_QUERIES * d);
        let weights = weights.at_least(BLOCK_QUERIES * BLOCK_KEYS);
        let sums = sums.at_least(BLOCK_QUERIES * layout.value_dim);
        let query = self.source.pack_queries::<MR>(q, queries);
        sums.fill(0.0);
        let mut largest = [0f32; BLOCK_QUERIES];
        let mut total = [0f32; BLOCK_QUERIES];
        let mut shrink = [0f32; BLOCK_QUERIES];
        let room = FLAT_LOGITS - self.bias.map_or(0.0, |(_, largest)| largest);
        let flat =
            room >= 0.0 && query * self.sizes.key <= room * room && self.sizes.value <= FLAT_VALUES * FLAT_VALUES;
        let totals = totals.at_least(BLOCK_QUERIES * S::W);
        match flat {
            true => totals.fill(0.0),
            false => largest.fill(f32::MIN),
        }

        for (index, block) in self.blocks.chunks_exact(layout.block_floats).enumerate() {
            let count = BLOCK_KEYS.min(self.source.inputs.count - index * BLOCK_KEYS);
            let (keys, values) = block.split_at(layout.key_floats);
            let bias = self.bias.map(|(bias, _)| &bias[index * BLOCK_KEYS..][..BLOCK_KEYS]);
            if flat {
                flat_weights::<S, MR>(&q[..panels * MR * d], d, keys, bias, count, weights, totals);
                add_values::<S, MR>(weights, values, layout, count, panels, None, sums);
                continue;
            }
            logits::<S, MR>(&q[..panels * MR * d], d, keys, bias, count, weights);
            let width = count.next_multiple_of(nr);
            for r in 0..panels * MR {
                let row = &mut weights[r * BLOCK_KEYS..][..width];
                row[count..].fill(f32::MIN);
                shrink[r] = largest[r];
                largest[r] = row_largest::<S>(row, largest[r]);
            }
            shrink_sums::<S>(&mut shrink, &largest, &mut total);
            for r in 0..panels * MR {
                let row = &mut weights[r * BLOCK_KEYS..][..width];
                total[r] += row_weights::<S>(row, largest[r]);
            }
            add_values::<S, MR>(weights, values, layout, count, panels, Some(&shrink), sums);
        }
        if flat {
            for (total, lanes) in total.iter_mut().zip(totals.chunks_exact(S::W)) {
                // SAFETY: the chunk has one vector.
                *total = S::sum(unsafe { S::load(lanes.as_ptr()) });
            }
        }
        if let Some(log_sums) = self.log_sums {
            // SAFETY: batch, head and query block identify the task, so no other task writes these.
            let to = unsafe { log_sums.row((batch * shape.heads + head) * shape.tokens + first, queries) };
            to.iter_mut().zip(largest.iter().zip(&total)).for_each(|(to, (top, total))| *to = top + total.log2());
        }
        for r in 0..queries {
            let at = (batch * shape.tokens + first + r) * shape.width() + head * d;
            // SAFETY: batch, head and query block identify the task, so no other task writes these columns of this row.
            let row = unsafe { self.out.row(at, d) };
            put_row(row, sums, (BLOCK_QUERIES, r), nr, total[r]);
        }
    }
}

/// A query's result from its sums, row `r` of panels of `rows` rows and `nr` columns, over its weights' total.
#[inline(always)]
pub(super) fn put_row(row: &mut [f32], sums: &[f32], (rows, r): (usize, usize), nr: usize, total: f32) {
    let scale = 1.0 / total;
    for (c, part) in row.chunks_mut(nr).enumerate() {
        let from = &sums[(c * rows + r) * nr..][..part.len()];
        part.iter_mut().zip(from).for_each(|(o, s)| *o = s * scale);
    }
}

/// What the sums of a panel of keys start from.
#[inline(always)]
pub(super) fn start_at<S: Simd>(bias: Option<&[f32]>, first: usize) -> [S::V; 2] {
    match bias {
        // SAFETY: two vectors, as just cut.
        Some(bias) => unsafe {
            let two = &bias[first..first + 2 * S::W];
            [S::load(two.as_ptr()), S::load(two.as_ptr().add(S::W))]
        },
        None => [S::zero(); 2],
    }
}

/// Logits of whole row panels of queries against `count` keys, rows of [`BLOCK_KEYS`].
#[inline(always)]
fn logits<S: Simd, const MR: usize>(
    q: &[f32],
    d: usize,
    keys: &[f32],
    bias: Option<&[f32]>,
    count: usize,
    weights: &mut [f32],
) {
    let nr = 2 * S::W;
    for (j, b) in keys.chunks_exact(d * nr).take(count.div_ceil(nr)).enumerate() {
        for (a, to) in q.chunks_exact(d * MR).zip(weights.chunks_exact_mut(MR * BLOCK_KEYS)) {
            // SAFETY: `a` has `d` columns of MR, `b` `d` rows of two vectors; `to` MR rows of BLOCK_KEYS, of which panel `j`
            // is inside.
            unsafe {
                let acc = tile::<S, MR>(d, a.as_ptr(), MR, 1, b.as_ptr(), [start_at::<S>(bias, j * nr); MR]);
                for r in 0..MR {
                    let row = to.as_mut_ptr().add(r * BLOCK_KEYS + j * nr);
                    S::store(row, acc[r][0]);
                    S::store(row.add(S::W), acc[r][1]);
                }
            }
        }
    }
}

/// As [`logits`], but weights `2^logit`, for logits within [`FLAT_LOGITS`]; `totals` are partial sums, a vector a row.
#[inline(always)]
fn flat_weights<S: Simd, const MR: usize>(
    q: &[f32],
    d: usize,
    keys: &[f32],
    bias: Option<&[f32]>,
    count: usize,
    weights: &mut [f32],
    totals: &mut [f32],
) {
    let nr = 2 * S::W;
    for (j, b) in keys.chunks_exact(d * nr).take(count.div_ceil(nr)).enumerate() {
        let valid = nr.min(count - j * nr);
        let panels = q.chunks_exact(d * MR).zip(weights.chunks_exact_mut(MR * BLOCK_KEYS));
        for ((a, to), totals) in panels.zip(totals.chunks_exact_mut(MR * S::W)) {
            // SAFETY: `a` has `d` columns of MR, `b` `d` rows of two vectors; `to` MR rows of BLOCK_KEYS, of which panel `j`
            // is inside; `totals` MR vectors.
            unsafe {
                let acc = tile::<S, MR>(d, a.as_ptr(), MR, 1, b.as_ptr(), [start_at::<S>(bias, j * nr); MR]);
                for r in 0..MR {
                    let row = to.as_mut_ptr().add(r * BLOCK_KEYS + j * nr);
                    let (mut low, mut high) = (exp2_short::<S>(acc[r][0]), exp2_short::<S>(acc[r][1]));
                    S::store(row, low);
                    S::store(row.add(S::W), high);
                    if valid < nr {
                        (valid..nr).for_each(|c| row.add(c).write(0.0));
                        (low, high) = (S::load(row), S::load(row.add(S::W)));
                    }
                    let sum = totals.as_mut_ptr().add(r * S::W);
                    S::store(sum, S::add(S::load(sum), S::add(low, high)));
                }
            }
        }
    }
}

/// `sums = shrink * sums + weights * values` for the row panels of a task.
#[inline(always)]
fn add_values<S: Simd, const MR: usize>(
    weights: &[f32],
    values: &[f32],
    layout: &Layout,
    count: usize,
    panels: usize,
    shrink: Option<&[f32; BLOCK_QUERIES]>,
    sums: &mut [f32],
) {
    let nr = 2 * S::W;
    for c in 0..layout.value_dim / nr {
        let b = &values[c * layout.keys * nr..][..count * nr];
        for i in 0..panels {
            let a = &weights[i * MR * BLOCK_KEYS..][..MR * BLOCK_KEYS];
            let to = &mut sums[(c * BLOCK_QUERIES + i * MR) * nr..][..MR * nr];
            // SAFETY: `a` has MR rows of BLOCK_KEYS >= count, `b` `count` rows of two vectors, `to` MR such rows.
            unsafe {
                let mut acc = [[S::zero(); 2]; MR];
                for r in 0..MR {
                    acc[r] = [S::load(to.as_ptr().add(r * nr)), S::load(to.as_ptr().add(r * nr + S::W))];
                    if let Some(shrink) = shrink {
                        let keep = S::splat(shrink[i * MR + r]);
                        acc[r] = [S::mul(keep, acc[r][0]), S::mul(keep, acc[r][1])];
                    }
                }
                let acc = tile::<S, MR>(count, a.as_ptr(), 1, BLOCK_KEYS, b.as_ptr(), acc);
                for r in 0..MR {
                    S::store(to.as_mut_ptr().add(r * nr), acc[r][0]);
                    S::store(to.as_mut_ptr().add(r * nr + S::W), acc[r][1]);
                }
            }
        }
    }
}

/// The largest of `before` and the row's logits (NaN is passed over: its weight will be NaN).
#[inline(always)]
fn row_largest<S: Simd>(row: &[f32], before: f32) -> f32 {
    let mut tops = [S::splat(before); 2];
    for two in row.chunks_exact(2 * S::W) {
        // SAFETY: the chunk has two vectors.
        unsafe {
            tops[0] = S::max_of(S::load(two.as_ptr()), tops[0]);
            tops[1] = S::max_of(S::load(two.as_ptr().add(S::W)), tops[1]);
        }
    }
    S::largest(S::max_of(tops[0], tops[1]))
}

/// `shrink` holds the largest logits before this block; turns them into `2^(before - largest)` and scales the totals.
#[inline(always)]
fn shrink_sums<S: Simd>(
    shrink: &mut [f32; BLOCK_QUERIES],
    largest: &[f32; BLOCK_QUERIES],
    total: &mut [f32; BLOCK_QUERIES],
) {
    for at in (0..BLOCK_QUERIES).step_by(S::W) {
        // SAFETY: BLOCK_QUERIES is a multiple of every vector's width.
        unsafe {
            let before = S::load(shrink.as_ptr().add(at));
            let factor = exp2::<S>(S::sub(before, S::load(largest.as_ptr().add(at))));
            S::store(shrink.as_mut_ptr().add(at), factor);
            S::store(total.as_mut_ptr().add(at), S::mul(factor, S::load(total.as_ptr().add(at))));
        }
    }
}

/// Weights `2^(x - top)` in place of the logits; returns their sum.
#[inline(always)]
fn row_weights<S: Simd>(row: &mut [f32], top: f32) -> f32 {
    let subtract = S::splat(top);
    let mut sum = S::zero();
    // One vector at a time: two would push the polynomial's constants out of the registers.
    for one in row.chunks_exact_mut(S::W) {
        // SAFETY: the chunk has one vector.
        unsafe {
            let w = exp2::<S>(S::sub(S::load(one.as_ptr()), subtract));
            sum = S::add(sum, w);
            S::store(one.as_mut_ptr(), w);
        }
    }
    S::sum(sum)
}
