//! Where the loss of PSNR comes from: how many dB each mend would gain on its own.
//!
//! With the squared error of an image as the whole:
//! - *colour*: what the affine transform of the rendered colours that fits the true image best (least squares) takes away; where
//!   detail is misplaced the best one also lowers the contrast, so this is the most that colours can be to blame for;
//! - *blur*: what is missing in contrast of fine detail. Images are split into a pyramid of 2 x 2 means; of each of the three finest
//!   levels the energy of the deviations from the means is compared in windows of 16 x 16 pixels. Whatever a rendering's detail looks
//!   like and wherever it lies, with energy `|P|^2` where the truth has `|T|^2 > |P|^2` it errs by at least `(|T| - |P|)^2`
//!   (the triangle inequality): that much is blur, and detail that is as strong but wrong or misplaced is not;
//! - *sky*: the error of the pixels of sky;
//! - *rest*: what is left without sky, after the colours' transform (of the other pixels alone), without the blur: wrong geometry,
//!   motion, occlusion and detail.
//!
//! The first three overlap (a washed-out image lacks contrast and has the wrong colours), so gains need not add up.

use serde::Serialize;

use super::image::Image;
use super::{Mean, MetricError, check_finite, check_len, check_mask};
use crate::scene::{Affine, AffineFit};

/// Mean squared error of rounding to 8 bits: no image is said to be better than this (58.9 dB).
const ROUNDING_MSE: f64 = 1.0 / (12.0 * 255.0 * 255.0);
/// Pull towards unchanged colours, per pixel: only there so that grey images have an answer.
const COLOR_PULL: f64 = 1e-6;
/// Levels of the pyramid that count as detail: structure finer than 8 pixels.
const LEVELS: usize = 3;
/// Side of the windows whose energies are compared, in pixels, as a power of two.
const WINDOW_LOG2: usize = 4;
/// Channels of a pixel.
const CHANNELS: usize = 3;

/// Gains of one image, or their means over images that have them, dB.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Mends {
    /// PSNR of the whole image as it is, sky included.
    pub psnr: Option<f64>,
    /// By the best affine transform of the colours.
    pub color: Option<f64>,
    /// By the missing contrast of detail.
    pub blur: Option<f64>,
    /// By a perfect sky; none where no sky is known.
    pub sky: Option<f64>,
    /// By everything else.
    pub rest: Option<f64>,
}

impl Mends {
    /// Of a rendering `pred` (colours 0-1) of `truth`; `sky` marks pixels of sky. `None` of no pixel.
    ///
    /// # Errors
    /// Images that are not of 3 channels and one size, values that are not finite.
    pub fn of(pred: &Image<'_>, truth: &Image<'_>, sky: Option<&[bool]>) -> Result<Option<Self>, MetricError> {
        check_len("channels", pred.channels, CHANNELS)?;
        truth.check("truth", truth, sky)?;
        pred.check("prediction", truth, sky)?;
        check_mask(sky, truth.pixels())?;
        let (p, t) = (pixels("prediction", pred)?, pixels("truth", truth)?);
        if p.is_empty() {
            return Ok(None);
        }
        let size = (pred.width, pred.height);
        let all = vec![true; p.len()];
        let ground: Vec<bool> = sky.map_or(all.clone(), |sky| sky.iter().map(|s| !s).collect());
        let whole = squares(&p, &t, &all);
        let mended = recolored(&p, &t, &ground);
        // Blur is that of the rendering as it is: the transform gives up contrast where colours are wrong in any case.
        let rest = squares(&mended, &t, &ground) - missing_detail(&p, &t, &ground, size);
        let gain = |left: f64| {
            let mse = |sum: f64| (sum / (CHANNELS * p.len()) as f64).max(ROUNDING_MSE);
            10.0 * (mse(whole) / mse(left)).log10()
        };
        Ok(Some(Self {
            psnr: Some(-10.0 * (whole / (CHANNELS * p.len()) as f64).max(ROUNDING_MSE).log10()),
            color: Some(gain(squares(&recolored(&p, &t, &all), &t, &all)).max(0.0)),
            blur: Some(gain(whole - missing_detail(&p, &t, &all, size))),
            sky: sky.map(|_| gain(squares(&p, &t, &ground))),
            // Both may mend the same.
            rest: Some(gain(whole - rest.clamp(0.0, whole))),
        }))
    }

    /// Each, with its name in tables.
    pub fn rows(&self) -> [(&'static str, Option<f64>); 5] {
        [
            ("PSNR of whole images", self.psnr),
            ("gain: colour", self.color),
            ("gain: blur", self.blur),
            ("gain: sky", self.sky),
            ("gain: rest", self.rest),
        ]
    }
}

/// Means of [`Mends`] over images.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct MendMeans([Mean; 5]);

impl MendMeans {
    /// Counts an image.
    pub fn add(&mut self, one: &Mends) {
        self.0.iter_mut().zip(one.rows()).for_each(|(mean, (_, value))| mean.add(value));
    }

    /// Counts what the other counted too.
    pub fn join(&mut self, other: &Self) {
        self.0.iter_mut().zip(&other.0).for_each(|(mean, other)| mean.join(other));
    }

    /// The means so far.
    pub fn means(&self) -> Mends {
        let [psnr, color, blur, sky, rest] = self.0.map(|mean| mean.value());
        Mends { psnr, color, blur, sky, rest }
    }
}

type Pixel = [f64; CHANNELS];

fn pixels(name: &'static str, image: &Image<'_>) -> Result<Vec<Pixel>, MetricError> {
    let value = |i: usize| check_finite(name, i, f64::from(image.values[i]));
    (0..image.pixels()).map(|k| Ok([value(3 * k)?, value(3 * k + 1)?, value(3 * k + 2)?])).collect()
}

/// Summed squared differences of the pixels of `mask`.
fn squares(a: &[Pixel], b: &[Pixel], mask: &[bool]) -> f64 {
    let one = |(a, b): (&Pixel, &Pixel)| a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum::<f64>();
    a.iter().zip(b).zip(mask).filter(|(_, m)| **m).map(|(pair, _)| one(pair)).sum()
}

/// The rendering with the colours that fit best over the pixels of `mask`.
fn recolored(pred: &[Pixel], truth: &[Pixel], mask: &[bool]) -> Vec<Pixel> {
    let mut fit = AffineFit::default();
    let narrow = |p: &Pixel| p.map(|x| x as f32);
    for ((p, t), _) in pred.iter().zip(truth).zip(mask).filter(|(_, m)| **m) {
        fit.add(narrow(p), narrow(t), 1.0);
    }
    let affine = fit.solve(&Affine::IDENTITY, COLOR_PULL * fit.weight().max(1.0));
    pred.iter().map(|p| affine.apply(narrow(p)).map(f64::from)).collect()
}

/// A level of the pyramid: of every cell how many pixels count, and the means of the rendering's and the truth's.
struct Level {
    width: usize,
    height: usize,
    cells: Vec<(f64, Pixel, Pixel)>,
}

impl Level {
    /// Cells of twice the side, and by window the energies of the rendering's and the truth's deviations from them; `shift` is the
    /// logarithm of a window's side in the larger cells.
    fn coarser(&self, shift: usize) -> (Self, Vec<(f64, f64)>) {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let windows = width.div_ceil(1 << shift);
        let mut energies = vec![(0.0, 0.0); windows * height.div_ceil(1 << shift)];
        let mut cells = Vec::with_capacity(width * height);
        for (row, col) in (0..height).flat_map(|row| (0..width).map(move |col| (row, col))) {
            let inside = |(y, x): &(usize, usize)| *y < self.height && *x < self.width;
            let (y, x) = (2 * row, 2 * col);
            let parts = [(y, x), (y, x + 1), (y + 1, x), (y + 1, x + 1)];
            let parts: Vec<_> =
                parts.iter().filter(|at| inside(at)).map(|(y, x)| &self.cells[y * self.width + x]).collect();
            let count: f64 = parts.iter().map(|c| c.0).sum();
            let mean = |pick: fn(&(f64, Pixel, Pixel)) -> &Pixel| -> Pixel {
                let sum = |k: usize| parts.iter().map(|c| c.0 * pick(c)[k]).sum::<f64>();
                std::array::from_fn(|k| if count > 0.0 { sum(k) / count } else { 0.0 })
            };
            let (pred, truth) = (mean(|c| &c.1), mean(|c| &c.2));
            let energy = &mut energies[(row >> shift) * windows + (col >> shift)];
            for part in parts {
                energy.0 += part.0 * squares(&[part.1], &[pred], &[true]);
                energy.1 += part.0 * squares(&[part.2], &[truth], &[true]);
            }
            cells.push((count, pred, truth));
        }
        (Self { width, height, cells }, energies)
    }
}

/// The part of the summed squared error that is missing contrast of detail, over the pixels of `mask`.
fn missing_detail(pred: &[Pixel], truth: &[Pixel], mask: &[bool], (width, height): (usize, usize)) -> f64 {
    let cells = pred.iter().zip(truth).zip(mask).map(|((p, t), &m)| (f64::from(u8::from(m)), *p, *t)).collect();
    let mut level = Level { width, height, cells };
    let mut missing = 0.0;
    for k in 1..=LEVELS {
        let (coarser, energies) = level.coarser(WINDOW_LOG2 - k);
        missing += energies.iter().map(|(p, t)| (t.sqrt() - p.sqrt()).max(0.0).powi(2)).sum::<f64>();
        level = coarser;
    }
    missing
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const SIZE: (usize, usize) = (32, 16);
    /// Images are f32.
    const EPS: f64 = 1e-3;

    fn image(values: &[f32]) -> Image<'_> {
        Image { width: SIZE.0, height: SIZE.1, channels: 3, values }
    }

    fn paint(color: impl Fn(usize, usize) -> [f32; 3]) -> Vec<f32> {
        (0..SIZE.0 * SIZE.1).flat_map(|i| color(i % SIZE.0, i / SIZE.0)).collect()
    }

    /// 1 or -1 by turns, in squares of `side` pixels.
    fn checker(x: usize, y: usize, side: usize) -> f32 {
        if (x / side + y / side).is_multiple_of(2) { 1.0 } else { -1.0 }
    }

    fn mends(pred: &[f32], truth: &[f32], sky: Option<&[bool]>) -> Mends {
        Mends::of(&image(pred), &image(truth), sky).unwrap().unwrap()
    }

    #[test]
    fn wrong_colours_are_all_mended_by_colours() {
        let truth = paint(|x, y| [x as f32 / 32.0, y as f32 / 16.0, ((x * y) % 7) as f32 / 7.0]);
        let turned = Affine { matrix: [[0.7, 0.1, 0.0], [0.0, 0.8, 0.1], [0.1, 0.0, 0.9]], bias: [0.1, 0.0, -0.05] };
        let pred: Vec<f32> = truth.chunks_exact(3).flat_map(|c| turned.apply([c[0], c[1], c[2]])).collect();
        let m = mends(&pred, &truth, None);
        // Down to the rounding of 8 bits.
        assert!((m.psnr.unwrap() + m.color.unwrap() + 10.0 * ROUNDING_MSE.log10()).abs() < EPS, "{m:?}");
        assert!(m.rest.unwrap() < EPS && m.sky.is_none(), "{m:?}");
    }

    #[test]
    fn detail_at_half_its_contrast_is_blur_and_an_offset_is_not() {
        // Detail of 0.2 at half contrast and an offset of 0.1: both err by 0.1, together by twice the square of it.
        for side in [1, 2, 4] {
            let truth = paint(|x, y| [0.5 + 0.2 * checker(x, y, side); 3]);
            let pred = paint(|x, y| [0.6 + 0.1 * checker(x, y, side); 3]);
            let m = mends(&pred, &truth, None);
            let two = 10.0 * 2f64.log10();
            assert!((m.psnr.unwrap() - (20.0 - two)).abs() < EPS, "{m:?}");
            assert!((m.blur.unwrap() - two).abs() < EPS, "{side}: {m:?}");
            // Transforming the colours mends both here, and leaves nothing.
            assert!(m.color.unwrap() > 30.0 && m.rest.unwrap() < EPS, "{m:?}");
        }
        // Structure of 8 pixels is no detail.
        let truth = paint(|x, y| [0.5 + 0.2 * checker(x, y, 8); 3]);
        let pred = paint(|x, y| [0.6 + 0.1 * checker(x, y, 8); 3]);
        assert!(mends(&pred, &truth, None).blur.unwrap() < EPS);
    }

    #[test]
    fn detail_that_is_nowhere_is_blur_whatever_the_colours() {
        let truth = paint(|x, y| [0.5 + 0.2 * checker(x, y, 2); 3]);
        let flat = vec![0.5; truth.len()];
        let m = mends(&flat, &truth, None);
        assert!((m.psnr.unwrap() + m.blur.unwrap() + 10.0 * ROUNDING_MSE.log10()).abs() < EPS, "{m:?}");
        assert!(m.color.unwrap() < EPS && m.rest.unwrap() < EPS, "{m:?}");
    }

    #[test]
    fn detail_in_the_wrong_place_is_the_rest() {
        // Stripes across, where there are stripes along: as strong, and without anything in common.
        let sign = |x: usize| if x.is_multiple_of(2) { 0.2 } else { -0.2 };
        let (truth, pred) = (paint(|x, _| [0.5 + sign(x); 3]), paint(|_, y| [0.5 + sign(y); 3]));
        let m = mends(&pred, &truth, None);
        assert!(m.blur.unwrap() < EPS, "{m:?}");
        // The best colours are those of no contrast: they halve the error, the other half is the rest.
        let two = 10.0 * 2f64.log10();
        assert!((m.color.unwrap() - two).abs() < EPS && (m.rest.unwrap() - two).abs() < EPS, "{m:?}");
    }

    #[test]
    fn the_sky_is_counted_apart() {
        let sky: Vec<bool> = (0..SIZE.0 * SIZE.1).map(|i| i / SIZE.0 < 4).collect();
        let truth = paint(|x, y| [if y < 4 { 0.9 } else { (x % 5) as f32 / 5.0 }; 3]);
        let pred = paint(|x, y| [if y < 4 { 0.5 } else { (x % 5) as f32 / 5.0 }; 3]);
        let m = mends(&pred, &truth, Some(&sky));
        assert!((m.psnr.unwrap() + m.sky.unwrap() + 10.0 * ROUNDING_MSE.log10()).abs() < EPS, "{m:?}");
        assert!((m.psnr.unwrap() + 10.0 * (0.16f64 / 4.0).log10()).abs() < EPS && m.rest.unwrap() < EPS, "{m:?}");
        let whole = mends(&pred, &truth, Some(&vec![false; sky.len()]));
        assert_eq!((whole.sky, whole.psnr), (Some(0.0), m.psnr));
    }

    #[test]
    fn equal_images_gain_nothing_and_bad_ones_are_errors() {
        let truth = paint(|x, y| [(x * y % 9) as f32 / 9.0; 3]);
        let m = mends(&truth, &truth, None);
        assert_eq!((m.color, m.blur, m.rest), (Some(0.0), Some(0.0), Some(0.0)));
        let bad = vec![f32::NAN; truth.len()];
        assert!(matches!(Mends::of(&image(&bad), &image(&truth), None), Err(MetricError::NonFinite { .. })));
        assert!(matches!(Mends::of(&image(&truth), &image(&truth), Some(&[true])), Err(MetricError::Size { .. })));
        let grey = Image { channels: 1, width: 1, height: 1, values: &[0.5] };
        assert!(matches!(Mends::of(&grey, &grey, None), Err(MetricError::Size { .. })));
        let none = Image { channels: 3, width: 0, height: 0, values: &[] };
        assert_eq!(Mends::of(&none, &none, None).unwrap(), None);
    }

    proptest! {
        #[test]
        fn gains_are_numbers_and_blur_is_never_more_than_the_error(
            values in prop::collection::vec((0f32..1.0, 0f32..1.0), 3 * 13 * 9),
            sky in prop::collection::vec(any::<bool>(), 13 * 9),
        ) {
            let (p, t): (Vec<f32>, Vec<f32>) = values.into_iter().unzip();
            let odd = |values| Image { width: 13, height: 9, channels: 3, values };
            let m = Mends::of(&odd(&p), &odd(&t), Some(&sky)).unwrap().unwrap();
            for (name, value) in m.rows() {
                prop_assert!(value.is_some_and(|x| x.is_finite() && x >= 0.0), "{name}: {value:?}");
            }
            let (p, t) = (pixels("p", &odd(&p)).unwrap(), pixels("t", &odd(&t)).unwrap());
            let missing = missing_detail(&p, &t, &sky, (13, 9));
            prop_assert!(missing <= squares(&p, &t, &sky) + 1e-9);
        }
    }
}
