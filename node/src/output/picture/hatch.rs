//! Pixels that no camera saw, hatched.

use super::{Picture, Rgb};

/// The two greys of the hatching.
const LIGHT: Rgb = [150, 152, 158];
const DARK: Rgb = [98, 100, 108];
/// Width of a stripe, pixels.
const STRIPE_PX: usize = 2;

/// The picture with grey diagonal stripes where `valid` (one flag per pixel, row by row) is false.
pub fn hatched(picture: &Picture, valid: &[bool]) -> Picture {
    let width = picture.width();
    Picture::from_fn(width, picture.height(), |col, row| {
        let stripe = if ((col + row) / STRIPE_PX).is_multiple_of(2) { LIGHT } else { DARK };
        match valid.get(row * width + col) {
            Some(false) => stripe,
            _ => picture.get(col, row).unwrap_or(stripe),
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masked_pixels_alone_are_hatched() {
        let plain = Picture::filled(4, 2, [7, 8, 9]);
        let valid = [true, false, false, false, true, true, true, false];
        let out = hatched(&plain, &valid);
        for (i, valid) in valid.iter().enumerate() {
            let color = out.get(i % 4, i / 4).unwrap();
            assert_eq!(color == [7, 8, 9], *valid);
        }
        assert_ne!(out.get(1, 0), out.get(2, 0));
        assert_eq!(hatched(&plain, &[]), plain);
    }
}
