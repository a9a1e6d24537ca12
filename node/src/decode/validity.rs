//! Which pixels of a camera's network images show something, and what stands in for the others.
//!
//! A pixel shows nothing where rectification looks past the edge of the sensor, where the driver's own rectification left
//! black ([`super::black_frame`]), and where the user's mask hides the vehicle itself. That depends on the camera alone, so it
//! is worked out once. Such pixels take the colour of the nearest pixel that shows something: a patch that shows both sees no
//! edge that is not there.

use std::collections::VecDeque;
use std::sync::Arc;

use super::RgbPicture;

/// The validity mask of one camera at the network's image size; there is at least one pixel of each kind.
#[derive(Debug, Clone)]
pub struct Validity {
    size: (usize, usize),
    valid: Arc<[bool]>,
    /// Masked pixel, and the valid one it takes its colour from.
    fill: Vec<(u32, u32)>,
}

/// A mask that leaves nothing of the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NothingLeft;

impl Validity {
    /// From one flag per pixel of a `width`-wide image, row by row. None when all are valid.
    ///
    /// # Errors
    /// When none is.
    pub fn new(valid: Vec<bool>, width: usize) -> Result<Option<Self>, NothingLeft> {
        if !valid.contains(&false) {
            return Ok(None);
        }
        if !valid.contains(&true) {
            return Err(NothingLeft);
        }
        let height = valid.len() / width.max(1);
        Ok(Some(Self { size: (width, height), fill: nearest(&valid, width, height), valid: valid.into() }))
    }

    /// One flag per pixel, row by row.
    pub fn valid(&self) -> &Arc<[bool]> {
        &self.valid
    }

    /// Share of the pixels that show nothing, 0 to 1.
    pub fn masked_share(&self) -> f64 {
        self.fill.len() as f64 / self.valid.len().max(1) as f64
    }

    /// Gives masked pixels the colour of the nearest valid one. An image of another size is left as it is.
    pub fn fill(&self, picture: &mut RgbPicture) {
        if (picture.width, picture.height) != self.size {
            return;
        }
        let (pixels, _) = picture.data.as_chunks_mut::<3>();
        for &(to, from) in &self.fill {
            if let Some(&color) = pixels.get(from as usize)
                && let Some(pixel) = pixels.get_mut(to as usize)
            {
                *pixel = color;
            }
        }
    }
}

/// Every masked pixel with the valid one nearest to it in steps along rows and columns; of equally near ones always the same.
fn nearest(valid: &[bool], width: usize, height: usize) -> Vec<(u32, u32)> {
    const UNKNOWN: u32 = u32::MAX;
    let mut source = vec![UNKNOWN; width * height];
    let mut queue: VecDeque<usize> = VecDeque::new();
    for i in (0..source.len()).filter(|&i| valid[i]) {
        source[i] = i as u32;
        queue.push_back(i);
    }
    while let Some(i) = queue.pop_front() {
        let (row, col) = (i / width, i % width);
        let around = [
            (row > 0).then(|| i - width),
            (col > 0).then(|| i - 1),
            (col + 1 < width).then(|| i + 1),
            (row + 1 < height).then(|| i + width),
        ];
        for next in around.into_iter().flatten() {
            if source[next] == UNKNOWN {
                source[next] = source[i];
                queue.push_back(next);
            }
        }
    }
    (0..source.len()).filter(|&i| !valid[i]).map(|i| (i as u32, source[i])).collect()
}

/// A mask image of any size, sampled at the pixel centres of a `width x height` image: false where it is black.
pub fn sampled_mask(mask: &RgbPicture, (width, height): (usize, usize)) -> Vec<bool> {
    /// Black as people paint it, JPEG's noise included.
    const BLACK: u8 = 16;
    let at = |i: usize, from: usize, to: usize| ((2 * i + 1) * from / (2 * to)).min(from.saturating_sub(1));
    let shown = |k: usize| {
        let (row, col) = (at(k / width, mask.height, height), at(k % width, mask.width, width));
        let first = 3 * (row * mask.width + col);
        mask.data.get(first..first + 3).is_some_and(|pixel| pixel.iter().any(|&x| x > BLACK))
    };
    (0..width * height).map(shown).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn all_or_nothing_needs_no_mask() {
        assert!(Validity::new(vec![true; 6], 3).unwrap().is_none());
        assert_eq!(Validity::new(vec![false; 6], 3).unwrap_err(), NothingLeft);
        let v = Validity::new(vec![true, false, true, true], 2).unwrap().unwrap();
        assert_eq!(v.masked_share(), 0.25);
    }

    proptest! {
        #[test]
        fn masked_pixels_take_the_nearest_valid_colour_and_valid_ones_stay(
            (w, h) in (1usize..12, 1usize..12), seed in any::<u64>(), share in 0.05f32..0.95,
        ) {
            let mut dice = crate::dice::Dice::new(seed);
            let valid: Vec<bool> = (0..w * h).map(|_| dice.unit() < share).collect();
            let data: Vec<u8> = (0..w * h).flat_map(|i| [i as u8, (i >> 3) as u8, 7]).collect();
            let mut picture = RgbPicture { width: w, height: h, data };
            let before = picture.clone();
            let Ok(Some(validity)) = Validity::new(valid.clone(), w) else { return Ok(()) };
            validity.fill(&mut picture);
            let distance = |a: usize, b: usize| (a / w).abs_diff(b / w) + (a % w).abs_diff(b % w);
            for i in 0..w * h {
                let got = usize::from(picture.data[3 * i]);
                let nearest = (0..w * h).filter(|&j| valid[j]).map(|j| distance(i, j)).min().unwrap();
                prop_assert!(valid[got]);
                prop_assert_eq!(distance(i, got), if valid[i] { 0 } else { nearest });
            }
            let mut other = RgbPicture { width: w + 1, height: h, data: vec![3; 3 * (w + 1) * h] };
            validity.fill(&mut other);
            prop_assert!(other.data.iter().all(|x| *x == 3));
            drop(before);
        }
    }

    #[test]
    fn a_mask_of_any_size_is_sampled_at_pixel_centres() {
        let mask = RgbPicture { width: 2, height: 1, data: vec![255, 255, 255, 3, 9, 0] };
        assert_eq!(sampled_mask(&mask, (4, 2)), [true, true, false, false, true, true, false, false]);
        assert_eq!(sampled_mask(&mask, (1, 1)), [false], "the centre lies in the right half");
        let red = RgbPicture { width: 1, height: 1, data: vec![200, 0, 0] };
        assert_eq!(sampled_mask(&red, (2, 1)), [true, true]);
    }
}
