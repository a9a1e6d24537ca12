//! One tile as blending sees it, in either direction: its splats cut to it, its rows, and how it ended.

use super::grid::{Record, TILE_H, TILE_W};
use super::simd::prefetch;
use super::sort::{key_depth, key_slot};
use super::tiles::{Chunk, ChunkView};

/// Pixels blended together.
pub(crate) const WIDTH: usize = 8;
/// Row pitch of the tile's buffers: a sweep may begin at the last pixel and run into the padding.
pub(crate) const PITCH: usize = TILE_W + WIDTH;
/// Splats fetched together, so that their cache misses overlap.
pub(crate) const BATCH: usize = 32;
/// Numbers in a cache line.
const LINE_FLOATS: usize = 16;

const _: () = assert!(TILE_W == u32::BITS as usize, "a row of a tile is one u32 of live pixels");

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
    pub(crate) features: FeatureRows<'a>,
    pub(crate) alpha_cap: f32,
}

/// The channels to draw of every Gaussian's row of features.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FeatureRows<'a> {
    pub(crate) values: &'a [f32],
    /// Channels of a Gaussian.
    pub(crate) stride: usize,
    /// First channel drawn.
    pub(crate) first: usize,
    /// Channels drawn.
    pub(crate) count: usize,
}

impl<'a> FeatureRows<'a> {
    /// All channels.
    pub(crate) fn all(values: &'a [f32], count: usize) -> Self {
        Self { values, stride: count, first: 0, count }
    }

    /// The drawn channels of Gaussian `id`.
    #[inline(always)]
    pub(crate) fn of(&self, id: u32) -> &'a [f32] {
        &self.values[id as usize * self.stride + self.first..][..self.count]
    }

    /// Asks for them.
    #[inline(always)]
    pub(crate) fn prefetch(&self, id: u32) {
        let first = id as usize * self.stride + self.first;
        for at in (first..first + self.count).step_by(LINE_FLOATS) {
            prefetch(self.values, at);
        }
    }
}

/// A splat cut to a tile.
#[derive(Clone, Copy)]
pub(crate) struct Cut {
    pub(crate) record: Record,
    pub(crate) depth: f32,
    pub(crate) id: u32,
    /// Position in the tile's list.
    pub(crate) position: u32,
    /// Box inside the tile.
    pub(crate) x0: usize,
    pub(crate) x1: usize,
    pub(crate) y0: usize,
    pub(crate) y1: usize,
}

impl Cut {
    /// The splat at `position` of the tile's list.
    #[inline(always)]
    pub(crate) fn new(input: &TileInput, position: usize, key: u64) -> Self {
        let (view, at) = locate(input, key);
        let record = view.records[at];
        Self {
            record,
            depth: key_depth(key),
            id: view.ids[at],
            position: position as u32,
            x0: usize::from(record.x0).max(input.x0) - input.x0,
            x1: usize::from(record.x1).min(input.x0 + input.width) - input.x0,
            y0: usize::from(record.y0).max(input.y0) - input.y0,
            y1: usize::from(record.y1).min(input.y0 + input.height) - input.y0,
        }
    }
}

/// A row of one plane.
pub(crate) type Row = [f32; PITCH];

/// A pixel that was full before its list ended.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Finished {
    /// Position in the tile's list of the splat that finished it (and was left out).
    pub(crate) position: u32,
    /// Pixel in the tile.
    pub(crate) x: u8,
    pub(crate) y: u8,
}

/// How a tile's blending ended: where the backward pass begins.
#[derive(Debug, Default)]
pub(crate) struct TileEnd {
    /// Transmittance behind the last splat, rows of `TILE_W`; negative where the pixel was finished.
    pub(crate) transmittance: Vec<f32>,
    /// Finished pixels, positions ascending.
    pub(crate) finished: Vec<Finished>,
}

impl TileEnd {
    /// Keeps how a tile ended.
    pub(crate) fn keep(&mut self, transmittance: &[Row; TILE_H], finished: &[Finished]) {
        self.transmittance.clear();
        self.transmittance.extend(transmittance.iter().flat_map(|row| &row[..TILE_W]));
        self.finished.clear();
        self.finished.extend_from_slice(finished);
    }
}

/// The `count` lowest bits; all of them from 32 on.
#[inline(always)]
pub(crate) fn low_bits(count: usize) -> u32 {
    if count >= 32 { u32::MAX } else { (1 << count) - 1 }
}

/// True when a pixel of the box is unfinished.
#[inline(always)]
pub(crate) fn is_live(live: &[u32; TILE_H], cut: &Cut) -> bool {
    let columns = low_bits(cut.x1 - cut.x0) << cut.x0;
    // All rows, whatever the box: a loop over its few rows would end where the processor did not expect it.
    let (first, end) = (&ROWS_BELOW[cut.y0.min(TILE_H)], &ROWS_BELOW[cut.y1.min(TILE_H)]);
    let mut any = [0u32; TILE_H];
    for y in 0..TILE_H {
        any[y] = live[y] & end[y] & !first[y];
    }
    any.iter().fold(0, |a, b| a | b) & columns != 0
}

/// All ones for the rows below the index, 0 from there on.
const ROWS_BELOW: [[u32; TILE_H]; TILE_H + 1] = {
    let mut table = [[0; TILE_H]; TILE_H + 1];
    let mut rows = 0;
    while rows <= TILE_H {
        let mut y = 0;
        while y < rows {
            table[rows][y] = u32::MAX;
            y += 1;
        }
        rows += 1;
    }
    table
};

/// The chunk and the position in it that a key stands for.
#[inline(always)]
pub(crate) fn locate<'a>(input: &TileInput<'a>, key: u64) -> (&'a ChunkView, usize) {
    let slot = key_slot(key);
    (&input.chunks[slot >> input.chunk_bits].views[input.view], slot & ((1 << input.chunk_bits) - 1))
}

/// Asks for the records and ids of a batch.
#[inline(always)]
pub(crate) fn prefetch_records(input: &TileInput, keys: &[u64]) {
    for &key in keys {
        let (view, at) = locate(input, key);
        prefetch(&view.records, at);
        prefetch(&view.ids, at);
    }
}

/// `0` for the lanes below the index, infinity from there on.
pub(crate) const EDGE: [[f32; WIDTH]; WIDTH + 1] = {
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

/// All ones or 0.
#[inline(always)]
pub(crate) fn mask(condition: bool) -> u32 {
    0u32.wrapping_sub(u32::from(condition))
}
