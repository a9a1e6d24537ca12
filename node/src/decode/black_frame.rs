//! The black frame that a driver's own rectification leaves around its images, and the black around a fisheye's circle: pixels at
//! the border that are black and exactly the same in several images. Rows and columns count by themselves; other shapes when they
//! hold all four corners (a circle) or meet all four sides (undistorted with nothing cut off). A dark sky does neither.

use std::collections::VecDeque;

use super::RgbPicture;

/// Images compared.
const IMAGES: usize = 4;
/// Images looked at closer together than this in time count as one, nanoseconds: a vehicle that waits sees the same again.
const APART_NS: u64 = 250_000_000;
/// After this many images, however close together, what was found holds.
const MOST_IMAGES: usize = 24;
/// No channel of a black pixel is above this.
const BLACK: u8 = 16;
/// Compression smears the frame's edge: what next to the frame stays below this in all images is part of it,
const SMEARED: u8 = 40;
/// up to a block of so many pixels.
const BLOCK_PX: usize = 8;
/// More than this share of the image is no frame: the lens is covered, or it is night.
const MOST_SHARE: f64 = 0.75;

/// Compares a camera's first images.
#[derive(Debug, Clone, Default)]
pub struct FrameFinder {
    size: (usize, usize),
    first: Vec<u8>,
    /// Black, and the same in all images so far.
    black: Vec<bool>,
    /// Dark in all images so far.
    dark: Vec<bool>,
    lossy: bool,
    last_ns: Option<i64>,
    compared: usize,
    seen: usize,
}

/// A frame that was found, at the camera's image size.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BlackFrame {
    /// Width and height of the image.
    pub size: (usize, usize),
    /// Whole black rows at the top and bottom, whole black columns left and right, pixels.
    pub rows_and_columns: [usize; 4],
    /// Per pixel, row by row: part of the frame.
    pub black: Vec<bool>,
}

impl FrameFinder {
    /// The next image of the camera; `lossy`: it was compressed. One of another size starts the comparison again.
    pub fn look(&mut self, stamp_ns: i64, image: &RgbPicture, lossy: bool) {
        self.seen += 1;
        let pixels = image.width * image.height;
        if image.data.len() != 3 * pixels {
            return;
        }
        if self.size != (image.width, image.height) {
            let seen = self.seen;
            *self = Self { size: (image.width, image.height), first: image.data.clone(), seen, ..Self::default() };
            (self.black, self.dark) = (vec![true; pixels], vec![true; pixels]);
        } else if self.last_ns.is_some_and(|last_ns| stamp_ns.abs_diff(last_ns) < APART_NS) {
            return;
        }
        (self.last_ns, self.lossy) = (Some(stamp_ns), self.lossy | lossy);
        self.compared += 1;
        let (now, _) = image.data.as_chunks::<3>();
        let (first, _) = self.first.as_chunks::<3>();
        for (i, (now, first)) in now.iter().zip(first).enumerate() {
            self.black[i] &= now == first && now.iter().all(|&x| x <= BLACK);
            self.dark[i] &= now.iter().all(|&x| x <= SMEARED);
        }
    }

    /// Whether further images would change nothing, or enough were compared.
    pub fn settled(&self) -> bool {
        let (w, h) = self.size;
        let border = |i: usize| i / w == 0 || i / w == h - 1 || i.is_multiple_of(w) || i % w == w - 1;
        self.compared >= IMAGES
            || self.seen >= MOST_IMAGES
            || (self.compared > 0 && !(0..w * h).any(|i| border(i) && self.black[i]))
    }

    /// The frame in all images so far; none where there is none, or where too few images were compared to say so.
    pub fn found(&self) -> Option<BlackFrame> {
        if self.compared < 2 {
            return None;
        }
        let (w, h) = self.size;
        let row_black = |r: usize| (0..w).all(|c| self.black[r * w + c]);
        let top = (0..h).take_while(|&r| row_black(r)).count();
        let bottom = (top..h).rev().take_while(|&r| row_black(r)).count();
        let rows = top..h - bottom;
        let column_black = |c: usize| rows.clone().all(|r| self.black[r * w + c]);
        if rows.is_empty() {
            return None;
        }
        let left = (0..w).take_while(|&c| column_black(c)).count();
        let right = (left..w).rev().take_while(|&c| column_black(c)).count();
        let columns = left..w - right;
        let outside = |i: usize| !(rows.contains(&(i / w)) && columns.contains(&(i % w)));
        let mut frame: Vec<bool> = (0..w * h).map(outside).collect();
        self.add_other_shapes(&mut frame, &rows, &columns);
        if !frame.contains(&true) {
            return None;
        }
        if self.lossy {
            self.add_smeared(&mut frame);
        }
        let share = frame.iter().filter(|x| **x).count() as f64 / frame.len() as f64;
        (share <= MOST_SHARE).then_some(BlackFrame {
            size: self.size,
            rows_and_columns: [top, bottom, left, right],
            black: frame,
        })
    }

    /// What is black from the border of the rectangle inwards, where its shape is a frame's.
    fn add_other_shapes(&self, frame: &mut [bool], rows: &std::ops::Range<usize>, columns: &std::ops::Range<usize>) {
        let w = self.size.0;
        if rows.is_empty() || columns.is_empty() {
            return;
        }
        let (r0, r1, c0, c1) = (rows.start, rows.end - 1, columns.start, columns.end - 1);
        let edges = |i: usize| [i / w == r0, i / w == r1, i % w == c0, i % w == c1];
        let mut inside = vec![false; frame.len()];
        let mut queue: VecDeque<usize> = VecDeque::new();
        let (mut sides, mut corners) = ([false; 4], 0);
        for i in rows.clone().flat_map(|r| columns.clone().map(move |c| r * w + c)) {
            let at = edges(i);
            if self.black[i] && at.contains(&true) {
                sides.iter_mut().zip(at).for_each(|(side, at)| *side |= at);
                corners += usize::from((at[0] || at[1]) && (at[2] || at[3]));
                inside[i] = true;
                queue.push_back(i);
            }
        }
        if !(corners == 4 || sides == [true; 4]) {
            return;
        }
        while let Some(i) = queue.pop_front() {
            frame[i] = true;
            let at = edges(i);
            let around = [(at[0], i.wrapping_sub(w)), (at[1], i + w), (at[2], i.wrapping_sub(1)), (at[3], i + 1)];
            for (_, next) in around.into_iter().filter(|(at_edge, _)| !at_edge) {
                if self.black[next] && !inside[next] {
                    inside[next] = true;
                    queue.push_back(next);
                }
            }
        }
    }

    /// Dark pixels up to a block away from the frame.
    fn add_smeared(&self, frame: &mut [bool]) {
        let (w, h) = self.size;
        let mut edge: Vec<usize> = (0..frame.len()).filter(|&i| frame[i]).collect();
        for _ in 0..BLOCK_PX {
            let mut next = Vec::new();
            for i in edge {
                let (r, c) = (i / w, i % w);
                let around = [
                    (r > 0).then(|| i - w),
                    (r + 1 < h).then(|| i + w),
                    (c > 0).then(|| i - 1),
                    (c + 1 < w).then(|| i + 1),
                ];
                for n in around.into_iter().flatten() {
                    if self.dark[n] && !frame[n] {
                        frame[n] = true;
                        next.push(n);
                    }
                }
            }
            edge = next;
        }
    }
}

impl BlackFrame {
    /// Per pixel, row by row: not part of the frame.
    pub fn valid(&self) -> Vec<bool> {
        self.black.iter().map(|b| !b).collect()
    }

    /// For people: `12 rows at the top and 3 columns on the left`, or the share where it is no rectangle.
    pub fn describe(&self) -> String {
        let [top, bottom, left, right] = self.rows_and_columns;
        let (w, h) = self.size;
        let named = [
            (top, "row", "at the top"),
            (bottom, "row", "at the bottom"),
            (left, "column", "on the left"),
            (right, "column", "on the right"),
        ];
        let mut parts: Vec<String> = named
            .iter()
            .filter(|(n, ..)| *n > 0)
            .map(|(n, what, place)| format!("{n} {what}{} {place}", if *n == 1 { "" } else { "s" }))
            .collect();
        let straight = w * h - (h - top - bottom) * (w - left - right);
        let rest = self.black.iter().filter(|b| **b).count().saturating_sub(straight);
        if rest > 0 {
            parts.push(format!("{:.1} % of the image along its border", 100.0 * rest as f64 / (w * h).max(1) as f64));
        }
        match parts.pop() {
            Some(last) if parts.is_empty() => last,
            Some(last) => format!("{} and {last}", parts.join(", ")),
            None => String::new(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const W: usize = 40;
    const H: usize = 30;

    /// A street that changes from image to image, black where `black` says.
    fn image(k: i64, black: &dyn Fn(usize, usize) -> bool) -> RgbPicture {
        let value = |i: usize| {
            let (r, c) = (i / 3 / W, i / 3 % W);
            if black(r, c) { 0 } else { 60 + ((r * 7 + c * 3 + 11 * k as usize) % 97) as u8 }
        };
        RgbPicture { width: W, height: H, data: (0..3 * W * H).map(value).collect() }
    }

    fn find(black: &dyn Fn(usize, usize) -> bool) -> FrameFinder {
        let mut finder = FrameFinder::default();
        (0..4).for_each(|k| finder.look(k * 300_000_000, &image(k, black), false));
        finder
    }

    #[test]
    fn rows_and_columns_are_found_and_named() {
        let frame = find(&|r, c| r < 5 || c >= W - 1).found().unwrap();
        assert_eq!(frame.rows_and_columns, [5, 0, 0, 1]);
        assert_eq!(frame.describe(), "5 rows at the top and 1 column on the right");
        assert_eq!(frame.valid().iter().filter(|v| !**v).count(), 5 * W + (H - 5));
        assert!(find(&|_, _| false).found().is_none());
    }

    #[test]
    fn circles_and_curved_edges_are_found() {
        let circle = |r: usize, c: usize| (r as f64 - 14.5).hypot(c as f64 - 19.5) > 18.0;
        let frame = find(&circle).found().unwrap();
        let wanted: Vec<bool> = (0..W * H).map(|i| circle(i / W, i % W)).collect();
        assert_eq!(frame.black, wanted);
        assert!(frame.describe().contains("% of the image"), "{}", frame.describe());
        // Undistorted with nothing cut off: thick in the middle of each side, nothing in the corners.
        let bow = |x: usize, n: usize| 4.0 * (1.0 - (2.0 * x as f64 / (n - 1) as f64 - 1.0).powi(2));
        let curved = |r: usize, c: usize| {
            let (r, c, by_col, by_row) = (r as f64, c as f64, bow(c, W), bow(r, H));
            r < by_col - 1.0
                || H as f64 - 1.0 - r < by_col - 1.0
                || c < by_row - 1.0
                || W as f64 - 1.0 - c < by_row - 1.0
        };
        assert!(!curved(0, 0) && curved(0, 20) && curved(15, 0));
        let frame = find(&curved).found().unwrap();
        assert!((0..W * H).all(|i| frame.black[i] == curved(i / W, i % W)));
    }

    #[test]
    fn what_is_dark_but_no_frame_stays() {
        // A black car low in the picture, a black sky with a house in it, night.
        assert!(find(&|r, c| r > 20 && (10..30).contains(&c)).found().is_none());
        assert!(find(&|r, c| r < 10 && !(12..20).contains(&c)).found().is_none());
        assert!(find(&|r, c| r < 28 || c != 7).found().is_none());
        // Black in the first images alone.
        let mut finder = FrameFinder::default();
        (0..4).for_each(|k| finder.look(k * 300_000_000, &image(k, &|r, _| r < 4 && k < 2), false));
        assert!(finder.found().is_none() && finder.settled());
        // Dark noise is not constant.
        let mut finder = FrameFinder::default();
        for k in 0..4 {
            let mut noisy = image(k, &|_, _| false);
            noisy.data[..3 * W * 4].iter_mut().enumerate().for_each(|(i, x)| *x = ((i as i64 + k) % 3) as u8);
            finder.look(k * 300_000_000, &noisy, false);
        }
        assert!(finder.found().is_none());
    }

    #[test]
    fn images_at_one_moment_count_once_and_nothing_black_ends_at_once() {
        let mut finder = FrameFinder::default();
        assert!(!finder.settled());
        (0..5).for_each(|k| finder.look(k * 1000, &image(0, &|r, _| r < 3), false));
        assert!(finder.found().is_none() && !finder.settled());
        finder.look(900_000_000, &image(1, &|r, _| r < 3), false);
        assert_eq!(finder.found().unwrap().rows_and_columns, [3, 0, 0, 0]);
        (0..MOST_IMAGES as i64).for_each(|_| finder.look(900_000_000, &image(1, &|r, _| r < 3), false));
        assert!(finder.settled());
        let mut bright = FrameFinder::default();
        bright.look(0, &image(0, &|_, _| false), false);
        assert!(bright.settled() && bright.found().is_none());
        bright.look(1, &RgbPicture { width: 3, height: 3, data: vec![0] }, false);
    }

    #[test]
    fn the_edge_that_compression_smears_belongs_to_the_frame() {
        let smeared = |lossy: bool| {
            let mut finder = FrameFinder::default();
            for k in 0..4 {
                let mut now = image(k, &|r, _| r < 8);
                // Ringing of the block below.
                now.data[3 * W * 6..3 * W * 8]
                    .iter_mut()
                    .enumerate()
                    .for_each(|(i, x)| *x = ((i as i64 * 5 + k) % 30) as u8);
                finder.look(k * 300_000_000, &now, lossy);
            }
            finder.found().unwrap().black.iter().filter(|b| **b).count()
        };
        assert_eq!((smeared(false), smeared(true)), (6 * W, 8 * W));
    }
}
