//! Separable resizing with an exact footprint: each output pixel is the mean of the source area it covers.

use rayon::prelude::*;

use super::RgbPicture;

/// How an output axis is made of a source axis.
#[derive(Debug, Clone, PartialEq)]
pub struct AxisWeights {
    /// For every output index, the first source index and the weights from there on (empty: it sees nothing).
    weights: Vec<(usize, Vec<f32>)>,
    /// Whether the middle of the output index lies within the source.
    inside: Vec<bool>,
}

impl AxisWeights {
    /// Output coordinate `x` (pixel edges at integers) lies at `scale * x + shift` of a source with `source` pixels;
    /// `scale` is positive. Area average when shrinking, bilinear when enlarging. What lies outside the source has no
    /// weight, and the rest is brought to a sum of one.
    pub fn new(output: usize, source: usize, scale: f64, shift: f64) -> Self {
        let end = source as f64;
        let one = |i: usize| {
            let (from, to) = (scale * i as f64 + shift, scale * (i + 1) as f64 + shift);
            if scale >= 1.0 { area(from, to, end) } else { bilinear(0.5 * (from + to), end) }
        };
        let inside = |i: usize| (0.0..=end).contains(&(scale * (i as f64 + 0.5) + shift));
        Self { weights: (0..output).map(one).collect(), inside: (0..output).map(inside).collect() }
    }

    /// For every output index whether its middle lies within the source.
    pub fn inside(&self) -> &[bool] {
        &self.inside
    }
}

fn area(from: f64, to: f64, end: f64) -> (usize, Vec<f32>) {
    let (from, to) = (from.clamp(0.0, end), to.clamp(0.0, end));
    let total = to - from;
    if total > 0.0 {
        let first = from.floor() as usize;
        let last = (to.ceil() as usize).max(first + 1);
        let overlap = |i: usize| ((to.min((i + 1) as f64) - from.max(i as f64)).max(0.0) / total) as f32;
        (first, (first..last).map(overlap).collect())
    } else {
        (0, Vec::new())
    }
}

fn bilinear(at: f64, end: f64) -> (usize, Vec<f32>) {
    if at >= 0.0 && at <= end && end >= 1.0 {
        // Between pixel centres, and flat within half a pixel of the border.
        let x = (at - 0.5).clamp(0.0, end - 1.0);
        let first = x.floor();
        let t = (x - first) as f32;
        if first + 1.0 < end { (first as usize, vec![1.0 - t, t]) } else { (first as usize, vec![1.0]) }
    } else {
        (0, Vec::new())
    }
}

/// Source bytes from which several threads pay: a megapixel takes one about a millisecond.
const PARALLEL_FROM_BYTES: usize = 8 << 20;

/// Resamples along both axes. `rows` and `cols` must have been made for the picture's size.
pub fn resample(picture: &RgbPicture, cols: &AxisWeights, rows: &AxisWeights) -> RgbPicture {
    let (width, height) = (cols.weights.len(), rows.weights.len());
    let stride = picture.width * 3;
    let mut data = vec![0u8; width * height * 3];
    let sums = || vec![0.0f32; stride];
    if picture.data.len() >= PARALLEL_FROM_BYTES {
        data.par_chunks_mut(width * 3)
            .zip(&rows.weights)
            .for_each_init(sums, |sums, (out, row)| resample_row(picture, cols, row, sums, out));
    } else {
        let mut sums = sums();
        for (out, row) in data.chunks_mut(width * 3).zip(&rows.weights) {
            resample_row(picture, cols, row, &mut sums, out);
        }
    }
    RgbPicture { width, height, data }
}

/// One output row: down the columns first, whole source rows at a time, then along the row.
fn resample_row(
    picture: &RgbPicture,
    cols: &AxisWeights,
    (first, weights): &(usize, Vec<f32>),
    sums: &mut [f32],
    out: &mut [u8],
) {
    sums.fill(0.0);
    for (row, weight) in picture.data.chunks_exact(sums.len()).skip(*first).zip(weights) {
        for (sum, v) in sums.iter_mut().zip(row) {
            *sum += weight * f32::from(*v);
        }
    }
    let (sums, _) = sums.as_chunks::<3>();
    let (pixels, _) = out.as_chunks_mut::<3>();
    for (pixel, (first, weights)) in pixels.iter_mut().zip(&cols.weights) {
        let mut rgb = [0.5f32; 3];
        for (sum, weight) in sums.iter().skip(*first).zip(weights) {
            for (a, s) in rgb.iter_mut().zip(sum) {
                *a += weight * s;
            }
        }
        // `as` saturates; the half added above rounds.
        *pixel = rgb.map(|v| v as u8);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The mean over the covered area, one overlap at a time, in f64.
    fn reference(p: &RgbPicture, width: usize, height: usize, ax: (f64, f64), ay: (f64, f64)) -> Vec<f64> {
        let overlap = |i: usize, from: f64, to: f64| (to.min(i as f64 + 1.0) - from.max(i as f64)).max(0.0);
        let mut out = Vec::new();
        for r in 0..height {
            for c in 0..width {
                let (x0, x1) = (ax.0 * c as f64 + ax.1, ax.0 * (c + 1) as f64 + ax.1);
                let (y0, y1) = (ay.0 * r as f64 + ay.1, ay.0 * (r + 1) as f64 + ay.1);
                let (mut sum, mut total) = ([0.0; 3], 0.0);
                for i in 0..p.height {
                    for j in 0..p.width {
                        let w = overlap(i, y0, y1) * overlap(j, x0, x1);
                        total += w;
                        for (s, v) in sum.iter_mut().zip(&p.data[(i * p.width + j) * 3..]) {
                            *s += w * f64::from(*v);
                        }
                    }
                }
                out.extend(sum.map(|s| if total > 0.0 { s / total } else { 0.0 }));
            }
        }
        out
    }

    /// Rounding to a byte, and f32 sums.
    const BYTE_TOLERANCE: f64 = 0.5 + 1e-3;

    proptest! {
        #[test]
        fn shrinking_is_the_mean_over_the_area(
            (w, h) in (1usize..24, 1usize..24), (ow, oh) in (1usize..9, 1usize..9),
            sx in 1.0f64..4.0, sy in 1.0f64..4.0, tx in -5.0f64..5.0, ty in -5.0f64..5.0, seed in any::<u32>(),
        ) {
            let data = (0..w * h * 3).map(|i| ((i as u32).wrapping_mul(2_654_435_761).wrapping_add(seed) >> 24) as u8).collect();
            let p = RgbPicture { width: w, height: h, data };
            let got = resample(&p, &AxisWeights::new(ow, w, sx, tx), &AxisWeights::new(oh, h, sy, ty));
            for (g, want) in got.data.iter().zip(reference(&p, ow, oh, (sx, tx), (sy, ty))) {
                prop_assert!((f64::from(*g) - want).abs() <= BYTE_TOLERANCE, "{g} {want}");
            }
        }
    }

    #[test]
    fn threads_do_not_change_a_byte() {
        let (w, h) = (2400, 1200);
        let data: Vec<u8> = (0..w * h * 3).map(|i| ((i as u32).wrapping_mul(2_654_435_761) >> 24) as u8).collect();
        assert!(data.len() >= PARALLEL_FROM_BYTES);
        let p = RgbPicture { width: w, height: h, data };
        let (cols, rows) = (AxisWeights::new(50, w, 47.9, 1.3), AxisWeights::new(40, h, 29.7, -3.0));
        let many = resample(&p, &cols, &rows);
        let mut sums = vec![0.0; w * 3];
        for (out, row) in many.data.chunks(150).zip(&rows.weights) {
            let mut alone = vec![0; 150];
            resample_row(&p, &cols, row, &mut sums, &mut alone);
            assert_eq!(out, alone);
        }
    }

    #[test]
    fn identity_copies_and_enlarging_interpolates() {
        let p = RgbPicture { width: 3, height: 2, data: (0..18).map(|i| i * 14).collect() };
        let same = resample(&p, &AxisWeights::new(3, 3, 1.0, 0.0), &AxisWeights::new(2, 2, 1.0, 0.0));
        assert_eq!(same, p);
        // A ramp of centres 0.5 and 1.5 read at 0.25, 0.75, 1.25, 1.75.
        let ramp = RgbPicture { width: 2, height: 1, data: vec![0, 0, 0, 100, 100, 100] };
        let up = resample(&ramp, &AxisWeights::new(4, 2, 0.5, 0.0), &AxisWeights::new(1, 1, 1.0, 0.0));
        assert_eq!(up.data.iter().step_by(3).copied().collect::<Vec<_>>(), [0, 25, 75, 100]);
    }

    #[test]
    fn stripes_finer_than_the_output_come_out_grey() {
        let (w, h) = (1241, 376);
        let data = (0..h * w).flat_map(|i| [if (i % w) % 2 == 0 { 255u8 } else { 0 }; 3]).collect();
        let p = RgbPicture { width: w, height: h, data };
        let cols = AxisWeights::new(96, w, w as f64 / 96.0, 0.0);
        let rows = AxisWeights::new(64, h, h as f64 / 64.0, 0.0);
        let out = resample(&p, &cols, &rows);
        // 12.93 columns per pixel: at most one column of 13 out of balance.
        assert!(out.data.iter().all(|v| v.abs_diff(127) <= 11));
    }
}
