//! Gradients of attention without the `n x n` matrix: the weights are computed again, block by block, from the queries,
//! the keys and each row's log-sum-exp (Dao et al., "FlashAttention", 2022, appendix B).
//!
//! With `P` the weights, `O` the result, `G` its gradient: `D = rowsum(G o O)`, `dS = P o (G V^T - D)`, and then
//! `dV = P^T G`, `dK = dS^T Q / sqrt(d)`, `dQ = dS K / sqrt(d)`. A task is one head of one sequence, so every sum has one
//! owner and one order: key blocks outside, query blocks inside.

use std::cell::RefCell;
use std::thread::LocalKey;

use rayon::prelude::*;

use super::Output;
use super::pack::{Head, Shape, logit_scale};
use crate::kernels::Isa;
use crate::kernels::aligned::Aligned;
use crate::kernels::gemm::tile;
use crate::kernels::math::exp2;
use crate::kernels::simd::{Kernel, Simd, dispatch};

/// Queries and keys taken at a time: a multiple of every tile's sides. Two blocks of weights are 72 KiB.
const BLOCK: usize = 96;

/// Working memory of a thread. Parts that no value is packed into (past the last token or channel) only reach results
/// that are not read.
#[derive(Default)]
struct Scratch {
    /// Queries (scaled) and gradients of the result, in panels of tile rows.
    query_rows: Aligned,
    grad_rows: Aligned,
    /// Keys and values, in panels of tile columns along the tokens.
    key_columns: Aligned,
    value_columns: Aligned,
    /// Keys, queries and gradients of the result, in panels of tile columns along the channels.
    keys: Aligned,
    queries: Aligned,
    grads: Aligned,
    /// `D` of each query.
    corrections: Aligned,
    /// One block of `P` and of `dS`, queries by keys.
    weights: Aligned,
    logit_grads: Aligned,
    /// Sums, in panels of tile columns along the channels: all queries, one block of keys.
    query_sums: Aligned,
    key_sums: Aligned,
    value_sums: Aligned,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// What the gradients of one call are taken from.
#[derive(Debug, Clone, Copy)]
pub struct Source<'a> {
    /// As in [`super::attention`].
    pub qkv: &'a [f32],
    /// Its result.
    pub result: &'a [f32],
    /// Log-sum-exp of each row's logits, `(batch, heads, tokens)`, from [`super::attention_keeping`].
    pub log_sums: &'a [f32],
    /// Gradient of the result.
    pub grad: &'a [f32],
    /// The sizes.
    pub shape: Shape,
}

/// What one head's gradients are taken from.
pub(super) struct Heads<'a> {
    pub(super) queries: Head<'a>,
    pub(super) keys: Head<'a>,
    pub(super) values: Head<'a>,
    result: Head<'a>,
    pub(super) grad: Head<'a>,
    /// Of each query.
    pub(super) log_sums: &'a [f32],
}

impl<'a> Source<'a> {
    pub(super) fn heads(&self, batch: usize, head: usize) -> Heads<'a> {
        let Shape { tokens: n, heads, head_dim: d, .. } = self.shape;
        let width = self.shape.width();
        let part = |values, part: usize, stride: usize| Head {
            values,
            first: batch * n * stride + part * width + head * d,
            stride,
            dim: d,
            tokens: n,
        };
        let of_qkv = |index| part(self.qkv, index, 3 * width);
        Heads {
            queries: of_qkv(0),
            keys: of_qkv(1),
            values: of_qkv(2),
            result: part(self.result, 0, width),
            grad: part(self.grad, 0, width),
            log_sums: &self.log_sums[(batch * heads + head) * n..][..n],
        }
    }
}

impl Heads<'_> {
    /// `D` of a query.
    pub(super) fn correction(&self, query: usize) -> f32 {
        self.grad.row(query).iter().zip(self.result.row(query)).map(|(g, o)| g * o).sum()
    }
}

/// One head of one sequence, and its thread's memory.
pub(super) struct Task<'a, S> {
    pub(super) source: Source<'a>,
    pub(super) batch: usize,
    pub(super) head: usize,
    pub(super) scratch: &'a mut S,
    pub(super) out: Output,
}

/// Runs `work` for every head of every sequence, in parallel.
pub(super) fn each_head<S: Default + 'static>(
    source: Source<'_>,
    out: Output,
    memory: &'static LocalKey<RefCell<S>>,
    work: impl Fn(Task<'_, S>) + Sync,
) {
    let Shape { batch, heads, .. } = source.shape;
    (0..batch * heads).into_par_iter().with_max_len(1).for_each(|index| {
        let (batch, head) = (index / heads, index % heads);
        // No rayon call happens inside, so a thread cannot come back here while it holds its scratch.
        memory.with_borrow_mut(|scratch| work(Task { source, batch, head, scratch, out }));
    });
}

/// `sums[row] += sum_p a[p][row] b[p]` for `rows` rows and all channel panels: `a` at `p * a_step + row * a_row`, `b` and
/// `sums` in panels along the channels of `b_room` and `sums_room` rows.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn accumulate<S: Simd, const MR: usize>(
    (depth, rows, panels): (usize, usize, usize),
    a: &[f32],
    (a_step, a_row): (usize, usize),
    (b, b_room, b_first): (&[f32], usize, usize),
    (sums, sums_room, sums_first): (&mut [f32], usize, usize),
) {
    let nr = 2 * S::W;
    let row_panels = rows.div_ceil(MR);
    assert!(a.len() >= BLOCK * BLOCK && depth <= BLOCK && row_panels * MR <= BLOCK);
    for c in 0..panels {
        let b = &b[(c * b_room + b_first) * nr..][..depth * nr];
        let to = &mut sums[(c * sums_room + sums_first) * nr..][..row_panels * MR * nr];
        for i in 0..row_panels {
            // SAFETY: `a` is BLOCK x BLOCK and both indices stay under BLOCK; `b` has `depth` rows of two vectors, `to`
            // MR of them for each `i`.
            unsafe {
                let to = to.as_mut_ptr().add(i * MR * nr);
                let mut acc = [[S::zero(); 2]; MR];
                for r in 0..MR {
                    acc[r] = [S::load(to.add(r * nr)), S::load(to.add(r * nr + S::W))];
                }
                let acc = tile::<S, MR>(depth, a.as_ptr().add(i * MR * a_row), a_step, a_row, b.as_ptr(), acc);
                for r in 0..MR {
                    S::store(to.add(r * nr), acc[r][0]);
                    S::store(to.add(r * nr + S::W), acc[r][1]);
                }
            }
        }
    }
}

/// `to[query][key] = a b` for one block, `a` in panels of tile rows, `b` in panels of tile columns, `depth` channels.
#[inline(always)]
fn products<S: Simd, const MR: usize>(
    depth: usize,
    (rows, a): (usize, &[f32]),
    (cols, b): (usize, &[f32]),
    to: &mut [f32],
) {
    let nr = 2 * S::W;
    for j in 0..cols.div_ceil(nr) {
        let b = &b[j * depth * nr..][..depth * nr];
        for i in 0..rows.div_ceil(MR) {
            let a = &a[i * depth * MR..][..depth * MR];
            let to = &mut to[i * MR * BLOCK..][..MR * BLOCK];
            // SAFETY: `a` has `depth` columns of MR, `b` `depth` rows of two vectors; `to` MR rows of BLOCK, and panel
            // `j` is inside because BLOCK is a multiple of `nr`.
            unsafe {
                let acc = tile::<S, MR>(depth, a.as_ptr(), MR, 1, b.as_ptr(), [[S::zero(); 2]; MR]);
                for r in 0..MR {
                    let row = to.as_mut_ptr().add(r * BLOCK + j * nr);
                    S::store(row, acc[r][0]);
                    S::store(row.add(S::W), acc[r][1]);
                }
            }
        }
    }
}

/// Logits become weights, and gradients of weights become gradients of logits.
#[inline(always)]
fn turn<S: Simd>(cols: usize, log_sum: f32, correction: f32, weights: &mut [f32], grads: &mut [f32]) {
    let (log_sum, correction) = (S::splat(log_sum), S::splat(correction));
    for (w, g) in weights[..cols].chunks_exact_mut(S::W).zip(grads[..cols].chunks_exact_mut(S::W)) {
        // SAFETY: both chunks have one vector.
        unsafe {
            let weight = exp2::<S>(S::sub(S::load(w.as_ptr()), log_sum));
            S::store(w.as_mut_ptr(), weight);
            S::store(g.as_mut_ptr(), S::mul(weight, S::sub(S::load(g.as_ptr()), correction)));
        }
    }
}

impl Kernel for Task<'_, Scratch> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd, const MR: usize>(self) {
        let shape = self.source.shape;
        let (n, d, width, nr) = (shape.tokens, shape.head_dim, shape.width(), 2 * S::W);
        let room = n.next_multiple_of(BLOCK);
        let panels = d.div_ceil(nr);
        let scratch = self.scratch;
        let heads = self.source.heads(self.batch, self.head);
        let Heads { queries: q, keys: k, values: v, grad: g, log_sums, .. } = &heads;

        let scale = 1.0 / (d as f32).sqrt();
        let query_rows = scratch.query_rows.at_least(room * d);
        // The same rounding as in the forward pass, so that the weights fit the kept sums.
        q.across(MR, logit_scale(d), query_rows);
        let grad_rows = scratch.grad_rows.at_least(room * d);
        g.across(MR, 1.0, grad_rows);
        let key_columns = scratch.key_columns.at_least(room * d);
        k.across(nr, 1.0, key_columns);
        let value_columns = scratch.value_columns.at_least(room * d);
        v.across(nr, 1.0, value_columns);
        let keys = scratch.keys.at_least(room * panels * nr);
        k.along(nr, room, keys);
        let queries = scratch.queries.at_least(room * panels * nr);
        q.along(nr, room, queries);
        let grads = scratch.grads.at_least(room * panels * nr);
        g.along(nr, room, grads);
        let corrections = scratch.corrections.at_least(n);
        for (t, correction) in corrections.iter_mut().enumerate() {
            *correction = heads.correction(t);
        }
        let weights = scratch.weights.at_least(BLOCK * BLOCK);
        let logit_grads = scratch.logit_grads.at_least(BLOCK * BLOCK);
        let query_sums = scratch.query_sums.at_least(room * panels * nr);
        let key_sums = scratch.key_sums.at_least(BLOCK * panels * nr);
        let value_sums = scratch.value_sums.at_least(BLOCK * panels * nr);
        query_sums.fill(0.0);

        for first_key in (0..n).step_by(BLOCK) {
            let key_count = BLOCK.min(n - first_key);
            let cols = key_count.next_multiple_of(nr);
            key_sums.fill(0.0);
            value_sums.fill(0.0);
            for first in (0..n).step_by(BLOCK) {
                let count = BLOCK.min(n - first);
                products::<S, MR>(d, (count, &query_rows[first * d..]), (cols, &key_columns[first_key * d..]), weights);
                products::<S, MR>(
                    d,
                    (count, &grad_rows[first * d..]),
                    (cols, &value_columns[first_key * d..]),
                    logit_grads,
                );
                for r in 0..count {
                    let (w, g) = (&mut weights[r * BLOCK..][..BLOCK], &mut logit_grads[r * BLOCK..][..BLOCK]);
                    turn::<S>(cols, log_sums[first + r], corrections[first + r], w, g);
                }
                let over_queries = (count, key_count, panels);
                accumulate::<S, MR>(over_queries, weights, (BLOCK, 1), (grads, room, first), (value_sums, BLOCK, 0));
                accumulate::<S, MR>(
                    over_queries,
                    logit_grads,
                    (BLOCK, 1),
                    (queries, room, first),
                    (key_sums, BLOCK, 0),
                );
                let over_keys = (key_count, count, panels);
                accumulate::<S, MR>(
                    over_keys,
                    logit_grads,
                    (1, BLOCK),
                    (keys, room, first_key),
                    (query_sums, room, first),
                );
            }
            for t in 0..key_count {
                let row = (self.batch * n + first_key + t) * 3 * width + self.head * d;
                // SAFETY: batch and head identify the task: no other writes these columns of these rows.
                let (to_key, to_value) = unsafe { (self.out.row(row + width, d), self.out.row(row + 2 * width, d)) };
                write(to_key, nr, |p| &key_sums[(p * BLOCK + t) * nr..], scale);
                write(to_value, nr, |p| &value_sums[(p * BLOCK + t) * nr..], 1.0);
            }
        }
        for t in 0..n {
            // SAFETY: as above.
            let to = unsafe { self.out.row((self.batch * n + t) * 3 * width + self.head * d, d) };
            write(to, nr, |p| &query_sums[(p * room + t) * nr..], scale);
        }
    }
}

#[inline(always)]
fn write<'a>(to: &mut [f32], width: usize, panel: impl Fn(usize) -> &'a [f32], scale: f32) {
    for (p, part) in to.chunks_mut(width).enumerate() {
        part.iter_mut().zip(panel(p)).for_each(|(to, sum)| *to = sum * scale);
    }
}

/// Gradient of `qkv`, in its layout.
///
/// Panics when the lengths disagree (callers take them from tensor shapes) or the machine lacks `isa`.
pub fn attention_backward(isa: Isa, source: Source<'_>, out: &mut [f32]) {
    let shape = source.shape;
    let rows = shape.batch * shape.tokens;
    assert!(source.qkv.len() == rows * 3 * shape.width() && out.len() == source.qkv.len(), "qkv of {shape:?}");
    assert!(source.grad.len() == rows * shape.width() && source.result.len() == source.grad.len(), "{shape:?}");
    assert_eq!(source.log_sums.len(), rows * shape.heads, "sums of {shape:?}");
    let output = Output { start: out.as_mut_ptr(), len: out.len() };
    #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
    if isa == Isa::Amx {
        return super::tiles_backward::run(source, output);
    }
    each_head(source, output, &SCRATCH, |task| dispatch(isa, task));
}

#[cfg(test)]
mod tests;
