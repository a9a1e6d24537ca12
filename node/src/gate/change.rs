//! Whether two pictures of one camera show the same, up to the camera's noise.
//!
//! The question is asked of the worst place, not of the mean: a pedestrian who steps out far away changes a handful of pixels. Every
//! 4x4 patch (they overlap by half) and every single pixel is compared with what the noise of these two pictures allows.

use crate::decode::RgbPicture;

/// Side of a patch, pixels; patches start at every second pixel.
const PATCH: usize = 4;
const STRIDE: usize = 2;
/// A Gaussian's standard deviation over the median of its absolute values.
const SIGMA_OVER_MAD: f32 = 1.4826;
/// Least noise assumed of the difference of two 8-bit pictures: that of rounding both.
const LEAST_SIGMA: f32 = 0.41;
/// More noise than this is not believed: what looks like it is change everywhere (rain, a shaking mount).
const MOST_SIGMA: f32 = 8.0;
/// A pixel alone has to stand out so much more than a patch: there are many, and compression makes them jump.
const PIXEL_SIGMAS_FACTOR: f32 = 1.5;
const PIXEL_LEVELS_FACTOR: f32 = 5.0;
/// What is allowed a patch in the mean, a single pixel of it may exceed by this factor.
const PIXEL_SLACK_FACTOR: f32 = 2.0;

/// What counts as change.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sensitivity {
    /// Standard deviations of the noise of a patch's mean.
    pub sigmas: f32,
    /// And at least so many 8-bit levels.
    pub levels: f32,
}

/// A place where two pictures differ.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Change {
    /// Column and row of the patch's or pixel's corner.
    pub at: [usize; 2],
    /// How much, 8-bit levels, mean over the patch.
    pub levels: f32,
}

/// The first place where `b` differs from `a` by more than noise; none where they show the same. Pictures of different sizes
/// differ everywhere. `valid`: the pixels that show something; others, and how many there are, change nothing. None: all do.
pub fn first_change(
    a: &RgbPicture,
    b: &RgbPicture,
    valid: Option<&[bool]>,
    sensitivity: Sensitivity,
) -> Option<Change> {
    let (w, h) = (a.width, a.height);
    let whole = |p: &RgbPicture| p.width == w && p.height == h && p.data.len() == 3 * w * h;
    if !whole(a) || !whole(b) {
        return Some(Change { at: [0, 0], levels: 255.0 });
    }
    if a.data == b.data {
        return None;
    }
    // Sum over the channels: what moves mostly changes all three alike, and noise grows more slowly than that.
    let mut d: Vec<i16> = a
        .data
        .chunks_exact(3)
        .zip(b.data.chunks_exact(3))
        .map(|(a, b)| (0..3).map(|c| i16::from(b[c]) - i16::from(a[c])).sum())
        .collect();
    leave_out(&mut d, valid);
    first_beyond(&d, None, valid, (w, h), sensitivity)
}

/// The first place where `d`, differences summed over the three channels of a picture of this width and height, is beyond noise;
/// `slack`, per pixel and summed likewise, is allowed on top. `valid` as in [`first_change`]; what is not has to be 0 in `d`.
pub(super) fn first_beyond(
    d: &[i16],
    slack: Option<&[f32]>,
    valid: Option<&[bool]>,
    (w, h): (usize, usize),
    sensitivity: Sensitivity,
) -> Option<Change> {
    let sigma = noise(d, w, valid).clamp(LEAST_SIGMA * 3f32.sqrt(), MOST_SIGMA * 3f32.sqrt());
    let pixel_limit =
        (PIXEL_SIGMAS_FACTOR * sensitivity.sigmas * sigma).max(PIXEL_LEVELS_FACTOR * 3.0 * sensitivity.levels);
    let limit = (sensitivity.sigmas * sigma / ((PATCH * PATCH) as f32).sqrt()).max(3.0 * sensitivity.levels);
    if slack.is_none() && w.min(h) >= PATCH {
        return if quiet(d, w, [pixel_limit, limit]) { None } else { place(d, None, (w, h), [pixel_limit, limit]) };
    }
    place(d, slack, (w, h), [pixel_limit, limit])
}

/// Puts 0 where nothing is shown.
pub(super) fn leave_out(d: &mut [i16], valid: Option<&[bool]>) {
    if let Some(valid) = valid {
        d.iter_mut().zip(valid).filter(|(_, valid)| !**valid).for_each(|(d, _)| *d = 0);
    }
}

/// Whether no pixel and no patch is beyond its limit: what [`place`] says of most pictures of a scene at rest; several times quicker.
fn quiet(d: &[i16], w: usize, [pixel_limit, limit]: [f32; 2]) -> bool {
    let most = d.iter().fold(0, |m, x| x.unsigned_abs().max(m));
    if f32::from(most) > pixel_limit {
        return false;
    }
    // A patch is four blocks of 2x2, since patches start at every second pixel.
    let (mut above, mut blocks) = (Vec::new(), vec![0i32; w / 2]);
    let most = limit * (PATCH * PATCH) as f32;
    for rows in d.chunks_exact(2 * w) {
        let (upper, lower) = rows.split_at(w);
        let pairs = upper.chunks_exact(2).zip(lower.chunks_exact(2));
        for (block, (u, l)) in blocks.iter_mut().zip(pairs) {
            *block = i32::from(u[0]) + i32::from(u[1]) + i32::from(l[0]) + i32::from(l[1]);
        }
        let sums = blocks.windows(2).zip(above.windows(2)).map(|(b, a): (&[i32], &[i32])| b[0] + b[1] + a[0] + a[1]);
        if sums.fold(0, |m, x| m.max(x.abs())) as f32 > most {
            return false;
        }
        above.clone_from(&blocks);
    }
    true
}

/// The first pixel or patch beyond its limit.
fn place(d: &[i16], slack: Option<&[f32]>, (w, h): (usize, usize), [pixel_limit, limit]: [f32; 2]) -> Option<Change> {
    let slack = |i: usize| slack.map_or(0.0, |s| s[i]);
    let stands_out = |(i, x): (usize, &i16)| f32::from(*x).abs() > pixel_limit + PIXEL_SLACK_FACTOR * slack(i);
    if let Some(i) = d.iter().enumerate().position(stands_out) {
        return Some(Change { at: [i % w, i / w], levels: f32::from(d[i]) / 3.0 });
    }
    let starts = |size: usize| (0..=size.saturating_sub(PATCH)).step_by(STRIDE);
    for y in starts(h) {
        for x in starts(w) {
            let (mut sum, mut allowed, mut count) = (0i32, 0.0, 0usize);
            for row in y..(y + PATCH).min(h) {
                for i in row * w + x..row * w + (x + PATCH).min(w) {
                    sum += i32::from(d[i]);
                    allowed += slack(i);
                    count += 1;
                }
            }
            let (mean, allowed) = (sum as f32 / count.max(1) as f32, allowed / count.max(1) as f32);
            if mean.abs() > limit + allowed {
                return Some(Change { at: [x, y], levels: mean / 3.0 });
            }
        }
    }
    None
}

/// Standard deviation of the noise in a picture of differences. From neighbours' differences, so that a change of exposure,
/// which is the same everywhere, is not taken for noise; from their median, so that a mover is not either. `valid`: the pixels
/// that count.
fn noise(d: &[i16], width: usize, valid: Option<&[bool]>) -> f32 {
    // Differences of sums of three 8-bit differences fit; larger ones are beyond `MOST_SIGMA` in any case.
    let mut counts = [0u32; 2048];
    let mut all = 0;
    for (r, row) in d.chunks_exact(width.max(1)).enumerate() {
        match valid.and_then(|valid| valid.get(r * width..(r + 1) * width)) {
            Some(valid) => {
                for (pair, _) in row.windows(2).zip(valid.windows(2)).filter(|(_, valid)| valid[0] && valid[1]) {
                    counts[usize::from(pair[0].abs_diff(pair[1])).min(counts.len() - 1)] += 1;
                    all += 1;
                }
            }
            None => {
                for (a, b) in row.iter().zip(&row[1..]) {
                    counts[usize::from(a.abs_diff(*b)).min(counts.len() - 1)] += 1;
                }
                all += row.len() as u32 - 1;
            }
        }
    }
    let mut below = 0;
    let median = counts.iter().position(|&n| {
        below += n;
        below > all / 2
    });
    SIGMA_OVER_MAD * median.unwrap_or(0) as f32 / std::f32::consts::SQRT_2
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::dice::Dice;

    const NORMAL: Sensitivity = Sensitivity { sigmas: 6.0, levels: 1.5 };

    /// A street-like picture with noise of this standard deviation (sum of uniforms).
    fn picture(seed: u64, sigma: f32) -> RgbPicture {
        let (width, height) = (96, 64);
        let mut dice = Dice::new(seed);
        let data = (0..3 * width * height).map(|i| {
            let (x, y, c) = (i / 3 % width, i / 3 / width, i % 3);
            let base = 90.0 + 60.0 * ((x as f32 * 0.2).sin() * (y as f32 * 0.15).cos()) + 10.0 * c as f32;
            let noise = (0..12).map(|_| dice.unit()).sum::<f32>() - 6.0;
            (base + sigma * noise).round().clamp(0.0, 255.0) as u8
        });
        RgbPicture { width, height, data: data.collect() }
    }

    fn changed(mut p: RgbPicture, side: usize, levels: i16) -> RgbPicture {
        for y in 30..30 + side {
            for x in 50..50 + side {
                for c in 0..3 {
                    let v = &mut p.data[3 * (y * 96 + x) + c];
                    *v = (i16::from(*v) + levels).clamp(0, 255) as u8;
                }
            }
        }
        p
    }

    #[test]
    fn noise_alone_is_no_change() {
        for (k, sigma) in [0.0, 0.5, 1.0, 2.0, 4.0].into_iter().enumerate() {
            for seed in 0..40 {
                let (a, b) = (picture(1000 * k as u64 + seed, sigma), picture(1000 * k as u64 + seed + 500, sigma));
                assert_eq!(first_change(&a, &b, None, NORMAL), None, "sigma {sigma}, seed {seed}");
            }
        }
    }

    #[test]
    fn a_small_far_mover_is_a_change_whatever_the_noise() {
        for sigma in [0.0, 1.0, 2.0] {
            for (side, levels) in [(2, 40), (3, 25), (4, -15), (8, 8)] {
                for seed in 0..10 {
                    let (a, b) = (picture(seed, sigma), changed(picture(seed + 500, sigma), side, levels));
                    let change = first_change(&a, &b, None, NORMAL);
                    let change = change.unwrap_or_else(|| panic!("{side} pixels by {levels} in noise {sigma}"));
                    assert!(change.at[0].abs_diff(50) <= 8 && change.at[1].abs_diff(30) <= 8, "{change:?}");
                }
            }
        }
    }

    proptest! {
        /// The quick answer is the slow one's, also at limits met exactly and at odd sizes.
        #[test]
        fn quiet_pictures_are_those_in_which_nothing_is_found(
            (w, h) in (4usize..23, 4usize..23), seed in 0u64..1000, spread in 0i32..60, pixel in 0i32..60, patch in 0i32..160,
        ) {
            let mut dice = Dice::new(seed);
            let d: Vec<i16> = (0..w * h).map(|_| ((dice.unit() - 0.5) * spread as f32) as i16).collect();
            let limits = [pixel as f32, patch as f32 / 16.0];
            prop_assert_eq!(quiet(&d, w, limits), place(&d, None, (w, h), limits).is_none());
        }

        #[test]
        fn noise_is_the_median_step(w in 1usize..20, h in 1usize..20, seed in 0u64..1000, spread in 0i32..3000) {
            let mut dice = Dice::new(seed);
            let d: Vec<i16> = (0..w * h).map(|_| ((dice.unit() - 0.5) * spread as f32) as i16).collect();
            let mut steps: Vec<u16> =
                d.chunks_exact(w).flat_map(|row| row.windows(2).map(|p| p[0].abs_diff(p[1]).min(2047))).collect();
            steps.sort_unstable();
            let median = steps.get(steps.len() / 2).copied().unwrap_or(0);
            prop_assert_eq!(noise(&d, w, None), SIGMA_OVER_MAD * f32::from(median) / std::f32::consts::SQRT_2);
        }
    }

    #[test]
    fn what_shows_nothing_is_no_change_and_hides_none() {
        // The upper half shows nothing; whatever stands there changes from one to the other.
        let valid: Vec<bool> = (0..96 * 64).map(|i| i / 96 >= 32).collect();
        for seed in 0..20 {
            let (a, mut b) = (picture(seed, 2.0), picture(seed + 500, 2.0));
            b.data[..3 * 96 * 32].iter_mut().enumerate().for_each(|(i, x)| *x = (i * 13 % 256) as u8);
            assert_eq!(first_change(&a, &b, Some(&valid), NORMAL), None, "seed {seed}");
            assert!(first_change(&a, &b, None, NORMAL).is_some());
            // A small mover in the lower half is seen all the same, and noise is that of the lower half.
            let (side, levels) = (3, 25);
            for y in 40..40 + side {
                for x in 50..50 + side {
                    (0..3).for_each(|c| {
                        b.data[3 * (y * 96 + x) + c] = b.data[3 * (y * 96 + x) + c].saturating_add(levels)
                    });
                }
            }
            assert!(first_change(&a, &b, Some(&valid), NORMAL).is_some_and(|change| change.at[1] >= 32));
        }
    }

    #[test]
    fn exposure_and_other_sizes_are_changes() {
        let a = picture(1, 2.0);
        let mut b = picture(2, 2.0);
        b.data.iter_mut().for_each(|x| *x = x.saturating_add(4));
        assert!(first_change(&a, &b, None, NORMAL).is_some());
        let smaller = RgbPicture { width: 48, height: 64, data: vec![0; 48 * 64 * 3] };
        assert!(first_change(&a, &smaller, None, NORMAL).is_some());
        let broken = RgbPicture { width: 96, height: 64, data: vec![0; 7] };
        assert!(first_change(&a, &broken, None, NORMAL).is_some());
        assert_eq!(first_change(&broken, &broken, None, NORMAL).map(|c| c.at), Some([0, 0]));
    }

    #[test]
    fn pictures_smaller_than_a_patch_are_compared_too() {
        let one = |x| RgbPicture { width: 2, height: 1, data: vec![x; 6] };
        assert_eq!(first_change(&one(10), &one(11), None, NORMAL), None);
        assert!(first_change(&one(10), &one(40), None, NORMAL).is_some());
    }
}
