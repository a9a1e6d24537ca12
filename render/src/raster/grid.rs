//! Which tiles of which view a splat has pixels in.

use super::ALPHA_MIN;
use bytemuck::{Pod, Zeroable};
use std::ops::Range;

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
    pub(super) fn tile_columns(&self) -> Range<usize> {
        usize::from(self.x0) / TILE_W..usize::from(self.x1).div_ceil(TILE_W)
    }

    /// Rows of tiles the box meets.
    #[inline(always)]
    pub(super) fn tile_rows(&self) -> Range<usize> {
        usize::from(self.y0) / TILE_H..usize::from(self.y1).div_ceil(TILE_H)
    }

    /// Tiles the box meets.
    #[inline(always)]
    pub(super) fn box_tiles(&self) -> usize {
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
    pub(super) fn each_tile(&self, record: &Record, mut visit: impl FnMut(usize)) {
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

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

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
