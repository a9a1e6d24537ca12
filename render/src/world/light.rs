//! Light that varies more than the usual: white and stormy skies, low sun, hard shadows, dusk and night with lamps.

use super::dice::Dice;
use super::material::Surface;
use super::scene::Part;
use super::sky::Sky;
use glam::Vec3;

/// Lamps farther than this from the eye light nothing, and so many at most do.
const LAMP_REACH_M: f32 = 70.0;
const LAMPS_MOST: usize = 12;
/// Lamps are no points: nearer than this they do not get brighter.
const LAMP_NEAR_M2: f32 = 1.0;
/// Cosine of the angle at which the headlights' cone ends, and of the one within which it is brightest.
const CONE: [f32; 2] = [0.82, 0.97];

impl Sky {
    /// The sky of a drive whose light varies.
    pub(crate) fn varied(seed: u64) -> Self {
        let mut sky = Self::new(seed);
        let mut dice = Dice::new(seed, &[71]);
        let kind = dice.unit();
        if sky.disc {
            // Cameras see the light of the sky in shadows only; how much there is decides how hard they are.
            sky.above *= dice.range32(-2.2, 0.3).exp2();
        }
        if kind < 0.3 {
            // Exposed for the street: the sky is white.
            let white = dice.range32(1.5, 6.0);
            for color in [&mut sky.zenith, &mut sky.horizon, &mut sky.cloud_color] {
                *color = color.lerp(Vec3::splat(color.max_element()), 0.8) * white;
            }
        } else if kind < 0.42 {
            sky.cloud_color *= dice.range32(0.25, 0.6);
            sky.clear = dice.range32(-0.6, 0.2);
        } else if kind < 0.58 {
            sky.low_sun(&mut dice);
        } else if kind < 0.68 {
            sky.night(&mut dice);
        } else if kind < 0.78 {
            sky.dusk(&mut dice);
        }
        sky.below = (0.25 * sky.above + 0.12 * sky.sun_color * sky.sun.z.max(0.0)) * Vec3::new(0.9, 0.85, 0.75);
        sky
    }

    fn low_sun(&mut self, dice: &mut Dice) {
        let height = dice.range32(0.03, 0.22);
        let flat = self.sun.truncate().normalize_or(glam::Vec2::X) * height.cos();
        self.sun = flat.extend(height.sin());
        self.sun_color = Vec3::new(1.0, dice.range32(0.6, 0.92), dice.range32(0.25, 0.75)) * dice.range32(1.2, 2.6);
        self.horizon = self.horizon.lerp(Vec3::new(1.1, 0.75, 0.45), dice.range32(0.0, 0.9));
        self.disc = true;
    }

    fn night(&mut self, dice: &mut Dice) {
        let glow = Vec3::new(1.0, dice.range32(0.75, 1.0), dice.range32(0.5, 1.2)) * dice.range32(0.006, 0.04);
        (self.zenith, self.horizon, self.cloud_color) = (0.25 * glow, glow, 0.6 * glow);
        self.above = glow * dice.range32(0.6, 1.5);
        self.sun_color = Vec3::new(0.8, 0.9, 1.1) * dice.range32(0.0, 0.03);
        self.disc = false;
        self.lamps = dice.range32(0.5, 1.6);
        self.exposure = dice.range32(2.5, 8.0);
    }

    fn dusk(&mut self, dice: &mut Dice) {
        let rest = dice.range32(0.08, 0.3);
        let blue = Vec3::new(0.4, 0.55, 0.95) * rest;
        self.zenith = blue;
        self.horizon = Vec3::new(1.0, dice.range32(0.55, 0.8), dice.range32(0.4, 0.8)) * (2.0 * rest);
        (self.cloud_color, self.above) = (1.2 * blue, 0.9 * blue);
        self.sun_color = Vec3::ZERO;
        self.disc = false;
        self.lamps = if dice.chance(0.7) { dice.range32(0.3, 1.0) } else { 0.0 };
        self.exposure = dice.range32(1.3, 3.0);
    }
}

/// What shines besides the sky: street lamps near the eye and the vehicle's own headlights.
#[derive(Debug, Clone, Default)]
pub(crate) struct Lamps {
    lamps: Vec<Vec3>,
    color: Vec3,
    headlights: Option<(Vec3, Vec3)>,
}

impl Lamps {
    /// The lamps of a scene; `strength` 0: none burn. `ahead` is where the vehicle looks, map axes.
    pub(crate) fn new(parts: &[Part], strength: f32, ahead: Vec3, seed: u64) -> Self {
        if strength == 0.0 {
            return Self::default();
        }
        let mut dice = Dice::new(seed, &[74]);
        let color = Vec3::new(1.0, dice.range32(0.6, 0.95), dice.range32(0.2, 0.9)) * (22.0 * strength);
        let burns = |p: &&Part| matches!(p.material.surface, Surface::Lamp) && p.pos.length() < LAMP_REACH_M;
        // Light leaves below the head, so that it does not shade itself.
        let mut lamps: Vec<Vec3> = parts.iter().filter(burns).map(|p| p.pos - Vec3::Z * 0.2).collect();
        lamps.sort_by(|a, b| a.length_squared().total_cmp(&b.length_squared()));
        lamps.truncate(LAMPS_MOST);
        let headlights = dice.chance(0.85).then(|| (Vec3::new(0.0, 0.0, -0.9) + ahead * 1.5, ahead));
        Self { lamps, color, headlights }
    }

    /// Light on a surface with this normal.
    pub(crate) fn light(&self, p: Vec3, normal: Vec3) -> Vec3 {
        let falls = |gap: Vec3| {
            let d2 = gap.length_squared().max(LAMP_NEAR_M2);
            normal.dot(gap).max(0.0) / (d2 * d2.sqrt())
        };
        // A lamp shines downward.
        let street: f32 =
            self.lamps.iter().map(|l| falls(*l - p) * (((l.z - p.z) / (*l - p).length()) * 1.5).clamp(0.0, 1.0)).sum();
        let own = self.headlights.map_or(0.0, |(at, ahead)| {
            let gap = at - p;
            let cone = (-gap.normalize_or_zero().dot(ahead) - CONE[0]) / (CONE[1] - CONE[0]);
            falls(gap) * 40.0 * cone.clamp(0.0, 1.0).powi(2)
        });
        self.color * street + Vec3::new(1.0, 0.95, 0.85) * own
    }
}
