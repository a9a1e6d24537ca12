//! Solids a ray can meet, each in its own frame centred on the origin. All are convex but for the ring's hole.
//!
//! A ray is `o + t d` with any length of `d`; hits are where it enters, `t > 0`. A ray that starts inside meets nothing.

use glam::{Vec2, Vec3};

/// A solid.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Shape {
    Box {
        half: Vec3,
    },
    /// A box whose top rectangle has another size and place: z from -half.z to half.z, `half.xy` at the bottom; `lean` holds the
    /// z parts of the normals of the +x, -x, +y, -y sides (whose x or y part is 1).
    Taper {
        half: Vec3,
        lean: [f32; 4],
        reach: Vec2,
    },
    /// Axis z, flat ends; the ends are open inside `hole`.
    Cylinder {
        radius: f32,
        half: f32,
        hole: f32,
    },
    /// Axis z from -half to half, with round ends beyond.
    Capsule {
        radius: f32,
        half: f32,
    },
    Ellipsoid {
        radii: Vec3,
    },
}

impl Shape {
    pub(crate) fn cuboid(x: f32, y: f32, z: f32) -> Self {
        Self::Box { half: Vec3::new(x, y, z) * 0.5 }
    }

    /// Full sizes at the bottom (`x`, `y`) and top, the height `z`, and by how much the top is shifted.
    pub(crate) fn taper(x: f32, y: f32, z: f32, top: Vec2, shift: Vec2) -> Self {
        let half = Vec3::new(x, y, z) * 0.5;
        let top = top * 0.5;
        let lean = [
            (half.x - top.x - shift.x) / z,
            (half.x - top.x + shift.x) / z,
            (half.y - top.y - shift.y) / z,
            (half.y - top.y + shift.y) / z,
        ];
        let reach = Vec2::new(half.x.max(top.x + shift.x.abs()), half.y.max(top.y + shift.y.abs()));
        Self::Taper { half, lean, reach }
    }

    /// Half sizes of a box around the solid.
    pub(crate) fn bounds(&self) -> Vec3 {
        match *self {
            Self::Box { half } => half,
            Self::Taper { half, reach, .. } => reach.extend(half.z),
            Self::Cylinder { radius, half, .. } => Vec3::new(radius, radius, half),
            Self::Capsule { radius, half } => Vec3::new(radius, radius, half + radius),
            Self::Ellipsoid { radii } => radii,
        }
    }

    /// Where the ray enters and the outward normal there (unit length).
    #[inline]
    pub(crate) fn hit(&self, o: Vec3, d: Vec3) -> Option<(f32, Vec3)> {
        match *self {
            Self::Box { half } => hit_box(o, d, half),
            Self::Taper { half, lean, .. } => hit_taper(o, d, half, &lean),
            Self::Cylinder { radius, half, hole } => hit_cylinder(o, d, radius, half, hole),
            Self::Capsule { radius, half } => hit_capsule(o, d, radius, half),
            Self::Ellipsoid { radii } => {
                let (so, sd) = (o / radii, d / radii);
                let t = sphere(so, sd, 1.0)?;
                Some((t, ((so + sd * t) / radii).normalize()))
            }
        }
    }
}

#[inline]
fn hit_box(o: Vec3, d: Vec3, half: Vec3) -> Option<(f32, Vec3)> {
    let inv = d.recip();
    let centre = -o * inv;
    let width = half * inv.abs();
    let (enter, exit) = (centre - width, centre + width);
    let (near, far) = (enter.max_element(), exit.min_element());
    if near > 0.0 && near <= far {
        let normal = if near == enter.x {
            Vec3::new(-d.x.signum(), 0.0, 0.0)
        } else if near == enter.y {
            Vec3::new(0.0, -d.y.signum(), 0.0)
        } else {
            Vec3::new(0.0, 0.0, -d.z.signum())
        };
        return Some((near, normal));
    }
    None
}

#[inline]
fn hit_taper(o: Vec3, d: Vec3, half: Vec3, lean: &[f32; 4]) -> Option<(f32, Vec3)> {
    let side = |n: Vec3, base: f32| (n, base - n.z * half.z);
    let planes = [
        (Vec3::Z, half.z),
        (Vec3::NEG_Z, half.z),
        side(Vec3::new(1.0, 0.0, lean[0]), half.x),
        side(Vec3::new(-1.0, 0.0, lean[1]), half.x),
        side(Vec3::new(0.0, 1.0, lean[2]), half.y),
        side(Vec3::new(0.0, -1.0, lean[3]), half.y),
    ];
    let (mut near, mut far, mut normal) = (0.0f32, f32::INFINITY, Vec3::ZERO);
    for (n, c) in planes {
        let speed = n.dot(d);
        let outside = n.dot(o) - c;
        if speed < 0.0 {
            let t = -outside / speed;
            if t > near {
                (near, normal) = (t, n);
            }
        } else if speed > 0.0 {
            far = far.min(-outside / speed);
        } else if outside > 0.0 {
            return None;
        }
    }
    (near > 0.0 && near <= far).then(|| (near, normal.normalize()))
}

/// Smaller positive root of |o + t d| = r, for a start outside.
#[inline]
fn sphere(o: Vec3, d: Vec3, r: f32) -> Option<f32> {
    // The point of the ray nearest the centre first: small numbers only, so far spheres keep their precision in f32.
    let dd = d.length_squared();
    let nearest = -o.dot(d) / dd;
    let gap = r * r - (o + d * nearest).length_squared();
    if gap > 0.0 {
        let t = nearest - (gap / dd).sqrt();
        return (t > 0.0).then_some(t);
    }
    None
}

#[inline]
fn hit_cylinder(o: Vec3, d: Vec3, radius: f32, half: f32, hole: f32) -> Option<(f32, Vec3)> {
    let dd = d.x * d.x + d.y * d.y;
    let (mut near, mut far) = (f32::NEG_INFINITY, f32::INFINITY);
    if dd > 1e-12 {
        let nearest = -(o.x * d.x + o.y * d.y) / dd;
        let (px, py) = (o.x + d.x * nearest, o.y + d.y * nearest);
        let gap = radius * radius - px * px - py * py;
        if gap <= 0.0 {
            return None;
        }
        let w = (gap / dd).sqrt();
        (near, far) = (nearest - w, nearest + w);
    } else if o.x * o.x + o.y * o.y > radius * radius {
        return None;
    }
    let inv = 1.0 / d.z;
    let (c, w) = (-o.z * inv, half * inv.abs());
    let cap = c - w;
    if cap.max(near) > far.min(c + w) {
        return None;
    }
    if cap > near {
        let p = o + d * cap;
        let open = p.x * p.x + p.y * p.y < hole * hole;
        (cap > 0.0 && !open).then(|| (cap, Vec3::new(0.0, 0.0, -d.z.signum())))
    } else {
        let p = o + d * near;
        (near > 0.0).then(|| (near, Vec3::new(p.x, p.y, 0.0).normalize()))
    }
}

#[inline]
fn hit_capsule(o: Vec3, d: Vec3, radius: f32, half: f32) -> Option<(f32, Vec3)> {
    let dd = d.x * d.x + d.y * d.y;
    if dd > 1e-12 {
        let nearest = -(o.x * d.x + o.y * d.y) / dd;
        let (px, py) = (o.x + d.x * nearest, o.y + d.y * nearest);
        let gap = radius * radius - px * px - py * py;
        if gap <= 0.0 {
            return None;
        }
        let t = nearest - (gap / dd).sqrt();
        let p = o + d * t;
        if p.z.abs() <= half {
            return (t > 0.0).then(|| (t, Vec3::new(p.x, p.y, 0.0).normalize()));
        }
    }
    let end = |z: f32| {
        let from = o - Vec3::new(0.0, 0.0, z);
        sphere(from, d, radius).map(|t| (t, (from + d * t) / radius))
    };
    match (end(half), end(-half)) {
        (Some(a), Some(b)) => Some(if a.0 < b.0 { a } else { b }),
        (a, b) => a.or(b),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Membership, the slow and obvious definition each ray test is held against.
    fn inside(shape: &Shape, p: Vec3) -> bool {
        match *shape {
            Shape::Box { half } => p.abs().cmple(half).all(),
            Shape::Taper { half, lean, .. } => {
                let up = p.z + half.z;
                p.z.abs() <= half.z
                    && p.x <= half.x - lean[0] * up
                    && -p.x <= half.x - lean[1] * up
                    && p.y <= half.y - lean[2] * up
                    && -p.y <= half.y - lean[3] * up
            }
            Shape::Cylinder { radius, half, .. } => p.z.abs() <= half && p.truncate().length() <= radius,
            Shape::Capsule { radius, half } => (p - Vec3::Z * p.z.clamp(-half, half)).length() <= radius,
            Shape::Ellipsoid { radii } => (p / radii).length() <= 1.0,
        }
    }

    fn shapes() -> [Shape; 5] {
        [
            Shape::cuboid(2.0, 1.0, 3.0),
            Shape::taper(2.0, 2.0, 1.5, Vec2::new(1.0, 0.4), Vec2::new(-0.3, 0.1)),
            Shape::Cylinder { radius: 0.7, half: 1.0, hole: 0.0 },
            Shape::Capsule { radius: 0.4, half: 0.8 },
            Shape::Ellipsoid { radii: Vec3::new(1.0, 0.5, 1.5) },
        ]
    }

    proptest! {
        #[test]
        fn hit_is_where_membership_begins(i in 0usize..5, o in prop::array::uniform3(-6.0f32..6.0), at in prop::array::uniform3(-1.5f32..1.5)) {
            let shape = shapes()[i];
            let (o, at) = (Vec3::from(o), Vec3::from(at));
            prop_assume!(o.length() > 3.5 && (at - o).abs().min_element() > 1e-3);
            let d = at - o;
            let step = 1e-3; // of the ray's parameter: finer than any feature of the shapes above
            let first = (0..2500).map(|k| k as f32 * step).find(|t| inside(&shape, o + d * *t));
            match (shape.hit(o, d), first) {
                (Some((t, n)), Some(f)) => {
                    prop_assert!(t <= f + 1e-4 && t > f - 1.1 * step - 1e-4, "{shape:?} {t} {f}");
                    prop_assert!((n.length() - 1.0).abs() < 1e-4 && n.dot(d) < 1e-5);
                    let p = o + d * t;
                    prop_assert!(!inside(&shape, p + n * 1e-3) && inside(&shape, p - n * 1e-3 + d * 1e-4), "normal points out");
                }
                (None, None) => {}
                (Some((t, _)), None) => prop_assert!(!inside(&shape, o + d * (t + 2.0 * step)), "grazing only"),
                (None, Some(f)) => prop_assert!(!inside(&shape, o + d * (f + 2.0 * step)), "missed {shape:?} at {f}"),
            }
        }
    }

    #[test]
    fn bounds_hold_the_solid() {
        for shape in shapes() {
            let b = shape.bounds();
            for k in 0..20_000u32 {
                let f = |s: u32| ((k.wrapping_mul(2_654_435_761).rotate_left(s)) as f32 / u32::MAX as f32 - 0.5) * 5.0;
                let p = Vec3::new(f(0), f(9), f(20));
                assert!(!inside(&shape, p) || p.abs().cmple(b * 1.0001).all());
            }
        }
    }

    #[test]
    fn ring_lets_rays_through_its_hole() {
        let ring = Shape::Cylinder { radius: 0.35, half: 0.02, hole: 0.3 };
        assert!(ring.hit(Vec3::new(0.1, 0.0, 2.0), Vec3::new(0.001, 0.0, -1.0)).is_none());
        assert!(ring.hit(Vec3::new(0.32, 0.0, 2.0), Vec3::new(0.001, 0.0, -1.0)).is_some());
    }
}
