//! One ray: what it meets first, and what colour that has.

use super::ground::GroundHit;
use super::paint;
use super::scene::Scene;
use super::skin::Skin;
use super::sky::Sky;
use super::texture::{self, Look};
use super::tiles::Tiles;
use crate::camera::Intrinsics;
use glam::{Mat3, Vec3};

/// Surfaces deeper than this count as sky (haze).
pub(crate) const FAR_M: f32 = 400.0;

/// What a ray met.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Hit {
    Sky,
    Ground(GroundHit),
    /// Depth, part, and the normal in the part's frame.
    Part {
        t: f32,
        part: u32,
        normal: Vec3,
    },
}

impl Hit {
    /// z-depth, metres; 0 in the sky.
    pub(crate) fn depth(&self) -> f32 {
        match self {
            Self::Sky => 0.0,
            Self::Ground(hit) => hit.t,
            Self::Part { t, .. } => *t,
        }
    }

    /// Equal for neighbours on one smooth surface; where it differs, there is an edge.
    pub(crate) fn label(&self) -> u32 {
        match self {
            Self::Sky => 0,
            Self::Ground(hit) => 1 + u32::from(hit.normal.z < 0.5) + 2 * u32::from(hit.spot.edge > 0.0),
            Self::Part { part, normal, .. } => {
                let side = if normal.z.abs() > 0.7 { 0 } else { 1 + u32::from(normal.x.abs() > normal.y.abs()) };
                16 + part * 4 + side
            }
        }
    }
}

/// One camera's rays through one scene.
pub(crate) struct Tracer<'a> {
    pub scene: &'a Scene,
    pub tiles: &'a Tiles,
    pub sky: &'a Sky,
    pub skin: Option<&'a Skin>,
    pub camera: &'a Intrinsics,
    pub view_from_camera: Mat3,
}

impl Tracer<'_> {
    /// The first surface along the ray through picture point `(u, v)`, which must lie in the picture (or within a pixel of it).
    pub(crate) fn hit(&self, u: f32, v: f32) -> Hit {
        let ray = self.camera.ray(u, v);
        let col = (u.max(0.0) as usize).min(self.camera.width - 1);
        let row = (v.max(0.0) as usize).min(self.camera.height - 1);
        let (mut t, mut found, mut normal) = (FAR_M, u32::MAX, Vec3::ZERO);
        for &i in self.tiles.at(col, row) {
            let seen = &self.tiles.seen[i as usize];
            if seen.near > t {
                break;
            }
            if u < seen.lo[0] || u > seen.hi[0] || v < seen.lo[1] || v > seen.hi[1] {
                continue;
            }
            let part = &self.scene.parts[seen.part as usize];
            let local = seen.turn * ray;
            if let Some((at, n)) = part.shape.hit(seen.eye, local)
                && at < t
                && !self.skin.is_some_and(|skin| skin.open(&part.material, seen.eye + local * at, at / self.camera.fx))
            {
                (t, found, normal) = (at, seen.part, n);
            }
        }
        let dir = self.view_from_camera * ray;
        if let Some(hit) = self.scene.ground.hit(dir, t) {
            return Hit::Ground(hit);
        }
        if found == u32::MAX { Hit::Sky } else { Hit::Part { t, part: found, normal } }
    }

    /// Light that comes back along the ray, and whether the sun shines on what it met.
    pub(crate) fn color(&self, u: f32, v: f32, hit: &Hit) -> (Vec3, bool) {
        let d = self.view_from_camera * self.camera.ray(u, v);
        let length = d.length();
        let dir = d / length;
        let pixel = 1.0 / self.camera.fx;
        let (look, normal, t): (Look, Vec3, f32) = match hit {
            Hit::Sky => return (self.sky.color(dir), false),
            Hit::Ground(hit) => {
                let own = paint::look(&self.scene.ground, hit, d, pixel);
                let look = match self.skin {
                    Some(skin) => {
                        let world = d.truncate() * hit.t + self.scene.ground.anchor;
                        let across = hit.t * length * pixel;
                        // As for paint: the mean of what a pixel covers along the view and across it.
                        let foot = across / (-dir.z).max(0.01).sqrt();
                        skin.ground(own, hit, world, foot)
                    }
                    None => own,
                };
                (look, hit.normal, hit.t)
            }
            Hit::Part { t, part, normal } => {
                let part = &self.scene.parts[*part as usize];
                let world = part.rot * *normal;
                let facing = world.dot(dir).abs().max(0.12);
                let local = part.rot.transpose() * (d * *t - part.pos);
                let foot = t * pixel / facing.sqrt();
                let own = texture::look(&part.material, local, *normal, part.shape.bounds(), foot, self.sky.lamps);
                let look = match self.skin {
                    Some(skin) => skin.solid(own, &part.material, local, *normal, foot),
                    None => own,
                };
                (look, world, *t)
            }
        };
        let p = d * t;
        let faces_sun = normal.dot(self.sky.sun) > 0.0;
        let lit =
            if faces_sun && !self.scene.shadows.dark(&self.scene.parts, p, normal, self.skin) { 1.0 } else { 0.0 };
        // Where the sun does not reach, less of the sky does either.
        let mut color = look.albedo * self.sky.light(normal, lit) * (0.86 + 0.14 * lit) + look.glow;
        if self.sky.lamps > 0.0 {
            color += look.albedo * self.scene.lamps.light(p, normal);
        }
        if look.gloss > 0.0 {
            let mirror = dir - 2.0 * dir.dot(normal) * normal;
            let x = 1.0 + dir.dot(normal).min(0.0);
            let x2 = x * x;
            // Schlick's rise at grazing angles, held back as rough surfaces do.
            let share = (look.gloss * (1.0 + 6.0 * x2 * x2 * x)).min(1.0);
            let shine = if mirror.z > 0.0 { self.sky.gradient(mirror.z) } else { self.sky.below * 0.4 };
            let near_sun = mirror.dot(self.sky.sun).max(0.0).powi(4).powi(12);
            color += share * (shine - color).max(Vec3::ZERO) + self.sky.sun_color * (look.gloss * 4.0 * near_sun * lit);
        }
        (self.sky.through_air(color, t * length), lit > 0.0)
    }
}
