//! Resampling through an arbitrary map: several bilinear samples per output pixel, averaged, with the map made once.
//!
//! Integer arithmetic throughout, so the result does not depend on the machine.

use rayon::prelude::*;

use super::RgbPicture;

/// Fractions of a pixel a sample's position is kept to.
const FRACTION: f64 = 256.0;
/// Marks a sample that sees nothing.
const NOWHERE: u32 = u32::MAX;
/// Most samples a map may have (8 bytes each); a 33-megapixel camera at its own resolution stays below.
const MAX_SAMPLES: usize = 1 << 26;
/// Most samples along one axis of an output pixel: a 64-fold reduction is still free of aliasing.
const MAX_PER_AXIS: usize = 64;

/// Where a sample lies: the pixel up and left of it, and how far it is towards the next ones (of 256).
#[derive(Debug, Clone, Copy)]
struct Sample {
    index: u32,
    right: u16,
    down: u16,
}

/// A map from an output picture to a source picture.
#[derive(Debug, Clone)]
pub struct Warp {
    width: usize,
    source: (usize, usize),
    per_pixel: usize,
    samples: Vec<Sample>,
}

impl Warp {
    /// Makes the map. `locate` takes a point of the output (pixel edges at integers) to a point of the source, `None` where
    /// it sees nothing. As many samples per output pixel and axis as it covers source pixels.
    pub fn new(
        (width, height): (usize, usize),
        source: (usize, usize),
        locate: impl Fn(f64, f64) -> Option<(f64, f64)> + Sync,
    ) -> Self {
        let per_axis = |source: usize, output: usize| source.div_ceil(output.max(1)).clamp(1, MAX_PER_AXIS);
        let (mut nx, mut ny) = (per_axis(source.0, width), per_axis(source.1, height));
        while width * height * nx * ny > MAX_SAMPLES && nx * ny > 1 {
            (nx, ny) = if nx >= ny { (nx - 1, ny) } else { (nx, ny - 1) };
        }
        let row = |r: usize| {
            let locate = &locate;
            (0..width).flat_map(move |c| {
                (0..nx * ny).map(move |s| {
                    let u = c as f64 + ((s % nx) as f64 + 0.5) / nx as f64;
                    let v = r as f64 + ((s / nx) as f64 + 0.5) / ny as f64;
                    Sample::new(locate(u, v), source)
                })
            })
        };
        let samples = (0..height).into_par_iter().flat_map_iter(row).collect();
        Self { width, source, per_pixel: nx * ny, samples }
    }

    /// Resamples a picture, which must have the size the map was made for.
    pub fn apply(&self, picture: &RgbPicture) -> RgbPicture {
        let (width, per_row) = (self.width, self.width * self.per_pixel);
        let height = self.samples.len() / per_row.max(1);
        let (pixels, _) = picture.data.as_chunks::<3>();
        // A row and a pixel of padding: the neighbours of the last ones, which always have weight zero.
        let mut packed: Vec<u64> = Vec::with_capacity(pixels.len() + self.source.0 + 1);
        packed.extend(pixels.iter().map(|p| pack(*p)));
        packed.resize(pixels.len() + self.source.0 + 1, 0);
        let mut data = vec![0u8; width * height * 3];
        data.par_chunks_mut(width * 3).zip(self.samples.par_chunks(per_row)).for_each(|(out, samples)| {
            let (out, _) = out.as_chunks_mut::<3>();
            for (pixel, samples) in out.iter_mut().zip(samples.chunks(self.per_pixel)) {
                *pixel = self.mean(&packed, samples);
            }
        });
        RgbPicture { width, height, data }
    }

    /// Whether at least half of an output pixel's samples lie within the source, row by row.
    pub fn inside(&self) -> Vec<bool> {
        let seen = |samples: &[Sample]| samples.iter().filter(|s| s.index != NOWHERE).count();
        self.samples.chunks(self.per_pixel.max(1)).map(|samples| 2 * seen(samples) >= samples.len()).collect()
    }

    /// Mean of the samples that see something; black when none does.
    fn mean(&self, pixels: &[u64], samples: &[Sample]) -> [u8; 3] {
        let (mut sum, mut seen) = ([0u32; 3], 0u32);
        let row = self.source.0;
        for s in samples.iter().filter(|s| s.index != NOWHERE) {
            let first = s.index as usize;
            let (Some([a, b]), Some([c, d])) = (pair(pixels, first), pair(pixels, first + row)) else { continue };
            let (x, y) = (u64::from(s.right), u64::from(s.down));
            // Lanes of 16 bits hold 255 * 256, so the three channels go through at once.
            let top = narrow(a * (256 - x) + b * x);
            let bottom = narrow(c * (256 - x) + d * x);
            let v = top * (256 - y) + bottom * y;
            // At most 4096 samples of 255 * 256 fit 32 bits.
            for (i, sum) in sum.iter_mut().enumerate() {
                *sum += (v >> (16 * i)) as u32 & 0xffff;
            }
            seen += 1;
        }
        if seen == 0 { [0; 3] } else { sum.map(|s| ((s + seen * 128) / (seen * 256)).min(255) as u8) }
    }
}

/// Three channels in 16-bit lanes.
fn pack([r, g, b]: [u8; 3]) -> u64 {
    u64::from(r) | u64::from(g) << 16 | u64::from(b) << 32
}

/// Each lane divided by 256, rounded.
fn narrow(lanes: u64) -> u64 {
    ((lanes + 0x0080_0080_0080) >> 8) & 0x00ff_00ff_00ff
}

fn pair(pixels: &[u64], at: usize) -> Option<[u64; 2]> {
    pixels.get(at..)?.first_chunk().copied()
}

impl Sample {
    fn new(at: Option<(f64, f64)>, (width, height): (usize, usize)) -> Self {
        let nowhere = Self { index: NOWHERE, right: 0, down: 0 };
        let Some((u, v)) = at else { return nowhere };
        let (w, h) = (width as f64, height as f64);
        if u >= 0.0 && u <= w && v >= 0.0 && v <= h && w >= 1.0 && h >= 1.0 {
            // Between pixel centres, and flat within half a pixel of the border.
            let fixed = |x: f64, n: f64| ((x - 0.5).clamp(0.0, n - 1.0) * FRACTION).round() as u64;
            let (x, y) = (fixed(u, w), fixed(v, h));
            match u32::try_from((y >> 8) * width as u64 + (x >> 8)) {
                Ok(index) if index != NOWHERE => Self { index, right: (x & 255) as u16, down: (y & 255) as u16 },
                _ => nowhere,
            }
        } else {
            nowhere
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identity_and_outside() {
        let data: Vec<u8> = (0..60).map(|i| i * 4).collect();
        let p = RgbPicture { width: 5, height: 4, data };
        assert_eq!(Warp::new((5, 4), (5, 4), |u, v| Some((u, v))).apply(&p), p);
        let black = Warp::new((5, 4), (5, 4), |_, _| None).apply(&p);
        assert!(black.data.iter().all(|v| *v == 0));
        let nan = Warp::new((5, 4), (5, 4), |_, _| Some((f64::NAN, f64::INFINITY))).apply(&p);
        assert_eq!(nan, black);
        // Shifted by half a pixel: means of neighbours, the last column flat.
        let half = Warp::new((5, 4), (5, 4), |u, v| Some(((u + 0.5).min(5.0), v))).apply(&p);
        assert_eq!(half.data[0], 6);
        assert_eq!(half.data[12..15], p.data[12..15]);
    }

    /// Bilinear samples in f64, averaged.
    fn reference(
        p: &RgbPicture,
        (width, height): (usize, usize),
        n: usize,
        locate: impl Fn(f64, f64) -> (f64, f64),
    ) -> Vec<f64> {
        let at = |x: f64, y: f64, c: usize| {
            let (x, y) = (x.clamp(0.0, p.width as f64 - 1.0), y.clamp(0.0, p.height as f64 - 1.0));
            f64::from(p.data[(y as usize * p.width + x as usize) * 3 + c])
        };
        let mut out = Vec::new();
        for i in 0..width * height * 3 {
            let (row, col, c) = (i / 3 / width, i / 3 % width, i % 3);
            let (mut sum, mut seen) = (0.0, 0.0);
            for s in 0..n * n {
                let step = |k: usize| (k as f64 + 0.5) / n as f64;
                let (u, v) = locate(col as f64 + step(s % n), row as f64 + step(s / n));
                if u >= 0.0 && u <= p.width as f64 && v >= 0.0 && v <= p.height as f64 {
                    let x = (u - 0.5).clamp(0.0, p.width as f64 - 1.0);
                    let y = (v - 0.5).clamp(0.0, p.height as f64 - 1.0);
                    let (fx, fy) = (x.fract(), y.fract());
                    sum += (at(x, y, c) * (1.0 - fx) + at(x + 1.0, y, c) * fx) * (1.0 - fy)
                        + (at(x, y + 1.0, c) * (1.0 - fx) + at(x + 1.0, y + 1.0, c) * fx) * fy;
                    seen += 1.0;
                }
            }
            out.push(if seen > 0.0 { sum / seen } else { 0.0 });
        }
        out
    }

    #[test]
    fn agrees_with_the_slow_version() {
        // Three roundings, and positions kept to 1/256 pixel on a picture with steps of up to 255.
        const TOLERANCE: f64 = 2.5;
        let (w, h) = (61, 47);
        let data = (0..w * h * 3).map(|i| ((i as u32).wrapping_mul(2_654_435_761) >> 24) as u8).collect();
        let p = RgbPicture { width: w, height: h, data };
        let turned = |u: f64, v: f64| (4.3 * u - 0.7 * v + 3.1, 0.9 * u + 4.6 * v - 4.2);
        let (width, height) = (13, 10);
        let out = Warp::new((width, height), (w, h), |u, v| Some(turned(u, v))).apply(&p);
        for (i, (got, want)) in out.data.iter().zip(reference(&p, (width, height), 5, turned)).enumerate() {
            assert!((f64::from(*got) - want).abs() <= TOLERANCE, "{i}: {got} {want}");
        }
        assert!(out.data.contains(&0) && out.data.iter().any(|v| *v > 0));
    }

    #[test]
    fn white_stays_white_however_many_samples() {
        for n in [1, 3, 64, 90] {
            let p = RgbPicture { width: n, height: n, data: vec![255; n * n * 3] };
            let out = Warp::new((1, 1), (n, n), |u, v| Some((u * n as f64, v * n as f64))).apply(&p);
            assert_eq!(out.data, [255, 255, 255]);
        }
    }
}
