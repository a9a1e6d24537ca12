//! Pictures and depth: PSNR, SSIM, depth RMSE, for whole images and regions.
//!
//! As the paper's program computes them: pictures in 0-1; PSNR = -10 log10(MSE); SSIM of Wang et al. 2004 with
//! scikit-image's defaults (7 x 7 uniform window, sample covariance, K1 0.01, K2 0.03, data range 1), its mean taken
//! without the 3-pixel border for whole images and over the region's pixels of the full map (mirrored at the edges)
//! for regions; depth RMSE in metres over pixels whose ground truth is above 0.

use super::{Mean, MetricError, check_finite, check_len, check_mask};

/// Side of SSIM's window, pixels.
const WINDOW: usize = 7;
/// Border left out of a whole image's SSIM, pixels.
const BORDER: usize = WINDOW / 2;
/// `(K1 * range)^2`.
const C1: f64 = 0.01 * 0.01;
/// `(K2 * range)^2`.
const C2: f64 = 0.03 * 0.03;

/// An image in memory: rows of pixels of interleaved channels.
#[derive(Debug, Clone, Copy)]
pub struct Image<'a> {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Values of a pixel.
    pub channels: usize,
    /// `height * width * channels` values, 0-1.
    pub values: &'a [f32],
}

impl Image<'_> {
    pub(super) fn pixels(&self) -> usize {
        self.width.saturating_mul(self.height)
    }

    pub(super) fn check(&self, name: &'static str, like: &Self, mask: Option<&[bool]>) -> Result<(), MetricError> {
        check_len(name, self.values.len(), self.pixels().saturating_mul(self.channels))?;
        check_len(name, self.width, like.width)?;
        check_len(name, self.height, like.height)?;
        check_len(name, self.channels, like.channels)?;
        check_mask(mask, self.pixels())
    }
}

/// A network picture value, -1 to 1, as 0-1.
pub fn unit_from_signed(value: f32) -> f32 {
    (value * 0.5 + 0.5).clamp(0.0, 1.0)
}

/// Mean squared difference over the values of `mask`'s pixels (all without one); `None` of none.
fn mse(pred: &Image<'_>, truth: &Image<'_>, mask: Option<&[bool]>) -> Result<Option<f64>, MetricError> {
    truth.check("truth", truth, mask)?;
    pred.check("prediction", truth, mask)?;
    let (mut sum, mut count) = (0f64, 0usize);
    for (i, (&p, &t)) in pred.values.iter().zip(truth.values).enumerate() {
        if mask.is_none_or(|m| m[i / pred.channels]) {
            let p = check_finite("prediction", i, p.into())?;
            let t = check_finite("truth", i, t.into())?;
            sum += (p - t) * (p - t);
            count += 1;
        }
    }
    Ok((count > 0).then(|| sum / count as f64))
}

/// Peak signal-to-noise ratio in dB (peak 1) over `mask`'s pixels; infinite for equal pictures, `None` of no pixel.
pub fn psnr(pred: &Image<'_>, truth: &Image<'_>, mask: Option<&[bool]>) -> Result<Option<f64>, MetricError> {
    Ok(mse(pred, truth, mask)?.map(|mse| if mse > 0.0 { -10.0 * mse.log10() } else { f64::INFINITY }))
}

/// Index `at + offset - BORDER` mirrored at the edges, edge values repeated (`c b a | a b c | c b a`).
fn mirrored(at: usize, offset: usize, len: usize) -> usize {
    let period = 2 * len as isize;
    let i = (at as isize + offset as isize - BORDER as isize).rem_euclid(period);
    (if i < len as isize { i } else { period - 1 - i }) as usize
}

/// Mean over the window around every pixel.
fn window_mean(plane: &[f64], width: usize, height: usize) -> Vec<f64> {
    let mut rows = vec![0f64; plane.len()];
    for y in 0..height {
        for x in 0..width {
            rows[y * width + x] = (0..WINDOW).map(|o| plane[y * width + mirrored(x, o, width)]).sum();
        }
    }
    let mut out = vec![0f64; plane.len()];
    for y in 0..height {
        for o in 0..WINDOW {
            let from = mirrored(y, o, height) * width;
            for x in 0..width {
                out[y * width + x] += rows[from + x];
            }
        }
    }
    out.iter_mut().for_each(|v| *v /= (WINDOW * WINDOW) as f64);
    out
}

/// SSIM at every pixel and channel, in the pictures' layout.
pub fn ssim_map(pred: &Image<'_>, truth: &Image<'_>) -> Result<Vec<f64>, MetricError> {
    truth.check("truth", truth, None)?;
    pred.check("prediction", truth, None)?;
    let (width, height, channels) = (pred.width, pred.height, pred.channels);
    let sample = (WINDOW * WINDOW) as f64 / (WINDOW * WINDOW - 1) as f64;
    let mut map = vec![0f64; pred.values.len()];
    for c in 0..channels {
        let plane = |name, image: &Image<'_>| -> Result<Vec<f64>, MetricError> {
            let values = image.values.iter().enumerate().skip(c).step_by(channels);
            values.map(|(i, &v)| check_finite(name, i, v.into())).collect()
        };
        let (x, y) = (plane("prediction", pred)?, plane("truth", truth)?);
        let mean = |f: &dyn Fn(f64, f64) -> f64| {
            let product: Vec<f64> = x.iter().zip(&y).map(|(&a, &b)| f(a, b)).collect();
            window_mean(&product, width, height)
        };
        let (ux, uy) = (mean(&|a, _| a), mean(&|_, b| b));
        let (xx, yy, xy) = (mean(&|a, _| a * a), mean(&|_, b| b * b), mean(&|a, b| a * b));
        for i in 0..width * height {
            let var_x = sample * (xx[i] - ux[i] * ux[i]);
            let var_y = sample * (yy[i] - uy[i] * uy[i]);
            let covariance = sample * (xy[i] - ux[i] * uy[i]);
            let top = (2.0 * ux[i] * uy[i] + C1) * (2.0 * covariance + C2);
            let bottom = (ux[i] * ux[i] + uy[i] * uy[i] + C1) * (var_x + var_y + C2);
            map[i * channels + c] = top / bottom;
        }
    }
    Ok(map)
}

/// Mean SSIM: of a whole image without its border (`None` below 7 x 7), or of the full map over `mask`'s pixels
/// (`None` of none).
pub fn ssim(pred: &Image<'_>, truth: &Image<'_>, mask: Option<&[bool]>) -> Result<Option<f64>, MetricError> {
    check_mask(mask, truth.pixels())?;
    let map = ssim_map(pred, truth)?;
    Ok(mean_ssim(&map, truth, mask))
}

fn mean_ssim(map: &[f64], image: &Image<'_>, mask: Option<&[bool]>) -> Option<f64> {
    let inside = |i: usize, len: usize| i >= BORDER && i + BORDER < len;
    let (mut sum, mut count) = (0f64, 0usize);
    for (i, pixel) in map.chunks_exact(image.channels.max(1)).enumerate() {
        let counted = match mask {
            Some(mask) => mask[i],
            None => inside(i % image.width, image.width) && inside(i / image.width, image.height),
        };
        if counted {
            sum += pixel.iter().sum::<f64>();
            count += pixel.len();
        }
    }
    (count > 0).then(|| sum / count as f64)
}

/// Root mean squared depth error, metres, over `mask`'s pixels whose ground truth is above 0; `None` of none.
pub fn depth_rmse(pred: &[f32], truth: &[f32], mask: Option<&[bool]>) -> Result<Option<f64>, MetricError> {
    check_len("predicted depth", pred.len(), truth.len())?;
    check_mask(mask, truth.len())?;
    let (mut sum, mut count) = (0f64, 0usize);
    for (i, (&p, &t)) in pred.iter().zip(truth).enumerate() {
        if t > 0.0 && mask.is_none_or(|m| m[i]) {
            let p = check_finite("predicted depth", i, p.into())?;
            let t = check_finite("true depth", i, t.into())?;
            sum += (p - t) * (p - t);
            count += 1;
        }
    }
    Ok((count > 0).then(|| (sum / count as f64).sqrt()))
}

/// One held-out image with its rendering.
#[derive(Debug, Clone, Copy)]
pub struct Held<'a> {
    /// Rendered picture, 0-1 ([`unit_from_signed`]).
    pub pred: Image<'a>,
    /// The camera's picture, 0-1.
    pub truth: Image<'a>,
    /// Rendered and true z-depth, metres; true depth 0 where unknown.
    pub depth: Option<(&'a [f32], &'a [f32])>,
    /// Pixels of sky.
    pub sky: Option<&'a [bool]>,
    /// Pixels of moving things.
    pub dynamic: Option<&'a [bool]>,
    /// Pixels the camera saw; others count in no figure, nor do SSIM's windows that reach one. `None`: it saw all.
    pub valid: Option<&'a [bool]>,
}

/// The figures of one image, or means of such figures over images that have them.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct ImageScores {
    /// dB, every pixel.
    pub psnr: Option<f64>,
    /// Every pixel but the border.
    pub ssim: Option<f64>,
    /// dB, without sky (the paper's "full image").
    pub psnr_occupied: Option<f64>,
    /// Without sky.
    pub ssim_occupied: Option<f64>,
    /// dB, moving things.
    pub psnr_dynamic: Option<f64>,
    /// Moving things.
    pub ssim_dynamic: Option<f64>,
    /// Metres, every pixel of known depth.
    pub depth_rmse: Option<f64>,
    /// Metres, moving things of known depth.
    pub depth_rmse_dynamic: Option<f64>,
    /// Metres, pixels whose true depth is at most [`LIDAR_REACH_M`].
    pub depth_rmse_lidar: Option<f64>,
}

/// How far the lidars of driving data sets reach, metres: the paper's depth errors are over their returns, while the truth of a
/// procedural drive goes on to the horizon.
pub const LIDAR_REACH_M: f32 = 75.0;

/// Pixels in both regions, none being all.
fn both(a: Option<&[bool]>, b: Option<&[bool]>) -> Option<Vec<bool>> {
    match (a, b) {
        (Some(a), Some(b)) => Some(a.iter().zip(b).map(|(a, b)| *a && *b).collect()),
        (one, other) => one.or(other).map(<[bool]>::to_vec),
    }
}

/// Pixels that are no border of SSIM's window.
fn inside(image: &Image<'_>) -> Vec<bool> {
    let (w, h) = (image.width, image.height);
    let off_border = |i: usize, len: usize| i >= BORDER && i + BORDER < len;
    (0..w * h).map(|i| off_border(i % w, w) && off_border(i / w, h)).collect()
}

/// Pixels around which SSIM's window holds valid ones alone (the image's edges are none).
fn whole_windows(valid: &[bool], image: &Image<'_>) -> Vec<bool> {
    let (w, h) = (image.width, image.height);
    let near = |x: usize, len: usize| x.saturating_sub(BORDER)..(x + BORDER + 1).min(len);
    let rows: Vec<bool> = (0..w * h).map(|i| near(i % w, w).all(|c| valid[i / w * w + c])).collect();
    (0..w * h).map(|i| near(i / w, h).all(|r| rows[r * w + i % w])).collect()
}

impl Held<'_> {
    /// All figures of this image. Regions that were not given have none.
    pub fn scores(&self) -> Result<ImageScores, MetricError> {
        let map = ssim_map(&self.pred, &self.truth)?;
        check_mask(self.valid, self.truth.pixels())?;
        let whole = self.valid.map(|valid| whole_windows(valid, &self.truth));
        let occupied = self.sky.map(|sky| sky.iter().map(|s| !s).collect::<Vec<bool>>());
        let picture = |mask: Option<&[bool]>| -> Result<(Option<f64>, Option<f64>), MetricError> {
            let seen = both(self.valid, mask);
            // A whole image's SSIM leaves out its border too.
            let inner = whole.as_ref().map(|whole| match mask {
                Some(_) => both(Some(whole), mask),
                None => both(Some(whole), Some(&inside(&self.truth))),
            });
            let ssim = mean_ssim(&map, &self.truth, inner.map_or(mask.map(<[bool]>::to_vec), |m| m).as_deref());
            Ok((psnr(&self.pred, &self.truth, seen.as_deref())?, ssim))
        };
        let region = |mask: Option<&[bool]>| mask.map_or(Ok((None, None)), |mask| picture(Some(mask)));
        let depth = |mask: Option<&[bool]>| {
            self.depth.map_or(Ok(None), |(p, t)| depth_rmse(p, t, both(self.valid, mask).as_deref()))
        };
        let (psnr, ssim) = picture(None)?;
        let (psnr_occupied, ssim_occupied) = region(occupied.as_deref())?;
        let (psnr_dynamic, ssim_dynamic) = region(self.dynamic)?;
        let depth_rmse_dynamic = self.dynamic.map_or(Ok(None), |mask| depth(Some(mask)))?;
        let reached = self.depth.map(|(_, t)| t.iter().map(|&t| t <= LIDAR_REACH_M).collect::<Vec<bool>>());
        Ok(ImageScores {
            psnr,
            ssim,
            psnr_occupied,
            ssim_occupied,
            psnr_dynamic,
            ssim_dynamic,
            depth_rmse: depth(None)?,
            depth_rmse_dynamic,
            depth_rmse_lidar: depth(reached.as_deref())?,
        })
    }
}

impl ImageScores {
    /// Each figure's mean over the images that have it (the paper averages over images, not pixels).
    pub fn mean<'a>(scores: impl IntoIterator<Item = &'a ImageScores>) -> ImageScores {
        let mut means = [Mean::default(); 9];
        for s in scores {
            let figures = [
                s.psnr,
                s.ssim,
                s.psnr_occupied,
                s.ssim_occupied,
                s.psnr_dynamic,
                s.ssim_dynamic,
                s.depth_rmse,
                s.depth_rmse_dynamic,
                s.depth_rmse_lidar,
            ];
            means.iter_mut().zip(figures).for_each(|(m, f)| m.add(f));
        }
        let [full, ssim, occupied, ssim_occupied, dynamic, ssim_dynamic, depth, depth_dynamic, depth_lidar] =
            means.map(|m| m.value());
        ImageScores {
            psnr: full,
            ssim,
            psnr_occupied: occupied,
            ssim_occupied,
            psnr_dynamic: dynamic,
            ssim_dynamic,
            depth_rmse: depth,
            depth_rmse_dynamic: depth_dynamic,
            depth_rmse_lidar: depth_lidar,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(values: &[f32], width: usize, channels: usize) -> Image<'_> {
        Image { width, height: values.len() / width / channels, channels, values }
    }

    #[test]
    fn known_values() {
        let (a, b) = ([0.5f32; 12], [0.6f32; 12]);
        let (a, b) = (image(&a, 2, 3), image(&b, 2, 3));
        let got = psnr(&a, &b, None).unwrap().unwrap();
        assert!((got - 20.0).abs() < 1e-5, "0.1 off everywhere is 20 dB: {got}");
        assert_eq!(psnr(&a, &a, None).unwrap(), Some(f64::INFINITY));
        assert_eq!(psnr(&a, &b, Some(&[false; 4])).unwrap(), None);
        assert_eq!(depth_rmse(&[3.0, 9.0, 9.0], &[0.0, 5.0, 6.0], Some(&[true, true, false])).unwrap(), Some(4.0));
        assert_eq!(depth_rmse(&[3.0], &[0.0], None).unwrap(), None);
    }

    #[test]
    fn equal_pictures_have_ssim_one_and_small_ones_none() {
        let values: Vec<f32> = (0..8 * 9 * 3).map(|i| (i % 13) as f32 / 13.0).collect();
        let a = image(&values, 9, 3);
        assert!((ssim(&a, &a, None).unwrap().unwrap() - 1.0).abs() < 1e-12);
        let small = image(&values[..6 * 9], 9, 1);
        assert_eq!(ssim(&small, &small, None).unwrap(), None);
        assert!(ssim(&small, &small, Some(&[true; 54])).unwrap().is_some());
        let one = image(&values[..1], 1, 1);
        assert!((ssim(&one, &one, Some(&[true])).unwrap().unwrap() - 1.0).abs() < 1e-12);
        let none = Image { width: 0, height: 0, channels: 3, values: &[] };
        assert_eq!(ssim(&none, &none, None).unwrap(), None);
        assert_eq!(psnr(&none, &none, None).unwrap(), None);
    }

    #[test]
    fn what_the_camera_did_not_see_counts_in_no_figure() {
        let (w, h) = (20, 16);
        let seen: Vec<f32> = (0..w * h * 3).map(|i| (i % 17) as f32 / 17.0).collect();
        let valid: Vec<bool> = (0..w * h).map(|i| i / w >= 5).collect();
        let sky: Vec<bool> = (0..w * h).map(|i| i % w < 6).collect();
        let depth = vec![5.0; w * h];
        let scores = |unseen: f32, valid: Option<&[bool]>| {
            let mut drawn: Vec<f32> = seen.iter().map(|x| x * 0.9).collect();
            let mut far = vec![6.0; w * h];
            drawn[..5 * w * 3].fill(unseen);
            far[..5 * w].fill(unseen);
            let held = Held {
                pred: image(&drawn, w, 3),
                truth: image(&seen, w, 3),
                depth: Some((&far, &depth)),
                sky: Some(&sky),
                dynamic: Some(&sky),
                valid,
            };
            held.scores().unwrap()
        };
        assert_eq!(scores(0.0, Some(&valid)), scores(1.0, Some(&valid)));
        assert_eq!(scores(0.0, Some(&valid)).depth_rmse, Some(1.0));
        assert_ne!(scores(0.0, None), scores(1.0, None));
        assert_eq!(scores(0.3, None), scores(0.3, Some(&vec![true; w * h])));
    }

    #[test]
    fn wrong_sizes_and_nan_are_errors() {
        let values = [0.5f32; 12];
        let a = image(&values, 2, 3);
        let turned = Image { width: 1, height: 4, ..a };
        assert!(matches!(psnr(&a, &turned, None), Err(MetricError::Size { .. })));
        assert!(matches!(psnr(&a, &a, Some(&[true; 3])), Err(MetricError::Size { .. })));
        assert!(matches!(ssim(&a, &a, Some(&[true; 3])), Err(MetricError::Size { .. })));
        assert!(matches!(depth_rmse(&[1.0], &[1.0, 2.0], None), Err(MetricError::Size { .. })));
        assert!(matches!(depth_rmse(&[f32::NAN], &[1.0], None), Err(MetricError::NonFinite { .. })));
        let bad = [f32::NAN; 12];
        assert!(matches!(psnr(&image(&bad, 2, 3), &a, None), Err(MetricError::NonFinite { index: 0, .. })));
        assert!(matches!(ssim(&image(&bad, 2, 3), &a, None), Err(MetricError::NonFinite { .. })));
    }
}
