//! Values put into another order, many threads at a time: pictures to patches, nested pixels to rows and columns.

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

/// Pixels `(n rows cols 4^levels, c)`, each of the `n` pictures in nested order (patch, child, child of child, ...), to
/// `(n, rows 2^levels, cols 2^levels, c)`.
///
/// Panics when the lengths disagree (callers take them from tensor shapes).
pub fn unnest(x: &[f32], c: usize, (rows, cols): (usize, usize), levels: usize, out: &mut [f32]) {
    let side = 1usize << levels;
    let picture = rows * cols * side * side * c;
    assert!(x.len() == out.len() && (picture == 0 || x.len().is_multiple_of(picture)), "pictures of {picture} values");
    if out.is_empty() {
        return;
    }
    // Bits of the place inside a patch, spread apart: finest level last.
    let spread = |bits: usize| (0..levels).map(|k| (bits >> k & 1) << (2 * k)).sum::<usize>();
    let places: Vec<usize> = (0..side).map(spread).collect();
    out.par_chunks_mut(cols * side * c).enumerate().for_each(|(index, out)| {
        let (patch_row, y) = (index / side, index % side);
        for (col, out) in out.chunks_exact_mut(side * c).enumerate() {
            let patch = &x[(patch_row * cols + col) * side * side * c..][..side * side * c];
            for (place, out) in places.iter().zip(out.chunks_exact_mut(c)) {
                out.copy_from_slice(&patch[(2 * places[y] + place) * c..][..c]);
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

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
