//! Pictures set side by side and in grids.

use super::{Picture, Rgb};

/// Pictures left to right, tops aligned, `gap` pixels of `background` between.
pub fn beside(pictures: &[&Picture], gap: usize, background: Rgb) -> Picture {
    grid(&[pictures.iter().map(|p| Some(*p)).collect()], gap, background)
}

/// Rows of pictures; each column is as wide as its widest picture, each row as high as its highest. `None` stays empty.
pub fn grid(rows: &[Vec<Option<&Picture>>], gap: usize, background: Rgb) -> Picture {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let mut widths = vec![0; columns];
    let mut heights = vec![0; rows.len()];
    for (r, row) in rows.iter().enumerate() {
        for (c, picture) in row.iter().enumerate() {
            if let Some(p) = picture {
                widths[c] = p.width().max(widths[c]);
                heights[r] = p.height().max(heights[r]);
            }
        }
    }
    let total = |sizes: &[usize]| sizes.iter().sum::<usize>() + gap * sizes.len().saturating_sub(1);
    let mut out = Picture::filled(total(&widths), total(&heights), background);
    let mut top = 0;
    for (r, row) in rows.iter().enumerate() {
        let mut left = 0;
        for (c, picture) in row.iter().enumerate() {
            if let Some(p) = picture {
                out.blit(p, left, top);
            }
            left += widths[c] + gap;
        }
        top += heights[r] + gap;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grid_makes_room_for_the_largest() {
        let (a, b) = (Picture::filled(2, 3, [1; 3]), Picture::filled(4, 1, [2; 3]));
        let out = grid(&[vec![Some(&a), None], vec![None, Some(&b)]], 1, [9; 3]);
        assert_eq!((out.width(), out.height()), (2 + 1 + 4, 3 + 1 + 1));
        assert_eq!(
            (out.get(1, 2), out.get(2, 0), out.get(3, 4), out.get(0, 4)),
            (Some([1; 3]), Some([9; 3]), Some([2; 3]), Some([9; 3]))
        );
        let side = beside(&[&a, &b], 2, [0; 3]);
        assert_eq!((side.width(), side.height()), (8, 3));
        assert_eq!(grid(&[], 3, [0; 3]).width(), 0);
    }
}
