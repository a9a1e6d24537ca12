//! What varied textures add to a drive's own colours: roughness of every scale, other colours, bold patterns, holes in foliage,
//! wet ground. All of it is fixed to the surface it lies on, so it moves with it.

use super::dice::Dice;
use super::ground::GroundHit;
use super::material::{Material, Surface};
use super::noise::{cell, grain, noise};
use super::texture::{Look, face};
use glam::{Vec2, Vec3};

/// Coarsest and finest roughness, cells per metre.
const COARSE: f32 = 0.125;
const OCTAVES: usize = 8;
/// Puddles have a cell of this many metres.
const PUDDLE_M: f32 = 4.0;

/// The textures of one drive.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Skin {
    /// Deviation of each octave's brightness, in stops, on walls and things and on the ground.
    rough: f32,
    rough_ground: f32,
    /// How an octave's deviation falls to the next finer one: 1 keeps it (a spectrum of 1/f^2).
    fall: f32,
    /// How far the colour of a solid strays from its own, 0 to 1, and by how many stops its brightness.
    tint: f32,
    stops: f32,
    /// Share of the solids with a bold pattern.
    bold: f32,
    /// Foliage: cells per metre, and the noise above which there is a hole (2 or more: none).
    leaves: f32,
    hole: f32,
    /// Brightness of the ground in stops.
    ground: f32,
    /// Share of the ground that is wet, and how it mirrors there.
    wet: f32,
    gloss: f32,
    seed: u32,
}

impl Skin {
    /// The skin of a drive: varied textures, wet roads, either, or (`None`) none of them.
    pub(crate) fn new(seed: u64, textures: bool, light: bool) -> Option<Self> {
        let mut dice = Dice::new(seed, &[72]);
        let mut skin = Self {
            rough: dice.range32(0.05, 0.4),
            rough_ground: dice.range32(0.03, 0.3),
            fall: dice.range32(0.7, 1.05),
            tint: dice.range32(0.0, 0.6),
            stops: dice.range32(0.1, 1.2),
            bold: if dice.chance(0.3) { dice.range32(0.05, 0.6) } else { 0.0 },
            leaves: dice.range32(2.0, 5.0),
            hole: if dice.chance(0.8) { dice.range32(0.25, 0.9) } else { 2.0 },
            ground: dice.range32(-0.6, 1.6),
            wet: 0.0,
            gloss: 0.0,
            seed: dice.next() as u32,
        };
        let wet = dice.chance(0.15);
        let (share, gloss) = (dice.range32(0.3, 1.0), dice.range32(0.08, 0.3));
        if !textures {
            let (rough, tint, stops, bold, hole, ground) = (0.0, 0.0, 0.0, 0.0, 2.0, 0.0);
            skin = Self { rough, rough_ground: rough, tint, stops, bold, hole, ground, ..skin };
        }
        if light && wet {
            (skin.wet, skin.gloss) = (share, gloss);
        }
        (textures || skin.wet > 0.0).then_some(skin)
    }

    /// Brightness, in stops, of a surface of deviation 1 per octave as a pixel that covers `foot` metres sees it.
    fn roughness(&self, p: Vec2, foot: f32, seed: u32) -> f32 {
        let (mut sum, mut share, mut per_metre) = (0.0, 1.0, COARSE);
        for k in 0..OCTAVES as u32 {
            if foot * per_metre >= 1.0 {
                break;
            }
            // Value noise has a deviation of about 0.37.
            sum += share * 2.7 * grain(p, per_metre, foot, seed ^ (k * 0x9e37));
            (share, per_metre) = (share * self.fall, per_metre * 2.0);
        }
        sum
    }

    /// The look of a solid whose own one is `look`, at local point `p` with normal `n`.
    pub(crate) fn solid(&self, look: Look, m: &Material, p: Vec3, n: Vec3, foot: f32) -> Look {
        // Glass and lamps stay as they are, so that vehicles are vehicles.
        let part = match m.surface {
            Surface::Body { .. } | Surface::Cabin | Surface::Coach { .. } => 0.25,
            Surface::Wheel | Surface::Sign { .. } | Surface::Signal { .. } | Surface::Lamp => return look,
            _ => 1.0,
        };
        let seed = self.seed ^ m.seed ^ m.color.x.to_bits().rotate_left(7);
        let roll = |k: u32| cell(Vec2::new(k as f32 + 0.5, 0.5), seed);
        let uv = face(p, n);
        let mut color = look.albedo;
        if part == 1.0 {
            let tint = Vec3::new(roll(1), roll(2), roll(3)) * self.tint;
            color *= (tint + self.stops * roll(4)).map(f32::exp2);
            if 0.5 + 0.5 * roll(5) < self.bold {
                color = color.lerp(self.pattern(uv, foot, seed), 0.8);
            }
        }
        let rough = part * self.rough * if matches!(m.surface, Surface::Leaves) { 1.6 } else { 1.0 };
        color *= (rough * self.roughness(uv, foot, seed)).clamp(-3.0, 2.0).exp2();
        Look { albedo: color.min(Vec3::splat(0.95)), ..look }
    }

    /// Blocks, stripes or blotches of a few colours.
    fn pattern(&self, uv: Vec2, foot: f32, seed: u32) -> Vec3 {
        let roll = |k: u32| 0.5 + 0.5 * cell(Vec2::new(k as f32 + 20.5, 0.5), seed);
        let size = 0.15 * 2f32.powf(4.5 * roll(0));
        let p = Vec2::from_angle(roll(1) * 3.0).rotate(uv) / size;
        let near = (1.3 - 1.3 * foot / size).clamp(0.0, 1.0);
        let which = match (roll(2) * 3.0) as u32 {
            0 => cell(p, seed ^ 0x77),
            1 => cell(Vec2::new(p.x, 0.5), seed ^ 0x78),
            _ => (noise(p, seed ^ 0x79) * 6.0).clamp(-1.0, 1.0),
        };
        let color = |k: u32| Vec3::new(roll(k), roll(k + 1), roll(k + 2)).map(|x| 0.02 + 0.85 * x * x);
        let (a, b) = (color(3), color(6));
        a.lerp(b, 0.5 + 0.5 * which * near)
    }

    /// The look of the ground whose own one is `look`, at `world` metres.
    pub(crate) fn ground(&self, look: Look, hit: &GroundHit, world: Vec2, foot: f32) -> Look {
        let mut look = look;
        if self.rough_ground > 0.0 {
            let stops = self.ground + self.rough_ground * self.roughness(world, foot, self.seed);
            look.albedo = (look.albedo * stops.clamp(-3.0, 3.0).exp2()).min(Vec3::splat(0.9));
        }
        let road = hit.spot.edge <= 0.0 && hit.normal.z > 0.5;
        if self.wet > 0.0 && hit.normal.z > 0.5 {
            let puddle = noise(world / PUDDLE_M, self.seed ^ 0x51) + 0.4 * noise(world / 1.0, self.seed ^ 0x52);
            let wet = ((puddle + 2.0 * self.wet - 1.0) * 3.0).clamp(0.0, 1.0) * if road { 1.0 } else { 0.4 };
            look.albedo *= 1.0 - 0.55 * wet;
            look.gloss += self.gloss * wet;
        }
        look
    }

    /// Whether foliage has a hole at local point `p`, seen so that a pixel covers `foot` metres. What a pixel cannot hold is closed.
    #[inline]
    pub(crate) fn open(&self, m: &Material, p: Vec3, foot: f32) -> bool {
        if self.hole >= 2.0 || !matches!(m.surface, Surface::Leaves) {
            return false;
        }
        let (q, seed) = (p * self.leaves, self.seed ^ m.seed);
        let n =
            noise(q.truncate(), seed) + noise(Vec2::new(q.x + 7.0, q.z), seed) + noise(Vec2::new(q.y, q.z + 3.0), seed);
        n > self.hole + 2.0 * (foot * self.leaves - 0.7).max(0.0)
    }
}
