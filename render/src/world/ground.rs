//! The ground as one camera sees it: asphalt at height 0, everything beside it a kerb higher, found by the distance to the roads'
//! edges. All `f32`, relative to the eye.

use super::layout::Layout;
use super::road::{Crossing, RoadStyle};
use glam::{DVec3, Vec2, Vec3};

/// Ground farther than this from the eye has no roads.
const REACH_M: f32 = 280.0;
/// Side of a cell of the lookup grid.
const CELL_M: f32 = 8.0;
const CELLS: usize = (2.0 * REACH_M / CELL_M) as usize;
/// Distances to a road's edge are exact up to here beside it; the corner radius and the widest pavement must fit.
const BESIDE_M: f32 = 9.0;
/// How far a strip's ends may overlap their neighbours', so that no ray slips between.
const SEAM_M: f32 = 2e-3;
/// Bisections that place a ray on the face of a kerb: 0.1 m along a grazing ray of 40 m, to a millimetre.
const KERB_STEPS: usize = 16;

/// One piece of a road's centreline.
#[derive(Debug, Clone, Copy)]
struct Strip {
    road: u16,
    start: Vec2,
    dir: Vec2,
    length: f32,
    /// Arc length at the start.
    s: f32,
    half_width: f32,
    /// Radius, positive where the arc turns left; infinite for lines.
    radius: f32,
    centre: Vec2,
    first: bool,
    last: bool,
}

/// A road as it is painted.
#[derive(Debug, Clone)]
pub(crate) struct PaintedRoad {
    pub style: RoadStyle,
    pub crossings: Vec<Crossing>,
    pub seed: u32,
}

/// What lies at a point of the ground.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Spot {
    /// Metres from the asphalt's edge, negative on it.
    pub edge: f32,
    /// The road nearest (index into [`Ground::roads`]), if any is near.
    pub road: Option<u16>,
    /// Offset to the left of its centreline.
    pub d: f32,
    /// Distance to the next other road's edge.
    pub other: f32,
    strip: u16,
}

/// A ray's meeting with the ground.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GroundHit {
    pub t: f32,
    pub spot: Spot,
    pub normal: Vec3,
}

/// The ground around an eye.
#[derive(Debug, Clone)]
pub(crate) struct Ground {
    /// Height of the eye over the asphalt.
    pub eye: f32,
    pub kerb: f32,
    pub corner: f32,
    /// 1 where one drives on the right.
    pub hand: f32,
    strips: Vec<Strip>,
    pub roads: Vec<PaintedRoad>,
    cells: Vec<u32>,
    entries: Vec<u16>,
    /// Eye position in the texture's frame.
    pub anchor: Vec2,
}

/// Period of world-anchored textures; a multiple of every noise lattice, so that there is no seam.
pub(crate) const TEXTURE_PERIOD_M: f64 = 4096.0;

impl Ground {
    pub(crate) fn new(layout: &Layout, leg: usize, eye: DVec3) -> Self {
        let (mut strips, mut roads) = (Vec::new(), Vec::new());
        let here = eye.truncate();
        for index in layout.roads_near(leg, 2) {
            let road = &layout.roads[index];
            if road.centre.distance(here) > road.radius + f64::from(REACH_M) {
                continue;
            }
            let pieces = road.path.pieces();
            for (k, piece) in pieces.iter().enumerate() {
                let start = (piece.start - here).as_vec2();
                let dir = piece.dir.as_vec2();
                let radius = if piece.curvature == 0.0 { f32::INFINITY } else { (1.0 / piece.curvature) as f32 };
                let centre = if piece.curvature == 0.0 { Vec2::ZERO } else { start + dir.perp() * radius };
                strips.push(Strip {
                    road: roads.len() as u16,
                    start,
                    dir,
                    length: piece.length as f32,
                    s: piece.s as f32,
                    half_width: road.style.half_width as f32,
                    radius,
                    centre,
                    first: k == 0,
                    last: k + 1 == pieces.len(),
                });
            }
            roads.push(PaintedRoad { style: road.style, crossings: road.crossings.clone(), seed: road.seed as u32 });
        }
        let anchor = here.rem_euclid(glam::DVec2::splat(TEXTURE_PERIOD_M)).as_vec2();
        let (kerb, corner) = (layout.town.kerb as f32, layout.town.corner as f32);
        let (cells, entries) = bin(&strips);
        let hand = layout.town.hand as f32;
        Self { eye: eye.z as f32, kerb, corner, hand, strips, roads, cells, entries, anchor }
    }

    /// What lies at a point, relative to the eye.
    pub(crate) fn spot(&self, p: Vec2) -> Spot {
        let mut best = Spot { edge: f32::INFINITY, road: None, d: 0.0, other: f32::INFINITY, strip: 0 };
        let Some(cell) = cell_of(p) else { return best };
        for &i in &self.entries[self.cells[cell] as usize..self.cells[cell + 1] as usize] {
            let strip = &self.strips[i as usize];
            let Some((edge, d)) = strip.edge(p) else { continue };
            if edge < best.edge {
                if best.road != Some(strip.road) {
                    best.other = best.edge;
                }
                best = Spot { edge, road: Some(strip.road), d, other: best.other, strip: i };
            } else if best.road != Some(strip.road) && edge < best.other {
                best.other = edge;
            }
        }
        // Street corners: the asphalt reaches out to a circle that touches both kerbs.
        let r = self.corner;
        if best.edge > 0.0 && best.edge < r && best.other < r {
            best.edge = r - Vec2::new(r - best.edge, r - best.other).length();
        }
        best
    }

    /// Arc length along the spot's road.
    pub(crate) fn along(&self, spot: &Spot, p: Vec2) -> f32 {
        self.strips.get(usize::from(spot.strip)).map_or(0.0, |strip| strip.s + strip.along(p))
    }

    /// Unit vector along the spot's road.
    pub(crate) fn direction(&self, spot: &Spot, p: Vec2) -> Vec2 {
        let Some(strip) = self.strips.get(usize::from(spot.strip)) else { return Vec2::X };
        if strip.radius.is_infinite() {
            return strip.dir;
        }
        (p - strip.centre).perp().normalize_or(strip.dir) * strip.radius.signum()
    }

    /// Where a ray from the eye meets the ground before `t_max`.
    #[inline]
    pub(crate) fn hit(&self, d: Vec3, t_max: f32) -> Option<GroundHit> {
        if d.z >= -1e-6 {
            return None;
        }
        let flat = d.truncate();
        let high = (self.kerb - self.eye) / d.z;
        if !(high > 0.0 && high < t_max) {
            return None;
        }
        let top = self.spot(flat * high);
        if top.edge > 0.0 {
            return Some(GroundHit { t: high, spot: top, normal: Vec3::Z });
        }
        let low = -self.eye / d.z;
        let bottom = self.spot(flat * low);
        if bottom.edge <= 0.0 {
            return (low < t_max).then_some(GroundHit { t: low, spot: bottom, normal: Vec3::Z });
        }
        // Asphalt where the ray passes the kerb's height, no asphalt at the bottom: it meets the kerb's face between.
        let (mut on, mut off) = (high, low);
        for _ in 0..KERB_STEPS {
            let mid = 0.5 * (on + off);
            if self.spot(flat * mid).edge > 0.0 { off = mid } else { on = mid }
        }
        let spot = self.spot(flat * off);
        let slope = |axis: Vec2| self.spot(flat * off + axis * 0.02).edge - self.spot(flat * off - axis * 0.02).edge;
        let out = Vec2::new(slope(Vec2::X), slope(Vec2::Y)).normalize_or(-flat.normalize_or_zero());
        (off < t_max).then(|| GroundHit { t: off, spot, normal: (-out).extend(0.0) })
    }
}

impl Strip {
    /// Distance to the edge and offset to the left, where the strip is the one beside the point.
    #[inline]
    fn edge(&self, p: Vec2) -> Option<(f32, f32)> {
        let (u, d) = if self.radius.is_infinite() {
            let v = p - self.start;
            (v.dot(self.dir), self.dir.perp_dot(v))
        } else {
            let d = (self.radius.abs() - p.distance(self.centre)) * self.radius.signum();
            if d.abs() - self.half_width > BESIDE_M {
                return None;
            }
            (self.along(p), d)
        };
        // Inside a road its strips end where the next begins; only the road's own ends are edges.
        let free = if u < 0.5 * self.length { self.first } else { self.last };
        let out = (-u).max(u - self.length);
        if out > SEAM_M && !free {
            return None;
        }
        let edge = if free { (d.abs() - self.half_width).max(out) } else { d.abs() - self.half_width };
        (edge < BESIDE_M).then_some((edge, d))
    }

    fn along(&self, p: Vec2) -> f32 {
        if self.radius.is_infinite() {
            return (p - self.start).dot(self.dir);
        }
        let (from, to) = (self.start - self.centre, p - self.centre);
        from.perp_dot(to).atan2(from.dot(to)) * self.radius
    }

    /// A box around everything within reach of the strip's edges.
    fn bounds(&self) -> (Vec2, Vec2) {
        let point = |u: f32| {
            if self.radius.is_infinite() {
                return self.start + self.dir * u;
            }
            self.centre + Vec2::from_angle(u / self.radius).rotate(self.start - self.centre)
        };
        // Between two of nine points an arc of under a radian bulges by less than a metre at the radii roads have.
        let (mut lo, mut hi) = (Vec2::INFINITY, Vec2::NEG_INFINITY);
        for k in 0..=8 {
            let p = point(self.length * k as f32 / 8.0);
            (lo, hi) = (lo.min(p), hi.max(p));
        }
        let margin = Vec2::splat(self.half_width + BESIDE_M + 1.0);
        (lo - margin, hi + margin)
    }

    /// Whether a cell's circle can hold points beside a straight strip (arcs: always).
    fn near(&self, p: Vec2, radius: f32) -> bool {
        let d = self.dir.perp_dot(p - self.start).abs();
        !self.radius.is_infinite() || d < self.half_width + BESIDE_M + radius
    }
}

fn cell_of(p: Vec2) -> Option<usize> {
    let q = (p + REACH_M) / CELL_M;
    let inside = q.x >= 0.0 && q.y >= 0.0 && q.x < CELLS as f32 && q.y < CELLS as f32;
    inside.then(|| q.y as usize * CELLS + q.x as usize)
}

/// For every cell the strips that may lie in it, as one list with offsets.
fn bin(strips: &[Strip]) -> (Vec<u32>, Vec<u16>) {
    let mut pairs = Vec::new();
    for (i, strip) in strips.iter().enumerate() {
        let (lo, hi) = strip.bounds();
        let index = |v: f32| ((v + REACH_M) / CELL_M).clamp(0.0, CELLS as f32 - 1.0) as usize;
        for y in index(lo.y)..=index(hi.y) {
            for x in index(lo.x)..=index(hi.x) {
                let centre = (Vec2::new(x as f32, y as f32) + 0.5) * CELL_M - REACH_M;
                if strip.near(centre, 0.71 * CELL_M) {
                    pairs.push((y * CELLS + x, i as u16));
                }
            }
        }
    }
    let mut cells = vec![0u32; CELLS * CELLS + 1];
    for (cell, _) in &pairs {
        cells[cell + 1] += 1;
    }
    for k in 0..CELLS * CELLS {
        cells[k + 1] += cells[k];
    }
    let mut next = cells.clone();
    let mut entries = vec![0u16; pairs.len()];
    for (cell, i) in pairs {
        entries[next[cell] as usize] = i;
        next[cell] += 1;
    }
    (cells, entries)
}
