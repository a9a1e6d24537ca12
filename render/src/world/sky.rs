//! Sun, sky, clouds and haze of one drive.

use super::dice::Dice;
use super::noise::noise;
use glam::{Vec2, Vec3};

/// The light of a drive. Colours are linear; the ground in full sun is about 1.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sky {
    /// Towards the sun (where the light comes from; near the zenith under an overcast sky).
    pub sun: Vec3,
    pub sun_color: Vec3,
    /// Light from above and from below.
    pub above: Vec3,
    pub below: Vec3,
    pub zenith: Vec3,
    pub horizon: Vec3,
    pub cloud_color: Vec3,
    /// Cloud noise above this is cloud: -1 all, 1 none.
    pub clear: f32,
    drift: Vec2,
    seed: u32,
    /// Per metre.
    haze: f32,
    /// Whether the sun is seen.
    pub disc: bool,
    /// How bright street lamps, lit windows and headlights are; 0 by day.
    pub lamps: f32,
    /// Factor on the cameras' brightness: what they make of so little light.
    pub exposure: f32,
}

impl Sky {
    pub(crate) fn new(seed: u64) -> Self {
        let mut dice = Dice::new(seed, &[70]);
        let overcast = dice.chance(0.28);
        let height = if overcast { dice.range32(1.1, 1.4) } else { dice.range32(0.2, 1.15) };
        let turn = dice.range32(0.0, std::f32::consts::TAU);
        let sun = Vec3::new(turn.cos() * height.cos(), turn.sin() * height.cos(), height.sin());
        // The lower the sun, the warmer and weaker.
        let low = if overcast { 0.0 } else { (1.0 - height / 0.7).max(0.0) };
        let warm = Vec3::new(1.0, 0.96 - 0.22 * low, 0.88 - 0.5 * low);
        let strength = if overcast { dice.range32(0.25, 0.55) } else { dice.range32(1.5, 2.2) * (1.0 - 0.35 * low) };
        let bright = dice.range32(0.75, 1.15);
        let (zenith, horizon) = if overcast {
            let grey = dice.range32(0.55, 0.9);
            (Vec3::new(0.72, 0.76, 0.82) * grey, Vec3::new(0.9, 0.92, 0.95) * grey)
        } else {
            let blue = Vec3::new(0.16, 0.34, 0.78) * bright;
            (blue, Vec3::new(0.72 + 0.25 * low, 0.8 - 0.05 * low, 0.95 - 0.3 * low) * bright)
        };
        let above = if overcast {
            Vec3::new(0.8, 0.83, 0.88) * dice.range32(0.6, 0.95)
        } else {
            Vec3::new(0.42, 0.5, 0.66) * bright * 0.62
        };
        let below = (0.25 * above + 0.12 * strength * warm * sun.z) * Vec3::new(0.9, 0.85, 0.75);
        Self {
            sun,
            sun_color: warm * strength,
            above,
            below,
            zenith,
            horizon,
            cloud_color: if overcast {
                zenith * 0.75
            } else {
                Vec3::splat(0.95 * bright) * (0.5 * Vec3::ONE + 0.5 * warm)
            },
            clear: if overcast { dice.range32(-0.5, -0.1) } else { dice.range32(-0.25, 0.6) },
            drift: Vec2::new(dice.range32(0.0, 500.0), dice.range32(0.0, 500.0)),
            seed: dice.next() as u32,
            haze: if dice.chance(0.2) { dice.range32(0.003, 0.009) } else { dice.range32(0.0005, 0.0025) },
            disc: !overcast,
            lamps: 0.0,
            exposure: 1.0,
        }
    }

    /// The gradient alone: what mirrors show and haze fades to.
    #[inline]
    pub(crate) fn gradient(&self, up: f32) -> Vec3 {
        let up = up.clamp(0.0, 1.0);
        let x = 1.0 - up;
        let x2 = x * x;
        self.zenith + (self.horizon - self.zenith) * (x2 * x2)
    }

    /// Colour in a direction of unit length.
    pub(crate) fn color(&self, dir: Vec3) -> Vec3 {
        let mut color = self.gradient(dir.z);
        if self.disc {
            let near = dir.dot(self.sun).max(0.0);
            let n4 = near.powi(4);
            color += self.sun_color * (0.1 * n4 * n4 + 0.35 * n4.powi(24) + if near > 0.9996 { 6.0 } else { 0.0 });
        }
        if dir.z > 0.0 {
            // A layer of cloud at a fixed height, flattened near the horizon so that it does not alias there.
            let p = dir.truncate() / (dir.z + 0.12) * 1.6 + self.drift;
            let mut n = 0.55 * noise(p, self.seed) + 0.3 * noise(p * 2.1, self.seed ^ 1);
            if dir.z > 0.06 {
                n += 0.18 * noise(p * 4.3, self.seed ^ 2) + 0.1 * noise(p * 9.1, self.seed ^ 3);
            }
            let cover = ((n - self.clear * 0.7) / 0.35).clamp(0.0, 1.0) * (dir.z * 9.0).min(1.0) * 0.9;
            let shade = 0.82 + 0.18 * noise(p * 1.7 + 9.0, self.seed ^ 4);
            color += (self.cloud_color * shade - color) * cover;
        }
        color
    }

    /// Light that falls on a surface.
    #[inline]
    pub(crate) fn light(&self, normal: Vec3, sunlit: f32) -> Vec3 {
        let up = 0.5 + 0.5 * normal.z;
        self.below + (self.above - self.below) * up + self.sun_color * (normal.dot(self.sun).max(0.0) * sunlit)
    }

    /// A colour seen through `distance` metres of air.
    #[inline]
    pub(crate) fn through_air(&self, color: Vec3, distance: f32) -> Vec3 {
        let fade = 1.0 - 1.0 / (1.0 + distance * self.haze * (1.0 + 0.5 * distance * self.haze));
        color + (self.horizon - color) * fade
    }
}
