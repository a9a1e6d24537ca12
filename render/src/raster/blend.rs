//! One tile, front to back: each splat sweeps the rows of its box, eight pixels at a time, and leaves its weights; then
//! every channel is one multiply-add per row, so that more channels cost little.

use super::settings::{ALPHA_FLOOR, ALPHA_MIN, TRANSMITTANCE_STOP};
use super::simd::{dispatch, exp2_neg, fma};
use super::sort::{key_depth, key_slot};
use super::tiles::{Chunk, Record, TILE_H, TILE_W};

/// Pixels blended together.
const WIDTH: usize = 8;
/// Row pitch of the tile's buffers: a sweep may begin at the last pixel and run into the padding.
const PITCH: usize = TILE_W + WIDTH;
/// Numbers in one channel's buffer.
const PLANE: usize = TILE_H * PITCH;
/// Channels every picture has: `sum(w)` and `sum(w z)`.
const BASE_PLANES: usize = 2;
/// Splats fetched together, so that their cache misses overlap.
const BATCH: usize = 32;

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

/// Buffers of one tile, reused.
pub(crate) struct Scratch {
    /// Transmittance; negated once the pixel is finished, 0 outside the picture.
    transmittance: Box<[f32; PLANE]>,
    /// `sum(w)`, `sum(w z)`, then the features, one plane each.
    planes: Vec<f32>,
    /// Per row, a bit for each unfinished pixel.
    live: [u32; TILE_H],
    weights: [[f32; WIDTH]; TILE_H],
    batch: Vec<Cut>,
    batch_features: Vec<f32>,
    /// For sorting.
    pub(crate) spare_keys: Vec<u64>,
}

const _: () = assert!(TILE_W == u32::BITS as usize, "a row of a tile is one u32 of live pixels");

impl Scratch {
    pub(crate) fn new() -> Self {
        Self {
            transmittance: Box::new([0.0; PLANE]),
            planes: Vec::new(),
            live: [0; TILE_H],
            weights: [[0.0; WIDTH]; TILE_H],
            batch: Vec::with_capacity(BATCH),
            batch_features: Vec::new(),
            spare_keys: Vec::new(),
        }
    }

    fn reset(&mut self, width: usize, height: usize, feature_count: usize) {
        self.planes.clear();
        self.planes.resize(PLANE * (BASE_PLANES + feature_count), 0.0);
        self.batch_features.resize(BATCH * feature_count, 0.0);
        for y in 0..TILE_H {
            let row_width = if y < height { width.min(TILE_W) } else { 0 };
            self.live[y] = low_bits(row_width);
            let row = &mut self.transmittance[y * PITCH..(y + 1) * PITCH];
            row[..row_width].fill(1.0);
            row[row_width..].fill(0.0);
        }
    }

    /// Writes the tile into its rows of the picture.
    pub(crate) fn write(&self, rows: &mut [RowOut], feature_count: usize) {
        let (base, features) = self.planes.split_at(BASE_PLANES * PLANE);
        for (y, row) in rows.iter_mut().enumerate() {
            let pixels = row.alpha.len();
            let weight = &base[y * PITCH..][..pixels];
            let weighted_depth = &base[PLANE + y * PITCH..][..pixels];
            for x in 0..pixels {
                row.alpha[x] = weight[x].min(1.0);
                row.depth[x] = weighted_depth[x] / weight[x].max(ALPHA_FLOOR);
            }
            for channel in 0..feature_count {
                let source = &features[channel * PLANE + y * PITCH..][..pixels];
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
    scratch.reset(input.width, input.height, input.feature_count);
    for keys in input.keys.chunks(BATCH) {
        fetch(input, keys, scratch);
        for j in 0..scratch.batch.len() {
            let cut = scratch.batch[j];
            if is_live(&scratch.live, &cut) {
                blend_splat::<FMA>(input, &cut, j, scratch);
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

/// Copies the records, and then the features, of those splats of a batch that may still add something.
#[inline(always)]
fn fetch(input: &TileInput, keys: &[u64], scratch: &mut Scratch) {
    scratch.batch.clear();
    let slot_mask = (1usize << input.chunk_bits) - 1;
    for &key in keys {
        let slot = key_slot(key);
        let view = &input.chunks[slot >> input.chunk_bits].views[input.view];
        let at = slot & slot_mask;
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
            scratch.batch.push(cut);
        }
    }
    let channels = input.feature_count;
    if channels > 0 {
        for (cut, row) in scratch.batch.iter().zip(scratch.batch_features.chunks_exact_mut(channels)) {
            row.copy_from_slice(&input.features[cut.id as usize * channels..][..channels]);
        }
    }
}

/// Blends one splat, strip by strip of eight columns.
#[inline(always)]
fn blend_splat<const FMA: bool>(input: &TileInput, cut: &Cut, in_batch: usize, scratch: &mut Scratch) {
    let record = &cut.record;
    let features = &scratch.batch_features[in_batch * input.feature_count..][..input.feature_count];
    // The tile's corner seen from the box's corner: small whole numbers, exact in f32.
    let from_box_x = input.x0 as f32 - f32::from(record.x0);
    let from_box_y = input.y0 as f32 - f32::from(record.y0);
    let rows = cut.y1 - cut.y0;
    for strip in (cut.x0..cut.x1).step_by(WIDTH) {
        let columns = cut.x1 - strip;
        let mut dx = [0.0f32; WIDTH];
        for l in 0..WIDTH {
            let offset = from_box_x + (strip + l) as f32 + 0.5 - record.u;
            // Outside the box (the rule's tiles may cut the ellipse short) alpha becomes 0.
            dx[l] = if l < columns { offset } else { f32::INFINITY };
        }
        let mut finished = [0u32; WIDTH];
        for row in 0..rows {
            let dy = from_box_y + (cut.y0 + row) as f32 + 0.5 - record.v;
            let shift = record.slope * dy;
            let along = record.along * dy * dy;
            let at = (cut.y0 + row) * PITCH + strip;
            let Some(transmittance) = scratch.transmittance[at..].first_chunk_mut::<WIDTH>() else { continue };
            let weights = &mut scratch.weights[row];
            for l in 0..WIDTH {
                let across = dx[l] - shift;
                let exponent = fma::<FMA>(record.across * across, across, along);
                let falloff = record.opacity * exp2_neg::<FMA>(exponent);
                let alpha = if falloff < input.alpha_cap { falloff } else { input.alpha_cap };
                let before = transmittance[l];
                let hit = (alpha >= ALPHA_MIN) & (before > 0.0);
                let weight = if hit { alpha * before } else { 0.0 };
                let after = before - weight;
                let stop = hit & (after <= TRANSMITTANCE_STOP);
                transmittance[l] = if stop { -before } else { after };
                weights[l] = if stop { 0.0 } else { weight };
                finished[l] |= u32::from(stop);
            }
        }
        let planes = &mut scratch.planes;
        let at = cut.y0 * PITCH + strip;
        let weights = &scratch.weights[..rows];
        accumulate::<FMA>(&mut planes[at..], weights, 1.0);
        accumulate::<FMA>(&mut planes[PLANE + at..], weights, cut.depth);
        for (channel, &value) in features.iter().enumerate() {
            accumulate::<FMA>(&mut planes[(BASE_PLANES + channel) * PLANE + at..], weights, value);
        }
        if finished.iter().fold(0, |a, b| a | b) != 0 {
            retire(&mut scratch.live, &scratch.transmittance, cut.y0..cut.y1, strip);
        }
    }
}

/// `plane += weights * value` over the rows of a strip.
#[inline(always)]
fn accumulate<const FMA: bool>(plane: &mut [f32], weights: &[[f32; WIDTH]], value: f32) {
    for (row, weight) in weights.iter().enumerate() {
        let Some(target) = plane[row * PITCH..].first_chunk_mut::<WIDTH>() else { continue };
        for l in 0..WIDTH {
            target[l] = fma::<FMA>(weight[l], value, target[l]);
        }
    }
}

/// Clears the live bits of the pixels a strip has finished.
#[cold]
#[inline(never)]
fn retire(live: &mut [u32; TILE_H], transmittance: &[f32; PLANE], rows: std::ops::Range<usize>, strip: usize) {
    for row in rows {
        for x in strip..(strip + WIDTH).min(TILE_W) {
            if transmittance[row * PITCH + x] < 0.0 {
                live[row] &= !(1 << x);
            }
        }
    }
}
