//! Colours of solids, as functions of the place on them: a moving body carries its texture along.

use super::material::{Facade, Material, Surface};
use super::noise::{band, cell, grain, pulse};
use glam::{Vec2, Vec3};

/// What light meets on a surface.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Look {
    pub albedo: Vec3,
    /// Share of mirror reflection at normal incidence.
    pub gloss: f32,
    /// Light of its own.
    pub glow: Vec3,
}

impl Look {
    pub(crate) fn matt(albedo: Vec3) -> Self {
        Self { albedo, gloss: 0.0, glow: Vec3::ZERO }
    }

    pub(crate) fn mix(self, other: Self, f: f32) -> Self {
        Self {
            albedo: self.albedo + (other.albedo - self.albedo) * f,
            gloss: self.gloss + (other.gloss - self.gloss) * f,
            glow: self.glow + (other.glow - self.glow) * f,
        }
    }
}

/// Coordinates on the face whose normal is nearest to `n`: across and up.
#[inline]
pub(crate) fn face(p: Vec3, n: Vec3) -> Vec2 {
    let a = n.abs();
    if a.z >= a.x && a.z >= a.y {
        Vec2::new(p.x, p.y)
    } else if a.x > a.y {
        Vec2::new(p.y, p.z)
    } else {
        Vec2::new(p.x, p.z)
    }
}

const GLASS: Vec3 = Vec3::new(0.02, 0.024, 0.028);

fn glass() -> Look {
    Look { albedo: GLASS, gloss: 0.12, glow: Vec3::ZERO }
}

/// The look of a solid at local point `p` with local normal `n`; `half` is the solid's box, `foot` the pixel's width there;
/// `lamps` says how bright lamps and lit windows are (0 by day).
pub(crate) fn look(m: &Material, p: Vec3, n: Vec3, half: Vec3, foot: f32, lamps: f32) -> Look {
    let uv = face(p, n);
    match m.surface {
        Surface::Plain => Look::matt(m.color * (1.0 + 0.06 * grain(uv, 9.0, foot, m.seed))),
        Surface::Sheen => Look { albedo: m.color, gloss: 0.06, glow: Vec3::ZERO },
        Surface::Lamp => Look { albedo: m.color, gloss: 0.06, glow: m.color * (3.0 * lamps) },
        Surface::Rough => {
            Look::matt(m.color * (1.0 + 0.3 * grain(uv, 12.0, foot, m.seed) + 0.15 * grain(uv, 4.0, foot, m.seed ^ 5)))
        }
        Surface::Leaves => {
            let clumps = 0.45 * grain(uv, 2.3, foot, m.seed)
                + 0.4 * grain(uv, 6.0, foot, m.seed ^ 9)
                + 0.25 * grain(uv, 14.0, foot, m.seed ^ 3);
            // Darker towards the inside and below.
            let depth = 0.75 + 0.25 * (p.z / half.z);
            Look::matt(m.color * (depth * (1.0 + clumps)).max(0.15))
        }
        Surface::Courses { step } => {
            let gap = pulse(uv.y / step, 0.0, 0.16, foot / step);
            let row = (uv.y / step).floor();
            let tone = cell(Vec2::new(uv.x / (2.2 * step) + 0.5 * (row - 2.0 * (0.5 * row).floor()), row), m.seed);
            let near = (1.0 - foot / step).clamp(0.0, 1.0);
            Look::matt(m.color * (1.0 + 0.18 * tone * near + 0.12 * grain(uv, 0.7, foot, m.seed)) * (1.0 - 0.35 * gap))
        }
        Surface::Boards { step } => {
            let gap = pulse(uv.x / step, 0.0, 0.13, foot / step);
            let near = (1.0 - foot / step).clamp(0.0, 1.0);
            let tone = cell(Vec2::new(uv.x / step, 0.0), m.seed);
            Look::matt(m.color * (1.0 + 0.15 * tone * near + 0.08 * grain(uv, 2.0, foot, m.seed)) * (1.0 - 0.6 * gap))
        }
        Surface::Facade(f) => facade(m, &f, p, n, half, foot, lamps),
        Surface::Body { axles, arch } => body(m, axles, arch, p, n, half, foot),
        Surface::Cabin => cabin(m, p, n, half, foot),
        Surface::Coach { glass, stripe } => coach(m, glass, stripe, p, n, half, foot),
        Surface::Wheel => wheel(m, p, n, half),
        Surface::Sign { round } => sign(m, round, p, n, half, foot),
        Surface::Signal { lamp } => signal(m, lamp, p, n, half, foot),
        Surface::Poster => {
            let block = (uv / half.y.min(half.z) * 1.7).floor();
            let c = |k: u32| 0.5 + 0.45 * cell(block + 0.5, m.seed ^ k);
            Look::matt(Vec3::new(c(1), c(2), c(3)) * 0.8)
        }
    }
}

fn facade(m: &Material, f: &Facade, p: Vec3, n: Vec3, half: Vec3, foot: f32, lamps: f32) -> Look {
    if n.z.abs() > 0.5 {
        return Look::matt(Vec3::splat(0.16) * (1.0 + 0.3 * grain(p.truncate(), 1.0, foot, m.seed)));
    }
    let (across, wide) = if n.x.abs() > n.y.abs() { (p.y, half.y) } else { (p.x, half.x) };
    let up = p.z + half.z;
    let uv = Vec2::new(across, up);
    let wall = m.color
        * (1.0 + 0.1 * grain(uv, 0.35, foot, m.seed) + 0.07 * grain(uv, 3.0, foot, m.seed ^ 7))
        * (1.0 - 0.25 * (0.5 - up).clamp(0.0, 0.5));
    let wall = if f.brick { wall * (1.0 - 0.25 * pulse(up / 0.075, 0.0, 0.2, foot / 0.075)) } else { wall };
    let columns = (2.0 * wide / f.cell).round().max(1.0);
    let x = (across + wide) / (2.0 * wide) * columns;
    let floors = (2.0 * half.z / f.floor).floor().max(1.0);
    let y = up / f.floor;
    let (fx, fy) = (foot * columns / (2.0 * wide), foot / f.floor);
    // A band between the floors, a cornice at the top.
    let sill = pulse(y, 0.0, 0.05, fy);
    let mut look = Look::matt(wall * (1.0 - 0.14 * sill));
    if y >= floors {
        return look;
    }
    let ground = y < 1.0;
    let (open, base) = if ground && f.shop { ([0.88, 0.72], 0.08) } else { (f.open, 0.5 * (1.0 - f.open[1]) + 0.05) };
    let (x0, x1) = (0.5 - 0.5 * open[0], 0.5 + 0.5 * open[0]);
    let frame = 0.07 / f.cell;
    let surround = pulse(x, x0 - frame, x1 + frame, fx) * pulse(y, base - 0.03, base + open[1] + 0.025, fy);
    look = look.mix(Look::matt(m.accent * 0.9), surround);
    let pane = pulse(x, x0, x1, fx) * pulse(y, base, base + open[1], fy);
    // Every window is its own: a curtain, a lit room, plain dark glass; far away they blend into a mean.
    let id = Vec2::new(x.floor(), y.floor());
    let tone = cell(id + 0.5, m.seed ^ 0x51);
    let near = (1.4 - fx.max(fy) * 1.4).clamp(0.0, 1.0);
    let curtain = if tone > 0.55 { Vec3::new(0.35, 0.33, 0.3) } else { Vec3::splat(0.03 + 0.04 * (tone + 1.0)) };
    let inside = Vec3::splat(0.09) + (curtain - Vec3::splat(0.09)) * near;
    // A door takes a window's place on the ground floor, and the glazing bar is a line down its middle.
    let middle = (columns * 0.5).floor();
    if ground && x.floor() == middle && n.y < -0.5 {
        let door = pulse(x, 0.25, 0.75, fx) * band(up, 0.0, 2.2, foot);
        let paint = Vec3::new(0.12, 0.08, 0.06) + 0.1 * Vec3::new(tone.abs(), 0.3, 1.0 - tone.abs());
        return Look::matt(wall).mix(Look::matt(paint), door);
    }
    let bar = pulse(x, 0.485, 0.515, fx) * 0.8;
    let lit = if tone > 0.55 { Vec3::new(0.3, 0.22, 0.12) * (lamps * near) } else { Vec3::ZERO };
    let pane_look = Look { albedo: inside, gloss: 0.14, glow: lit }.mix(Look::matt(m.accent * 0.7), bar);
    look.mix(pane_look, pane)
}

fn body(m: &Material, axles: [f32; 2], arch: f32, p: Vec3, n: Vec3, half: Vec3, foot: f32) -> Look {
    let paint =
        Look { albedo: m.color * (1.0 + 0.03 * grain(face(p, n), 6.0, foot, m.seed)), gloss: 0.07, glow: Vec3::ZERO };
    let dark = Look { albedo: Vec3::splat(0.015), gloss: 0.03, glow: Vec3::ZERO };
    let up = (p.z + half.z) / (2.0 * half.z);
    let fz = foot / (2.0 * half.z);
    if n.x.abs() > 0.6 {
        let y = (p.y / half.y).abs();
        let fy = foot / half.y;
        let lamps = band(y, 0.55, 0.93, fy) * band(up, 0.55, 0.85, fz);
        let plate = band(y, -0.3, 0.3, fy) * band(up, 0.22, 0.4, fz);
        let lower = dark.mix(Look::matt(Vec3::splat(0.55)), plate);
        if n.x > 0.0 {
            let grille = band(y, -0.1, 0.5, fy) * band(up, 0.5, 0.82, fz);
            let head = Look { albedo: Vec3::splat(0.7), gloss: 0.15, glow: Vec3::splat(0.25) };
            return paint.mix(dark, band(up, -0.1, 0.2, fz)).mix(dark, 0.8 * grille).mix(lower, plate).mix(head, lamps);
        }
        let tail = Look { albedo: Vec3::new(0.5, 0.02, 0.02), gloss: 0.1, glow: Vec3::new(0.12, 0.0, 0.0) };
        return paint.mix(dark, band(up, -0.1, 0.22, fz)).mix(lower, plate).mix(tail, lamps);
    }
    if n.y.abs() > 0.5 {
        let mut look = paint.mix(dark, band(up, -0.1, 0.12, fz));
        // Door seams, handles, and the dark of the wheel arches (the axles lie at the body's underside).
        for seam in [-0.16f32, 0.12, 0.4] {
            let line = band(p.x - 2.0 * half.x * (seam - 0.1), -0.012, 0.012, foot) * band(up, 0.14, 1.0, fz);
            look = look.mix(dark, 0.8 * line);
        }
        for axle in axles {
            let hub = Vec2::new(p.x - axle, p.z + half.z - 0.35 * arch);
            let inside = ((arch - hub.length()) / foot.max(1e-3) + 0.5).clamp(0.0, 1.0);
            look = look.mix(dark, inside);
        }
        return look;
    }
    paint
}

fn cabin(m: &Material, p: Vec3, n: Vec3, half: Vec3, foot: f32) -> Look {
    let paint = Look { albedo: m.color, gloss: 0.07, glow: Vec3::ZERO };
    if n.z > 0.85 {
        return paint;
    }
    let up = (p.z + half.z) / (2.0 * half.z);
    let fz = foot / (2.0 * half.z);
    let pane = band(up, 0.1, 0.9, fz);
    if n.y.abs() > 0.6 {
        let x = p.x / half.x;
        let fx = foot / half.x;
        // Narrower to the top: the pillars follow the sloping screens.
        let front = 0.9 - 0.34 * up;
        let rear = -0.9 + 0.3 * up;
        let open = band(x, rear, front, fx) * (1.0 - band(x, -0.09, -0.03, fx));
        return paint.mix(glass(), pane * open);
    }
    let y = p.y / half.y;
    paint.mix(glass(), pane * band(y, -0.9 + 0.12 * up, 0.9 - 0.12 * up, foot / half.y))
}

fn coach(m: &Material, from: f32, stripe: f32, p: Vec3, n: Vec3, half: Vec3, foot: f32) -> Look {
    let paint =
        Look { albedo: m.color * (1.0 + 0.04 * grain(face(p, n), 2.0, foot, m.seed)), gloss: 0.05, glow: Vec3::ZERO };
    let up = (p.z + half.z) / (2.0 * half.z);
    let fz = foot / (2.0 * half.z);
    let mut look = paint;
    if n.z.abs() > 0.7 {
        return look;
    }
    if stripe > 0.0 {
        look = look.mix(Look { albedo: m.accent, ..paint }, band(up, 0.18, 0.18 + stripe, fz));
    }
    look = look.mix(Look::matt(Vec3::splat(0.02)), band(up, -0.1, 0.07, fz));
    if n.x < -0.5 {
        let (y, fy) = ((p.y / half.y).abs(), foot / half.y);
        let lamps = band(y, 0.8, 0.95, fy) * band(up, 0.1, 0.3, fz);
        let seam = band(y, -0.02, 0.02, fy) * band(up, 0.1, 0.95, fz);
        let tail = Look { albedo: Vec3::new(0.5, 0.02, 0.02), gloss: 0.1, glow: Vec3::new(0.12, 0.0, 0.0) };
        look = look.mix(Look::matt(m.color * 0.4), seam).mix(tail, lamps);
    }
    if from < 1.0 {
        let pane = band(up, from, 0.88, fz);
        let (x, f, count) = if n.y.abs() > 0.5 {
            (p.x / half.x, foot / half.x, (half.x * 1.3).round().max(1.0))
        } else {
            (p.y / half.y, foot / half.y, 1.0)
        };
        let posts = pulse((x * 0.5 + 0.5) * count, 0.05, 0.95, 0.5 * f * count);
        look = look.mix(glass(), pane * posts);
        if n.x > 0.5 {
            let y = (p.y / half.y).abs();
            let head = Look { albedo: Vec3::splat(0.7), gloss: 0.15, glow: Vec3::splat(0.25) };
            look = look.mix(head, band(y, 0.68, 0.92, f) * band(up, 0.12, 0.22, fz));
        }
    }
    look
}

fn wheel(m: &Material, p: Vec3, n: Vec3, half: Vec3) -> Look {
    let tyre = Look::matt(Vec3::splat(0.018));
    let r = p.truncate().length() / half.x;
    if n.z.abs() < 0.5 || r > 0.68 {
        return tyre;
    }
    let spoke = (p.y.atan2(p.x) * (5.0 / std::f32::consts::TAU) + 8.0).fract();
    let solid = r < 0.2 || (0.3..0.7).contains(&spoke) || r > 0.6;
    if solid { Look { albedo: m.color, gloss: 0.05, glow: Vec3::ZERO } } else { Look::matt(Vec3::splat(0.04)) }
}

fn sign(m: &Material, round: bool, p: Vec3, n: Vec3, half: Vec3, foot: f32) -> Look {
    let back = Look::matt(Vec3::splat(0.25));
    // A disc faces along its axis -> its own z; a plate faces along -x.
    let (uv, size, front) = if round {
        (Vec2::new(p.y, p.x), Vec2::splat(half.x), n.z > 0.5)
    } else {
        (Vec2::new(p.y, p.z), Vec2::new(half.y, half.z), n.x < -0.5)
    };
    if !front {
        return back;
    }
    let q = uv / size;
    let f = foot / size.min_element();
    let out = if round { q.length() } else { q.abs().max_element() };
    let rim = 1.0 - band(out, -1.0, 0.78, f);
    let mark = (Vec2::new(q.x, q.y) * 2.2).floor();
    let symbol = if cell(mark + 0.5, m.seed) > 0.1 { band(out, -1.0, 0.55, f) } else { 0.0 };
    let ink = if m.color.min_element() > 0.3 { Vec3::splat(0.03) } else { Vec3::splat(0.75) };
    Look::matt(m.color).mix(Look::matt(ink), symbol * (1.0 - 1.2 * f).clamp(0.0, 1.0)).mix(Look::matt(m.accent), rim)
}

fn signal(m: &Material, lamp: u8, p: Vec3, n: Vec3, half: Vec3, foot: f32) -> Look {
    let mut look = Look::matt(m.color);
    if n.x > -0.5 {
        return look;
    }
    let colors = [Vec3::new(1.0, 0.06, 0.03), Vec3::new(1.0, 0.55, 0.05), Vec3::new(0.05, 0.9, 0.35)];
    for (k, color) in colors.iter().enumerate() {
        let at = Vec2::new(p.y, p.z - half.z * 0.62 * (1.0 - k as f32));
        let inside = ((0.11 - at.length()) / foot.max(1e-3) + 0.5).clamp(0.0, 1.0);
        let glow = if usize::from(lamp) == k { *color * 1.6 } else { Vec3::ZERO };
        look = look.mix(Look { albedo: *color * 0.08, gloss: 0.05, glow }, inside);
    }
    look
}
