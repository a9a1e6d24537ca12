//! Bayer mosaics: each missing colour is the mean of its nearest neighbours of that colour (bilinear interpolation).

use rayon::prelude::*;

/// Which colour the top-left 2x2 block starts with, as ROS names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pattern {
    /// Column parity of red.
    red_col: usize,
    /// Row parity of red.
    red_row: usize,
}

impl Pattern {
    /// Pattern and bytes per sample of an encoding such as `bayer_rggb8`.
    pub fn of_encoding(encoding: &str) -> Option<(Self, usize)> {
        let rest = encoding.strip_prefix("bayer_")?;
        let (order, bytes) = match rest.strip_suffix("16") {
            Some(order) => (order, 2),
            None => (rest.strip_suffix('8')?, 1),
        };
        let (red_row, red_col) = match order {
            "rggb" => (0, 0),
            "grbg" => (0, 1),
            "gbrg" => (1, 0),
            "bggr" => (1, 1),
            _ => return None,
        };
        Some((Self { red_col, red_row }, bytes))
    }
}

/// One sample per pixel.
pub struct Mosaic<'a> {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `height * width` samples.
    pub samples: &'a [u16],
    /// Which sample has which colour.
    pub pattern: Pattern,
}

impl Mosaic<'_> {
    /// A sample; outside, the nearest of the same colour by mirroring (which keeps the parity).
    fn at(&self, row: isize, col: isize) -> u32 {
        let mirror = |i: isize, n: usize| -> usize {
            let i = i.unsigned_abs();
            if i < n { i } else { (2 * n).saturating_sub(i + 2).min(n - 1) }
        };
        let index = mirror(row, self.height) * self.width + mirror(col, self.width);
        self.samples.get(index).copied().map_or(0, u32::from)
    }

    fn rgb(&self, row: usize, col: usize) -> [u32; 3] {
        let (r, c) = (row as isize, col as isize);
        let here = self.at(r, c);
        let horizontal = (self.at(r, c - 1) + self.at(r, c + 1)).div_ceil(2);
        let vertical = (self.at(r - 1, c) + self.at(r + 1, c)).div_ceil(2);
        let red_row = row % 2 == self.pattern.red_row;
        let red_col = col % 2 == self.pattern.red_col;
        if red_row != red_col {
            // Green: red lies along the row on red rows, along the column otherwise.
            return if red_row { [horizontal, here, vertical] } else { [vertical, here, horizontal] };
        }
        let cross = (self.at(r, c - 1) + self.at(r, c + 1) + self.at(r - 1, c) + self.at(r + 1, c) + 2) / 4;
        let corners =
            (self.at(r - 1, c - 1) + self.at(r - 1, c + 1) + self.at(r + 1, c - 1) + self.at(r + 1, c + 1) + 2) / 4;
        if red_row { [here, cross, corners] } else { [corners, cross, here] }
    }
}

/// RGB bytes, `height * width * 3`, of samples shifted right by `shift`.
pub fn demosaic(mosaic: &Mosaic<'_>, shift: u32) -> Vec<u8> {
    let mut out = vec![0u8; mosaic.width * mosaic.height * 3];
    out.par_chunks_mut(mosaic.width * 3).enumerate().for_each(|(row, line)| {
        let (pixels, _) = line.as_chunks_mut::<3>();
        for (col, pixel) in pixels.iter_mut().enumerate() {
            *pixel = mosaic.rgb(row, col).map(|v| (v >> shift).min(255) as u8);
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Samples a picture through the mosaic.
    fn mosaic_of(pattern: Pattern, width: usize, height: usize, rgb: impl Fn(usize, usize) -> [u16; 3]) -> Vec<u16> {
        let channel = |row: usize, col: usize| match (row % 2 == pattern.red_row, col % 2 == pattern.red_col) {
            (true, true) => 0,
            (false, false) => 2,
            _ => 1,
        };
        (0..height * width).map(|i| rgb(i / width, i % width)[channel(i / width, i % width)]).collect()
    }

    #[test]
    fn names_put_their_first_letters_at_the_top_left() {
        for (name, first_row) in [("rggb", [0, 1]), ("grbg", [1, 0]), ("gbrg", [1, 2]), ("bggr", [2, 1])] {
            let (pattern, bytes) = Pattern::of_encoding(&format!("bayer_{name}16")).unwrap();
            assert_eq!(bytes, 2);
            let samples = mosaic_of(pattern, 2, 2, |_, _| [0, 1, 2]);
            assert_eq!(samples[..2], first_row, "{name}");
        }
        assert_eq!(Pattern::of_encoding("bayer_rrgb8"), None);
        assert_eq!(Pattern::of_encoding("bayer_rggb12"), None);
    }

    #[test]
    fn flat_colours_and_ramps_come_back() {
        for name in ["rggb", "grbg", "gbrg", "bggr"] {
            let (pattern, _) = Pattern::of_encoding(&format!("bayer_{name}8")).unwrap();
            for (width, height) in [(8, 6), (7, 5)] {
                let samples = mosaic_of(pattern, width, height, |_, _| [200, 90, 30]);
                let m = Mosaic { width, height, samples: &samples, pattern };
                assert!(demosaic(&m, 0).chunks(3).all(|p| p == [200, 90, 30]), "{name}");
                // A linear picture is reproduced exactly inside: bilinear interpolation is exact on it.
                let ramp = |r: usize, c: usize| {
                    [(10 * r + 6 * c) as u16, (4 * r + 20 + 2 * c) as u16, (8 * r + 12 * c) as u16]
                };
                let samples = mosaic_of(pattern, width, height, ramp);
                let m = Mosaic { width, height, samples: &samples, pattern };
                let got = demosaic(&m, 0);
                for (r, c) in (1..height - 1).flat_map(|r| (1..width - 1).map(move |c| (r, c))) {
                    let want = ramp(r, c).map(|v| v as u8);
                    assert_eq!(got[(r * width + c) * 3..][..3], want, "{name} {r} {c}");
                }
            }
        }
    }

    #[test]
    fn tiny_pictures_do_not_reach_outside() {
        let (pattern, _) = Pattern::of_encoding("bayer_rggb8").unwrap();
        for (width, height) in [(1, 1), (1, 3), (2, 1), (2, 2)] {
            let samples = vec![7; width * height];
            assert_eq!(demosaic(&Mosaic { width, height, samples: &samples, pattern }, 0).len(), width * height * 3);
        }
    }
}
