//! Chunks of Gaussians to tile lists: each chunk is projected into all views and sorted by tile on its own, so that a
//! tile finds its splats by visiting the chunks in order. No shared writes, and the same lists for any thread count.

use super::block::{Block, Centers, LANES, Shapes};
use super::grid::{Grid, Record};
use super::loaded::{GROUP, Stored};
use super::project::{Camera, Footprints, Rules};
use super::simd::dispatch;
use super::sort::key;
use super::{MAX_PAIRS, Splats};
use std::ops::Range;
use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering};

/// The splats of a chunk that have pixels in one view, in index order.
#[derive(Debug, Default)]
pub(crate) struct ChunkView {
    pub(crate) records: Vec<Record>,
    /// Camera z, metres.
    pub(crate) depths: Vec<f32>,
    /// Index of the Gaussian.
    pub(crate) ids: Vec<u32>,
    /// Backward pass: where the pairs of each record start; one more entry than records.
    pair_starts: Vec<u32>,
    /// Backward pass: one row of sums per (record, tile) pair, tiles in the order of the grid.
    sums: Vec<AtomicU32>,
}

/// One chunk of consecutive Gaussians: its splats per view and its keys per tile.
#[derive(Debug, Default)]
pub(crate) struct Chunk {
    pub(crate) views: Vec<ChunkView>,
    /// Where each tile's keys start in `keys`; one more entry than tiles.
    starts: Vec<u32>,
    /// Sort keys, tile after tile, index order inside a tile.
    keys: Vec<u64>,
    /// Which views may see the group at hand.
    seen: Vec<bool>,
    pub(crate) counts: ChunkCounts,
}

/// What a chunk's Gaussians came to.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ChunkCounts {
    /// Not usable; of kept Gaussians only those that have no place at the time drawn.
    pub(crate) invalid: usize,
    /// Blended by the convention, summed over the views.
    pub(crate) visible: usize,
    /// Of these, with a pixel that may reach 1/255.
    pub(crate) listed: usize,
    /// 3D covariances worked out.
    pub(crate) shapes: usize,
    /// Passed over by the bounds of their group, summed over the views.
    pub(crate) unread: usize,
}

/// Where the Gaussians come from.
#[derive(Clone, Copy)]
pub(crate) enum Source<'a> {
    /// The caller's arrays, seen for the first time.
    Fresh(Splats<'a>),
    /// Those kept, at a time.
    Kept(&'a Stored, f32),
}

impl<'a> Source<'a> {
    pub(crate) fn len(&self) -> usize {
        match self {
            Self::Fresh(splats) => splats.len(),
            Self::Kept(stored, _) => stored.len(),
        }
    }

    fn opacities(&self) -> &'a [f32] {
        match self {
            Self::Fresh(splats) => splats.opacities,
            Self::Kept(stored, _) => stored.opacities(),
        }
    }
}

/// What all chunks share.
pub(crate) struct ChunkInput<'a> {
    pub(crate) source: Source<'a>,
    pub(crate) cameras: &'a [Camera],
    pub(crate) rules: Rules,
    pub(crate) grid: &'a Grid,
    /// Keys of all chunks so far; a chunk that passes [`MAX_PAIRS`] keeps none.
    pub(crate) pairs: &'a AtomicUsize,
}

impl Chunk {
    /// Keys of one tile, in index order.
    pub(crate) fn tile_keys(&self, tile: usize) -> &[u64] {
        match (self.starts.get(tile), self.starts.get(tile + 1)) {
            (Some(&from), Some(&to)) => self.keys.get(from as usize..to as usize).unwrap_or_default(),
            _ => &[],
        }
    }

    /// Sorts the chunk's splats by tile (counting sort, stable). `first_slot` is the slot of its first splat.
    fn bin(&mut self, input: &ChunkInput, first_slot: u32) {
        let tiles = input.grid.tile_count();
        self.starts.clear();
        self.starts.resize(tiles + 1, 0);
        let mut total = 0usize;
        for (view, grid) in self.views.iter().zip(input.grid.views()) {
            for record in &view.records {
                grid.each_tile(record, |tile| {
                    self.starts[tile] = self.starts[tile].wrapping_add(1);
                    total += 1;
                });
            }
        }
        self.keys.clear();
        if input.pairs.fetch_add(total, Ordering::Relaxed).saturating_add(total) > MAX_PAIRS {
            self.starts.fill(0);
            return;
        }
        // Counts become ends; filling backwards turns them into starts.
        let mut end = 0;
        for s in self.starts.iter_mut() {
            end += *s;
            *s = end;
        }
        self.keys.resize(total, 0);
        for (view, grid) in self.views.iter().zip(input.grid.views()) {
            for (k, (record, &depth)) in view.records.iter().zip(&view.depths).enumerate().rev() {
                let key = key(depth, first_slot + k as u32);
                grid.each_tile(record, |tile| {
                    self.starts[tile] -= 1;
                    self.keys[self.starts[tile] as usize] = key;
                });
            }
        }
    }
}

dispatch!(
    /// Projects the Gaussians `range` into all views and lists them by tile.
    fill_chunk, fill_chunk_kernel, (input: &ChunkInput<'_>, range: Range<usize>, first_slot: u32, chunk: &mut Chunk)
);

#[inline(always)]
fn fill_chunk_kernel<const FMA: bool>(input: &ChunkInput, range: Range<usize>, first_slot: u32, chunk: &mut Chunk) {
    chunk.views.resize_with(input.cameras.len(), ChunkView::default);
    for view in &mut chunk.views {
        view.records.clear();
        view.depths.clear();
        view.ids.clear();
    }
    chunk.counts = ChunkCounts::default();
    match &input.source {
        Source::Fresh(splats) => fill_fresh::<FMA>(input, splats, range, chunk),
        Source::Kept(stored, draw_sec) => fill_kept::<FMA>(input, stored, *draw_sec, range, chunk),
    }
    chunk.counts.listed = chunk.views.iter().map(|view| view.records.len()).sum();
    chunk.bin(input, first_slot);
}

/// Reads every Gaussian of the range.
#[inline(always)]
fn fill_fresh<const FMA: bool>(input: &ChunkInput, splats: &Splats, range: Range<usize>, chunk: &mut Chunk) {
    let rows = range.start * splats.feature_count..range.end * splats.feature_count;
    let features_finite = all_finite(splats.features.get(rows).unwrap_or_default());
    let mut block = Block::new();
    let mut prints = Footprints::new();
    for start in range.clone().step_by(LANES) {
        let count = (range.end - start).min(LANES);
        chunk.counts.invalid += block.load(splats, start, count, features_finite);
        chunk.counts.shapes += count;
        for (camera, view) in input.cameras.iter().zip(&mut chunk.views) {
            let Block { centers, shapes } = &block;
            if super::project::project::<FMA>(centers, shapes, camera, &input.rules, &mut prints) {
                chunk.counts.visible += view.keep(shapes, &prints, splats.opacities, start);
            }
        }
    }
}

/// Reads the groups of the range that some view may see.
#[inline(always)]
fn fill_kept<const FMA: bool>(
    input: &ChunkInput,
    stored: &Stored,
    draw_sec: f32,
    range: Range<usize>,
    chunk: &mut Chunk,
) {
    let opacities = input.source.opacities();
    let mut centers = Centers::new();
    let mut prints = Footprints::new();
    let Chunk { views, seen, counts, .. } = chunk;
    for first in range.clone().step_by(GROUP) {
        let end = (first + GROUP).min(range.end);
        let bounds = stored.bounds(first, draw_sec);
        seen.clear();
        seen.extend(input.cameras.iter().map(|camera| bounds.is_some_and(|b| b.may_show(camera, &input.rules))));
        let seeing = seen.iter().filter(|&&sees| sees).count();
        counts.unread += (end - first) * (seen.len() - seeing);
        if seeing == 0 {
            continue;
        }
        for start in (first..end).step_by(LANES) {
            let (shapes, lost) = stored.place(start, draw_sec, &mut centers);
            counts.invalid += lost;
            for ((camera, view), _) in input.cameras.iter().zip(views.iter_mut()).zip(&*seen).filter(|(_, sees)| **sees)
            {
                if super::project::project::<FMA>(&centers, shapes, camera, &input.rules, &mut prints) {
                    counts.visible += view.keep(shapes, &prints, opacities, start);
                }
            }
        }
    }
}

/// True when no number is infinite or NaN: its exponent bits are not all ones.
#[inline(always)]
fn all_finite(values: &[f32]) -> bool {
    const EXPONENT: u32 = 0x7f80_0000;
    let (blocks, rest) = values.as_chunks::<64>();
    let bad = |x: f32| u32::from(x.to_bits() & EXPONENT == EXPONENT);
    let mut any = [0u32; 64];
    for block in blocks {
        for l in 0..64 {
            any[l] |= bad(block[l]);
        }
    }
    any.iter().fold(0, |a, b| a | b) == 0 && rest.iter().all(|&x| bad(x) == 0)
}

impl ChunkView {
    /// Tiles of the boxes of all records: the pairs `clear_sums` makes room for.
    pub(crate) fn box_tiles(&self) -> usize {
        self.records.iter().map(Record::box_tiles).sum()
    }

    /// Makes a row of `row_len` zeros for every (record, tile of its box) pair.
    pub(crate) fn clear_sums(&mut self, row_len: usize) {
        self.pair_starts.clear();
        let mut pairs = 0;
        for record in &self.records {
            self.pair_starts.push(pairs);
            pairs += record.box_tiles() as u32;
        }
        self.pair_starts.push(pairs);
        self.sums.clear();
        self.sums.resize_with(pairs as usize * row_len, AtomicU32::default);
    }

    /// The row of sums of record `at` in the tile at `(column, row)` of the view.
    #[inline(always)]
    pub(crate) fn pair_sums(&self, at: usize, column: usize, row: usize, row_len: usize) -> Option<&[AtomicU32]> {
        let record = self.records.get(at)?;
        let columns = record.tile_columns();
        let tile = (row - record.tile_rows().start) * columns.len() + (column - columns.start);
        let pair = *self.pair_starts.get(at)? as usize + tile;
        self.sums.get(pair * row_len..(pair + 1) * row_len)
    }

    /// The rows of sums of all pairs of record `at`, one after the other.
    pub(crate) fn record_sums(&self, at: usize, row_len: usize) -> &[AtomicU32] {
        match (self.pair_starts.get(at), self.pair_starts.get(at + 1)) {
            (Some(&from), Some(&to)) => {
                self.sums.get(from as usize * row_len..to as usize * row_len).unwrap_or_default()
            }
            _ => &[],
        }
    }

    /// Keeps the visible lanes that have a pixel to blend; returns how many lanes are visible.
    #[inline(always)]
    fn keep(&mut self, shapes: &Shapes, prints: &Footprints, opacities: &[f32], start: usize) -> usize {
        let mut visible = 0;
        for l in 0..LANES {
            if !prints.visible[l] {
                continue;
            }
            visible += 1;
            let (x0, x1, y0, y1) = (prints.x0[l], prints.x1[l], prints.y0[l], prints.y1[l]);
            let blended = shapes.reach2[l] >= 0.0 && x0 < x1 && y0 < y1;
            if !blended {
                continue;
            }
            let (slope, across, along) = prints.quadratic(l);
            let id = start + l;
            self.records.push(Record {
                u: (prints.u[l] - x0) as f32,
                v: (prints.v[l] - y0) as f32,
                slope,
                across,
                along,
                opacity: opacities[id].min(super::settings::OPACITY_CEILING),
                x0: x0 as u16,
                y0: y0 as u16,
                x1: x1 as u16,
                y1: y1 as u16,
            });
            self.depths.push(prints.z[l] as f32);
            self.ids.push(id as u32);
        }
        visible
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finite_check_sees_every_position() {
        for n in [0, 1, 63, 64, 65, 200] {
            assert!(all_finite(&vec![f32::MAX; n]));
            for at in 0..n {
                let mut values = vec![1.0; n];
                values[at] = if at % 2 == 0 { f32::NAN } else { f32::NEG_INFINITY };
                assert!(!all_finite(&values), "{n} {at}");
            }
        }
    }
}
