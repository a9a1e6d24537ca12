//! The layouts attention reads: keys and values in panels of tile columns, queries in panels of tile rows.

use super::BLOCK_KEYS;
use crate::kernels::Isa;

/// The sizes of one call.
#[derive(Debug, Clone, Copy)]
pub struct Shape {
    /// Independent sequences.
    pub batch: usize,
    /// Tokens of each.
    pub tokens: usize,
    /// Heads.
    pub heads: usize,
    /// Channels of a head.
    pub head_dim: usize,
}

impl Shape {
    /// Channels of the result.
    pub(super) fn width(&self) -> usize {
        self.heads * self.head_dim
    }
}

/// Rows of several heads' channels inside a wider matrix.
#[derive(Debug, Clone, Copy)]
pub struct Rows<'a> {
    /// The matrix.
    pub values: &'a [f32],
    /// Its columns.
    pub stride: usize,
    /// The first head's first column.
    pub first: usize,
}

impl<'a> Rows<'a> {
    /// One head's `d` channels of a row.
    #[inline(always)]
    pub(super) fn head(&self, row: usize, head: usize, d: usize) -> &'a [f32] {
        &self.values[row * self.stride + self.first + head * d..][..d]
    }
}

/// What attention is taken of.
#[derive(Debug, Clone, Copy)]
pub struct Inputs<'a> {
    /// `batch * tokens` rows.
    pub queries: Rows<'a>,
    /// `batch * count` rows.
    pub keys: Rows<'a>,
    /// As many.
    pub values: Rows<'a>,
    /// Keys of each sequence.
    pub count: usize,
    /// Added to the logits of each key, in units of log 2: `(count)`, the same for all sequences.
    pub bias: Option<&'a [f32]>,
}

impl<'a> Inputs<'a> {
    /// Of rows `[q | k | v]`.
    pub(super) fn joined(qkv: &'a [f32], shape: &Shape) -> Self {
        let rows = |part: usize| Rows { values: qkv, stride: 3 * shape.width(), first: part * shape.width() };
        Self { queries: rows(0), keys: rows(1), values: rows(2), count: shape.tokens, bias: None }
    }

    /// Panics unless the lengths fit.
    pub(super) fn check(&self, shape: &Shape) {
        let fits = |rows: &Rows<'_>, count: usize| {
            rows.values.len() == shape.batch * count * rows.stride && rows.first + shape.width() <= rows.stride
        };
        let all = fits(&self.queries, shape.tokens) && fits(&self.keys, self.count) && fits(&self.values, self.count);
        assert!(all, "queries, {} keys and values of {shape:?}", self.count);
        assert!(self.bias.is_none_or(|b| b.len() == self.count), "bias of {} keys", self.count);
    }
}

/// How the packed keys and values of one block of keys lie in memory.
#[derive(Clone, Copy)]
pub(super) struct Layout {
    /// Floats of a register tile's row.
    pub(super) nr: usize,
    /// `head_dim` rounded up to whole tiles.
    pub(super) value_dim: usize,
    /// Keys a block has room for: fewer than [`BLOCK_KEYS`] only for sequences shorter than that.
    pub(super) keys: usize,
    /// Floats of a block's keys; its values follow.
    pub(super) key_floats: usize,
    /// Floats of a block.
    pub(super) block_floats: usize,
    /// Blocks of a head.
    pub(super) blocks: usize,
}

impl Layout {
    pub(super) fn new(isa: Isa, head_dim: usize, count: usize) -> Self {
        let nr = isa.tile_cols();
        let value_dim = head_dim.next_multiple_of(nr);
        let keys = BLOCK_KEYS.min(count.next_multiple_of(nr));
        let key_floats = keys * head_dim;
        let block_floats = (key_floats + keys * value_dim).next_multiple_of(16);
        Self { nr, value_dim, keys, key_floats, block_floats, blocks: count.div_ceil(BLOCK_KEYS) }
    }

    /// The same for pairs of whole numbers: of channels in keys, of keys in values.
    pub(super) fn of_pairs(isa: Isa, head_dim: usize, count: usize) -> Self {
        let floats = Self::new(isa, head_dim, count);
        let key_floats = floats.keys * head_dim.div_ceil(2);
        let block_floats = (key_floats + floats.keys / 2 * floats.value_dim).next_multiple_of(16);
        Self { key_floats, block_floats, ..floats }
    }
}

/// How large what a block holds is; NaN where it holds one.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sizes {
    /// Longest key, squared.
    pub(super) key: f32,
    /// Longest value, squared.
    pub(super) value: f32,
}

impl Sizes {
    /// The larger of both, NaN before anything.
    pub(super) fn or(self, other: Self) -> Self {
        Self { key: larger(self.key, other.key), value: larger(self.value, other.value) }
    }
}

/// The larger number, or NaN if there is one.
#[inline(always)]
pub(super) fn larger(a: f32, b: f32) -> f32 {
    if a >= b || a.is_nan() { a } else { b }
}

/// Sum of squares over eight interleaved partial sums.
#[inline(always)]
pub(super) fn squares(x: &[f32]) -> f32 {
    let mut partial = [0f32; 8];
    let mut chunks = x.chunks_exact(8);
    for chunk in &mut chunks {
        for l in 0..8 {
            partial[l] += chunk[l] * chunk[l];
        }
    }
    partial.iter().sum::<f32>() + chunks.remainder().iter().map(|v| v * v).sum::<f32>()
}

/// Packs the keys `(panel, channel, key)` and values `(panel, key, channel)` of one block, with zeros where there are none.
pub(super) fn pack(inputs: &Inputs<'_>, shape: &Shape, layout: &Layout, index: usize, block: &mut [f32]) -> Sizes {
    let (head_index, first) = (index / layout.blocks, index % layout.blocks * BLOCK_KEYS);
    let (batch, head) = (head_index / shape.heads, head_index % shape.heads);
    let (d, nr) = (shape.head_dim, layout.nr);
    let (keys, values) = block.split_at_mut(layout.key_floats);
    let count = BLOCK_KEYS.min(inputs.count - first);
    keys[count / nr * d * nr..].fill(0.0);
    let mut sizes = Sizes::default();
    for t in 0..count {
        let row = batch * inputs.count + first + t;
        let key = inputs.keys.head(row, head, d);
        let panel = &mut keys[t / nr * d * nr..][..d * nr];
        for (c, &x) in key.iter().enumerate() {
            panel[c * nr + t % nr] = x;
        }
        let value = inputs.values.head(row, head, d);
        for (p, part) in value.chunks(nr).enumerate() {
            let to = &mut values[(p * layout.keys + t) * nr..][..nr];
            to[..part.len()].copy_from_slice(part);
            to[part.len()..].fill(0.0);
        }
        sizes = sizes.or(Sizes { key: squares(key), value: squares(value) });
    }
    sizes
}

/// One block of queries of one head.
#[derive(Clone, Copy)]
pub(super) struct Source<'a> {
    pub(super) inputs: &'a Inputs<'a>,
    pub(super) shape: &'a Shape,
    pub(super) batch: usize,
    pub(super) head: usize,
    pub(super) first: usize,
}

/// What products of queries and keys are multiplied by to be logits in units of log 2.
pub(super) fn logit_scale(head_dim: usize) -> f32 {
    std::f32::consts::LOG2_E / (head_dim as f32).sqrt()
}

impl<'a> Source<'a> {
    /// Query `index` of the block.
    #[inline(always)]
    pub(super) fn query(&self, index: usize) -> &'a [f32] {
        let row = self.batch * self.shape.tokens + self.first + index;
        self.inputs.queries.head(row, self.head, self.shape.head_dim)
    }

    /// Row panels of `MR` queries, scaled; the last query again past the end. Returns the square of the longest scaled query.
    #[inline(always)]
    pub(super) fn pack_queries<const MR: usize>(&self, packed: &mut [f32], queries: usize) -> f32 {
        let d = self.shape.head_dim;
        let scale = logit_scale(d);
        let mut longest = 0f32;
        let panels = packed.chunks_exact_mut(d * MR).take(queries.div_ceil(MR));
        for (i, panel) in panels.enumerate() {
            // All rows at a time: they lie far apart, and their misses overlap.
            let rows: [&[f32]; MR] = std::array::from_fn(|r| self.query((i * MR + r).min(queries - 1)));
            for (c, column) in panel.chunks_exact_mut(MR).enumerate() {
                for r in 0..MR {
                    column[r] = rows[r][c] * scale;
                }
            }
            for row in rows {
                longest = larger(longest, squares(row));
            }
        }
        longest * scale * scale
    }
}

/// Rows `(token, channel)` of one head inside a wider matrix.
#[derive(Clone, Copy)]
pub(super) struct Head<'a> {
    pub(super) values: &'a [f32],
    pub(super) first: usize,
    pub(super) stride: usize,
    pub(super) dim: usize,
    pub(super) tokens: usize,
}

impl Head<'_> {
    #[inline(always)]
    pub(super) fn row(&self, token: usize) -> &[f32] {
        &self.values[self.first + token * self.stride..][..self.dim]
    }

    /// Panels of `width` tokens, each channel by channel; tokens past the end are zeros.
    #[inline(always)]
    pub(super) fn across(&self, width: usize, scale: f32, to: &mut [f32]) {
        let panel = self.dim * width;
        to[self.tokens / width * panel..].fill(0.0);
        for t in 0..self.tokens {
            let to = &mut to[t / width * panel + t % width..];
            for (c, x) in self.row(t).iter().enumerate() {
                to[c * width] = x * scale;
            }
        }
    }

    /// Panels of `width` channels, each token by token, `room` tokens to a panel.
    #[inline(always)]
    pub(super) fn along(&self, width: usize, room: usize, to: &mut [f32]) {
        for t in 0..self.tokens {
            for (p, part) in self.row(t).chunks(width).enumerate() {
                to[(p * room + t) * width..][..part.len()].copy_from_slice(part);
            }
        }
    }
}
