//! Which solids may be seen in which tile of a picture, nearest first.

use super::scene::Part;
use crate::camera::Intrinsics;
use glam::{Mat3, Vec3};

/// Side of a tile, pixels.
pub(crate) const TILE: usize = 16;
/// Solids nearer than this to the camera's plane are cut there.
const NEAR_M: f32 = 0.05;
/// Pixels added around every solid's outline: rays of smoothed edges leave their pixel's centre by half a pixel.
const MARGIN_PX: f32 = 1.0;

/// A solid as one camera sees it.
#[derive(Debug, Clone)]
pub(crate) struct Seen {
    pub part: u32,
    /// No point of the solid has a smaller depth.
    pub near: f32,
    /// Rectangle of the picture that holds it, pixels.
    pub lo: [f32; 2],
    pub hi: [f32; 2],
    /// The eye in the solid's frame, and part_from_camera: rotates a camera ray into it.
    pub eye: Vec3,
    pub turn: Mat3,
}

/// The solids of a picture by tile.
#[derive(Debug, Clone)]
pub(crate) struct Tiles {
    columns: usize,
    starts: Vec<u32>,
    entries: Vec<u32>,
    pub seen: Vec<Seen>,
}

impl Tiles {
    pub(crate) fn new(parts: &[Part], view_from_camera: &Mat3, camera: &Intrinsics) -> Self {
        let camera_from_view = view_from_camera.transpose();
        let mut seen: Vec<Seen> = parts
            .iter()
            .enumerate()
            .filter_map(|(i, part)| outline(i as u32, part, &camera_from_view, view_from_camera, camera))
            .collect();
        seen.sort_by(|a, b| a.near.total_cmp(&b.near).then(a.part.cmp(&b.part)));
        let (columns, rows) = (camera.width.div_ceil(TILE), camera.height.div_ceil(TILE));
        let span = |s: &Seen| {
            let index = |v: f32, n: usize| ((v.max(0.0) as usize) / TILE).min(n - 1);
            (index(s.lo[0], columns)..=index(s.hi[0], columns), index(s.lo[1], rows)..=index(s.hi[1], rows))
        };
        let mut starts = vec![0u32; columns * rows + 1];
        for s in &seen {
            let (xs, ys) = span(s);
            ys.for_each(|y| xs.clone().for_each(|x| starts[y * columns + x + 1] += 1));
        }
        for k in 0..columns * rows {
            starts[k + 1] += starts[k];
        }
        let mut next = starts.clone();
        let mut entries = vec![0u32; starts[columns * rows] as usize];
        for (i, s) in seen.iter().enumerate() {
            let (xs, ys) = span(s);
            for y in ys {
                for x in xs.clone() {
                    let slot = &mut next[y * columns + x];
                    entries[*slot as usize] = i as u32;
                    *slot += 1;
                }
            }
        }
        Self { columns, starts, entries, seen }
    }

    /// The solids of the tile that holds a pixel, by growing nearest depth.
    #[inline]
    pub(crate) fn at(&self, col: usize, row: usize) -> &[u32] {
        let tile = row / TILE * self.columns + col / TILE;
        &self.entries[self.starts[tile] as usize..self.starts[tile + 1] as usize]
    }
}

/// The rectangle that holds the solid's box in the picture, cut at the camera's plane; `None` outside.
fn outline(index: u32, part: &Part, camera_from_view: &Mat3, view_from_camera: &Mat3, k: &Intrinsics) -> Option<Seen> {
    let half = part.shape.bounds();
    let centre = *camera_from_view * part.pos;
    let axes = *camera_from_view * part.rot;
    let (x, y, z) = (axes.x_axis * half.x, axes.y_axis * half.y, axes.z_axis * half.z);
    let reach = x.z.abs() + y.z.abs() + z.z.abs();
    if centre.z + reach < NEAR_M {
        return None;
    }
    let corner = |i: usize| {
        let sign = |bit: usize| if i & bit == 0 { -1.0 } else { 1.0 };
        centre + x * sign(1) + y * sign(2) + z * sign(4)
    };
    let (mut lo, mut hi) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
    let mut grow = |p: Vec3| {
        let (u, v) = (k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy);
        lo = [lo[0].min(u), lo[1].min(v)];
        hi = [hi[0].max(u), hi[1].max(v)];
    };
    if centre.z - reach >= NEAR_M {
        (0..8).for_each(|i| grow(corner(i)));
    } else {
        for i in 0..8 {
            let a = corner(i);
            if a.z >= NEAR_M {
                grow(a);
            }
            for bit in [1, 2, 4].into_iter().filter(|bit| i & bit == 0) {
                let b = corner(i | bit);
                if (a.z < NEAR_M) != (b.z < NEAR_M) {
                    let f = (NEAR_M - a.z) / (b.z - a.z);
                    grow((a + (b - a) * f).with_z(NEAR_M));
                }
            }
        }
    }
    let (lo, hi) = (lo.map(|v| v - MARGIN_PX), hi.map(|v| v + MARGIN_PX));
    let inside = hi[0] >= 0.0 && hi[1] >= 0.0 && lo[0] < k.width as f32 && lo[1] < k.height as f32;
    inside.then(|| Seen {
        part: index,
        near: (centre.z - reach).max(0.0),
        lo,
        hi,
        eye: part.eye,
        turn: part.rot.transpose() * *view_from_camera,
    })
}
