//! Depth in colour: near is red, far is blue, on a logarithmic scale, with a bar that says which is which.

use super::draw::{text_height, text_width};
use super::{OutputError, Picture, Rgb, STRIP, STRIP_TEXT, turbo};

/// Colour of pixels without depth (the sky).
const NO_DEPTH: Rgb = [26, 28, 36];
/// The scale's ends are these percentiles, so that a few stray depths do not flatten the rest.
const LOW_PERCENT: usize = 1;
const HIGH_PERCENT: usize = 99;
/// Depths are shown from 1 m to 100 m when a picture has none.
const DEFAULT_SCALE: DepthScale = DepthScale { near_m: 1.0, far_m: 100.0 };
/// The far end is at least this many times the near end, so that a flat wall does not show its noise.
const MIN_RATIO: f32 = 1.5;

/// Ends of the colour scale, metres; colours follow the logarithm between them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthScale {
    /// Depth shown red.
    pub near_m: f32,
    /// Depth shown blue.
    pub far_m: f32,
}

fn is_depth(d: f32) -> bool {
    d > 0.0 && d.is_finite()
}

impl DepthScale {
    /// Ends that fit the depths of one or several pictures; depths that are 0, negative or not finite do not count.
    pub fn fit<'a>(depths: impl IntoIterator<Item = &'a [f32]>) -> Self {
        let mut all: Vec<f32> = depths.into_iter().flatten().copied().filter(|&d| is_depth(d)).collect();
        all.sort_unstable_by(f32::total_cmp);
        match all.len() {
            0 => DEFAULT_SCALE,
            n => {
                let near_m = all[(n - 1) * LOW_PERCENT / 100];
                let far_m = all[(n - 1) * HIGH_PERCENT / 100].max(near_m * MIN_RATIO);
                Self { near_m, far_m }
            }
        }
    }

    /// Place of a depth on the scale: 0 near, 1 far (outside the ends beyond).
    fn place(&self, depth_m: f32) -> f32 {
        (depth_m / self.near_m).ln() / (self.far_m / self.near_m).ln()
    }

    /// Colour of a depth; dark where there is none.
    pub fn color(&self, depth_m: f32) -> Rgb {
        if is_depth(depth_m) { turbo(0.97 - 0.92 * self.place(depth_m).clamp(0.0, 1.0)) } else { NO_DEPTH }
    }

    /// Round depths (1, 2, 5 times powers of ten) inside the scale.
    pub fn ticks(&self) -> Vec<f32> {
        let decades = -3..6;
        let all = decades.flat_map(|e| [1.0, 2.0, 5.0].map(|m| m * 10f32.powi(e)));
        all.filter(|&d| d >= self.near_m && d <= self.far_m).collect()
    }
}

/// Depth in colour. `depth_m` is row-major; 0, negative or non-finite means none.
pub fn depth_picture(width: usize, height: usize, depth_m: &[f32], scale: DepthScale) -> Result<Picture, OutputError> {
    let expected = width.saturating_mul(height);
    if depth_m.len() != expected {
        return Err(OutputError::Length { what: "depth", expected, got: depth_m.len() });
    }
    Ok(Picture::from_fn(width, height, |col, row| scale.color(depth_m[row * width + col])))
}

/// The picture with a colour bar and its ticks (metres) below.
pub fn with_depth_bar(picture: &Picture, scale: DepthScale) -> Picture {
    let (width, text_scale) = (picture.width(), if picture.width() >= 480 { 2 } else { 1 });
    let bar = 6 * text_scale;
    let strip = bar + text_height(text_scale) + 3 * text_scale;
    let mut out = Picture::filled(width, picture.height() + strip, STRIP);
    out.blit(picture, 0, 0);
    let top = picture.height();
    let ratio = (scale.far_m / scale.near_m).ln();
    for col in 0..width {
        let x = (col as f32 + 0.5) / width as f32;
        out.fill_rect(col, top, 1, bar, scale.color(scale.near_m * (x * ratio).exp()));
    }
    let mut free_from = 0;
    for tick in scale.ticks() {
        let label = if tick >= 1.0 { format!("{tick:.0}m") } else { format!("{tick}m") };
        let col = (scale.place(tick) * width as f32) as usize;
        let half = text_width(&label, text_scale) / 2;
        let left = col.saturating_sub(half).min(width.saturating_sub(2 * half + 1));
        // Labels that would run into the one before are left out; their tick stays.
        out.fill_rect(col.min(width.saturating_sub(1)), top + bar, text_scale, text_scale, STRIP_TEXT);
        if left >= free_from {
            out.text(&label, left, top + bar + 2 * text_scale, text_scale, STRIP_TEXT);
            free_from = left + 2 * half + 6 * text_scale;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_is_red_far_is_blue_and_sky_is_dark() {
        let scale = DepthScale { near_m: 2.0, far_m: 80.0 };
        let p = depth_picture(5, 1, &[2.0, 80.0, 0.0, f32::NAN, 1000.0], scale).unwrap();
        let [near, far] = [p.get(0, 0).unwrap(), p.get(1, 0).unwrap()];
        assert!(near[0] > near[1] && near[0] > near[2], "{near:?}");
        assert!(far[2] > far[1] && far[2] > far[0], "{far:?}");
        assert_eq!((p.get(2, 0), p.get(3, 0)), (Some(NO_DEPTH), Some(NO_DEPTH)));
        assert_eq!(p.get(4, 0), Some(far));
        assert!(depth_picture(2, 2, &[1.0; 3], scale).is_err());
    }

    #[test]
    fn the_scale_ignores_sky_and_strays() {
        let mut depths: Vec<f32> = (0..1000).map(|i| 5.0 + 0.045 * i as f32).collect();
        depths.extend([0.0, f32::NAN, f32::INFINITY, -3.0, 1e9]);
        let scale = DepthScale::fit([depths.as_slice()]);
        assert!(scale.near_m > 4.9 && scale.near_m < 6.0 && scale.far_m > 48.0 && scale.far_m < 51.0, "{scale:?}");
        assert_eq!(scale.ticks(), [10.0, 20.0]);
        assert_eq!(DepthScale::fit([[0.0f32; 4].as_slice()]), DEFAULT_SCALE);
        let flat = DepthScale::fit([[7.0f32; 4].as_slice()]);
        assert!(flat.far_m > flat.near_m);
    }

    #[test]
    fn the_bar_stands_below_and_has_labels() {
        let scale = DepthScale { near_m: 1.0, far_m: 100.0 };
        let picture = depth_picture(200, 10, &[10.0; 2000], scale).unwrap();
        let out = with_depth_bar(&picture, scale);
        assert_eq!((out.width(), out.height()), (200, 10 + 6 + 7 + 3));
        assert_eq!(out.get(100, 5), picture.get(100, 5));
        assert_eq!(out.get(0, 12), Some(scale.color(1.0 * (0.0025f32 * 100f32.ln()).exp())));
        let dark = (18..26).any(|row| (0..200).any(|col| out.get(col, row) == Some(STRIP_TEXT)));
        assert!(dark, "no label drawn");
    }
}
