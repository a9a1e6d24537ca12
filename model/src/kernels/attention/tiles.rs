//! Attention on AMX tile units: blocks of queries against blocks of keys as in [`super`], 32 queries at a time, both products
//! from [`crate::kernels::amx`], the softmax between them on vectors in f32. Weights go from the vectors' registers
//! to the left-hand tiles of the second product; keys and values are packed once per head.

use std::arch::x86_64::{_mm512_mask_mov_ps, _mm512_maskz_mov_ps};
use std::cell::RefCell;

use rayon::prelude::*;

use super::pack::{Inputs, Shape, Sizes, Source, larger, logit_scale, squares};
use super::{BLOCK_KEYS, FLAT_LOGITS, FLAT_VALUES, Output, PACKED, by_head, each_query_block, whole_blocks};
use crate::kernels::aligned::Aligned;
use crate::kernels::amx::{
    Configured, Parts, SIDE, STEP, TILE, column_tiles, product, product_onto, put, row_tiles, transpose, words_of,
};
use crate::kernels::math::{exp2, exp2_rough, exp2_short};
use crate::kernels::simd::{Avx512, Simd};

/// Queries of a task: keys and values are fetched from the third-level cache once for all of them.
const BLOCK_QUERIES: usize = 192;

type V = Avx512<true>;

/// Working memory of a task, kept by its thread.
#[derive(Default)]
struct Scratch {
    queries: Aligned,
    logits: Aligned,
    weights: Aligned,
    sums: Aligned,
    totals: Aligned,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// How one head's packed blocks lie: panels of 32 keys, then panels of 32 channels of values.
#[derive(Clone, Copy)]
struct Layout {
    parts: Parts,
    head_dim: usize,
    /// Of a panel of keys.
    key_floats: usize,
    /// Of a panel of values.
    value_floats: usize,
    block_floats: usize,
    blocks: usize,
}

impl Layout {
    fn new(parts: Parts, head_dim: usize, count: usize) -> Self {
        let room = BLOCK_KEYS.min(count.next_multiple_of(SIDE));
        let (key_floats, value_floats) = (parts.panel_floats(head_dim), parts.panel_floats(room));
        let block_floats = room / SIDE * key_floats + head_dim.div_ceil(SIDE) * value_floats;
        Self { parts, head_dim, key_floats, value_floats, block_floats, blocks: count.div_ceil(BLOCK_KEYS) }
    }

    /// A block's panels of keys, and of values.
    fn split<'a>(&self, block: &'a [f32]) -> (&'a [f32], &'a [f32]) {
        block.split_at(block.len() - self.head_dim.div_ceil(SIDE) * self.value_floats)
    }
}

/// Packs the keys and values of one block.
fn pack(inputs: &Inputs<'_>, shape: &Shape, layout: &Layout, index: usize, block: &mut [f32]) -> Sizes {
    let (head_index, first) = (index / layout.blocks, index % layout.blocks * BLOCK_KEYS);
    let (batch, head) = (head_index / shape.heads, head_index % shape.heads);
    let (d, parts) = (shape.head_dim, layout.parts);
    let count = BLOCK_KEYS.min(inputs.count - first);
    let row = |t: usize| batch * inputs.count + first + t;
    let values_at = block.len() - d.div_ceil(SIDE) * layout.value_floats;
    let (keys, values) = block.split_at_mut(values_at);
    for (panel, to) in keys.chunks_exact_mut(layout.key_floats).enumerate() {
        for half in 0..2 {
            let at = panel * SIDE + half * TILE;
            let key = |r: usize| (at + r < count).then(|| inputs.keys.head(row(at + r), head, d));
            // SAFETY: `Isa::Amx`, under which alone this runs, exists only where the features were detected.
            unsafe { row_tiles(parts, half, d, 1.0, key, to) };
        }
        // SAFETY: as above.
        unsafe { transpose(to) };
    }
    for (panel, to) in values.chunks_exact_mut(layout.value_floats).enumerate() {
        for half in 0..2 {
            let channel = (panel * SIDE + half * TILE).min(d);
            let value = |t: usize| &inputs.values.head(row(t), head, d)[channel..];
            // SAFETY: as above.
            unsafe { column_tiles(parts, half, count, value, to) };
        }
    }
    (0..count).fold(Sizes::default(), |sizes, t| {
        let (key, value) = (inputs.keys.head(row(t), head, d), inputs.values.head(row(t), head, d));
        sizes.or(Sizes { key: squares(key), value: squares(value) })
    })
}

/// One block of queries of one head, and what it needs.
struct Task<'a> {
    source: Source<'a>,
    layout: &'a Layout,
    /// Packed blocks of this head.
    blocks: &'a [f32],
    sizes: Sizes,
    /// Added to the logits, for whole blocks of keys; and its largest size.
    bias: Option<(&'a [f32], f32)>,
    scratch: &'a mut Scratch,
    out: Output,
    log_sums: Option<Output>,
}

/// Weights `2^logit` of a panel of 32 keys, `there` of them real, for logits within [`FLAT_LOGITS`]; `to` is the step of the
/// left-hand panel that they are, `totals` a vector a row.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,avx512vnni,avx2,fma")]
fn weigh_flat<const ONE: bool>(
    logits: &[f32],
    bias: Option<&[f32]>,
    there: usize,
    queries: usize,
    to: &mut [f32],
    totals: &mut [f32],
) {
    let parts = if ONE { Parts::One } else { Parts::Three };
    // SAFETY: a bias is of whole panels.
    let [low_bias, high_bias] = bias.map_or([V::zero(); 2], |b| unsafe {
        let b = &b[..SIDE];
        [V::load(b.as_ptr()), V::load(b[TILE..].as_ptr())]
    });
    let rows = logits.chunks_exact(SIDE).zip(totals.chunks_exact_mut(V::W)).take(queries);
    for (r, (logits, total)) in rows.enumerate() {
        // SAFETY: rows of two vectors, totals of one.
        let (mut low, mut high, sum) =
            unsafe { (V::load(logits.as_ptr()), V::load(logits[TILE..].as_ptr()), V::load(total.as_ptr())) };
        if bias.is_some() {
            (low, high) = (V::add(low, low_bias), V::add(high, high_bias));
        }
        // Where weights are rounded to bf16 a rough power is more than fine.
        (low, high) = match ONE {
            true => (exp2_rough::<V>(low), exp2_rough::<V>(high)),
            false => (exp2_short::<V>(low), exp2_short::<V>(high)),
        };
        if there < SIDE {
            (low, high) = (first_of(low, there), first_of(high, there.saturating_sub(TILE)));
        }
        put(parts, words_of(parts, low, high), r / TILE, r % TILE, to);
        // SAFETY: one vector.
        unsafe { V::store(total.as_mut_ptr(), V::add(sum, V::add(low, high))) };
    }
}

/// Logits of 32 queries, the largest of which is subtracted, and what becomes of them.
struct Rows<'a> {
    parts: Parts,
    /// Rows of `BLOCK_KEYS`.
    logits: &'a [f32],
    /// A left-hand panel.
    weights: &'a mut [f32],
    /// Rows of so many floats.
    sums: &'a mut [f32],
    sums_width: usize,
    /// A vector a row.
    totals: &'a mut [f32],
    /// The largest logit so far.
    largest: &'a mut [f32],
}

impl Rows<'_> {
    /// Turns the logits of `count` keys into weights.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,avx512vnni,avx2,fma")]
    fn weigh(&mut self, queries: usize, bias: Option<&[f32]>, count: usize) {
        let width = count.next_multiple_of(STEP);
        for r in 0..queries {
            let logits = &self.logits[r * BLOCK_KEYS..][..width];
            let total = &mut self.totals[r * V::W..][..V::W];
            // SAFETY: one vector, as just cut.
            let mut sum = unsafe { V::load(total.as_ptr()) };
            let before = self.largest[r];
            let mut tops = V::splat(before);
            for (at, one) in logits.chunks_exact(V::W).enumerate() {
                // SAFETY: the chunk is a vector, and so is the bias' there.
                let logit = unsafe { biased(one, bias, at * V::W) };
                let there = first_mask(count.saturating_sub(at * V::W));
                tops = _mm512_mask_mov_ps(tops, there, V::max_of(logit, tops));
            }
            self.largest[r] = V::largest(tops);
            let top = V::splat(self.largest[r]);
            let shrink = exp2::<V>(V::splat(before - self.largest[r]));
            sum = V::mul(sum, shrink);
            for part in self.sums[r * self.sums_width..][..self.sums_width].chunks_exact_mut(V::W) {
                // SAFETY: the chunk is a vector.
                unsafe { V::store(part.as_mut_ptr(), V::mul(shrink, V::load(part.as_ptr()))) };
            }
            let (half, row) = (r / TILE, r % TILE);
            let steps = self.weights.chunks_exact_mut(self.parts.step_floats());
            for (step, (two, to)) in logits.chunks_exact(STEP).zip(steps).enumerate() {
                // SAFETY: both halves are vectors, and so is the bias' there.
                let (a, b) = unsafe {
                    (biased(&two[..TILE], bias, step * STEP), biased(&two[TILE..], bias, step * STEP + TILE))
                };
                let (mut low, mut high) = (exp2::<V>(V::sub(a, top)), exp2::<V>(V::sub(b, top)));
                let there = count - step * STEP;
                if there < STEP {
                    (low, high) = (first_of(low, there), first_of(high, there.saturating_sub(TILE)));
                }
                sum = V::add(sum, V::add(low, high));
                put(self.parts, words_of(self.parts, low, high), half, row, to);
            }
            // SAFETY: one vector.
            unsafe { V::store(total.as_mut_ptr(), sum) };
        }
    }
}

/// # Safety
/// `logits` has a vector, `bias` one at `at`.
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn biased(logits: &[f32], bias: Option<&[f32]>, at: usize) -> <V as Simd>::V {
    // SAFETY: the caller's contract.
    unsafe {
        let x = V::load(logits.as_ptr());
        match bias {
            Some(bias) => V::add(x, V::load(bias[at..].as_ptr())),
            None => x,
        }
    }
}

/// The first `count` of 16.
#[inline(always)]
fn first_mask(count: usize) -> u16 {
    ((1u32 << count.min(TILE)) - 1) as u16
}

/// The first `count` values, zeros after them.
#[inline]
#[target_feature(enable = "avx512f")]
fn first_of(x: <V as Simd>::V, count: usize) -> <V as Simd>::V {
    _mm512_maskz_mov_ps(first_mask(count), x)
}

impl Task<'_> {
    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512bf16,avx512vnni,avx2,fma")]
    fn run(self) {
        let Source { inputs, shape, batch, head, first } = self.source;
        let (layout, parts, d) = (self.layout, self.layout.parts, shape.head_dim);
        let queries = BLOCK_QUERIES.min(shape.tokens - first);
        let panels = queries.div_ceil(SIDE);
        let sums_width = d.next_multiple_of(SIDE);
        let Scratch { queries: q, logits, weights, sums, totals } = self.scratch;
        let q = q.at_least(panels * layout.key_floats);
        let logits = logits.at_least(SIDE * BLOCK_KEYS);
        let weights = weights.at_least(parts.panel_floats(BLOCK_KEYS));
        let sums = sums.at_least(panels * SIDE * sums_width);
        let totals = totals.at_least(panels * SIDE * V::W);
        sums.fill(0.0);
        totals.fill(0.0);

        let mut longest = 0f32;
        for (panel, to) in q.chunks_exact_mut(layout.key_floats).enumerate() {
            for half in 0..2 {
                let at = panel * SIDE + half * TILE;
                let query = |r: usize| (at + r < queries).then(|| self.source.query(at + r));
                row_tiles(parts, half, d, logit_scale(d), query, to);
            }
        }
        for r in 0..queries {
            longest = larger(longest, squares(self.source.query(r)));
        }
        let longest = longest * logit_scale(d) * logit_scale(d);
        let room = FLAT_LOGITS - self.bias.map_or(0.0, |(_, largest)| largest);
        let flat =
            room >= 0.0 && longest * self.sizes.key <= room * room && self.sizes.value <= FLAT_VALUES * FLAT_VALUES;
        let mut largest = [f32::MIN; BLOCK_QUERIES];

        let tiles = Configured::new();
        let (depth, channels) = (d.div_ceil(STEP), d.div_ceil(SIDE));
        for (index, block) in self.blocks.chunks_exact(layout.block_floats).enumerate() {
            let count = BLOCK_KEYS.min(inputs.count - index * BLOCK_KEYS);
            let steps = count.div_ceil(STEP);
            let (keys, values) = layout.split(block);
            let bias = self.bias.map(|(bias, _)| &bias[index * BLOCK_KEYS..][..BLOCK_KEYS]);
            for (panel, a) in q.chunks_exact(layout.key_floats).enumerate() {
                let sums = &mut sums[panel * SIDE * sums_width..][..SIDE * sums_width];
                let totals = &mut totals[panel * SIDE * V::W..][..SIDE * V::W];
                let left = (queries - panel * SIDE).min(SIDE);
                let logits_of = |j: usize, logits: &mut [f32], stride: usize| {
                    assert!(logits.len() >= (SIDE - 1) * stride + SIDE);
                    let b = &keys[j * layout.key_floats..][..layout.key_floats];
                    // SAFETY: both panels have `depth` steps; `logits` 32 rows of 32, `stride` apart, as just asserted.
                    unsafe { product(&tiles, parts, depth, (a.as_ptr(), b.as_ptr()), logits.as_mut_ptr(), stride) };
                };
                if flat {
                    // A panel's products are under way while the one before is weighed.
                    let (even, odd) = logits.split_at_mut(SIDE * SIDE);
                    logits_of(0, even, SIDE);
                    for (j, to) in weights.chunks_exact_mut(parts.step_floats()).take(steps).enumerate() {
                        let (now, next) = if j % 2 == 0 { (&mut *even, &mut *odd) } else { (&mut *odd, &mut *even) };
                        if j + 1 < steps {
                            logits_of(j + 1, next, SIDE);
                        }
                        let bias = bias.map(|bias| &bias[j * SIDE..]);
                        let there = count - j * SIDE;
                        match parts {
                            Parts::One => weigh_flat::<true>(now, bias, there, left, to, totals),
                            _ => weigh_flat::<false>(now, bias, there, left, to, totals),
                        }
                    }
                } else {
                    (0..steps).for_each(|j| logits_of(j, &mut logits[j * SIDE..], BLOCK_KEYS));
                    let largest = &mut largest[panel * SIDE..][..SIDE];
                    let mut rows = Rows { parts, logits, weights, sums, sums_width, totals, largest };
                    rows.weigh(left, bias, count);
                }
                for c in 0..channels {
                    let (b, to) = (&values[c * layout.value_floats..], &mut sums[c * SIDE..]);
                    let both = (weights.as_ptr(), b.as_ptr());
                    // SAFETY: both panels have room for `steps` steps; `to` has 32 rows of `sums_width`, `c` inside.
                    unsafe { product_onto(&tiles, parts, steps, both, to.as_mut_ptr(), sums_width) };
                }
            }
        }
        drop(tiles);
        for r in 0..queries {
            // SAFETY: one vector a row.
            let total = V::sum(unsafe { V::load(totals[r * V::W..][..V::W].as_ptr()) });
            let at = (batch * shape.tokens + first + r) * shape.width() + head * d;
            // SAFETY: batch, head and query block identify the task, so no other task writes these columns of this row.
            let row = unsafe { self.out.row(at, d) };
            let scale = 1.0 / total;
            row.iter_mut().zip(&sums[r * sums_width..]).for_each(|(o, s)| *o = s * scale);
            if let Some(log_sums) = self.log_sums {
                // SAFETY: as above.
                let to = unsafe { log_sums.row((batch * shape.heads + head) * shape.tokens + first + r, 1) };
                to[0] = if flat { 0.0 } else { largest[r] } + total.log2();
            }
        }
    }
}

/// As [`super::run`], products in these parts.
pub(super) fn run(parts: Parts, inputs: &Inputs<'_>, shape: Shape, out: &mut [f32], log_sums: Option<Output>) {
    let bias = whole_blocks(inputs);
    let bias = bias.as_ref().map(|(bias, largest)| (&bias[..], *largest));
    let layout = Layout::new(parts, shape.head_dim, inputs.count);
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
            let task = Task { source, layout: &layout, blocks, sizes, bias, scratch, out: output, log_sums };
            // SAFETY: `Isa::Amx`, under which alone this runs, exists only where the features were detected.
            unsafe { task.run() };
        });
    });
    PACKED.set(memory);
}
