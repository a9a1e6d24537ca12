//! Solids that fly through a drive, turning: what moves is not only what looks like a road user on its lane.

use super::dice::Dice;
use super::material::{Material, Surface};
use super::part::PartSpec;
use super::scene::BodyState;
use super::shapes::Shape;
use glam::{DMat3, DVec3, Mat3, Quat, Vec2, Vec3};
use std::f64::consts::TAU;

/// Share of the drives that have any.
const SHARE: f64 = 0.2;
/// Instance numbers, between those of the ego's companions and those of the legs.
const ID_FIRST: u16 = 8;
const MOST: usize = 8;
/// Least and most speed, m/s.
const SPEED_MPS: [f64; 2] = [3.0, 20.0];
/// Kept free around the vehicle's cameras, metres, and for how long before and after the solid's own moment this is checked.
const CLEAR_M: f64 = 3.0;
const CHECKED_SEC: f64 = 15.0;

/// A solid on its way: straight on, swinging to the side, turning about an axis of its own.
#[derive(Debug, Clone)]
pub(crate) struct Solid {
    at_sec: f64,
    pos: DVec3,
    vel: DVec3,
    swing: DVec3,
    swing_rate: f64,
    axis: Vec3,
    turn_rate: f64,
    parts: Vec<PartSpec>,
    pub reach: f32,
    instance: u16,
}

/// The solids of a drive of `seconds`; `ego` gives local_from_base rotation and position over time.
pub(crate) fn solids(seed: u64, seconds: f64, ego: impl Fn(f64) -> (DMat3, DVec3)) -> Vec<Solid> {
    let mut dice = Dice::new(seed, &[73]);
    if !dice.chance(SHARE) {
        return Vec::new();
    }
    let count = 3 + dice.below(MOST - 2);
    let mut all = Vec::new();
    for _ in 0..4 * count {
        let solid = Solid::roll(&mut dice, seconds, &ego, ID_FIRST + all.len() as u16);
        let steps = (20.0 * CHECKED_SEC) as i32;
        let clear = (-steps..=steps).all(|k| {
            let time = solid.at_sec + 0.05 * f64::from(k);
            let (_, pos) = ego(time);
            solid.state(time).origin.distance(pos + DVec3::Z) > f64::from(solid.reach) + CLEAR_M
        });
        if clear {
            all.push(solid);
        }
        if all.len() == count {
            break;
        }
    }
    all
}

impl Solid {
    fn roll(dice: &mut Dice, seconds: f64, ego: impl Fn(f64) -> (DMat3, DVec3), instance: u16) -> Self {
        let at_sec = dice.range(0.0, seconds);
        let (turn, from) = ego(at_sec);
        let ahead = DVec3::new(dice.range(6.0, 35.0), dice.range(-12.0, 12.0), 0.0);
        let angle = dice.range(0.0, TAU);
        let [low, high] = SPEED_MPS;
        let speed = low * (high / low).powf(dice.unit());
        let vel = DVec3::new(angle.cos(), angle.sin(), dice.range(-0.08, 0.08)).normalize() * speed;
        let swing_rate = dice.range(0.5, 4.0);
        // Swings at no more than a third of the solid's speed.
        let swing =
            DVec3::new(-angle.sin(), angle.cos(), dice.range(-0.3, 0.3)) * (dice.range(0.0, 0.3) * speed / swing_rate);
        let axis = Vec3::new(dice.range32(-1.0, 1.0), dice.range32(-1.0, 1.0), dice.range32(-1.0, 1.0));
        let turn_rate = if dice.chance(0.7) { dice.range(-3.0, 3.0) } else { 0.0 };
        let size = (0.3 * (4.0f64 / 0.3).powf(dice.unit())) as f32;
        let parts: Vec<PartSpec> = (0..1 + dice.below(3)).map(|k| part(dice, size, k)).collect();
        let reach = parts.iter().map(PartSpec::reach).fold(0.0, f32::max);
        let height = dice.range(0.2, 3.5) + 0.4 * f64::from(size);
        Self {
            at_sec,
            pos: from + turn * ahead + DVec3::Z * height,
            vel,
            swing,
            swing_rate,
            axis: axis.normalize_or(Vec3::Z),
            turn_rate,
            parts,
            reach,
            instance,
        }
    }

    /// Where it is and how its centre moves; turning is the parts' matter.
    pub(crate) fn state(&self, time: f64) -> BodyState {
        let t = time - self.at_sec;
        let (sin, cos) = (self.swing_rate * t).sin_cos();
        BodyState {
            origin: self.pos + self.vel * t + self.swing * sin,
            yaw: 0.0,
            vel: self.vel + self.swing * (self.swing_rate * cos),
            yaw_rate: 0.0,
            instance: self.instance,
        }
    }

    /// Its parts at a time, turned.
    pub(crate) fn parts(&self, time: f64) -> Vec<PartSpec> {
        let angle = (self.turn_rate * (time - self.at_sec)).rem_euclid(TAU) as f32;
        let turn = Mat3::from_quat(Quat::from_axis_angle(self.axis, angle));
        let omega = self.axis * self.turn_rate as f32;
        let turned = |p: &PartSpec| {
            let pos = turn * p.pos;
            PartSpec { rot: turn * p.rot, pos, vel: omega.cross(pos), omega, ..*p }
        };
        self.parts.iter().map(turned).collect()
    }
}

fn part(dice: &mut Dice, size: f32, index: usize) -> PartSpec {
    let length = |dice: &mut Dice| size * dice.range32(0.35, 1.0);
    let (x, y, z) = (length(dice), length(dice), length(dice));
    let shape = match dice.below(5) {
        0 | 1 => Shape::cuboid(x, y, z),
        2 => Shape::Ellipsoid { radii: Vec3::new(x, y, z) * 0.5 },
        3 => Shape::Cylinder { radius: 0.5 * x, half: 0.5 * z, hole: 0.0 },
        _ => Shape::taper(x, y, z, Vec2::new(x, y) * dice.range32(0.2, 0.9), Vec2::ZERO),
    };
    let color = |dice: &mut Dice| {
        Vec3::new(dice.range32(0.1, 1.0), dice.range32(0.1, 1.0), dice.range32(0.1, 1.0)).map(|c| 0.8 * c * c)
    };
    let surface = match dice.below(6) {
        0 => Surface::Plain,
        1 => Surface::Rough,
        2 => Surface::Boards { step: 0.15 * size },
        3 => Surface::Courses { step: 0.12 * size },
        _ => Surface::Poster,
    };
    let material = Material::new(surface, color(dice)).accent(color(dice)).seed(dice.next());
    let off = if index == 0 { 0.0 } else { 0.5 * size };
    let pos = Vec3::new(dice.range32(-off, off), dice.range32(-off, off), dice.range32(-off, off));
    PartSpec::fixed(shape, pos, material).turned(Mat3::from_rotation_z(dice.range32(0.0, 3.0)))
}
