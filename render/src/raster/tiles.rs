//! Chunks of Gaussians to tile lists: each chunk is projected into all views and sorted by tile on its own, so that a
//! tile finds its splats by visiting the chunks in order. No shared writes, and the same lists for any thread count.

use super::loaded::{GROUP, Stored};
use super::project::{Block, Camera, Centers, Footprints, LANES, Rules, Shapes};
use super::simd::dispatch;
use super::sort::key;
use super::{ALPHA_MIN, MAX_PAIRS, Splats};
use bytemuck::{Pod, Zeroable};
use std::ops::Range;
use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering};

/// Tile width, pixels: wide enough that few splats are listed twice.
pub(crate) const TILE_W: usize = 32;
/// Tile height, pixels: low enough that the accumulators of a tile stay in the first-level cache.
pub(crate) const TILE_H: usize = 16;

/// A splat as the blending reads it: half a cache line.
///
/// `alpha = opacity 2^-(across (dx - slope dy)^2 + along dy^2)` at `(dx, dy)` from the centre, which is stored relative
/// to the box corner: the f32 keeps its digits however wide the picture is.
#[repr(C, align(32))]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct Record {
    /// Centre minus the box corner `(x0, y0)`, pixels.
    pub(crate) u: f32,
    pub(crate) v: f32,
    pub(crate) slope: f32,
    pub(crate) across: f32,
    pub(crate) along: f32,
    pub(crate) opacity: f32,
    /// Pixel box `[x0, x1) x [y0, y1)`, never empty, inside the picture.
    pub(crate) x0: u16,
    pub(crate) y0: u16,
    pub(crate) x1: u16,
    pub(crate) y1: u16,
}

impl Record {
    /// Columns of tiles the box meets.
    #[inline(always)]
    fn tile_columns(&self) -> Range<usize> {
        usize::from(self.x0) / TILE_W..usize::from(self.x1).div_ceil(TILE_W)
    }

    /// Rows of tiles the box meets.
    #[inline(always)]
    fn tile_rows(&self) -> Range<usize> {
        usize::from(self.y0) / TILE_H..usize::from(self.y1).div_ceil(TILE_H)
    }

    /// Tiles the box meets.
    #[inline(always)]
    fn box_tiles(&self) -> usize {
        self.tile_columns().len() * self.tile_rows().len()
    }

    /// Columns of the tiles in tile row `row` where the ellipse of `alpha >= 1/255` has a pixel centre; a tile too many
    /// only costs time.
    ///
    /// At one `dy` the ellipse spans `slope dy -+ sqrt((R - along dy^2) / across)`, `R = log2(255 o)`: a concave (convex)
    /// function of `dy`, whose extremum over the tile's rows is at its own, clamped to them.
    #[cold]
    #[inline(never)]
    fn ellipse_columns(&self, row: usize) -> Range<usize> {
        let columns = self.tile_columns();
        let (slope, across, along) = (f64::from(self.slope), f64::from(self.across), f64::from(self.along));
        let reach = f64::from(self.opacity / ALPHA_MIN).log2() * (1.0 + REACH_SLACK) + REACH_SLACK;
        let (u, v) = (f64::from(self.u) + f64::from(self.x0), f64::from(self.v) + f64::from(self.y0));
        let half_height = (reach / along).sqrt();
        let low = ((row * TILE_H) as f64 + 0.5 - v - PLACE_SLACK_PX).max(-half_height);
        let high = ((row * TILE_H + TILE_H) as f64 - 0.5 - v + PLACE_SLACK_PX).min(half_height);
        let tilt = slope.abs() * across.sqrt();
        let peak = half_height * slope.signum() * tilt / (along + tilt * tilt).sqrt();
        if high < low {
            return columns.start..columns.start;
        }
        if !(peak.is_finite() && low <= high) {
            return columns;
        }
        let half_width = |dy: f64| ((reach - along * dy * dy).max(0.0) / across).sqrt();
        let (left_dy, right_dy) = ((-peak).clamp(low, high), peak.clamp(low, high));
        let (left, right) = (slope * left_dy - half_width(left_dy), slope * right_dy + half_width(right_dy));
        let slack = PLACE_SLACK_PX + PLACE_SLACK * (left.abs() + right.abs() + u.abs());
        // `as usize` saturates: what lies beyond the picture stays at its edge.
        let first = (u + left - slack - 0.5).ceil().max(0.0) as usize / TILE_W;
        let end = ((u + right + slack - 0.5).floor() + 1.0).max(0.0) as usize;
        let end = end.div_ceil(TILE_W).min(columns.end);
        first.max(columns.start).min(end)..end
    }
}

/// Boxes of more tiles than this are looked at row by row: below, the look costs more than it saves.
const LOOK_FROM_TILES: usize = 4;
/// Rounding of the f32 blending: of the exponent, as a share and absolutely, and of positions, as a share and in pixels.
const REACH_SLACK: f64 = 1e-5;
const PLACE_SLACK: f64 = 4e-6;
const PLACE_SLACK_PX: f64 = 2e-3;

/// Where the tiles of each view stand in the list of all tiles.
#[derive(Debug, Clone, Default)]
pub(crate) struct Grid {
    views: Vec<GridView>,
}

/// Tiles of one view.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GridView {
    pub(crate) first: usize,
    pub(crate) columns: usize,
    pub(crate) rows: usize,
}

impl Grid {
    pub(crate) fn new(sizes: impl Iterator<Item = (usize, usize)>) -> Self {
        let mut first = 0;
        let views = sizes
            .map(|(width, height)| {
                let view = GridView { first, columns: width.div_ceil(TILE_W), rows: height.div_ceil(TILE_H) };
                first += view.columns * view.rows;
                view
            })
            .collect();
        Self { views }
    }

    pub(crate) fn views(&self) -> &[GridView] {
        &self.views
    }

    pub(crate) fn tile_count(&self) -> usize {
        self.views.last().map_or(0, |v| v.first + v.columns * v.rows)
    }
}

impl GridView {
    /// Calls `visit` with the index of every tile where `record` may have a pixel.
    #[inline(always)]
    fn each_tile(&self, record: &Record, mut visit: impl FnMut(usize)) {
        let look = record.box_tiles() > LOOK_FROM_TILES;
        for row in record.tile_rows() {
            let first = self.first + row * self.columns;
            let columns = if look { record.ellipse_columns(row) } else { record.tile_columns() };
            for column in columns {
                visit(first + column);
            }
        }
    }
}

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
    use proptest::prelude::*;

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

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]
        #[test]
        fn ellipses_meet_all_tiles_that_they_can_show_in(
            center in (-50.0f64..350.0, -40.0f64..200.0),
            angle in 0.0f64..3.2,
            length in 0.5f64..200.0,
            thin in prop_oneof![Just(0.55f64), 0.55f64..60.0],
            opacity in prop_oneof![0.004f32..1.0, Just(1.0f32)],
        ) {
            let (width, height) = (300usize, 160usize);
            let (sin, cos) = angle.sin_cos();
            let (l2, t2) = (length * length, thin * thin);
            let (a, b, c) = (cos * cos * l2 + sin * sin * t2, sin * cos * (l2 - t2), sin * sin * l2 + cos * cos * t2);
            let half = 0.5 * std::f64::consts::LOG2_E;
            let det = l2 * t2;
            let reach = (2.0 * f64::from(opacity / ALPHA_MIN).ln()).max(0.0);
            let span = |center: f64, variance: f64, size: usize| {
                let far = (reach * variance).sqrt() + 2e-3;
                let first = (center - far - 0.5).ceil().clamp(0.0, size as f64);
                (first as u16, ((center + far - 0.5).floor() + 1.0).clamp(0.0, size as f64) as u16)
            };
            let ((x0, x1), (y0, y1)) = (span(center.0, a, width), span(center.1, c, height));
            prop_assume!(x0 < x1 && y0 < y1);
            let (u, v) = ((center.0 - f64::from(x0)) as f32, (center.1 - f64::from(y0)) as f32);
            let (slope, across, along) = ((b / c) as f32, (half * c / det) as f32, (half / c) as f32);
            let record = Record { u, v, slope, across, along, opacity, x0, y0, x1, y1 };
            let mut shows = std::collections::BTreeSet::new();
            for y in y0..y1 {
                for x in x0..x1 {
                    // As `blend` does it, without the fused operations.
                    let dx = f32::from(x - x0) + 0.5 - u;
                    let dy = f32::from(y - y0) + 0.5 - v;
                    let q = dx - slope * dy;
                    let alpha = opacity * (-(across * q * q + along * dy * dy)).exp2();
                    if alpha >= ALPHA_MIN {
                        shows.insert((usize::from(y) / TILE_H, usize::from(x) / TILE_W));
                    }
                }
            }
            for row in record.tile_rows() {
                let columns = record.ellipse_columns(row);
                prop_assert!(columns.start >= record.tile_columns().start && columns.end <= record.tile_columns().end);
                let wanted: Vec<usize> = shows.range((row, 0)..(row + 1, 0)).map(|&(_, column)| column).collect();
                prop_assert!(wanted.iter().all(|column| columns.contains(column)), "{row} {columns:?} {wanted:?}");
                // And few others: a row of an ellipse is one stretch, of which pixels may miss the ends.
                prop_assert!(columns.len() <= wanted.len() + 2, "{row} {columns:?} {wanted:?}");
            }
        }
    }

    #[test]
    fn a_diagonal_needle_is_listed_along_its_length_alone() {
        // 45 degrees across 8 x 16 tiles of 32 x 16, one pixel thick.
        let (l2, t2) = (80.0f64.powi(2), 1.0);
        let (a, b) = (0.5 * (l2 + t2), 0.5 * (l2 - t2));
        let half = 0.5 * std::f64::consts::LOG2_E;
        let (slope, across, along) = ((b / a) as f32, (half * a / (l2 * t2)) as f32, (half / a) as f32);
        let record = Record { u: 128.0, v: 128.0, slope, across, along, opacity: 1.0, x0: 0, y0: 0, x1: 256, y1: 256 };
        let grid = Grid::new([(256, 256)].into_iter());
        let mut met = 0;
        grid.views()[0].each_tile(&record, |_| met += 1);
        assert_eq!(record.box_tiles(), 128);
        assert!((16..=32).contains(&met), "{met}");
    }

    #[test]
    fn boxes_meet_the_tiles_that_hold_their_pixels() {
        let grid = Grid::new([(70, 33), (10, 10)].into_iter());
        assert_eq!(grid.tile_count(), 3 * 3 + 1);
        let record = Record { x0: 31, x1: 33, y0: 16, y1: 32, ..Record::zeroed() };
        let mut met = Vec::new();
        grid.views()[0].each_tile(&record, |t| met.push(t));
        assert_eq!(met, [3, 4]);
        met.clear();
        grid.views()[1].each_tile(&Record { x1: 10, y1: 10, ..Record::zeroed() }, |t| met.push(t));
        assert_eq!(met, [9]);
    }
}
