//! One tile, front to back: each splat sweeps the rows of its box, eight pixels at a time, and leaves its weights; then
//! every channel is one multiply-add per row, so that more channels cost little.

use super::settings::{ALPHA_FLOOR, ALPHA_MIN, TRANSMITTANCE_STOP};
use super::simd::{dispatch, exp2_neg_lanes, fma, prefetch};
use super::sort::{key_depth, key_slot};
use super::tiles::{Chunk, ChunkView, Record, TILE_H, TILE_W};

/// Pixels blended together.
const WIDTH: usize = 8;
/// Row pitch of the tile's buffers: a sweep may begin at the last pixel and run into the padding.
const PITCH: usize = TILE_W + WIDTH;
/// Channels every picture has: `sum(w)` and `sum(w z)`.
const BASE_PLANES: usize = 2;
/// Splats fetched together, so that their cache misses overlap.
const BATCH: usize = 32;
/// Numbers in a cache line.
const LINE_FLOATS: usize = 16;
/// Sign bit of an f32.
const SIGN: u32 = 1 << 31;

/// A tile and the splats it shows.
pub(crate) struct TileInput<'a> {
    /// Top left pixel.
    pub(crate) x0: usize,
    pub(crate) y0: usize,
    /// Size inside the picture, pixels.
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Nearest first.
    pub(crate) keys: &'a [u64],
    pub(crate) chunks: &'a [Chunk],
    /// log2 of the slots of a chunk.
    pub(crate) chunk_bits: u32,
    pub(crate) view: usize,
    pub(crate) features: &'a [f32],
    pub(crate) feature_count: usize,
    pub(crate) alpha_cap: f32,
}

/// The part of one picture row that a tile owns.
pub(crate) struct RowOut<'a> {
    pub(crate) features: &'a mut [f32],
    pub(crate) alpha: &'a mut [f32],
    pub(crate) depth: &'a mut [f32],
}

/// A splat cut to a tile.
#[derive(Clone, Copy)]
struct Cut {
    record: Record,
    depth: f32,
    id: u32,
    /// Box inside the tile.
    x0: usize,
    x1: usize,
    y0: usize,
    y1: usize,
}

/// A row of one plane.
type Row = [f32; PITCH];

/// Buffers of one tile, reused.
pub(crate) struct Scratch {
    /// Transmittance; negated once the pixel is finished, 0 outside the picture.
    transmittance: [Row; TILE_H],
    /// Per tile row: `sum(w)`, `sum(w z)`, then the features.
    sums: Vec<Row>,
    /// Per row, a bit for each unfinished pixel.
    live: [u32; TILE_H],
    /// Splats to blend now, and those to blend next.
    batch: Vec<Cut>,
    fetched: Vec<Cut>,
    /// For sorting.
    pub(crate) spare_keys: Vec<u64>,
}

const _: () = assert!(TILE_W == u32::BITS as usize, "a row of a tile is one u32 of live pixels");

impl Scratch {
    pub(crate) fn new() -> Self {
        Self {
            transmittance: [[0.0; PITCH]; TILE_H],
            sums: Vec::new(),
            live: [0; TILE_H],
            batch: Vec::with_capacity(BATCH),
            fetched: Vec::with_capacity(BATCH),
            spare_keys: Vec::new(),
        }
    }

    fn reset(&mut self, width: usize, height: usize, planes: usize) {
        self.sums.clear();
        self.sums.resize(TILE_H * planes, [0.0; PITCH]);
        for y in 0..TILE_H {
            let row_width = if y < height { width.min(TILE_W) } else { 0 };
            self.live[y] = low_bits(row_width);
            self.transmittance[y][..row_width].fill(1.0);
            self.transmittance[y][row_width..].fill(0.0);
        }
    }

    /// Writes the tile into its rows of the picture.
    pub(crate) fn write(&self, rows: &mut [RowOut], feature_count: usize) {
        let planes = BASE_PLANES + feature_count;
        for (row, sums) in rows.iter_mut().zip(self.sums.chunks_exact(planes)) {
            let [weight, weighted_depth, features @ ..] = sums else { continue };
            let pixels = row.alpha.iter_mut().zip(row.depth.iter_mut());
            for ((alpha, depth), (w, wz)) in pixels.zip(weight.iter().zip(weighted_depth)) {
                *alpha = w.min(1.0);
                *depth = wz / w.max(ALPHA_FLOOR);
            }
            for (channel, source) in features.iter().enumerate() {
                for (pixel, &value) in row.features.chunks_exact_mut(feature_count).zip(source) {
                    // Weights add up to 1 give or take rounding, which features near f32::MAX do not forgive.
                    pixel[channel] = value.clamp(f32::MIN, f32::MAX);
                }
            }
        }
    }
}

/// The `count` lowest bits; all of them from 32 on.
#[inline(always)]
fn low_bits(count: usize) -> u32 {
    if count >= 32 { u32::MAX } else { (1 << count) - 1 }
}

dispatch!(
    /// Blends the splats of a tile into `scratch`.
    blend_tile, blend_tile_kernel, (input: &TileInput<'_>, scratch: &mut Scratch)
);

#[inline(always)]
fn blend_tile_kernel<const FMA: bool>(input: &TileInput, scratch: &mut Scratch) {
    scratch.reset(input.width, input.height, BASE_PLANES + input.feature_count);
    let batch = |index: usize| {
        let keys = input.keys.get(index * BATCH..).unwrap_or_default();
        keys.get(..BATCH).unwrap_or(keys)
    };
    // While one batch is blended, the next has its features on the way and the one after that its records.
    prefetch_records(input, batch(0));
    prefetch_records(input, batch(1));
    fetch(input, batch(0), scratch);
    for index in 0..input.keys.len().div_ceil(BATCH) {
        std::mem::swap(&mut scratch.batch, &mut scratch.fetched);
        prefetch_records(input, batch(index + 2));
        fetch(input, batch(index + 1), scratch);
        for cut in &scratch.batch {
            if is_live(&scratch.live, cut) {
                blend_splat::<FMA>(input, cut, &mut scratch.transmittance, &mut scratch.sums, &mut scratch.live);
            }
        }
        if scratch.live.iter().fold(0, |a, b| a | b) == 0 {
            break;
        }
    }
}

/// True when a pixel of the box is unfinished.
#[inline(always)]
fn is_live(live: &[u32; TILE_H], cut: &Cut) -> bool {
    let columns = low_bits(cut.x1 - cut.x0) << cut.x0;
    live[cut.y0..cut.y1].iter().fold(0, |a, b| a | b) & columns != 0
}

/// The chunk and the position in it that a key stands for.
#[inline(always)]
fn locate<'a>(input: &TileInput<'a>, key: u64) -> (&'a ChunkView, usize) {
    let slot = key_slot(key);
    (&input.chunks[slot >> input.chunk_bits].views[input.view], slot & ((1 << input.chunk_bits) - 1))
}

/// Asks for the records and ids of a batch.
#[inline(always)]
fn prefetch_records(input: &TileInput, keys: &[u64]) {
    for &key in keys {
        let (view, at) = locate(input, key);
        prefetch(&view.records, at);
        prefetch(&view.ids, at);
    }
}

/// Reads the records of a batch, keeps the splats that may still add something, and asks for their features.
#[inline(always)]
fn fetch(input: &TileInput, keys: &[u64], scratch: &mut Scratch) {
    scratch.fetched.clear();
    for &key in keys {
        let (view, at) = locate(input, key);
        let record = view.records[at];
        let cut = Cut {
            record,
            depth: key_depth(key),
            id: view.ids[at],
            x0: usize::from(record.x0).max(input.x0) - input.x0,
            x1: usize::from(record.x1).min(input.x0 + input.width) - input.x0,
            y0: usize::from(record.y0).max(input.y0) - input.y0,
            y1: usize::from(record.y1).min(input.y0 + input.height) - input.y0,
        };
        if is_live(&scratch.live, &cut) {
            let first = cut.id as usize * input.feature_count;
            for at in (first..first + input.feature_count).step_by(LINE_FLOATS) {
                prefetch(input.features, at);
            }
            scratch.fetched.push(cut);
        }
    }
}

/// `0` for the lanes below the index, infinity from there on.
const EDGE: [[f32; WIDTH]; WIDTH + 1] = {
    let mut table = [[f32::INFINITY; WIDTH]; WIDTH + 1];
    let mut columns = 0;
    while columns <= WIDTH {
        let mut l = 0;
        while l < columns {
            table[columns][l] = 0.0;
            l += 1;
        }
        columns += 1;
    }
    table
};

/// Blends one splat, strip by strip of eight columns.
#[inline(always)]
fn blend_splat<const FMA: bool>(
    input: &TileInput,
    cut: &Cut,
    transmittance: &mut [Row; TILE_H],
    sums: &mut [Row],
    live: &mut [u32; TILE_H],
) {
    let record = &cut.record;
    let features = &input.features[cut.id as usize * input.feature_count..][..input.feature_count];
    let planes = BASE_PLANES + features.len();
    // The tile's corner seen from the centre; the whole numbers are exact, so small boxes keep all digits.
    let left = (input.x0 as f32 - f32::from(record.x0)) + 0.5;
    let top = (input.y0 as f32 - f32::from(record.y0)) + 0.5;
    for strip in (cut.x0..cut.x1).step_by(WIDTH) {
        // Outside the box (the rule's tiles may cut the ellipse short) alpha becomes 0.
        let mut dx = EDGE[(cut.x1 - strip).min(WIDTH)];
        let first = left + strip as f32 - record.u;
        for l in 0..WIDTH {
            dx[l] += first + l as f32;
        }
        let mut finished = [0u32; WIDTH];
        let rows = transmittance[cut.y0..cut.y1].iter_mut();
        let sums = sums[cut.y0 * planes..].chunks_exact_mut(planes);
        for ((y, row), sums) in (cut.y0..cut.y1).zip(rows).zip(sums) {
            let dy = top + y as f32 - record.v;
            let shift = record.slope * dy;
            let along = record.along * dy * dy;
            let Some(before) = row[strip..].first_chunk_mut::<WIDTH>() else { continue };
            let mut falloff = [0.0; WIDTH];
            for l in 0..WIDTH {
                let across = dx[l] - shift;
                falloff[l] = fma::<FMA>(record.across * across, across, along);
            }
            exp2_neg_lanes::<FMA>(&mut falloff);
            let step = shade(&falloff, before, record.opacity, input.alpha_cap);
            *before = step.after;
            for l in 0..WIDTH {
                finished[l] |= step.finished[l];
            }
            let [weight_sum, weighted_depth, feature_sums @ ..] = sums else { continue };
            add::<FMA>(weight_sum, strip, &step.weight, 1.0);
            add::<FMA>(weighted_depth, strip, &step.weight, cut.depth);
            for (sum, &feature) in feature_sums.iter_mut().zip(features) {
                add::<FMA>(sum, strip, &step.weight, feature);
            }
        }
        if finished.iter().fold(0, |a, b| a | b) != 0 {
            retire(live, transmittance, cut.y0..cut.y1, strip);
        }
    }
}

/// `sum += weight * value` at eight pixels of a row.
#[inline(always)]
fn add<const FMA: bool>(sum: &mut Row, strip: usize, weight: &[f32; WIDTH], value: f32) {
    if let Some(sum) = sum[strip..].first_chunk_mut::<WIDTH>() {
        for l in 0..WIDTH {
            sum[l] = fma::<FMA>(weight[l], value, sum[l]);
        }
    }
}

/// What a splat does to eight pixels.
struct Step {
    weight: [f32; WIDTH],
    after: [f32; WIDTH],
    /// All ones where the splat finishes the pixel, else 0.
    finished: [u32; WIDTH],
}

/// Weights of a splat whose falloff and whose pixels' transmittance are given. One operation per loop, conditions as
/// bit masks: straight-line code the compiler reliably turns into vectors.
#[inline(always)]
fn shade(falloff: &[f32; WIDTH], before: &[f32; WIDTH], opacity: f32, alpha_cap: f32) -> Step {
    let (mut alpha, mut hit, mut weight) = ([0.0f32; WIDTH], [0u32; WIDTH], [0.0f32; WIDTH]);
    let (mut after, mut finished) = ([0.0f32; WIDTH], [0u32; WIDTH]);
    for l in 0..WIDTH {
        alpha[l] = opacity * falloff[l];
    }
    for l in 0..WIDTH {
        alpha[l] = if alpha[l] < alpha_cap { alpha[l] } else { alpha_cap };
    }
    for l in 0..WIDTH {
        hit[l] = mask(alpha[l] >= ALPHA_MIN) & mask(before[l] > 0.0);
    }
    for l in 0..WIDTH {
        weight[l] = f32::from_bits((alpha[l] * before[l]).to_bits() & hit[l]);
    }
    for l in 0..WIDTH {
        after[l] = before[l] - weight[l];
    }
    for l in 0..WIDTH {
        finished[l] = mask(after[l] <= TRANSMITTANCE_STOP) & hit[l];
    }
    for l in 0..WIDTH {
        weight[l] = f32::from_bits(weight[l].to_bits() & !finished[l]);
    }
    for l in 0..WIDTH {
        // A finished pixel keeps its transmittance, negated.
        let kept = (before[l].to_bits() ^ SIGN) & finished[l];
        after[l] = f32::from_bits((after[l].to_bits() & !finished[l]) | kept);
    }
    Step { weight, after, finished }
}

/// All ones or 0.
#[inline(always)]
fn mask(condition: bool) -> u32 {
    0u32.wrapping_sub(u32::from(condition))
}

/// Clears the live bits of the pixels a strip has finished.
#[cold]
#[inline(never)]
fn retire(live: &mut [u32; TILE_H], transmittance: &[Row; TILE_H], rows: std::ops::Range<usize>, strip: usize) {
    for (bits, row) in live[rows.clone()].iter_mut().zip(&transmittance[rows]) {
        for (x, &t) in row.iter().enumerate().skip(strip).take(WIDTH.min(TILE_W - strip)) {
            *bits &= !(u32::from(t < 0.0) << x);
        }
    }
}
