//! Attention in whole numbers: both products of pairs of 16-bit numbers with sums in 32 bits, the softmax in f32 between.
//!
//! Queries have a scale each, keys and values one per block of `BLOCK_KEYS` keys. The weights of a row are quantised against
//! the largest logit so far (the running maximum of the f32 kernel), so the largest is as fine as 12 bits make it, and
//! the sum that divides is that of the quantised weights: what rounding takes from the numerator it takes from the divisor too.
//!
//! A row panel goes through a block of keys at once: logits, weights and sums of a few rows stay in the first-level cache.

use std::cell::{Cell, RefCell};

use rayon::prelude::*;

use super::block::{put_row, start_at};
use super::pack::{Inputs, Layout, Shape, Source, larger, logit_scale};
use super::{BLOCK_KEYS, BLOCK_QUERIES, Output, each_query_block, whole_blocks};
use crate::kernels::Isa;
use crate::kernels::aligned::Aligned;
use crate::kernels::gemm::integer::{factors_of, largest_of, quantise, row_factors};
use crate::kernels::gemm::{Pairs, tile_of};
use crate::kernels::math::{ROUND, exp2, exp2_rough};
use crate::kernels::simd::{Kernel, Simd, dispatch};

/// Logarithm of a weight's largest whole number, 4095.
const WEIGHT_LOG2: f32 = 11.999_648;
/// Largest whole number of a value, 11 bits: `BLOCK_KEYS * 4095 * 2047` fits 32 bits.
const VALUE: f32 = 2047.0;
/// Weights below `2^-WEIGHTLESS` of a row's largest are zeros long before.
const WEIGHTLESS: f32 = -120.0;
/// Largest whole number of 16 bits.
const SIXTEEN_BITS: f64 = 32767.0;

/// Largest whole number of a query's or a key's channel: `head_dim` products of two fit 32 bits.
fn largest_channel(head_dim: usize) -> f32 {
    (f64::from(i32::MAX) / head_dim as f64).sqrt().floor().min(SIXTEEN_BITS) as f32
}

/// What brings a block's keys and values back.
#[derive(Debug, Clone, Copy, Default)]
struct Scales {
    key: f32,
    value: f32,
}

#[derive(Default)]
struct Scratch {
    queries: Aligned,
    logits: Aligned,
    weights: Aligned,
    sums: Aligned,
    /// Two rows in whole numbers, while packing.
    rows: Vec<i16>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
    /// Packed keys and values of the last call from this thread.
    static PACKED: Cell<Aligned> = Cell::default();
}

/// Packs one block: keys `(panel, pair of channels, key)`, values `(panel, pair of keys, channel)` where a tile's keys are
/// paired across its two vectors, as [`Simd::pair`] pairs their weights. Zeros where there are none.
struct Pack<'a> {
    inputs: &'a Inputs<'a>,
    shape: &'a Shape,
    layout: &'a Layout,
    index: usize,
    block: &'a mut [f32],
    rows: &'a mut Vec<i16>,
}

impl Kernel for Pack<'_> {
    type Out = Scales;

    #[inline(always)]
    fn run<S: Simd, const MR: usize>(self) -> Scales {
        let Self { inputs, shape, layout, index, block, rows } = self;
        let (head_index, first) = (index / layout.blocks, index % layout.blocks * BLOCK_KEYS);
        let (batch, head) = (head_index / shape.heads, head_index % shape.heads);
        let (d, nr) = (shape.head_dim, layout.nr);
        let depth = d.div_ceil(2);
        let count = BLOCK_KEYS.min(inputs.count - first);
        let row = |t: usize| batch * inputs.count + first + t;
        rows.clear();
        rows.resize(4 * depth, 0);
        let (one, two) = rows.split_at_mut(2 * depth);

        let (mut key_top, mut value_top) = (0f32, 0f32);
        for t in 0..count {
            key_top = larger(key_top, largest_of(inputs.keys.head(row(t), head, d)));
            value_top = larger(value_top, largest_of(inputs.values.head(row(t), head, d)));
        }
        let (key_factor, key) = row_factors(key_top, largest_channel(d));
        let (value_factor, value) = row_factors(value_top, VALUE);

        let (keys, values) = block.split_at_mut(layout.key_floats);
        keys[count / nr * depth * nr..].fill(0.0);
        for t in 0..count {
            quantise(inputs.keys.head(row(t), head, d), key_factor, &mut one[..d]);
            let panel = &mut keys[t / nr * depth * nr..][..depth * nr];
            let pairs: &[[i16; 2]] = bytemuck::cast_slice(one);
            for (c, pair) in pairs.iter().enumerate() {
                panel[c * nr + t % nr] = bytemuck::cast(*pair);
            }
        }
        one.fill(0);
        for tile in 0..layout.keys / nr {
            for j in 0..S::W {
                let t = tile * nr + j;
                for (t, whole) in [(t, &mut *one), (t + S::W, &mut *two)] {
                    match t < count {
                        true => quantise(inputs.values.head(row(t), head, d), value_factor, &mut whole[..d]),
                        false => whole.fill(0),
                    }
                }
                for (panel, first) in (0..d).step_by(nr).enumerate() {
                    let to = &mut values[(panel * layout.keys / 2 + tile * S::W + j) * nr..][..nr];
                    let width = nr.min(d - first);
                    for ((to, low), high) in to.iter_mut().zip(&one[first..first + width]).zip(&two[first..]) {
                        *to = f32::from_bits(u32::from(*low as u16) | u32::from(*high as u16) << 16);
                    }
                    to[width..].fill(0.0);
                }
            }
        }
        Scales { key, value }
    }
}

/// One block of queries of one head, and what it needs.
struct Task<'a> {
    source: Source<'a>,
    layout: &'a Layout,
    /// Packed blocks of this head, and their scales.
    blocks: &'a [f32],
    scales: &'a [Scales],
    /// Added to the logits, for whole blocks of keys.
    bias: Option<&'a [f32]>,
    scratch: &'a mut Scratch,
    out: Output,
}

impl Kernel for Task<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd, const MR: usize>(self) {
        let Source { inputs, shape, batch, head, first } = self.source;
        let layout = self.layout;
        let (d, nr) = (shape.head_dim, 2 * S::W);
        let depth = d.div_ceil(2);
        let queries = BLOCK_QUERIES.min(shape.tokens - first);
        let Scratch { queries: q, logits, weights, sums, .. } = self.scratch;
        let q = q.at_least(MR * depth);
        let logits = logits.at_least(MR * BLOCK_KEYS);
        let weights = weights.at_least(MR * BLOCK_KEYS / 2);
        let sums = &mut sums.at_least(MR * layout.value_dim)[..MR * layout.value_dim];
        for start in (0..queries).step_by(MR) {
            // Past the end the last query again.
            let mut row_scales = [0f32; MR];
            for (r, row) in q.chunks_exact_mut(depth).take(MR).enumerate() {
                let query = self.source.query((start + r).min(queries - 1));
                let (factor, back) = factors_of(query, largest_channel(d));
                row_scales[r] = back * logit_scale(d);
                let row: &mut [i16] = bytemuck::cast_slice_mut(row);
                quantise(query, factor, &mut row[..d]);
                row[d..].fill(0);
            }
            sums.fill(0.0);
            let mut largest = [f32::MIN; MR];
            // Not a number where the query is not: whole numbers cannot say so.
            let mut total: [f32; MR] = std::array::from_fn(|r| row_scales[r] * 0.0);
            for (index, (block, scales)) in self.blocks.chunks_exact(layout.block_floats).zip(self.scales).enumerate() {
                let count = BLOCK_KEYS.min(inputs.count - index * BLOCK_KEYS);
                let (keys, values) = block.split_at(layout.key_floats);
                let bias = self.bias.map(|bias| &bias[index * BLOCK_KEYS..][..BLOCK_KEYS]);
                let factors: [f32; MR] = std::array::from_fn(|r| row_scales[r] * scales.key);
                let tops = block_logits::<S, MR>(q, depth, keys, &factors, bias, count, logits);
                let mut shrink = [0f32; MR];
                for r in 0..MR {
                    let top = if tops[r] > largest[r] { tops[r] } else { largest[r] };
                    // SAFETY: no vector has more than 16 lanes.
                    shrink[r] = unsafe {
                        let mut lanes = [0f32; 16];
                        S::store(lanes.as_mut_ptr(), exp2::<S>(S::splat(largest[r] - top)));
                        lanes[0]
                    };
                    largest[r] = top;
                    let (logits, weights) = (&logits[r * BLOCK_KEYS..], &mut weights[r * BLOCK_KEYS / 2..]);
                    let sum = quantised_weights::<S>(logits, top - WEIGHT_LOG2, count.div_ceil(nr), weights);
                    total[r] = total[r] * shrink[r] + sum + (scales.key + scales.value) * 0.0;
                }
                let pairs = count.div_ceil(nr) * S::W;
                for (c, to) in sums.chunks_exact_mut(MR * nr).enumerate() {
                    let b = &values[c * layout.keys / 2 * nr..][..pairs * nr];
                    let a = &weights[..MR * BLOCK_KEYS / 2];
                    // SAFETY: `a` has MR rows of BLOCK_KEYS / 2 >= pairs, `b` `pairs` rows of two vectors, `to` MR such rows.
                    unsafe {
                        let zero = [[S::zero(); 2]; MR];
                        let acc = tile_of::<S, MR, Pairs>(pairs, a.as_ptr(), 1, BLOCK_KEYS / 2, b.as_ptr(), zero);
                        let value = S::splat(scales.value);
                        for r in 0..MR {
                            let keep = S::splat(shrink[r]);
                            for (half, sum) in acc[r].iter().enumerate() {
                                let at = to.as_mut_ptr().add(r * nr + half * S::W);
                                let before = S::mul(keep, S::load(at));
                                S::store(at, S::mul_add(S::whole_to_float(*sum), value, before));
                            }
                        }
                    }
                }
            }
            for r in 0..MR.min(queries - start) {
                let at = (batch * shape.tokens + first + start + r) * shape.width() + head * d;
                // SAFETY: batch, head and query block identify the task, so no other task writes these columns of this row.
                let row = unsafe { self.out.row(at, d) };
                put_row(row, sums, (MR, r), nr, total[r]);
            }
        }
    }
}

/// Logits of a row panel against `count` keys, rows of [`BLOCK_KEYS`]; past the last key of a tile the least float. Returns each
/// row's largest.
#[inline(always)]
fn block_logits<S: Simd, const MR: usize>(
    q: &[f32],
    depth: usize,
    keys: &[f32],
    factors: &[f32; MR],
    bias: Option<&[f32]>,
    count: usize,
    logits: &mut [f32],
) -> [f32; MR] {
    let nr = 2 * S::W;
    assert!(q.len() >= MR * depth && logits.len() >= MR * BLOCK_KEYS && count <= BLOCK_KEYS);
    let mut tops = [S::splat(f32::MIN); MR];
    for (j, b) in keys.chunks_exact(depth * nr).take(count.div_ceil(nr)).enumerate() {
        let valid = nr.min(count - j * nr);
        let start = start_at::<S>(bias, j * nr);
        // SAFETY: `q` has MR rows of `depth`, `b` `depth` rows of two vectors; `logits` MR rows of BLOCK_KEYS, of which panel
        // `j` is inside.
        unsafe {
            let zero = [[S::zero(); 2]; MR];
            let acc = tile_of::<S, MR, Pairs>(depth, q.as_ptr(), 1, depth, b.as_ptr(), zero);
            for r in 0..MR {
                let row = logits.as_mut_ptr().add(r * BLOCK_KEYS + j * nr);
                let factor = S::splat(factors[r]);
                let mut low = S::mul_add(S::whole_to_float(acc[r][0]), factor, start[0]);
                let mut high = S::mul_add(S::whole_to_float(acc[r][1]), factor, start[1]);
                S::store(row, low);
                S::store(row.add(S::W), high);
                if valid < nr {
                    (valid..nr).for_each(|c| row.add(c).write(f32::MIN));
                    (low, high) = (S::load(row), S::load(row.add(S::W)));
                }
                tops[r] = S::max_of(tops[r], S::max_of(low, high));
            }
        }
    }
    let mut largest = [0f32; MR];
    for r in 0..MR {
        largest[r] = S::largest(tops[r]);
    }
    largest
}

/// `2^(x - offset)` to the nearest whole number, which is in the low bits (a function, not a closure: see `kernels::math`).
#[inline(always)]
fn whole<S: Simd>(x: S::V, offset: S::V) -> S::V {
    let x = S::max_of(S::splat(WEIGHTLESS), S::sub(x, offset));
    S::add(exp2_rough::<S>(x), S::splat(ROUND))
}

/// Weights `2^(x - offset)` to the nearest whole number, as pairs across the vectors of each tile; returns their sum.
#[inline(always)]
fn quantised_weights<S: Simd>(logits: &[f32], offset: f32, tiles: usize, weights: &mut [f32]) -> f32 {
    let offset = S::splat(offset);
    // Both halves of a pair once: at most 128 pairs of two weights of 12 bits.
    let ones = S::splat(f32::from_bits(0x0001_0001));
    let mut sum = S::zero();
    for (logits, to) in logits.chunks_exact(2 * S::W).zip(weights.chunks_exact_mut(S::W)).take(tiles) {
        // SAFETY: two vectors of logits, one of pairs.
        unsafe {
            let low = whole::<S>(S::load(logits.as_ptr()), offset);
            let high = whole::<S>(S::load(logits.as_ptr().add(S::W)), offset);
            let pair = S::pair(low, high);
            sum = S::mul_add_pairs(pair, ones, sum);
            S::store(to.as_mut_ptr(), pair);
        }
    }
    S::sum(S::whole_to_float(sum))
}

/// [`super::attention_of`] in whole numbers.
///
/// Panics when the lengths disagree (callers take them from tensor shapes) or the machine lacks `isa`.
pub fn attention_in_pairs(isa: Isa, inputs: &Inputs<'_>, shape: Shape, out: &mut [f32]) {
    let isa = isa.for_pairs();
    inputs.check(&shape);
    assert_eq!(out.len(), shape.batch * shape.tokens * shape.width(), "output of {shape:?}");
    if out.is_empty() {
        return;
    }
    assert!(inputs.count > 0, "no keys");
    let bias = whole_blocks(inputs);
    let bias = bias.as_ref().map(|(bias, _)| &bias[..]);
    let layout = Layout::of_pairs(isa, shape.head_dim, inputs.count);
    let head_floats = layout.blocks * layout.block_floats;
    let mut memory = PACKED.take();
    let packed = memory.at_least(shape.batch * shape.heads * head_floats);
    let mut scales = vec![Scales::default(); shape.batch * shape.heads * layout.blocks];
    packed.par_chunks_exact_mut(layout.block_floats).zip(&mut scales).enumerate().for_each(|(index, (block, to))| {
        SCRATCH.with_borrow_mut(|Scratch { rows, .. }| {
            *to = dispatch(isa, Pack { inputs, shape: &shape, layout: &layout, index, block, rows });
        });
    });
    let packed = &*packed;
    let output = Output { start: out.as_mut_ptr(), len: out.len() };
    each_query_block(inputs, &shape, BLOCK_QUERIES, |source, head_index| {
        let blocks = &packed[head_index * head_floats..][..head_floats];
        let scales = &scales[head_index * layout.blocks..][..layout.blocks];
        // No rayon call happens inside, so a thread cannot come back here while it holds its scratch.
        SCRATCH.with_borrow_mut(|scratch| {
            dispatch(isa, Task { source, layout: &layout, blocks, scales, bias, scratch, out: output });
        });
    });
    PACKED.set(memory);
}

#[cfg(test)]
mod tests {
    use super::super::Rows;
    use super::super::tests::{NEARLY, reference};
    use super::*;
    use crate::kernels::tests::{noise, worst_difference};

    #[test]
    fn every_shape_with_and_without_bias() {
        let shapes = [
            (1, 1, 1, 1, 1),
            (1, 2, 5, 3, 8),
            (2, 20, 20, 4, 16),
            (1, 97, 30, 1, 64),
            (1, 30, 255, 2, 24),
            (1, 256, 257, 1, 33),
            (2, 101, 300, 2, 7),
            (1, 7, 700, 1, 72),
        ];
        for isa in Isa::tested() {
            for (i, &(batch, tokens, count, heads, head_dim)) in shapes.iter().enumerate() {
                let shape = Shape { batch, tokens, heads, head_dim };
                let width = heads * head_dim;
                let mut queries = noise(i as u64, batch * tokens * width, 1.0);
                // Some logits of tens, so that maxima move from block to block.
                queries.iter_mut().step_by(7).for_each(|x| *x *= 20.0);
                let both = noise(50 + i as u64, batch * count * 2 * width, 1.0);
                let bias: Vec<f32> = (0..count).map(|k| (k % 4) as f32).collect();
                for bias in [None, Some(&bias[..])] {
                    let inputs = Inputs {
                        queries: Rows { values: &queries, stride: width, first: 0 },
                        keys: Rows { values: &both, stride: 2 * width, first: 0 },
                        values: Rows { values: &both, stride: 2 * width, first: width },
                        count,
                        bias,
                    };
                    let want = reference(&inputs, shape);
                    let mut out = vec![f32::NAN; batch * tokens * width];
                    attention_in_pairs(isa, &inputs, shape, &mut out);
                    let worst = worst_difference(&out, &want);
                    assert!(worst < 4e-3, "{isa:?} {shape:?} {count} keys: {worst:e}");
                    out.fill(f32::NAN);
                    super::super::attention_of(isa, &inputs, shape, &mut out);
                    let worst = worst_difference(&out, &want);
                    assert!(worst < NEARLY, "f32: {isa:?} {shape:?} {count} keys: {worst:e}");
                }
            }
        }
    }

    #[test]
    fn nan_is_not_lost_and_threads_do_not_matter() {
        let shape = Shape { batch: 1, tokens: 140, heads: 2, head_dim: 8 };
        let width = shape.width();
        let qkv = noise(6, shape.tokens * 3 * width, 1.0);
        let run = |qkv: &[f32], threads: usize| {
            let mut out = vec![0.0; shape.tokens * width];
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                attention_in_pairs(Isa::detect(), &Inputs::joined(qkv, &shape), shape, &mut out);
            });
            out.iter().map(|x| x.to_bits()).collect::<Vec<_>>()
        };
        assert!(run(&qkv, 1) == run(&qkv, 3));
        let nan = |at: usize| {
            let mut poisoned = qkv.clone();
            poisoned[at] = f32::NAN;
            run(&poisoned, 2).iter().map(|&x| f32::from_bits(x).is_nan()).collect::<Vec<_>>()
        };
        for (i, is) in nan(17 * 3 * width + 3).into_iter().enumerate() {
            assert_eq!(is, i / width == 17 && i % width < 8, "query: element {i}");
        }
        // A key or a value reaches all rows of its head.
        for part in [1, 2] {
            for (i, is) in nan(20 * 3 * width + part * width + 9).into_iter().enumerate() {
                assert_eq!(is, i % width >= 8, "part {part}: element {i}");
            }
        }
    }
}
