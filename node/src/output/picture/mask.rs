//! Masks in colour: one colour per id, alone or laid over the picture they belong to.

use super::{OutputError, Picture, Rgb, hsv};

/// How much of a mask's colour covers the picture below it.
const OVERLAY: f32 = 0.55;
/// Turns of hue between one id and the next: the golden section keeps any few neighbours far apart.
const HUE_STEP: f32 = 0.618_034;

/// Colour of an id; 0 is the background, dark.
pub fn palette(id: u16) -> Rgb {
    match id {
        0 => [26, 28, 36],
        _ => {
            let k = f32::from(id - 1);
            // Every other round is paler, since hues alone run out.
            hsv(0.02 + k * HUE_STEP, if (id / 8).is_multiple_of(2) { 0.85 } else { 0.5 }, 0.98)
        }
    }
}

fn check(expected: usize, ids: &[u16]) -> Result<(), OutputError> {
    let got = ids.len();
    if got == expected { Ok(()) } else { Err(OutputError::Length { what: "mask", expected, got }) }
}

/// Ids in colour, row-major.
pub fn mask_picture(width: usize, height: usize, ids: &[u16]) -> Result<Picture, OutputError> {
    check(width.saturating_mul(height), ids)?;
    Ok(Picture::from_fn(width, height, |col, row| palette(ids[row * width + col])))
}

/// Ids over a picture: the background (0) greyed and darkened, every other id tinted with its colour.
pub fn mask_overlay(picture: &Picture, ids: &[u16]) -> Result<Picture, OutputError> {
    let width = picture.width();
    check(width * picture.height(), ids)?;
    Ok(Picture::from_fn(width, picture.height(), |col, row| {
        let below = picture.get(col, row).unwrap_or_default().map(f32::from);
        match ids[row * width + col] {
            0 => {
                let grey = 0.299 * below[0] + 0.587 * below[1] + 0.114 * below[2];
                below.map(|c| (0.55 * (0.3 * c + 0.7 * grey)).round() as u8)
            }
            id => {
                let above = palette(id);
                [0, 1, 2].map(|k| (below[k] + OVERLAY * (f32::from(above[k]) - below[k])).round() as u8)
            }
        }
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neighbouring_ids_are_far_apart() {
        for a in 0..16u16 {
            for b in 0..a {
                let (p, q) = (palette(a), palette(b));
                let distance: i32 = (0..3).map(|k| (i32::from(p[k]) - i32::from(q[k])).abs()).sum();
                assert!(distance > 40, "{a} and {b}: {p:?} {q:?}");
            }
        }
    }

    #[test]
    fn the_overlay_tints_only_what_is_marked() {
        let picture = Picture::filled(2, 1, [100; 3]);
        let out = mask_overlay(&picture, &[0, 3]).unwrap();
        let [r, g, b] = out.get(0, 0).unwrap();
        assert!(r == g && g == b && r < 100);
        let tinted = out.get(1, 0).unwrap();
        let expected = palette(3).map(|c| (100.0 + OVERLAY * (f32::from(c) - 100.0)).round() as u8);
        assert_eq!(tinted, expected);
        assert!(mask_overlay(&picture, &[0]).is_err());
        assert_eq!(mask_picture(2, 1, &[1, 0]).unwrap().get(0, 0), Some(palette(1)));
    }
}
