//! Gradients of attention on AMX tile units: the sums of [`super::backward`], keys along rows.
//!
//! With `S' = K Q^T` and `G' = V G^T` for 32 keys and 32 queries, rows are keys: those of the weights and of the logits'
//! gradients go from the vectors' registers to the left-hand tiles of `dV = P' G` and `dK = dS' Q`, and two at a time to the
//! right-hand tiles of `dQ' = K' dS'`, so nothing is transposed but the queries' gradients at the end.

use std::cell::RefCell;

use super::Output;
use super::backward::{Heads, Source, Task, each_head};
use super::pack::{Head, logit_scale};
use crate::kernels::aligned::Aligned;
use crate::kernels::amx::{
    Configured, Parts, SIDE, STEP, TILE, column_tiles, interleaved, product, product_onto, put, row_tiles, transpose,
    words_of,
};
use crate::kernels::math::exp2;
use crate::kernels::simd::{Avx512, Simd};

/// Logits are as exact as the forward pass's, so that the weights fit the kept sums.
const LOGITS: Parts = Parts::Three;
/// Everything else.
const GRADIENTS: Parts = Parts::Two;
/// Queries and keys taken at a time: a block's weights and gradients are 80 KiB.
const BLOCK: usize = 128;

type V = Avx512<true>;

/// Working memory of a thread.
#[derive(Default)]
struct Scratch {
    /// Left-hand panels of 32 tokens.
    key_rows: Aligned,
    value_rows: Aligned,
    /// Right-hand panels of 32 tokens.
    query_columns: Aligned,
    grad_columns: Aligned,
    /// Panels of 32 channels along a block's tokens: left-hand, and right-hand.
    key_channels: Aligned,
    queries: Aligned,
    grads: Aligned,
    /// Of each query, zeros past the last.
    log_sums: Aligned,
    corrections: Aligned,
    /// `S'` and `G'`, of this panel and the next.
    products: Aligned,
    /// Of 32 keys along a block's queries, left-hand.
    weights: Aligned,
    logit_grads: Aligned,
    /// Of 32 queries along a block's keys, right-hand.
    logit_grad_columns: Aligned,
    /// Rows of channels of a block's keys.
    key_sums: Aligned,
    value_sums: Aligned,
    /// A row of all queries for every channel.
    query_sums: Aligned,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// Panels of 32 tokens, their channels in `parts`; `turned` ones are right-hand.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn panels(parts: Parts, head: &Head<'_>, scale: f32, turned: bool, to: &mut [f32]) {
    for (panel, to) in to.chunks_exact_mut(parts.panel_floats(head.dim)).enumerate() {
        for half in 0..2 {
            let at = panel * SIDE + half * TILE;
            row_tiles(parts, half, head.dim, scale, |r| (at + r < head.tokens).then(|| head.row(at + r)), to);
        }
        if turned {
            transpose(to);
        }
    }
}

/// Block by block, panels of 32 channels along the tokens; `turned` ones are left-hand.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
fn along(head: &Head<'_>, turned: bool, to: &mut [f32]) {
    let channels = head.dim.div_ceil(SIDE);
    for (index, to) in to.chunks_exact_mut(GRADIENTS.panel_floats(BLOCK)).enumerate() {
        let (first, panel) = (index / channels * BLOCK, index % channels);
        let count = BLOCK.min(head.tokens - first);
        for half in 0..2 {
            let channel = (panel * SIDE + half * TILE).min(head.dim);
            column_tiles(GRADIENTS, half, count, |t| &head.row(first + t)[channel..], to);
        }
        if turned {
            transpose(&mut to[..GRADIENTS.panel_floats(count)]);
        }
    }
}

/// Where 32 keys by 32 queries of weights and of logits' gradients go: steps of panels.
struct Turned<'a> {
    weights: &'a mut [f32],
    logit_grads: &'a mut [f32],
    logit_grad_columns: &'a mut [f32],
}

/// Logits become weights, gradients of weights become gradients of logits; of the 32 keys `there` are real.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,avx512vnni,avx2,fma")]
fn turn(products: &[f32], there: usize, log_sums: &[f32], corrections: &[f32], to: &mut Turned<'_>) {
    let two = |x: &[f32]| {
        let x = &x[..SIDE];
        // SAFETY: two vectors, as just cut.
        unsafe { [V::load(x.as_ptr()), V::load(x[TILE..].as_ptr())] }
    };
    let (log_sums, corrections) = (two(log_sums), two(corrections));
    let (logits, along) = products.split_at(SIDE * SIDE);
    for pair in 0..SIDE / 2 {
        let mut grads = [[V::zero(); 2]; 2];
        for (k, grads) in grads.iter_mut().enumerate() {
            let row = 2 * pair + k;
            let mut weights = [V::zero(); 2];
            // Keys past the last one would have weights of any size.
            if row < there {
                let (logits, along) = (two(&logits[row * SIDE..]), two(&along[row * SIDE..]));
                for half in 0..2 {
                    weights[half] = exp2::<V>(V::sub(logits[half], log_sums[half]));
                    grads[half] = V::mul(weights[half], V::sub(along[half], corrections[half]));
                }
            }
            let (half, row) = (row / TILE, row % TILE);
            put(GRADIENTS, words_of(GRADIENTS, weights[0], weights[1]), half, row, to.weights);
            put(GRADIENTS, words_of(GRADIENTS, grads[0], grads[1]), half, row, to.logit_grads);
        }
        for half in 0..2 {
            let words = interleaved(GRADIENTS, grads[0][half], grads[1][half]);
            put(GRADIENTS, words, half, pair, to.logit_grad_columns);
        }
    }
}

impl Task<'_, Scratch> {
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,avx512vnni,avx2,fma")]
    fn run_tiles(self) {
        let shape = self.source.shape;
        let (n, d, width) = (shape.tokens, shape.head_dim, shape.width());
        let heads = self.source.heads(self.batch, self.head);
        let Heads { queries: q, keys: k, values: v, grad: g, log_sums, .. } = &heads;
        let (blocks, channels, depth) = (n.div_ceil(BLOCK), d.div_ceil(SIDE), d.div_ceil(STEP));
        let (room, channel_room) = (blocks * BLOCK, channels * SIDE);
        let scratch = self.scratch;

        let (logit_floats, floats) = (LOGITS.panel_floats(d), GRADIENTS.panel_floats(d));
        let token_panels = n.div_ceil(SIDE);
        let key_rows = scratch.key_rows.at_least(token_panels * logit_floats);
        panels(LOGITS, k, 1.0, false, key_rows);
        let query_columns = scratch.query_columns.at_least(token_panels * logit_floats);
        panels(LOGITS, q, logit_scale(d), true, query_columns);
        let value_rows = scratch.value_rows.at_least(token_panels * floats);
        panels(GRADIENTS, v, 1.0, false, value_rows);
        let grad_columns = scratch.grad_columns.at_least(token_panels * floats);
        panels(GRADIENTS, g, 1.0, true, grad_columns);
        let block_floats = GRADIENTS.panel_floats(BLOCK);
        let key_channels = scratch.key_channels.at_least(blocks * channels * block_floats);
        along(k, true, key_channels);
        let queries = scratch.queries.at_least(blocks * channels * block_floats);
        along(q, false, queries);
        let grads = scratch.grads.at_least(blocks * channels * block_floats);
        along(g, false, grads);
        let sums = scratch.log_sums.at_least(room);
        sums[..n].copy_from_slice(log_sums);
        sums[n..].fill(0.0);
        let corrections = scratch.corrections.at_least(room);
        (0..n).for_each(|t| corrections[t] = heads.correction(t));
        corrections[n..].fill(0.0);

        let (even, odd) = scratch.products.at_least(4 * SIDE * SIDE).split_at_mut(2 * SIDE * SIDE);
        let weights = scratch.weights.at_least(block_floats);
        let logit_grads = scratch.logit_grads.at_least(block_floats);
        let logit_grad_columns = scratch.logit_grad_columns.at_least(BLOCK / SIDE * block_floats);
        let key_sums = scratch.key_sums.at_least(BLOCK * channel_room);
        let value_sums = scratch.value_sums.at_least(BLOCK * channel_room);
        let query_sums = scratch.query_sums.at_least(channel_room * room);
        query_sums.fill(0.0);

        let step_floats = GRADIENTS.step_floats();
        let scale = 1.0 / (d as f32).sqrt();
        let tiles = Configured::new();
        // `S'` and `G'` of a panel of keys and one of queries.
        let multiply = |keys: usize, queries: usize, to: &mut [f32]| {
            let (logits, along) = to.split_at_mut(SIDE * SIDE);
            assert!(along.len() >= SIDE * SIDE);
            let a = &key_rows[keys * logit_floats..][..logit_floats];
            let b = &query_columns[queries * logit_floats..][..logit_floats];
            let (v, g) = (&value_rows[keys * floats..][..floats], &grad_columns[queries * floats..][..floats]);
            // SAFETY: all panels have `depth` steps, both places 32 rows of 32.
            unsafe {
                product(&tiles, LOGITS, depth, (a.as_ptr(), b.as_ptr()), logits.as_mut_ptr(), SIDE);
                product(&tiles, GRADIENTS, depth, (v.as_ptr(), g.as_ptr()), along.as_mut_ptr(), SIDE);
            }
        };
        for first_key in (0..n).step_by(BLOCK) {
            let key_count = BLOCK.min(n - first_key);
            let key_steps = key_count.div_ceil(STEP);
            key_sums.fill(0.0);
            value_sums.fill(0.0);
            for first in (0..n).step_by(BLOCK) {
                let query_steps = BLOCK.min(n - first).div_ceil(STEP);
                let of_block = |panels: &[f32], c: usize| {
                    let at = (first / BLOCK * channels + c) * block_floats;
                    panels[at..at + block_floats].as_ptr()
                };
                for j in 0..key_steps {
                    // A panel's products are under way while the one before is turned.
                    multiply(first_key / SIDE + j, first / SIDE, even);
                    for i in 0..query_steps {
                        let (now, next) = if i % 2 == 0 { (&mut *even, &mut *odd) } else { (&mut *odd, &mut *even) };
                        if i + 1 < query_steps {
                            multiply(first_key / SIDE + j, first / SIDE + i + 1, next);
                        }
                        let column_step = i * block_floats + j * step_floats;
                        let mut to = Turned {
                            weights: &mut weights[i * step_floats..][..step_floats],
                            logit_grads: &mut logit_grads[i * step_floats..][..step_floats],
                            logit_grad_columns: &mut logit_grad_columns[column_step..][..step_floats],
                        };
                        let query = first + i * SIDE;
                        turn(now, key_count - j * SIDE, &sums[query..], &corrections[query..], &mut to);
                    }
                    let (weights, logit_grads) = (weights.as_ptr(), logit_grads.as_ptr());
                    for c in 0..channels {
                        let at = j * SIDE * channel_room + c * SIDE;
                        let (values, keys) = (value_sums[at..].as_mut_ptr(), key_sums[at..].as_mut_ptr());
                        let (g, q) = (of_block(grads, c), of_block(queries, c));
                        // SAFETY: panels of a block have room for `query_steps` steps; sums have 32 rows of
                        // `channel_room` from row `32 j` on, `c` inside.
                        unsafe {
                            product_onto(&tiles, GRADIENTS, query_steps, (weights, g), values, channel_room);
                            product_onto(&tiles, GRADIENTS, query_steps, (logit_grads, q), keys, channel_room);
                        }
                    }
                }
                for i in 0..query_steps {
                    let columns = logit_grad_columns[i * block_floats..][..block_floats].as_ptr();
                    for c in 0..channels {
                        let at = (first_key / BLOCK * channels + c) * block_floats;
                        let rows = key_channels[at..at + block_floats].as_ptr();
                        let to = query_sums[c * SIDE * room + first + i * SIDE..].as_mut_ptr();
                        // SAFETY: as above; sums have 32 rows of `room` from row `32 c` on, these columns inside.
                        unsafe { product_onto(&tiles, GRADIENTS, key_steps, (rows, columns), to, room) };
                    }
                }
            }
            for t in 0..key_count {
                let row = (self.batch * n + first_key + t) * 3 * width + self.head * d;
                // SAFETY: batch and head identify the task: no other writes these columns of these rows.
                let (to_key, to_value) = unsafe { (self.out.row(row + width, d), self.out.row(row + 2 * width, d)) };
                let sums = &key_sums[t * channel_room..];
                to_key.iter_mut().zip(sums).for_each(|(to, sum)| *to = sum * scale);
                to_value.copy_from_slice(&value_sums[t * channel_room..][..d]);
            }
        }
        drop(tiles);
        for t in 0..n {
            // SAFETY: as above.
            let to = unsafe { self.out.row((self.batch * n + t) * 3 * width + self.head * d, d) };
            let sums = query_sums[t..].iter().step_by(room);
            to.iter_mut().zip(sums).for_each(|(to, sum)| *to = sum * scale);
        }
    }
}

/// See [`super::attention_backward`].
pub(super) fn run(source: Source<'_>, out: Output) {
    each_head(source, out, &SCRATCH, |task: Task<'_, Scratch>| {
        // SAFETY: `Isa::Amx`, under which alone this runs, exists only where the features were detected.
        unsafe { task.run_tiles() };
    });
}
