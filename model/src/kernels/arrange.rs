//! Values put into another order, many threads at a time: images to patches, nested pixels to rows and columns.

use rayon::prelude::*;

/// Pictures `(views, channels, h, w)` of one or more groups of channels, to patches: `(views, rows, cols, channel, y, x)` with
/// `p x p` pixels each, channels of all groups in order.
///
/// Panics when the lengths disagree (callers take them from tensor shapes).
pub fn patches(groups: &[(&[f32], usize)], [views, h, w]: [usize; 3], p: usize, out: &mut [f32]) {
    let channels: usize = groups.iter().map(|(_, c)| c).sum();
    assert!(p > 0 && h.is_multiple_of(p) && w.is_multiple_of(p), "{w} x {h} in patches of {p}");
    assert!(
        groups.iter().all(|(x, c)| x.len() == views * c * h * w) && out.len() == views * channels * h * w,
        "patches"
    );
    if out.is_empty() {
        return;
    }
    let patch = channels * p * p;
    // A task is one row of patches.
    out.par_chunks_mut(w / p * patch).enumerate().for_each(|(index, out)| {
        let (view, row) = (index / (h / p), index % (h / p));
        let mut channel = 0;
        for &(values, count) in groups {
            for c in 0..count {
                for y in 0..p {
                    let line = &values[((view * count + c) * h + row * p + y) * w..][..w];
                    for (from, to) in line.chunks_exact(p).zip(out.chunks_exact_mut(patch)) {
                        to[(channel * p + y) * p..][..p].copy_from_slice(from);
                    }
                }
                channel += 1;
            }
        }
    });
}

/// Where nested pixels lie in an image: its patches, doubled `levels` times each way, every pixel then repeated.
#[derive(Debug, Clone, Copy)]
pub struct Nesting {
    /// Rows and columns of patches.
    pub grid: (usize, usize),
    /// Doublings from a patch to its pixels.
    pub levels: usize,
    /// Side of the block of image pixels that hold one nested pixel's values; 1: each pixel is one.
    pub copies: usize,
}

impl Nesting {
    /// Places of a patch's pixels along one side: the bits spread apart, finest level last.
    fn places(&self) -> Vec<usize> {
        let spread = |bits: usize| (0..self.levels).map(|k| (bits >> k & 1) << (2 * k)).sum::<usize>();
        (0..1usize << self.levels).map(spread).collect()
    }

    /// Panics when the lengths disagree (callers take them from tensor shapes).
    fn check(&self, nested: usize, image: usize, c: usize) {
        let one = (self.grid.0 * self.grid.1 * c) << (2 * self.levels);
        assert!(nested * self.copies * self.copies == image, "{nested} values for {image} of {self:?}");
        assert!(one == 0 || nested.is_multiple_of(one), "{nested} values in images of {one}");
    }
}

/// Pixels `(n rows cols 4^levels, c)`, each of the `n` images in nested order (patch, child, child of child, ...), to
/// `(n, rows 2^levels copies, cols 2^levels copies, c)`.
///
/// Panics when the lengths disagree (callers take them from tensor shapes).
pub fn unnest(x: &[f32], c: usize, nesting: Nesting, out: &mut [f32]) {
    nesting.check(x.len(), out.len(), c);
    if out.is_empty() {
        return;
    }
    let Nesting { grid: (_, cols), copies, .. } = nesting;
    let places = nesting.places();
    let side = places.len();
    out.par_chunks_mut(cols * side * copies * c).enumerate().for_each(|(index, out)| {
        let (patch_row, y) = (index / (side * copies), index / copies % side);
        for (col, out) in out.chunks_exact_mut(side * copies * c).enumerate() {
            let patch = &x[(patch_row * cols + col) * side * side * c..][..side * side * c];
            for (place, out) in places.iter().zip(out.chunks_exact_mut(copies * c)) {
                let from = &patch[(2 * places[y] + place) * c..][..c];
                out.chunks_exact_mut(c).for_each(|out| out.copy_from_slice(from));
            }
        }
    });
}

/// The transpose of [`unnest`]: every nested pixel is the sum of its block of image pixels.
///
/// Panics when the lengths disagree (callers take them from tensor shapes).
pub fn nest(image: &[f32], c: usize, nesting: Nesting, out: &mut [f32]) {
    nesting.check(out.len(), image.len(), c);
    if out.is_empty() {
        return;
    }
    let Nesting { grid: (_, cols), copies, .. } = nesting;
    let places = nesting.places();
    let side = places.len();
    let width = cols * side * copies * c;
    out.par_chunks_mut(cols * side * side * c).enumerate().for_each(|(patch_row, out)| {
        out.fill(0.0);
        let lines = image[patch_row * side * copies * width..].chunks_exact(width).take(side * copies);
        for (y, line) in lines.enumerate() {
            for (block, from) in line.chunks_exact(copies * c).enumerate() {
                let (col, x) = (block / side, block % side);
                let to = &mut out[(col * side * side + 2 * places[y / copies] + places[x]) * c..][..c];
                from.chunks_exact(c).for_each(|from| to.iter_mut().zip(from).for_each(|(to, from)| *to += from));
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nested_pixels_fill_their_blocks_and_nesting_is_the_transpose() {
        for (n, grid, levels, copies, c) in [(2, (2, 3), 2, 1, 3), (1, (1, 2), 1, 2, 2), (2, (3, 1), 3, 4, 1)] {
            let nesting = Nesting { grid, levels, copies };
            let patches = n * grid.0 * grid.1;
            let x: Vec<f32> = (0..(patches * c) << (2 * levels)).map(|i| i as f32).collect();
            let mut out = vec![f32::NAN; x.len() * copies * copies];
            unnest(&x, c, nesting, &mut out);
            let (h, w) = ((grid.0 << levels) * copies, (grid.1 << levels) * copies);
            for (i, &got) in out.iter().enumerate() {
                let (channel, col, row, image) = (i % c, i / c % w, i / (c * w) % h, i / (c * w * h));
                let (row, col) = (row / copies, col / copies);
                let patch = (image * grid.0 + (row >> levels)) * grid.1 + (col >> levels);
                // Coarsest child first: row bit, then column bit.
                let children = (0..levels).rev().flat_map(|k| [row >> k & 1, col >> k & 1]);
                let place = children.fold(patch, |place, bit| 2 * place + bit);
                assert_eq!(got, x[place * c + channel], "{nesting:?}, value {i}");
            }
            let mut back = vec![f32::NAN; x.len()];
            nest(&out, c, nesting, &mut back);
            let times = (copies * copies) as f32;
            assert!(back.iter().zip(&x).all(|(back, x)| *back == times * x), "{nesting:?}");
        }
    }

    #[test]
    fn patches_hold_their_pixels() {
        for (views, h, w, p) in [(2, 4, 6, 2), (1, 3, 9, 3), (3, 8, 8, 8)] {
            let a: Vec<f32> = (0..views * 3 * h * w).map(|i| i as f32).collect();
            let b: Vec<f32> = (0..views * 2 * h * w).map(|i| -(i as f32)).collect();
            let mut out = vec![f32::NAN; 5 * views * h * w];
            patches(&[(&a, 3), (&b, 2)], [views, h, w], p, &mut out);
            for (i, &got) in out.iter().enumerate() {
                let (x, y, c, patch) = (i % p, i / p % p, i / (p * p) % 5, i / (5 * p * p));
                let (view, row, col) = (patch / (h / p * (w / p)), patch / (w / p) % (h / p), patch % (w / p));
                let at = |c: usize, channels: usize| ((view * channels + c) * h + row * p + y) * w + col * p + x;
                assert_eq!(got, if c < 3 { a[at(c, 3)] } else { b[at(c - 3, 2)] });
            }
        }
    }
}
