//! The loss of 3D Gaussian Splatting (Kerbl et al., 2023, eq. 7): `0.8 L1 + 0.2 (1 - SSIM)`, and its gradient.
//!
//! SSIM here is the training one: Gaussian window of 11 x 11 (sigma 1.5), zeros beyond the border, mean over every value. The
//! figure that is reported (`storm_model::metrics::image`) is another.

use rayon::prelude::*;

/// Weight of the structural term.
pub const DSSIM_WEIGHT: f64 = 0.2;
const TAPS: usize = 11;
const REACH: usize = TAPS / 2;
const SIGMA: f64 = 1.5;
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
const CHANNELS: usize = 3;

/// One camera's picture with what of the loss does not depend on the rendering.
#[derive(Debug, Clone)]
pub struct Reference {
    width: usize,
    height: usize,
    planes: Vec<Plane>,
}

#[derive(Debug, Clone)]
struct Plane {
    values: Vec<f32>,
    mean: Vec<f32>,
    square: Vec<f32>,
}

impl Reference {
    /// From `height * width * 3` values of 0-1.
    pub fn new(rgb01: &[f32], width: usize, height: usize) -> Self {
        let plane = |c: usize| {
            let values: Vec<f32> = rgb01.iter().skip(c).step_by(CHANNELS).copied().collect();
            let squares: Vec<f32> = values.iter().map(|x| x * x).collect();
            let mean = blur(&values, width, height);
            let square = blur(&squares, width, height);
            Plane { values, mean, square }
        };
        Self { width, height, planes: (0..CHANNELS).map(plane).collect() }
    }

    /// Its value number `i`, in the layout it was made of.
    pub fn value(&self, i: usize) -> f32 {
        self.planes.get(i % CHANNELS).and_then(|plane| plane.values.get(i / CHANNELS)).copied().unwrap_or(0.0)
    }

    /// The loss of `rgb01` (same layout as the reference's), and its gradient with respect to it.
    pub fn compare(&self, rgb01: &[f32]) -> (f64, Vec<f32>) {
        let count = rgb01.len().max(1) as f64;
        let planes: Vec<(f64, Vec<f32>)> =
            self.planes.par_iter().enumerate().map(|(c, plane)| self.plane(plane, c, rgb01, count)).collect();
        let loss = DSSIM_WEIGHT + planes.iter().map(|(loss, _)| loss).sum::<f64>();
        let mut gradient = vec![0.0; rgb01.len()];
        for (c, (_, plane)) in planes.iter().enumerate() {
            gradient.iter_mut().skip(c).step_by(CHANNELS).zip(plane).for_each(|(to, &from)| *to = from);
        }
        (loss, gradient)
    }

    /// One channel's share of the loss (without the constant) and the gradient there.
    fn plane(&self, truth: &Plane, channel: usize, rgb01: &[f32], count: f64) -> (f64, Vec<f32>) {
        let (width, height) = (self.width, self.height);
        let x: Vec<f32> = rgb01.iter().skip(channel).step_by(CHANNELS).copied().collect();
        let y = &truth.values;
        let mean = blur(&x, width, height);
        let square = blur(&x.iter().map(|x| x * x).collect::<Vec<f32>>(), width, height);
        let cross = blur(&x.iter().zip(y).map(|(x, y)| x * y).collect::<Vec<f32>>(), width, height);
        let n = x.len();
        // Slopes of the summed similarity in the three blurred pictures.
        let (mut by_mean, mut by_square, mut by_cross) = (vec![0f32; n], vec![0f32; n], vec![0f32; n]);
        let mut similarity = 0f64;
        for i in 0..n {
            let (mx, my) = (mean[i], truth.mean[i]);
            let (vx, vy, vxy) = (square[i] - mx * mx, truth.square[i] - my * my, cross[i] - mx * my);
            let (a1, a2) = (2.0 * mx * my + C1, 2.0 * vxy + C2);
            let (b1, b2) = (mx * mx + my * my + C1, vx + vy + C2);
            let share = 1.0 / (b1 * b2);
            let s = a1 * a2 * share;
            similarity += f64::from(s);
            by_square[i] = -s / b2;
            by_cross[i] = 2.0 * a1 * share;
            by_mean[i] = 2.0 * my * (a2 - a1) * share + 2.0 * mx * s * (1.0 / b2 - 1.0 / b1);
        }
        let (by_mean, by_square) = (blur(&by_mean, width, height), blur(&by_square, width, height));
        let by_cross = blur(&by_cross, width, height);
        let (flat, structural) = (((1.0 - DSSIM_WEIGHT) / count) as f32, (DSSIM_WEIGHT / count) as f32);
        let mut absolute = 0f64;
        let mut gradient = vec![0f32; n];
        for i in 0..n {
            let gap = x[i] - y[i];
            absolute += f64::from(gap.abs());
            let sign = if gap > 0.0 { 1.0 } else { -f32::from(u8::from(gap < 0.0)) };
            gradient[i] = flat * sign - structural * (by_mean[i] + 2.0 * x[i] * by_square[i] + y[i] * by_cross[i]);
        }
        ((1.0 - DSSIM_WEIGHT) * absolute / count - DSSIM_WEIGHT * similarity / count, gradient)
    }
}

fn taps() -> [f32; TAPS] {
    let raw: [f64; TAPS] = std::array::from_fn(|k| (-((k as f64 - REACH as f64) / SIGMA).powi(2) / 2.0).exp());
    let sum: f64 = raw.iter().sum();
    raw.map(|x| (x / sum) as f32)
}

/// Gaussian window around every pixel, zeros beyond the border; its own transpose.
fn blur(plane: &[f32], width: usize, height: usize) -> Vec<f32> {
    let taps = taps();
    let mut rows = vec![0f32; width * height];
    let mut padded = vec![0f32; width + 2 * REACH];
    for (from, to) in plane.chunks_exact(width).zip(rows.chunks_exact_mut(width)) {
        padded[REACH..REACH + width].copy_from_slice(from);
        for (k, &tap) in taps.iter().enumerate() {
            to.iter_mut().zip(&padded[k..]).for_each(|(to, from)| *to += tap * from);
        }
    }
    let mut out = vec![0f32; width * height];
    for (y, to) in out.chunks_exact_mut(width).enumerate() {
        for (k, &tap) in taps.iter().enumerate() {
            let Some(from) = (y + k).checked_sub(REACH).filter(|&row| row < height) else { continue };
            let from = &rows[from * width..(from + 1) * width];
            to.iter_mut().zip(from).for_each(|(to, from)| *to += tap * from);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dice::Dice;

    const W: usize = 14;
    const H: usize = 9;

    fn picture(seed: u64) -> Vec<f32> {
        let mut dice = Dice::new(seed);
        (0..W * H * CHANNELS).map(|i| 0.5 + 0.3 * (i as f32 * 0.11).sin() + 0.2 * (dice.unit() - 0.5)).collect()
    }

    #[test]
    fn equal_pictures_cost_nothing() {
        let a = picture(1);
        let (loss, gradient) = Reference::new(&a, W, H).compare(&a);
        // The mean of 378 similarities of 1, each rounded to f32.
        assert!(loss.abs() < 1e-6, "{loss}");
        assert!(gradient.iter().all(|g| g.abs() < 1e-6));
        assert!(Reference::new(&a, W, H).compare(&picture(2)).0 > 0.02);
    }

    #[test]
    fn the_gradient_is_the_slope() {
        let (a, b) = (picture(3), picture(4));
        let reference = Reference::new(&a, W, H);
        let (_, gradient) = reference.compare(&b);
        // Central differences of an f32 loss of about 0.1: the step is chosen so that 1e-8 of rounding is 1e-5 of slope.
        let step = 2e-3f32;
        for i in (0..b.len()).step_by(17) {
            let at = |x: f32| {
                let mut moved = b.clone();
                moved[i] = x;
                reference.compare(&moved).0
            };
            let slope = (at(b[i] + step) - at(b[i] - step)) / f64::from(2.0 * step);
            let crosses_kink = (b[i] - a[i]).abs() <= step;
            assert!(crosses_kink || (slope - f64::from(gradient[i])).abs() < 2e-5, "{i}: {slope} {}", gradient[i]);
        }
    }
}
