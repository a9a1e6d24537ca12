//! Pedestrians and cyclists. Every limb is a rigid part whose joint angle and rate are closed forms of the way travelled, so the
//! velocity of each of its points is exact.

use super::dice::Dice;
use super::material::{Material, Surface, rgb};
use super::part::{Joint, PartSpec};
use super::shapes::Shape;
use glam::{Mat3, Vec2, Vec3};
use std::f64::consts::TAU;

/// One person's looks.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PersonModel {
    pub height: f32,
    coat: Vec3,
    trousers: Vec3,
    skin: Vec3,
    hair: Vec3,
    long_sleeves: bool,
    backpack: bool,
    start: f64,
}

fn cloth(dice: &mut Dice) -> Vec3 {
    let base = dice.pick(&[
        rgb(30, 32, 40),
        rgb(60, 60, 66),
        rgb(120, 120, 125),
        rgb(215, 215, 210),
        rgb(35, 50, 90),
        rgb(60, 90, 140),
        rgb(140, 35, 40),
        rgb(200, 60, 50),
        rgb(70, 90, 55),
        rgb(150, 120, 80),
        rgb(220, 180, 60),
        rgb(120, 70, 110),
    ]);
    base * dice.range32(0.7, 1.2)
}

impl PersonModel {
    pub(crate) fn roll(dice: &mut Dice) -> Self {
        let child = dice.chance(0.1);
        Self {
            height: if child { dice.range32(1.05, 1.4) } else { dice.range32(1.55, 1.92) },
            coat: cloth(dice),
            trousers: if dice.chance(0.6) {
                dice.pick(&[rgb(30, 34, 48), rgb(40, 50, 80), rgb(50, 48, 46)])
            } else {
                cloth(dice)
            },
            skin: dice.pick(&[rgb(232, 190, 165), rgb(215, 170, 140), rgb(170, 120, 90), rgb(110, 75, 55)]),
            hair: dice.pick(&[
                rgb(30, 24, 20),
                rgb(70, 48, 32),
                rgb(150, 115, 70),
                rgb(150, 150, 150),
                rgb(60, 60, 90),
            ]),
            long_sleeves: dice.chance(0.7),
            backpack: dice.chance(0.2),
            start: dice.range(0.0, TAU),
        }
    }

    /// Adds the parts of somebody who has walked `way` metres at `speed`; the frame is on the ground between the feet.
    pub(crate) fn parts(&self, way: f64, speed: f32, out: &mut Vec<PartSpec>) {
        let h = self.height;
        let stride = f64::from(h) * 0.82;
        let phase = ((way / stride * TAU + self.start).rem_euclid(TAU)) as f32;
        let rate = (TAU / stride) as f32 * speed;
        // The swing is part of the gait, not of the speed at this instant: a stop freezes it mid-step, with zero rates.
        let bob = 0.012 * h;
        let (lift, lift_rate) = (bob * ((2.0 * phase).cos() - 1.0), -2.0 * bob * (2.0 * phase).sin() * rate);
        let hips = Joint::new(Vec3::new(0.0, 0.0, 0.5 * h + lift), Vec3::new(0.0, 0.0, lift_rate));
        let coat = Material::new(Surface::Rough, self.coat);
        let legs = Material::new(Surface::Rough, self.trousers);
        let skin = Material::new(Surface::Plain, self.skin);
        let torso =
            Shape::taper(0.11 * h, 0.165 * h, 0.33 * h, Vec2::new(0.12 * h, 0.225 * h), Vec2::new(0.02 * h, 0.0));
        out.push(hips.at(Vec3::new(0.0, 0.0, 0.165 * h)).part(torso, coat));
        let head = hips.at(Vec3::new(0.03 * h, 0.0, 0.425 * h));
        out.push(head.part(Shape::Ellipsoid { radii: Vec3::new(0.056, 0.046, 0.068) * h }, skin));
        let hair = Shape::Ellipsoid { radii: Vec3::new(0.055, 0.051, 0.058) * h };
        out.push(head.at(Vec3::new(-0.012 * h, 0.0, 0.018 * h)).part(hair, Material::new(Surface::Rough, self.hair)));
        if self.backpack {
            let bag = Material::new(Surface::Rough, Vec3::new(self.coat.z, self.coat.x, self.coat.y) * 0.7);
            let shape = Shape::cuboid(0.09 * h, 0.16 * h, 0.22 * h);
            out.push(hips.at(Vec3::new(-0.09 * h, 0.0, 0.2 * h)).part(shape, bag));
        }
        for side in [-1.0f32, 1.0] {
            let p = if side > 0.0 { phase } else { phase + std::f32::consts::PI };
            let (sin, cos) = p.sin_cos();
            // Thigh swings as a sine; the knee bends while the leg comes forward.
            let (thigh, thigh_rate) = (-0.42 * sin, -0.42 * cos * rate);
            let lifted = cos.max(0.0);
            let (knee, knee_rate) = (0.9 * lifted * lifted, -1.8 * lifted * sin * rate);
            let hip = hips.at(Vec3::new(0.0, side * 0.05 * h, 0.0)).pitched(thigh, thigh_rate);
            let limb = |length: f32, radius: f32| Shape::Capsule {
                radius: radius * h,
                half: 0.5 * length * h - 0.5 * radius * h,
            };
            out.push(hip.at(Vec3::new(0.0, 0.0, -0.12 * h)).part(limb(0.24, 0.045), legs));
            let shin = hip.at(Vec3::new(0.0, 0.0, -0.24 * h)).pitched(knee, knee_rate);
            out.push(shin.at(Vec3::new(0.0, 0.0, -0.115 * h)).part(limb(0.23, 0.034), legs));
            let shoe = Material::new(Surface::Plain, self.trousers * 0.3 + Vec3::splat(0.01));
            let foot = shin.at(Vec3::new(0.03 * h, 0.0, -0.237 * h));
            out.push(foot.part(Shape::cuboid(0.14 * h, 0.05 * h, 0.04 * h), shoe));
            // Arms swing against the legs, elbows a little bent.
            let (arm, arm_rate) = (0.38 * sin, 0.38 * cos * rate);
            let shoulder = hips.at(Vec3::new(0.02 * h, side * 0.135 * h, 0.315 * h)).pitched(arm, arm_rate);
            out.push(shoulder.at(Vec3::new(0.0, 0.0, -0.08 * h)).part(limb(0.18, 0.03), coat));
            let elbow = shoulder.at(Vec3::new(0.0, 0.0, -0.165 * h)).pitched(-0.35, 0.0);
            let sleeve = if self.long_sleeves { coat } else { skin };
            out.push(elbow.at(Vec3::new(0.0, 0.0, -0.075 * h)).part(limb(0.17, 0.024), sleeve));
        }
    }
}

/// One cyclist's looks; the frame sits on the ground under the rear hub.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CyclistModel {
    rider: PersonModel,
    frame: Vec3,
    helmet: bool,
    gear: f64,
}

/// Hub to hub.
pub(crate) const BICYCLE_WHEELBASE_M: f32 = 1.05;
const WHEEL_M: f32 = 0.34;
const CRANK_M: f32 = 0.17;

impl CyclistModel {
    pub(crate) fn roll(dice: &mut Dice) -> Self {
        Self {
            rider: PersonModel { height: dice.range32(1.6, 1.9), ..PersonModel::roll(dice) },
            frame: cloth(dice),
            helmet: dice.chance(0.5),
            gear: dice.range(1.8, 3.0),
        }
    }

    pub(crate) fn parts(&self, way: f64, speed: f32, out: &mut Vec<PartSpec>) {
        let r = f64::from(WHEEL_M);
        let turn = (way / r).rem_euclid(TAU) as f32;
        let crank = (way / r / self.gear + self.rider.start).rem_euclid(TAU) as f32;
        let crank_rate = speed / WHEEL_M / self.gear as f32;
        let metal = Material::new(Surface::Sheen, self.frame);
        let rubber = Material::new(Surface::Plain, Vec3::splat(0.02));
        for x in [0.0, BICYCLE_WHEELBASE_M] {
            let mut wheel = Joint::new(Vec3::new(x, 0.0, WHEEL_M), Vec3::ZERO)
                .pitched(turn, speed / WHEEL_M)
                .part(Shape::Cylinder { radius: WHEEL_M, half: 0.02, hole: WHEEL_M - 0.05 }, rubber);
            wheel.rot *= Mat3::from_rotation_x(std::f32::consts::FRAC_PI_2);
            out.push(wheel);
        }
        let rear = Vec3::new(0.0, 0.0, WHEEL_M);
        let front = Vec3::new(BICYCLE_WHEELBASE_M, 0.0, WHEEL_M);
        let pedals = Vec3::new(0.43, 0.0, 0.28);
        let (seat, stem) = (Vec3::new(0.25, 0.0, 0.88), Vec3::new(0.85, 0.0, 0.92));
        for (a, b) in [(rear, pedals), (rear, seat), (pedals, seat), (pedals, stem), (seat, stem), (front, stem)] {
            out.push(PartSpec::bar(a, b, 0.02, metal));
        }
        let bar = stem + Vec3::new(0.05, 0.0, 0.1);
        out.push(PartSpec::bar(bar - Vec3::Y * 0.24, bar + Vec3::Y * 0.24, 0.018, rubber));
        self.rider_parts(seat + Vec3::Z * 0.08, bar, pedals, crank, crank_rate, out);
    }

    fn rider_parts(&self, hip: Vec3, bar: Vec3, pedals: Vec3, crank: f32, rate: f32, out: &mut Vec<PartSpec>) {
        let who = &self.rider;
        let h = who.height;
        let coat = Material::new(Surface::Rough, who.coat);
        let skin = Material::new(Surface::Plain, who.skin);
        let legs = Material::new(Surface::Rough, who.trousers);
        let shoulders = hip + Vec3::new(0.3, 0.0, 0.29 * h);
        let along = (shoulders - hip).normalize();
        let rot = Mat3::from_rotation_y(along.x.atan2(along.z));
        let torso = Shape::taper(0.12 * h, 0.17 * h, 0.35 * h, Vec2::new(0.12 * h, 0.22 * h), Vec2::ZERO);
        out.push(PartSpec::fixed(torso, 0.5 * (hip + shoulders), coat).turned(rot));
        let head = shoulders + Vec3::new(0.07, 0.0, 0.12 * h);
        out.push(PartSpec::fixed(Shape::Ellipsoid { radii: Vec3::new(0.056, 0.046, 0.068) * h }, head, skin));
        let cap = if self.helmet {
            Material::new(Surface::Sheen, self.frame)
        } else {
            Material::new(Surface::Rough, who.hair)
        };
        let shape = Shape::Ellipsoid { radii: Vec3::new(0.068, 0.054, 0.055) * h };
        out.push(PartSpec::fixed(shape, head + Vec3::new(-0.01, 0.0, 0.025 * h), cap));
        for side in [-1.0f32, 1.0] {
            let shoulder = shoulders + Vec3::new(0.0, side * 0.11 * h, -0.02 * h);
            let hand = bar + Vec3::new(0.0, side * 0.21, 0.02);
            let elbow = 0.5 * (shoulder + hand) + Vec3::new(-0.02, side * 0.04, -0.06);
            out.push(PartSpec::bar(shoulder, elbow, 0.05, coat));
            out.push(PartSpec::bar(elbow, hand, 0.04, if who.long_sleeves { coat } else { skin }));
            let angle = if side > 0.0 { crank } else { crank + std::f32::consts::PI };
            let from = hip + Vec3::new(0.02, side * 0.09, 0.0);
            let foot = PedalLeg::new(from, pedals + Vec3::new(0.0, side * 0.09, 0.0), angle, rate);
            out.push(foot.thigh.part(Shape::Capsule { radius: 0.07, half: 0.5 * PedalLeg::LINK_M }, legs));
            out.push(foot.shin.part(Shape::Capsule { radius: 0.05, half: 0.5 * PedalLeg::LINK_M }, legs));
            let shoe = Material::new(Surface::Plain, Vec3::splat(0.03));
            out.push(foot.pedal.at(Vec3::new(0.04, 0.0, 0.02)).part(Shape::cuboid(0.26, 0.09, 0.08), shoe));
        }
    }
}

/// A leg of two equal links from hip to pedal: the knee by intersecting two circles, the rates by differentiating that.
struct PedalLeg {
    thigh: Joint,
    shin: Joint,
    pedal: Joint,
}

impl PedalLeg {
    const LINK_M: f32 = 0.45;

    fn new(hip: Vec3, centre: Vec3, crank: f32, rate: f32) -> Self {
        let link = Self::LINK_M;
        // In the x-z plane; riding forward turns the crank from up over the front to down.
        let (sin, cos) = crank.sin_cos();
        let pedal = Vec2::new(centre.x + CRANK_M * sin, centre.z + CRANK_M * cos);
        let pedal_vel = Vec2::new(cos, -sin) * CRANK_M * rate;
        let hip2 = Vec2::new(hip.x, hip.z);
        let (d, v) = (pedal - hip2, pedal_vel);
        let dist = d.length();
        let bend = (0.5 * dist / link).min(0.999).acos();
        let bend_rate = -0.5 * d.dot(v) / dist / link / bend.sin();
        let (upper, upper_rate) = (d.y.atan2(d.x) + bend, d.perp_dot(v) / (dist * dist) + bend_rate);
        let arm = Vec2::from_angle(upper) * link;
        let (knee, knee_vel) = (hip2 + arm, arm.perp() * upper_rate);
        let (low, low_vel) = (pedal - knee, pedal_vel - knee_vel);
        let lower_rate = low.perp_dot(low_vel) / low.length_squared();
        // A turn from x to z in this plane is a negative turn about y.
        let link_joint = |a: Vec2, va: Vec2, along: Vec2, turn_rate: f32| {
            let mid = a + 0.5 * along;
            let vel = va + 0.5 * along.perp() * turn_rate;
            Joint {
                rot: Mat3::from_rotation_y(along.x.atan2(along.y)),
                pos: Vec3::new(mid.x, hip.y, mid.y),
                vel: Vec3::new(vel.x, 0.0, vel.y),
                omega: Vec3::new(0.0, -turn_rate, 0.0),
            }
        };
        Self {
            thigh: link_joint(hip2, Vec2::ZERO, arm, upper_rate),
            shin: link_joint(knee, knee_vel, low, lower_rate),
            pedal: Joint::new(Vec3::new(pedal.x, hip.y, pedal.y), Vec3::new(pedal_vel.x, 0.0, pedal_vel.y)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The motion of every part must be the derivative of its pose: checked by a central difference of a point off its centre.
    fn check(parts: impl Fn(f64, f32) -> Vec<PartSpec>) {
        let (speed, h) = (1.7f32, 1e-3);
        for k in 0..80 {
            let t = f64::from(k) * 0.037;
            let at = |t: f64| parts(t * f64::from(speed), speed);
            let (before, now, after) = (at(t - h), at(t), at(t + h));
            for i in 0..now.len() {
                let q = Vec3::new(0.1, 0.05, 0.2);
                let place = |p: &PartSpec| p.pos + p.rot * q;
                let numeric = (place(&after[i]) - place(&before[i])) / (2.0 * h as f32);
                let exact = now[i].vel + now[i].omega.cross(now[i].rot * q);
                // f32 positions of a metre over 2 ms: 1e-4 m/s of rounding, 5e-3 for curvature at the fastest limbs.
                assert!(numeric.distance(exact) < 0.012, "part {i} at {t}: {numeric} {exact}");
            }
        }
    }

    #[test]
    fn limbs_move_as_their_velocity_says() {
        let person = PersonModel::roll(&mut Dice::new(1, &[]));
        check(|way, v| {
            let mut out = Vec::new();
            person.parts(way, v, &mut out);
            out
        });
        let cyclist = CyclistModel::roll(&mut Dice::new(2, &[]));
        check(|way, v| {
            let mut out = Vec::new();
            cyclist.parts(way, v, &mut out);
            out
        });
    }

    #[test]
    fn who_stands_is_still_and_feet_stay_near_the_ground() {
        let person = PersonModel::roll(&mut Dice::new(5, &[]));
        for k in 0..50 {
            let mut out = Vec::new();
            person.parts(f64::from(k) * 0.05, 0.0, &mut out);
            assert!(out.iter().all(|p| p.vel == Vec3::ZERO && p.omega == Vec3::ZERO));
            let low = out.iter().map(|p| p.pos.z - p.shape.bounds().z).fold(f32::INFINITY, f32::min);
            assert!(low.abs() < 0.15, "{low}");
        }
    }
}
