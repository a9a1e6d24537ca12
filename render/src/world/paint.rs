//! Colour of the ground: asphalt with its marks, kerbs, pavements, lawns, yards and fields.

use super::ground::{Ground, GroundHit, PaintedRoad};
use super::noise::{band, cell, grain, pulse};
use super::road::District;
use super::texture::Look;
use super::traffic::{ZEBRA_M, zebra_from};
use glam::{Vec2, Vec3};

/// How far along and across the view a pixel reaches on the ground.
struct Foot {
    view: Vec2,
    along: f32,
    across: f32,
}

impl Foot {
    /// Width of the pixel's footprint measured along a unit direction.
    fn along(&self, axis: Vec2) -> f32 {
        self.along * self.view.dot(axis).abs() + self.across * self.view.perp_dot(axis).abs()
    }
}

const WHITE: Vec3 = Vec3::new(0.62, 0.62, 0.6);
const YELLOW: Vec3 = Vec3::new(0.6, 0.42, 0.06);

/// The look of the ground where a ray `d` (any length) met it; `pixel` is a pixel's angle in radians.
pub(crate) fn look(ground: &Ground, hit: &GroundHit, d: Vec3, pixel: f32) -> Look {
    let p = d.truncate() * hit.t;
    let length = d.length();
    let distance = hit.t * length;
    let across = distance * pixel;
    let sink = (-d.z / length).max(0.01);
    let foot = Foot { view: d.truncate().normalize_or(Vec2::X), along: across / sink, across };
    let world = p + ground.anchor;
    let soft = (foot.along * across).sqrt();
    let Some(road) = hit.spot.road.and_then(|r| ground.roads.get(usize::from(r))) else {
        return field(world, soft, None);
    };
    let s = ground.along(&hit.spot, p);
    let uv = Vec2::new(s, hit.spot.d);
    if hit.normal.z < 0.5 {
        return Look::matt(Vec3::splat(0.28) * (1.0 + 0.15 * grain(uv, 5.0, soft, 3)));
    }
    let edge = hit.spot.edge;
    if edge <= 0.0 {
        return asphalt(ground, road, hit, p, uv, &foot, soft);
    }
    let walk = road.style.pavement as f32;
    let kerb = band(edge, -1.0, 0.16, foot.across.min(0.5));
    let stone = Look::matt(Vec3::splat(0.33) * (1.0 - 0.3 * pulse(s, 0.0, 0.03, soft)));
    let beside = if edge < walk { pavement(road, uv, soft) } else { field(world, soft, Some(road)) };
    if matches!(road.style.district, District::Rural) { beside } else { beside.mix(stone, kerb) }
}

fn pavement(road: &PaintedRoad, uv: Vec2, soft: f32) -> Look {
    let tint = match road.seed % 4 {
        0 => Vec3::new(0.3, 0.29, 0.28),
        1 => Vec3::new(0.36, 0.34, 0.31),
        2 => Vec3::new(0.26, 0.26, 0.27),
        _ => Vec3::new(0.36, 0.26, 0.22),
    };
    let step = [0.5f32, 0.8, 1.5, 0.3][(road.seed / 4 % 4) as usize];
    let q = uv / step;
    let f = soft / step;
    let joints = 1.0 - (1.0 - pulse(q.x, 0.0, 0.05, f)) * (1.0 - pulse(q.y, 0.0, 0.05, f));
    let near = (1.0 - f).clamp(0.0, 1.0);
    let tone =
        0.1 * near * cell(q, road.seed) + 0.08 * grain(uv, 0.4, soft, road.seed) + 0.08 * grain(uv, 6.0, soft, 8);
    Look::matt(tint * (1.0 + tone) * (1.0 - 0.35 * joints))
}

/// Away from roads: lawns, fields, yards.
fn field(world: Vec2, soft: f32, road: Option<&PaintedRoad>) -> Look {
    let hard = match road.map(|r| r.style.district) {
        Some(District::Downtown) => 1.0,
        Some(District::Industrial) => 0.8,
        Some(District::Terraces) => 0.6,
        _ => 0.0,
    };
    let patch = grain(world, 1.0 / 16.0, soft, 21);
    let blades =
        0.22 * grain(world, 8.0, soft, 22) + 0.15 * grain(world, 2.0, soft, 23) + 0.15 * grain(world, 0.25, soft, 24);
    let grass = Vec3::new(0.1, 0.15, 0.045) + Vec3::new(0.07, 0.04, 0.01) * (patch.max(-0.6) + 0.3);
    let grass = grass * (1.0 + blades);
    let paved = Vec3::new(0.25, 0.24, 0.22) * (1.0 + 0.15 * grain(world, 4.0, soft, 25) + 0.12 * patch);
    Look::matt(grass + (paved - grass) * hard)
}

fn asphalt(ground: &Ground, road: &PaintedRoad, hit: &GroundHit, p: Vec2, uv: Vec2, foot: &Foot, soft: f32) -> Look {
    let base = 0.07 + 0.05 * ((road.seed >> 8) % 64) as f32 / 64.0;
    let grainy = 0.16 * grain(uv, 10.0, soft, road.seed)
        + 0.1 * grain(uv, 2.5, soft, 31)
        + 0.14 * grain(uv * Vec2::new(0.2, 1.0), 0.6, soft, 32);
    let patch = if cell(uv * Vec2::new(0.12, 0.28), road.seed ^ 33) > 0.86 { 0.72 } else { 1.0 };
    let tint = Vec3::new(1.0, 1.0, 1.03) * base;
    let mut color = tint * (1.0 + grainy) * patch;
    // The lines of manholes and drains: dark discs at random places.
    let hole = (uv * Vec2::new(1.0 / 19.0, 0.28)).floor();
    if cell(hole + 0.5, road.seed ^ 34) > 0.55 {
        let at = Vec2::new((hole.x + 0.5) * 19.0, (hole.y + 0.5) / 0.28);
        let inside = ((0.32 - uv.distance(at)) / soft.max(1e-3) + 0.5).clamp(0.0, 1.0);
        color *= 1.0 - 0.5 * inside;
    }
    // Paint stays off the part that another road covers.
    if hit.spot.other > 0.3 {
        let axis = ground.direction(&hit.spot, p);
        let (paint, ink) = marks(ground, road, uv.x, hit.spot.d, foot.along(axis), foot.along(axis.perp()));
        let worn = 0.9 + 0.25 * grain(uv, 3.0, soft, 35);
        color += (ink - color) * (paint * worn).clamp(0.0, 1.0);
    }
    Look { albedo: color, gloss: 0.012, glow: Vec3::ZERO }
}

/// Share of the pixel that is painted, and the paint's colour.
fn marks(ground: &Ground, road: &PaintedRoad, s: f32, d: f32, fs: f32, fd: f32) -> (f32, Vec3) {
    let style = &road.style;
    let lane = style.lane_width as f32;
    let lanes = style.lanes as f32;
    let zebra_edge = zebra_from(f64::from(ground.corner)) as f32;
    let mut paint = 0.0f32;
    let mut ink = WHITE;
    // Which crossing is near? Lines end before it, zebras and stop lines lie there.
    let mut open = 1.0f32;
    for c in &road.crossings {
        let way = s - c.s as f32;
        let beyond = way.abs() - c.wide as f32;
        if beyond > 30.0 {
            continue;
        }
        let zebra = c.zebra[usize::from(way > 0.0)];
        let end = if zebra { zebra_edge + ZEBRA_M as f32 + 0.8 } else { zebra_edge * 0.6 };
        open *= band(beyond, end, 1e6, fs);
        if zebra {
            let stripes = pulse(d + 0.25, 0.0, 0.5, fd) * band(beyond, zebra_edge, zebra_edge + ZEBRA_M as f32, fs);
            paint = paint.max(stripes);
        }
        // Stop lines lie before the crossing on the side one drives on.
        let coming = way * d * ground.hand > 0.0;
        if c.stop_lines && coming {
            let inner = band(d.abs(), 0.1, lanes * lane, fd);
            paint = paint.max(inner * band(beyond, end, end + 0.35, fs));
        }
    }
    let dash = pulse(s / 6.0, 0.0, 0.5, fs / 6.0);
    let line = |at: f32, width: f32| band(d, at - 0.5 * width, at + 0.5 * width, fd);
    let centre = match style.centre {
        0 => 0.0,
        1 => line(0.0, 0.13) * dash,
        2 => line(0.0, 0.13),
        _ => line(0.12, 0.11) + line(-0.12, 0.11),
    } * open;
    if style.yellow && centre > 0.0 {
        ink = YELLOW;
    }
    paint = paint.max(centre);
    let mut white = 0.0f32;
    for k in 1..style.lanes {
        let at = k as f32 * lane;
        white = white.max((line(at, 0.12) + line(-at, 0.12)) * dash * open);
    }
    if style.edge_lines {
        let at = lanes * lane + 0.05;
        white = white.max((line(at, 0.12) + line(-at, 0.12)) * open);
    }
    for (k, side) in [(0, 1.0f32), (1, -1.0)] {
        if style.parking[k] && road.seed & 16 != 0 {
            let from = lanes * lane + 0.1;
            let bays = pulse(s / 6.0, 0.0, 0.018, fs / 6.0) * band(d * side, from, style.half_width as f32, fd);
            white = white.max((line(side * from, 0.1)).max(bays) * open);
        }
    }
    if white > centre {
        ink = WHITE;
    }
    (paint.max(white), ink)
}
