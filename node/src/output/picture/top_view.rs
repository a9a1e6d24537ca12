//! The map from above: points binned into pixels, the highest of each bin on top.

use super::{Picture, Rgb};

/// Background: dark, so that any map colour stands out.
const BACKGROUND: Rgb = [16, 18, 24];
/// Part of the points on each side that the view may leave out, so that a few strays do not shrink the rest.
const TRIM: f64 = 0.005;
/// Free border, as a part of the extent.
const MARGIN: f64 = 0.04;
/// Largest side of a point's square, pixels: points are points, however near the view.
const MAX_POINT_PX: f64 = 9.0;
/// Least extent shown, metres.
const MIN_EXTENT_M: f64 = 2.0;

/// Which part of the ground plane a picture shows: x to the right, y up, the same scale both ways.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TopView {
    /// Map x of the left edge, metres.
    pub left_m: f64,
    /// Map y of the top edge, metres.
    pub top_m: f64,
    /// Metres per pixel.
    pub m_per_px: f64,
    /// Width, pixels.
    pub width: usize,
    /// Height, pixels.
    pub height: usize,
}

/// Bounds of one axis: the trimmed bulk, stretched so that everything in `keep` is inside.
fn bounds(bulk: impl Iterator<Item = f64>, keep: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    let mut values: Vec<f64> = bulk.filter(|v| v.is_finite()).collect();
    values.sort_unstable_by(f64::total_cmp);
    let cut = (values.len() as f64 * TRIM) as usize;
    let trimmed = values.get(cut..values.len() - cut).unwrap_or_default();
    let ends = trimmed.first().into_iter().chain(trimmed.last()).copied();
    let all = ends.chain(keep.filter(|v| v.is_finite()));
    all.fold(None, |b, v| b.map_or(Some((v, v)), |(lo, hi): (f64, f64)| Some((lo.min(v), hi.max(v)))))
}

impl TopView {
    /// A view of at most `max_width` x `max_height` pixels that holds the bulk of `points` and all of `keep` (metres).
    pub fn fit(points: &[[f64; 3]], keep: &[[f64; 3]], max_width: usize, max_height: usize) -> Self {
        let axis = |k: usize| {
            let (lo, hi) = bounds(points.iter().map(|p| p[k]), keep.iter().map(|p| p[k])).unwrap_or((0.0, 0.0));
            let extent = (hi - lo).max(MIN_EXTENT_M);
            let center = 0.5 * (lo + hi);
            (center, extent * (1.0 + 2.0 * MARGIN))
        };
        let ((cx, w), (cy, h)) = (axis(0), axis(1));
        let m_per_px = (w / max_width.max(1) as f64).max(h / max_height.max(1) as f64);
        let pixels = |extent: f64, most: usize| ((extent / m_per_px).ceil() as usize).clamp(1, most.max(1));
        let (width, height) = (pixels(w, max_width), pixels(h, max_height));
        let (half_w, half_h) = (0.5 * width as f64 * m_per_px, 0.5 * height as f64 * m_per_px);
        Self { left_m: cx - half_w, top_m: cy + half_h, m_per_px, width, height }
    }

    /// Picture coordinates (pixels, fractional) of a map position.
    pub fn project(&self, p: [f64; 3]) -> (f64, f64) {
        ((p[0] - self.left_m) / self.m_per_px, (self.top_m - p[1]) / self.m_per_px)
    }

    /// A round length (metres) that takes about a fifth of the width, for a scale bar.
    pub fn scale_bar_m(&self) -> f64 {
        let target = 0.2 * self.width as f64 * self.m_per_px;
        let decade = 10f64.powf(target.log10().floor());
        [5.0, 2.0, 1.0].into_iter().map(|m| m * decade).find(|&m| m <= target).unwrap_or(decade)
    }
}

/// The points from above; `colors[i]` belongs to `points[i]`, points outside the view are left out. Each point covers a
/// square of `point_m` metres (the map's voxel size), at least one pixel, so that the map looks closed.
pub fn top_view_picture(view: &TopView, points: &[[f64; 3]], colors: &[Rgb], point_m: f64) -> Picture {
    let mut picture = Picture::filled(view.width, view.height, BACKGROUND);
    let mut highest = vec![f64::NEG_INFINITY; view.width * view.height];
    let side = (point_m / view.m_per_px).round();
    let side = if side > 1.0 { side.min(MAX_POINT_PX) } else { 1.0 };
    for (p, &color) in points.iter().zip(colors) {
        let (x, y) = view.project(*p);
        // The first pixel of a square around the point; for one pixel, the one the point is in.
        let (x, y) = ((x - 0.5 * (side - 1.0)).floor(), (y - 0.5 * (side - 1.0)).floor());
        let (right, bottom) = ((x + side).min(view.width as f64), (y + side).min(view.height as f64));
        if right > 0.0 && bottom > 0.0 && x < right && y < bottom && p[2].is_finite() {
            // `as` takes what lies left of or above the picture to its edge.
            for row in y as usize..bottom as usize {
                for col in x as usize..right as usize {
                    let z = &mut highest[row * view.width + col];
                    if p[2] > *z {
                        *z = p[2];
                        picture.set(col, row, color);
                    }
                }
            }
        }
    }
    picture
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_view_holds_the_points_and_the_highest_wins() {
        let points = [[5e6, 10.0, 0.0], [5e6 + 40.0, 10.0, 1.0], [5e6 + 40.0, 30.0, 2.0], [5e6 + 40.0, 30.0, 1.0]];
        let colors = [[10; 3], [20; 3], [30; 3], [40; 3]];
        let view = TopView::fit(&points, &[[5e6, 35.0, 0.0]], 400, 400);
        assert!(view.width <= 400 && view.height <= 400 && view.height < view.width);
        let picture = top_view_picture(&view, &points, &colors, 0.0);
        for (p, expected) in [(0, [10; 3]), (1, [20; 3]), (2, [30; 3])] {
            let (x, y) = view.project(points[p]);
            assert_eq!(picture.get(x as usize, y as usize), Some(expected));
        }
        let (_, y0) = view.project(points[0]);
        let (_, y2) = view.project(points[2]);
        assert!(y2 < y0, "y is up");
        let bar = view.scale_bar_m();
        assert!([5.0, 10.0].contains(&bar), "{bar}");
    }

    #[test]
    fn points_cover_their_voxel_and_are_cut_at_the_edge() {
        let view = TopView { left_m: 0.0, top_m: 10.0, m_per_px: 1.0, width: 10, height: 10 };
        let painted = |p: [f64; 3], point_m: f64| {
            let picture = top_view_picture(&view, &[p], &[[200; 3]], point_m);
            picture.as_bytes().chunks(3).filter(|p| *p == [200; 3]).count()
        };
        assert_eq!(painted([5.5, 5.5, 0.0], 3.0), 9);
        assert_eq!(painted([5.5, 5.5, 0.0], 0.1), 1);
        assert_eq!(painted([0.5, 9.5, 0.0], 3.0), 4);
        assert_eq!(painted([9.5, 0.5, 0.0], 3.0), 4);
        assert_eq!(painted([-5.0, 5.0, 0.0], 3.0), 0);
        assert_eq!(painted([50.0, 5.0, 0.0], 3.0), 0);
    }

    #[test]
    fn no_points_and_bad_points_still_give_a_picture() {
        let empty = TopView::fit(&[], &[], 100, 50);
        assert!(empty.m_per_px > 0.0 && empty.width > 0 && empty.height > 0);
        let points = [[f64::NAN, 0.0, 0.0], [1.0, 1.0, 0.0], [f64::INFINITY, 0.0, 0.0]];
        let view = TopView::fit(&points, &[], 100, 50);
        assert!(view.m_per_px.is_finite());
        let picture = top_view_picture(&view, &points, &[[200; 3]; 3], f64::NAN);
        assert_eq!(picture.as_bytes().chunks(3).filter(|p| *p == [200; 3]).count(), 1);
    }
}
