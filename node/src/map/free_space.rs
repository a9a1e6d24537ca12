//! Free space: what a camera sees behind a cell says that the cell is not there (any more).

use glam::{Affine3A, Vec3, Vec3A};
use storm_render::Intrinsics;

use crate::rigid::Rigid;

use super::cell::Cell;

/// A cell is passed through when the surface behind it is farther by this part of its own depth: three times the gate
/// within which two depths count as one surface by default.
const CLEAR_PART: f32 = 0.06;
/// And by at least this, metres: twice the finest voxel's usual edge.
const CLEAR_M: f32 = 0.4;
/// Nearer cells are not judged: their pixels change too much between two pictures, metres.
const NEAR_M: f32 = 1.0;

/// One camera's picture of how far things are.
#[derive(Debug, Clone)]
pub struct DepthView {
    /// The camera's pose in the map.
    pub map_from_camera: Rigid,
    /// The camera.
    pub intrinsics: Intrinsics,
    /// z-depth per pixel, metres, row by row; infinite where nothing is hit (the sky), 0 where it is not known.
    pub depth: Vec<f32>,
}

/// A view made ready: the nearest depth around every pixel, so that edges and slopes carve nothing.
pub(super) struct Carver {
    map_from_camera: Rigid,
    intrinsics: Intrinsics,
    nearest: Vec<f32>,
    farthest: f32,
}

/// A carver as one tile sees it.
pub(super) struct TileCarver<'a> {
    camera_from_tile: Affine3A,
    view: &'a Carver,
    reach_m: f32,
}

impl Carver {
    /// None when the picture's size and its depths do not fit together, or nothing is known.
    pub fn new(view: &DepthView) -> Option<Self> {
        let k = view.intrinsics;
        let (w, h) = (k.width, k.height);
        let fits = k.is_valid() && w.checked_mul(h) == Some(view.depth.len()) && view.map_from_camera.is_finite();
        if !fits {
            return None;
        }
        // The minimum over three columns, then over three rows. What is not finite and positive (NaN too) counts as 0:
        // not known.
        let known = |d: f32| if d > 0.0 { d } else { 0.0 };
        let mut rows = vec![0f32; w * h];
        for (line, out) in view.depth.chunks_exact(w).zip(rows.chunks_exact_mut(w)) {
            for c in 0..w {
                out[c] = known(line[c]).min(known(line[c.saturating_sub(1)])).min(known(line[(c + 1).min(w - 1)]));
            }
        }
        let mut nearest = vec![0f32; w * h];
        for r in 0..h {
            let (above, below) = (r.saturating_sub(1) * w, (r + 1).min(h - 1) * w);
            for c in 0..w {
                nearest[r * w + c] = rows[above + c].min(rows[r * w + c]).min(rows[below + c]);
            }
        }
        let farthest = nearest.iter().copied().fold(0.0, f32::max);
        (farthest > 0.0).then_some(Self { map_from_camera: view.map_from_camera, intrinsics: k, nearest, farthest })
    }

    /// For a tile whose corner is at `corner` of the map; none when the tile is out of sight or farther than `reach_m`.
    pub fn for_tile(&self, corner: glam::DVec3, tile_m: f64, reach_m: f64) -> Option<TileCarver<'_>> {
        let camera_from_map = self.map_from_camera.inverse();
        let offset = camera_from_map.apply(corner);
        let camera_from_tile = Rigid::new(camera_from_map.rotation, offset).to_f32();
        let reach_m = reach_m.min(f64::from(self.farthest)) as f32;
        // The ball around the tile against the picture's pyramid.
        let radius = (0.5 * 3f64.sqrt() * tile_m) as f32;
        let middle = camera_from_tile.transform_point3(Vec3::splat(0.5 * tile_m as f32));
        let k = &self.intrinsics;
        let (x0, x1) = (-k.cx / k.fx, (k.width as f32 - k.cx) / k.fx);
        let (y0, y1) = (-k.cy / k.fy, (k.height as f32 - k.cy) / k.fy);
        let sides = [
            Vec3::new(1.0, 0.0, -x0),
            Vec3::new(-1.0, 0.0, x1),
            Vec3::new(0.0, 1.0, -y0),
            Vec3::new(0.0, -1.0, y1),
            Vec3::Z,
        ];
        let inside = sides.iter().all(|n| n.normalize().dot(middle) >= -radius) && middle.length() <= reach_m + radius;
        inside.then_some(TileCarver { camera_from_tile, view: self, reach_m })
    }
}

impl TileCarver<'_> {
    /// Whether the camera looks clearly through the cell.
    #[inline]
    pub fn passes_through(&self, cell: &Cell) -> bool {
        let p: Vec3A = self.camera_from_tile.transform_point3a(cell.position.into());
        if !(p.z > NEAR_M && p.z <= self.reach_m) {
            return false;
        }
        let k = &self.view.intrinsics;
        let inverse = 1.0 / p.z;
        let (u, v) = (k.fx * p.x * inverse + k.cx, k.fy * p.y * inverse + k.cy);
        // The border's pixels have neighbours on one side only.
        let inside = u >= 1.0 && v >= 1.0 && u < (k.width - 1) as f32 && v < (k.height - 1) as f32;
        inside && self.view.nearest[v as usize * k.width + u as usize] > p.z * (1.0 + CLEAR_PART) + CLEAR_M
    }
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::super::cell::Sample;
    use super::*;

    fn cell(position: Vec3) -> Cell {
        let (cov, color, ray) = ([0.01, 0.0, 0.0, 0.01, 0.0, 0.01], Vec3::ONE, Vec3::ZERO);
        Cell::new(
            0,
            &Sample { position, cov, color, opacity: 1.0, weight: 1.0, ray, gate_m: 0.0, level: 0, fresh: true },
            0,
        )
    }

    #[test]
    fn only_what_lies_clearly_before_everything_around_its_pixel_is_passed_through() {
        let k = Intrinsics::from_fov(90.0, 20, 20);
        let mut depth = vec![10.0; 400];
        // An edge: the right half is near.
        (0..20).for_each(|r| (10..20).for_each(|c| depth[r * 20 + c] = 3.0));
        depth[5 * 20 + 3] = f32::NAN;
        let at = DVec3::new(5e5, 4e6, 7.0);
        let view = DepthView { map_from_camera: Rigid::new(DQuat::IDENTITY, at), intrinsics: k, depth };
        let carver = Carver::new(&view).unwrap();
        let tile = carver.for_tile(at - DVec3::splat(8.0), 16.0, 60.0).unwrap();
        // Camera coordinates to the tile's.
        let hit = |x: f32, y: f32, z: f32| tile.passes_through(&cell(Vec3::new(x, y, z) + 8.0));
        assert!(hit(-2.5, 2.0, 5.0));
        assert!(!hit(2.5, 2.0, 5.0), "behind a surface");
        assert!(!hit(-2.5, 2.0, 9.8), "at the surface");
        assert!(!hit(-0.1, 2.0, 5.0), "beside the edge");
        assert!(!hit(-2.5, 2.0, -5.0), "behind the camera");
        assert!(!hit(-6.0, 2.0, 5.0), "outside the picture");
        assert!(!hit(-3.2, -2.2, 5.0), "beside a pixel that is not known");
        assert!(carver.for_tile(at + DVec3::new(0.0, 0.0, -40.0), 16.0, 60.0).is_none());
        assert!(carver.for_tile(at + DVec3::new(0.0, 0.0, 200.0), 16.0, 60.0).is_none());
        let short = DepthView { depth: vec![1.0; 3], ..view };
        assert!(Carver::new(&short).is_none());
    }
}
