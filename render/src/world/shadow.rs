//! Shadows by rays towards the sun. The sun being infinitely far, all its rays are parallel: casters are sorted into the cells of
//! a grid perpendicular to them, and a ray looks into one cell.

use super::scene::Part;
use super::skin::Skin;
use glam::{Vec2, Vec3};

/// Half the grid's side and a cell's side, metres. Outside the grid everything is lit.
const REACH_M: f32 = 96.0;
const CELL_M: f32 = 2.0;
const CELLS: usize = (2.0 * REACH_M / CELL_M) as usize;
/// Shadow rays start this far off the surface, so that it does not shade itself.
const LIFT_M: f32 = 0.012;

/// Casters by cell.
#[derive(Debug, Clone, Default)]
pub(crate) struct Shadows {
    sun: Vec3,
    across: [Vec3; 2],
    cells: Vec<u32>,
    entries: Vec<u32>,
}

impl Shadows {
    pub(crate) fn new(parts: &[Part], sun: Vec3) -> Self {
        let (a, b) = sun.any_orthonormal_pair();
        let flat = |p: Vec3| Vec2::new(a.dot(p), b.dot(p));
        let spans: Vec<Option<[usize; 4]>> = parts
            .iter()
            .map(|part| {
                let half = part.shape.bounds();
                let inv = part.rot.transpose();
                let reach = Vec2::new((inv * a).abs().dot(half), (inv * b).abs().dot(half));
                let at = flat(part.pos);
                let (lo, hi) = ((at - reach + REACH_M) / CELL_M, (at + reach + REACH_M) / CELL_M);
                let top = CELLS as f32;
                let inside = hi.cmpgt(Vec2::ZERO).all() && lo.cmplt(Vec2::splat(top)).all();
                let index = |v: f32| v.clamp(0.0, top - 1.0) as usize;
                inside.then(|| [index(lo.x), index(hi.x), index(lo.y), index(hi.y)])
            })
            .collect();
        let mut cells = vec![0u32; CELLS * CELLS + 1];
        for [x0, x1, y0, y1] in spans.iter().flatten() {
            for y in *y0..=*y1 {
                for cell in &mut cells[y * CELLS + x0 + 1..=y * CELLS + x1 + 1] {
                    *cell += 1;
                }
            }
        }
        for k in 0..CELLS * CELLS {
            cells[k + 1] += cells[k];
        }
        let mut next = cells.clone();
        let mut entries = vec![0u32; cells[CELLS * CELLS] as usize];
        for (i, span) in spans.iter().enumerate() {
            let Some([x0, x1, y0, y1]) = span else { continue };
            for y in *y0..=*y1 {
                for slot in &mut next[y * CELLS + x0..=y * CELLS + x1] {
                    entries[*slot as usize] = i as u32;
                    *slot += 1;
                }
            }
        }
        Self { sun, across: [a, b], cells, entries }
    }

    /// Whether something stands between a surface point and the sun.
    #[inline]
    pub(crate) fn dark(&self, parts: &[Part], p: Vec3, normal: Vec3, skin: Option<&Skin>) -> bool {
        let q = (Vec2::new(self.across[0].dot(p), self.across[1].dot(p)) + REACH_M) / CELL_M;
        if !(q.x >= 0.0 && q.y >= 0.0 && q.x < CELLS as f32 && q.y < CELLS as f32) {
            return false;
        }
        let cell = q.y as usize * CELLS + q.x as usize;
        let start = p + normal * LIFT_M;
        self.entries[self.cells[cell] as usize..self.cells[cell + 1] as usize].iter().any(|&i| {
            let part = &parts[i as usize];
            let inv = part.rot.transpose();
            let (o, d) = (inv * (start - part.pos), inv * self.sun);
            part.shape.hit(o, d).is_some_and(|(t, _)| {
                // Light falls through the holes of foliage.
                !skin.is_some_and(|skin| skin.open(&part.material, o + d * t, 0.0))
            })
        })
    }
}
