//! Matching costs of a plane sweep over velocities: for every cell of an image, how well its surface is found again in another
//! image if it moved with each of a few candidate velocities, or stood still at another depth.
//!
//! A cell's point at depth `d` and candidate `v` is at `o + d r + v dt` when the other image is taken. Images are box-averaged to
//! the grid of cells and normalised by local mean and contrast, so that exposure does not count. The error of a cell is averaged
//! over its 3 x 3 neighbours, each at its own depth. Plain numbers, no gradients: the evidence is given to the network as it is.

use glam::{Mat3, Vec3};

/// Candidate velocities, m/s, in the anchor's axes (x forward, y left): along the road, across it, and between.
const VELOCITIES: [[f32; 2]; 24] = [
    [0.0, 0.0],
    [2.0, 0.0],
    [-2.0, 0.0],
    [4.0, 0.0],
    [-4.0, 0.0],
    [7.0, 0.0],
    [-7.0, 0.0],
    [10.0, 0.0],
    [-10.0, 0.0],
    [13.0, 0.0],
    [-13.0, 0.0],
    [17.0, 0.0],
    [-17.0, 0.0],
    [-22.0, 0.0],
    [0.0, 2.0],
    [0.0, -2.0],
    [0.0, 5.0],
    [0.0, -5.0],
    [0.0, 9.0],
    [0.0, -9.0],
    [5.0, 5.0],
    [5.0, -5.0],
    [-5.0, 5.0],
    [-5.0, -5.0],
];

/// Candidate depths of a surface that stands still, over the depth that is swept at.
const DEPTHS: [f32; 8] = [0.5, 0.63, 0.76, 0.88, 1.14, 1.32, 1.59, 2.0];

/// Candidates of a sweep.
pub(crate) const CANDIDATES: usize = VELOCITIES.len() + DEPTHS.len();

/// Nearest z-depth at which a moved point counts as seen, metres.
const NEAREST_M: f32 = 0.2;

/// Mean absolute difference of normalised colours from which a match is no worse.
const WORST: f32 = 1.0;

/// Contrast (colours -1..1) below which an area counts as flat: its noise is not amplified.
const FLAT: f32 = 0.06;

/// Half width of the window of local mean and contrast, cells.
const WINDOW: usize = 2;

/// Marks a candidate whose point is not seen.
const UNSEEN: f32 = -1.0;

/// An image on the grid of cells, and its camera.
pub(crate) struct Frame {
    /// Normalised colours, row by row, three numbers a cell.
    colors: Vec<f32>,
    /// Whether the camera saw all of a cell's pixels; empty: it saw all of every cell.
    valid: Vec<bool>,
    rows: usize,
    cols: usize,
    /// Focal lengths and principal point, cells.
    focal: [f32; 4],
    world_from_camera: Mat3,
    origin: Vec3,
    time_sec: f32,
}

/// What a frame is made of: colours `(3, h, w)` in -1..1, 1 where the camera saw something `(h, w)` (none: everywhere), intrinsics 3 x 3, pose 4 x 4 (row-major), seconds.
pub(crate) struct Source<'a> {
    pub image: &'a [f32],
    pub valid: Option<&'a [f32]>,
    pub size: [usize; 2],
    pub intrinsics: &'a [f32],
    pub pose: &'a [f32],
    pub time_sec: f32,
}

impl Frame {
    /// `side`: pixels a cell is wide and high.
    pub fn new(source: &Source<'_>, side: usize) -> Self {
        let [h, w] = source.size;
        let (rows, cols) = (h / side, w / side);
        let mut colors = vec![0f32; rows * cols * 3];
        let share = 1.0 / (side * side) as f32;
        for (c, plane) in source.image.chunks_exact(h * w).take(3).enumerate() {
            for (y, line) in plane.chunks_exact(w).take(rows * side).enumerate() {
                let out = &mut colors[y / side * cols * 3..][..cols * 3];
                for (x, pixels) in line.chunks_exact(side).take(cols).enumerate() {
                    out[3 * x + c] += share * pixels.iter().sum::<f32>();
                }
            }
        }
        let mut valid = vec![true; if source.valid.is_some() { rows * cols } else { 0 }];
        for (y, line) in source.valid.iter().flat_map(|valid| valid.chunks_exact(w)).take(rows * side).enumerate() {
            for (x, pixels) in line.chunks_exact(side).take(cols).enumerate() {
                valid[y / side * cols + x] &= pixels.iter().all(|&x| x > 0.5);
            }
        }
        let (k, m) = (source.intrinsics, source.pose);
        let shrink = 1.0 / side as f32;
        Self {
            colors: normalised(&colors, rows, cols),
            valid,
            rows,
            cols,
            focal: [k[0], k[4], k[2], k[5]].map(|x| x * shrink),
            world_from_camera: Mat3::from_cols_array(&[m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]]),
            origin: Vec3::new(m[3], m[7], m[11]),
            time_sec: source.time_sec,
        }
    }

    /// Whether both were taken at the same moment.
    pub fn taken_with(&self, other: &Self) -> bool {
        self.time_sec == other.time_sec
    }

    /// Rows and columns.
    pub fn size(&self) -> (usize, usize) {
        (self.rows, self.cols)
    }

    /// Mean absolute difference of a colour to the one at `at` (camera coordinates), or [`UNSEEN`].
    #[inline]
    fn error(&self, color: [f32; 3], at: Vec3) -> f32 {
        if at.z <= NEAREST_M || at.z.is_nan() {
            return UNSEEN;
        }
        let [fx, fy, cx, cy] = self.focal;
        let (x, y) = (fx * at.x / at.z + cx - 0.5, fy * at.y / at.z + cy - 0.5);
        let (right, low) = ((self.cols - 1) as f32, (self.rows - 1) as f32);
        if !(x >= -0.5 && x <= right + 0.5 && y >= -0.5 && y <= low + 0.5) {
            return UNSEEN;
        }
        let (x, y) = (x.clamp(0.0, right), y.clamp(0.0, low));
        let (left, top) =
            ((x as usize).min(self.cols.saturating_sub(2)), (y as usize).min(self.rows.saturating_sub(2)));
        let (u, v) = (x - left as f32, y - top as f32);
        let (step, line) = (if self.cols > 1 { 3 } else { 0 }, if self.rows > 1 { 3 * self.cols } else { 0 });
        let seen = |i: usize| self.valid.get(i).copied().unwrap_or(true);
        let corner = top * self.cols + left;
        if !self.valid.is_empty() && ![0, step / 3, line / 3, (line + step) / 3].iter().all(|&by| seen(corner + by)) {
            return UNSEEN;
        }
        let first = 3 * corner;
        let mut sum = 0.0;
        for (c, own) in color.into_iter().enumerate() {
            let pick = |at: usize| self.colors[at + c];
            let upper = pick(first) * (1.0 - u) + pick(first + step) * u;
            let lower = pick(first + line) * (1.0 - u) + pick(first + line + step) * u;
            sum += (upper * (1.0 - v) + lower * v - own).abs();
        }
        sum / 3.0
    }
}

/// Colours less their local mean, over their local contrast.
fn normalised(colors: &[f32], rows: usize, cols: usize) -> Vec<f32> {
    let mut out = vec![0f32; colors.len()];
    for y in 0..rows {
        for x in 0..cols {
            let (mut sum, mut square, mut count) = ([0f32; 3], 0f32, 0f32);
            for j in y.saturating_sub(WINDOW)..(y + WINDOW + 1).min(rows) {
                for i in x.saturating_sub(WINDOW)..(x + WINDOW + 1).min(cols) {
                    let at = 3 * (j * cols + i);
                    for c in 0..3 {
                        sum[c] += colors[at + c];
                        square += colors[at + c] * colors[at + c];
                    }
                    count += 1.0;
                }
            }
            let mean = sum.map(|s| s / count);
            let variance = (square / (3.0 * count) - mean.iter().map(|m| m * m).sum::<f32>() / 3.0).max(0.0);
            let scale = 1.0 / (variance.sqrt() + FLAT);
            let at = 3 * (y * cols + x);
            (0..3).for_each(|c| out[at + c] = (colors[at + c] - mean[c]) * scale);
        }
    }
    out
}

/// How well each cell of `own` is found in `other` for every candidate, 0 (not at all, or not in view) to 1, `(cell, candidate)`.
/// `depth`: z-depth of each cell, metres, or its distance along the ray.
pub(crate) fn sweep(own: &Frame, depth: &[f32], distance_along_ray: bool, other: &Frame) -> Vec<f32> {
    let (rows, cols) = own.size();
    let other_from_world = other.world_from_camera.transpose();
    let other_from_own = other_from_world * own.world_from_camera;
    let shift = other_from_world * (own.origin - other.origin);
    let dt = other.time_sec - own.time_sec;
    let moved = VELOCITIES.map(|[x, y]| other_from_world * Vec3::new(x, y, 0.0) * dt);
    let [fx, fy, cx, cy] = own.focal;
    let mut errors = vec![UNSEEN; rows * cols * CANDIDATES];
    let seen = |cell: usize| own.valid.get(cell).copied().unwrap_or(true);
    for (cell, out) in errors.chunks_exact_mut(CANDIDATES).enumerate().filter(|(cell, _)| seen(*cell)) {
        let (x, y) = ((cell % cols) as f32 + 0.5, (cell / cols) as f32 + 0.5);
        let mut ray = Vec3::new((x - cx) / fx, (y - cy) / fy, 1.0);
        if distance_along_ray {
            ray = ray.normalize();
        }
        let along = other_from_own * ray * depth[cell];
        let color = [own.colors[3 * cell], own.colors[3 * cell + 1], own.colors[3 * cell + 2]];
        let (velocities, depths) = out.split_at_mut(VELOCITIES.len());
        velocities.iter_mut().zip(&moved).for_each(|(e, moved)| *e = other.error(color, along + shift + *moved));
        depths.iter_mut().zip(DEPTHS).for_each(|(e, factor)| *e = other.error(color, along * factor + shift));
    }
    scores(&errors, rows, cols)
}

/// Errors averaged over neighbours that are seen, as scores.
fn scores(errors: &[f32], rows: usize, cols: usize) -> Vec<f32> {
    let mut out = vec![0f32; errors.len()];
    for y in 0..rows {
        for x in 0..cols {
            let (mut sum, mut count) = ([0f32; CANDIDATES], [0f32; CANDIDATES]);
            for j in y.saturating_sub(1)..(y + 2).min(rows) {
                for i in x.saturating_sub(1)..(x + 2).min(cols) {
                    let at = (j * cols + i) * CANDIDATES;
                    for (k, &e) in errors[at..at + CANDIDATES].iter().enumerate() {
                        let seen = if e >= 0.0 { 1.0 } else { 0.0 };
                        sum[k] += e.clamp(0.0, WORST) * seen;
                        count[k] += seen;
                    }
                }
            }
            let at = (y * cols + x) * CANDIDATES;
            for k in 0..CANDIDATES {
                // Seen by itself, not by its neighbours alone.
                let seen = errors[at + k] >= 0.0;
                out[at + k] = if seen { 1.0 - sum[k] / (count[k].max(1.0) * WORST) } else { 0.0 };
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [24, 48];

    /// A textured wall 10 m ahead of a camera that looks along x, moved by `shift_px` to the right, brighter by `gain`.
    fn image(shift_px: f32, gain: f32) -> Vec<f32> {
        let [h, w] = SIZE;
        let plane = (0..h * w).map(|i| {
            let (x, y) = ((i % w) as f32 - shift_px, (i / w) as f32);
            gain * 0.4 * ((0.55 * x).sin() * (0.4 * y).cos() + (0.21 * x + 0.3 * y).sin())
        });
        let plane: Vec<f32> = plane.collect();
        [&plane[..], &plane, &plane].concat()
    }

    /// Optical axes in a world of x forward, y left, z up.
    const POSE: [f32; 16] = [0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    const K: [f32; 9] = [40.0, 0.0, 24.0, 0.0, 40.0, 12.0, 0.0, 0.0, 1.0];

    fn frame(shift_px: f32, gain: f32, time_sec: f32) -> Frame {
        let image = image(shift_px, gain);
        Frame::new(&Source { image: &image, valid: None, size: SIZE, intrinsics: &K, pose: &POSE, time_sec }, 2)
    }

    #[test]
    fn the_true_velocity_matches_best_whatever_the_exposure() {
        // 5 m/s to the left for half a second at 10 m: 10 pixels.
        let (own, other) = (frame(0.0, 1.0, 0.0), frame(-10.0, 0.6, 0.5));
        let scores = sweep(&own, &vec![10.0; 12 * 24], false, &other);
        let best = VELOCITIES.iter().position(|v| *v == [0.0, 5.0]).unwrap();
        let mut right = 0;
        let inner: Vec<usize> = (0..12 * 24).filter(|c| (8..22).contains(&(c % 24))).collect();
        for &cell in &inner {
            let row = &scores[cell * CANDIDATES..][..VELOCITIES.len()];
            let top = (0..row.len()).max_by(|&a, &b| row[a].total_cmp(&row[b])).unwrap();
            right += usize::from(top == best);
            assert!(row.iter().all(|s| (0.0..=1.0).contains(s)));
        }
        assert!(right * 10 > inner.len() * 9, "{right} of {}", inner.len());
    }

    #[test]
    fn what_the_camera_did_not_see_is_neither_looked_for_nor_found() {
        // The left half of both images shows nothing; whatever stands there.
        let [h, w] = SIZE;
        let valid: Vec<f32> = (0..h * w).map(|i| if i % w < w / 2 { 0.0 } else { 1.0 }).collect();
        let frame = |unseen: f32, time_sec: f32| {
            let mut image = image(0.0, 1.0);
            image.iter_mut().enumerate().filter(|(i, _)| i % w < w / 2).for_each(|(_, x)| *x = unseen);
            let source =
                Source { image: &image, valid: Some(&valid), size: SIZE, intrinsics: &K, pose: &POSE, time_sec };
            Frame::new(&source, 2)
        };
        let scores = sweep(&frame(0.3, 0.0), &vec![10.0; 12 * 24], false, &frame(0.3, 0.5));
        let left = VELOCITIES.iter().position(|v| *v == [0.0, 9.0]).unwrap();
        for (cell, row) in scores.chunks_exact(CANDIDATES).enumerate() {
            if cell % 24 < 12 {
                assert!(row.iter().all(|s| *s == 0.0), "cell {cell}");
            } else {
                assert!(row[0] > 0.999);
            }
            // 9 m/s to the left for half a second at 10 m: 9 cells, so out of what was seen from the nearer ones.
            assert!(!(12..20).contains(&(cell % 24)) || row[left] == 0.0, "cell {cell}");
        }
    }

    #[test]
    fn points_out_of_view_and_depths_that_are_no_numbers_score_nothing() {
        let (own, other) = (frame(0.0, 1.0, 0.0), frame(0.0, 1.0, 0.5));
        // 2 m: 22 m/s backwards goes behind the camera.
        let scores = sweep(&own, &vec![2.0; 12 * 24], false, &other);
        let behind = VELOCITIES.iter().position(|v| *v == [-22.0, 0.0]).unwrap();
        assert!(scores.iter().skip(behind).step_by(CANDIDATES).all(|&s| s == 0.0));
        for odd in [f32::NAN, f32::INFINITY, 0.0, -3.0, 1e30] {
            let scores = sweep(&own, &vec![odd; 12 * 24], true, &other);
            assert!(scores.iter().all(|s| s.is_finite()));
        }
    }

    #[test]
    fn standing_still_at_the_right_depth_is_a_perfect_match() {
        let own = frame(0.0, 1.0, 0.0);
        let scores = sweep(&own, &vec![10.0; 12 * 24], false, &frame(0.0, 1.0, 0.5));
        assert!(scores.iter().step_by(CANDIDATES).all(|&s| s > 0.999));
    }
}
