//! Self-attention without the `n x n` matrix: blocks of queries against blocks of keys with a running maximum and sum
//! (Milakov and Gimelshein, "Online normalizer calculation for softmax", 2018; Dao et al., "FlashAttention", 2022).
//!
//! Keys and values are first packed per head into panels of one register tile's width. A task is one block of
//! `BLOCK_QUERIES` queries of one head; for each block of `BLOCK_KEYS` keys it computes the logits in register
//! tiles (in units of log 2, so that the softmax is a power of two), turns them into weights row by row, and adds the
//! weighted values to its output block. All blocks of a task fit the second-level cache.
//!
//! Where the lengths of a task's queries and of its head's keys bound every logit by `FLAT_LOGITS`, nothing is subtracted: the
//! softmax does not depend on it and no power can overflow or vanish, so weights are taken as the logits leave the registers.
//! Else logits may be of any finite size: the largest so far is subtracted before the power is taken, so weights are at most
//! 1 and the sum at least 1. A NaN in a query, key or value reaches every output that depends on it.

mod backward;
mod block;
mod pack;
mod pairs;
#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
mod tiles;
#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
mod tiles_backward;

use std::cell::RefCell;

use rayon::prelude::*;

use super::Isa;
use super::aligned::Aligned;
#[cfg(all(target_arch = "x86_64", target_os = "linux"))]
use super::amx::Parts;
use super::math::bf16;
use super::simd::dispatch;
use block::Task;
use pack::{Layout, Sizes, Source, pack};

pub use backward::{Source as BackwardSource, attention_backward};
pub use pack::{Inputs, Rows, Shape};
pub use pairs::attention_in_pairs;

/// Queries of a task: a multiple of both tile heights.
const BLOCK_QUERIES: usize = 96;
/// Keys taken at a time. The logits of a task are `96 x 256` floats, 96 KiB.
const BLOCK_KEYS: usize = 256;

/// Logits (in units of log 2) up to which weights are plain powers: weights lie within `2^-60..2^60` then.
const FLAT_LOGITS: f32 = 60.0;
/// Lengths of values up to which sums of such weights times values stay in range.
const FLAT_VALUES: f32 = 1.1e12;

/// Working memory of a task, kept by its thread.
#[derive(Default)]
struct Scratch {
    queries: Aligned,
    weights: Aligned,
    sums: Aligned,
    totals: Aligned,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
    /// Packed keys and values of the last call from this thread.
    static PACKED: RefCell<Aligned> = RefCell::default();
}

/// The result, written by tasks that own disjoint rows and columns of it.
#[derive(Clone, Copy)]
struct Output {
    start: *mut f32,
    len: usize,
}

// SAFETY: every task writes other elements (see `Output::row`), and the buffer outlives the parallel loop.
unsafe impl Send for Output {}
// SAFETY: as above.
unsafe impl Sync for Output {}

impl Output {
    /// # Safety
    /// No other task may hold any of `at..at + len`.
    #[allow(clippy::mut_from_ref)]
    unsafe fn row(&self, at: usize, len: usize) -> &mut [f32] {
        assert!(at + len <= self.len);
        // SAFETY: in bounds by the assertion, not shared by the caller's contract.
        unsafe { std::slice::from_raw_parts_mut(self.start.add(at), len) }
    }
}

/// `softmax(q k^T / sqrt(head_dim)) v` for `qkv` `(batch, tokens, 3 * heads * head_dim)` with rows `[q | k | v]`; `out` is
/// `(batch, tokens, heads * head_dim)`.
///
/// Panics when the lengths disagree (callers take them from tensor shapes) or the machine lacks `isa`.
pub fn attention(isa: Isa, qkv: &[f32], shape: Shape, out: &mut [f32]) {
    run(isa, &Inputs::joined(qkv, &shape), shape, out, None);
}

/// As [`attention`], of queries, keys and values that may be rows of different matrices; `shape.tokens` is the number of
/// queries of each sequence.
///
/// Panics when the lengths disagree (callers take them from tensor shapes) or the machine lacks `isa`.
pub fn attention_of(isa: Isa, inputs: &Inputs<'_>, shape: Shape, out: &mut [f32]) {
    run(isa, inputs, shape, out, None);
}

/// As [`attention`]; also returns what [`attention_backward`] needs of each row: the log-sum-exp of its logits in units
/// of log 2, `(batch, heads, tokens)`.
///
/// Panics when the lengths disagree (callers take them from tensor shapes) or the machine lacks `isa`.
pub fn attention_keeping(isa: Isa, qkv: &[f32], shape: Shape, out: &mut [f32]) -> Vec<f32> {
    let mut log_sums = vec![0f32; shape.batch * shape.tokens * shape.heads];
    let to = Output { start: log_sums.as_mut_ptr(), len: log_sums.len() };
    run(isa, &Inputs::joined(qkv, &shape), shape, out, Some(to));
    log_sums
}

/// As [`attention_of`], operands rounded to bf16 (weights of the softmax only where tile units take the product).
///
/// Panics when the lengths disagree (callers take them from tensor shapes) or the machine lacks `isa`.
pub fn attention_in_bf16(isa: Isa, inputs: &Inputs<'_>, shape: Shape, out: &mut [f32]) {
    #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
    if isa == Isa::Amx {
        inputs.check(&shape);
        assert_eq!(out.len(), shape.batch * shape.tokens * shape.width(), "output of {shape:?}");
        assert!(inputs.count > 0 || out.is_empty(), "no keys");
        if !out.is_empty() {
            tiles::run(Parts::One, inputs, shape, out, None);
        }
        return;
    }
    let rounded = |rows: &Rows<'_>| rows.values.iter().map(|&x| bf16(x)).collect::<Vec<f32>>();
    let [queries, keys, values] = [&inputs.queries, &inputs.keys, &inputs.values].map(rounded);
    let with = |rows: Rows<'_>, values| Rows { values, ..rows };
    let inputs = Inputs {
        queries: with(inputs.queries, &queries),
        keys: with(inputs.keys, &keys),
        values: with(inputs.values, &values),
        ..*inputs
    };
    attention_of(isa, &inputs, shape, out);
}

/// The bias in whole blocks, and its largest size (NaN where it holds one).
fn whole_blocks(inputs: &Inputs<'_>) -> Option<(Vec<f32>, f32)> {
    let bias = inputs.bias?;
    let mut padded = vec![0f32; inputs.count.next_multiple_of(BLOCK_KEYS)];
    padded[..bias.len()].copy_from_slice(bias);
    let largest = bias.iter().fold(0f32, |a, x| if x.abs() <= a { a } else { x.abs() });
    Some((padded, largest))
}

/// The largest of each head's blocks.
fn by_head(sizes: &[Sizes], blocks: usize) -> Vec<Sizes> {
    sizes.chunks_exact(blocks).map(|head| head.iter().copied().reduce(Sizes::or).unwrap_or_default()).collect()
}

/// Runs `task` for every `rows` queries of every head, in parallel; it is told which head of all sequences' it is.
fn each_query_block<'a>(
    inputs: &'a Inputs<'a>,
    shape: &'a Shape,
    rows: usize,
    task: impl Fn(Source<'a>, usize) + Sync + Send,
) {
    let query_blocks = shape.tokens.div_ceil(rows);
    (0..shape.batch * shape.heads * query_blocks).into_par_iter().for_each(|index| {
        let (head_index, query_block) = (index / query_blocks, index % query_blocks);
        let (batch, head) = (head_index / shape.heads, head_index % shape.heads);
        task(Source { inputs, shape, batch, head, first: query_block * rows }, head_index);
    });
}

fn run(isa: Isa, inputs: &Inputs<'_>, shape: Shape, out: &mut [f32], log_sums: Option<Output>) {
    inputs.check(&shape);
    assert_eq!(out.len(), shape.batch * shape.tokens * shape.width(), "output of {shape:?}");
    if out.is_empty() {
        return;
    }
    assert!(inputs.count > 0, "no keys");
    #[cfg(all(target_arch = "x86_64", target_os = "linux"))]
    if isa == Isa::Amx {
        return tiles::run(Parts::Three, inputs, shape, out, log_sums);
    }
    let bias = whole_blocks(inputs);
    let bias = bias.as_ref().map(|(bias, largest)| (&bias[..], *largest));
    let layout = Layout::new(isa, shape.head_dim, inputs.count);
    let head_floats = layout.blocks * layout.block_floats;
    let mut memory = PACKED.take();
    let packed = memory.at_least(shape.batch * shape.heads * head_floats);
    let mut sizes = vec![Sizes::default(); shape.batch * shape.heads * layout.blocks];
    packed.par_chunks_exact_mut(layout.block_floats).zip(&mut sizes).enumerate().for_each(|(index, (block, sizes))| {
        *sizes = pack(inputs, &shape, &layout, index, block);
    });
    let packed = &*packed;
    let sizes = by_head(&sizes, layout.blocks);
    let output = Output { start: out.as_mut_ptr(), len: out.len() };
    each_query_block(inputs, &shape, BLOCK_QUERIES, |source, head_index| {
        let blocks = &packed[head_index * head_floats..][..head_floats];
        // No rayon call happens inside, so a thread cannot come back here while it holds its scratch.
        SCRATCH.with_borrow_mut(|scratch| {
            let sizes = sizes[head_index];
            dispatch(isa, Task { source, layout: &layout, blocks, sizes, bias, scratch, out: output, log_sums });
        });
    });
    PACKED.set(memory);
}

#[cfg(test)]
mod tests;
