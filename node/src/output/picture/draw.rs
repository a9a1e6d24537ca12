//! Drawing into a picture; whatever lies outside is cut off.

use super::font::{GLYPH_HEIGHT, GLYPH_WIDTH, glyph};
use super::{Picture, Rgb};

impl Picture {
    /// Sets one pixel; nothing happens outside.
    pub fn set(&mut self, col: usize, row: usize, color: Rgb) {
        if col < self.width
            && let Some(p) = self.pixels.get_mut(row * self.width + col)
        {
            *p = color;
        }
    }

    /// Fills a rectangle.
    pub fn fill_rect(&mut self, col: usize, row: usize, width: usize, height: usize, color: Rgb) {
        for r in row..row.saturating_add(height).min(self.height) {
            for c in col..col.saturating_add(width).min(self.width) {
                self.set(c, r, color);
            }
        }
    }

    /// Puts another picture's top left corner at `(col, row)`.
    pub fn blit(&mut self, other: &Picture, col: usize, row: usize) {
        for r in 0..other.height.min(self.height.saturating_sub(row)) {
            for c in 0..other.width.min(self.width.saturating_sub(col)) {
                self.set(col + c, row + r, other.pixels[r * other.width + c]);
            }
        }
    }

    /// Writes text (digits, `. - + /`, and the letters m s x y) with its top left corner at `(col, row)`, each dot
    /// `scale` pixels wide.
    pub fn text(&mut self, text: &str, col: usize, row: usize, scale: usize, color: Rgb) {
        for (k, c) in text.chars().enumerate() {
            let left = col + k * (GLYPH_WIDTH + 1) * scale;
            for (y, bits) in glyph(c).into_iter().enumerate() {
                for x in (0..GLYPH_WIDTH).filter(|x| bits >> (GLYPH_WIDTH - 1 - x) & 1 == 1) {
                    self.fill_rect(left + x * scale, row + y * scale, scale, scale, color);
                }
            }
        }
    }

    /// Every pixel repeated `factor` times each way.
    pub fn enlarged(&self, factor: usize) -> Self {
        Self::from_fn(self.width * factor, self.height * factor, |c, r| {
            self.pixels[r / factor * self.width + c / factor]
        })
    }
}

/// Width of a text, pixels.
pub(super) fn text_width(text: &str, scale: usize) -> usize {
    (text.chars().count() * (GLYPH_WIDTH + 1)).saturating_sub(1) * scale
}

/// Height of a text, pixels.
pub(super) fn text_height(scale: usize) -> usize {
    GLYPH_HEIGHT * scale
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drawing_is_cut_at_the_edges() {
        let mut p = Picture::filled(4, 4, [0; 3]);
        p.fill_rect(2, 2, 10, usize::MAX, [1; 3]);
        p.blit(&Picture::filled(9, 1, [2; 3]), 3, 3);
        p.text("8", 3, 0, 1, [9; 3]);
        p.set(4, 0, [7; 3]);
        assert_eq!(p.get(2, 2), Some([1; 3]));
        assert_eq!(p.get(3, 3), Some([2; 3]));
        assert_eq!(p.get(3, 1), Some([9; 3]), "the 8's left edge");
        assert_eq!(p.get(0, 1), Some([0; 3]), "no wrap into the next row");
        assert_eq!(p.enlarged(3).get(8, 8), Some([1; 3]));
        assert_eq!(text_width("12", 2), 22);
    }
}
