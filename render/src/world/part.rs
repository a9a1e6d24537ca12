//! Parts of bodies: a solid with its pose and rigid motion in the body's frame, and the joints limbs hang from.

use super::material::Material;
use super::shapes::Shape;
use glam::{Mat3, Vec3};

/// A solid in its body's frame (x forward, y left, z up), with the velocity of its centre and its angular velocity there.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PartSpec {
    pub shape: Shape,
    pub rot: Mat3,
    pub pos: Vec3,
    pub vel: Vec3,
    pub omega: Vec3,
    pub material: Material,
}

impl PartSpec {
    /// A part fixed to the body, axes parallel to it.
    pub(crate) fn fixed(shape: Shape, pos: Vec3, material: Material) -> Self {
        Self { shape, rot: Mat3::IDENTITY, pos, vel: Vec3::ZERO, omega: Vec3::ZERO, material }
    }

    pub(crate) fn turned(mut self, rot: Mat3) -> Self {
        self.rot = rot * self.rot;
        self
    }

    /// A capsule between two fixed points.
    pub(crate) fn bar(a: Vec3, b: Vec3, radius: f32, material: Material) -> Self {
        let along = b - a;
        let half = 0.5 * along.length();
        let rot = Mat3::from_quat(glam::Quat::from_rotation_arc(Vec3::Z, along.normalize_or(Vec3::Z)));
        Self { rot, ..Self::fixed(Shape::Capsule { radius, half }, 0.5 * (a + b), material) }
    }

    /// Radius of a sphere around the body's origin that holds the part.
    pub(crate) fn reach(&self) -> f32 {
        self.pos.length() + self.shape.bounds().length()
    }
}

/// A moving frame inside a body.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Joint {
    pub rot: Mat3,
    pub pos: Vec3,
    pub vel: Vec3,
    pub omega: Vec3,
}

impl Joint {
    pub(crate) fn new(pos: Vec3, vel: Vec3) -> Self {
        Self { rot: Mat3::IDENTITY, pos, vel, omega: Vec3::ZERO }
    }

    /// The same frame at another of its points.
    pub(crate) fn at(&self, offset: Vec3) -> Self {
        let arm = self.rot * offset;
        Self { pos: self.pos + arm, vel: self.vel + self.omega.cross(arm), ..*self }
    }

    /// Turned about its own y axis (a positive angle moves what hangs below backward), at a rate in rad/s.
    pub(crate) fn pitched(&self, angle: f32, rate: f32) -> Self {
        let rot = self.rot * Mat3::from_rotation_y(angle);
        Self { rot, omega: self.omega + self.rot * Vec3::new(0.0, rate, 0.0), ..*self }
    }

    /// A part centred on this joint.
    pub(crate) fn part(&self, shape: Shape, material: Material) -> PartSpec {
        PartSpec { shape, rot: self.rot, pos: self.pos, vel: self.vel, omega: self.omega, material }
    }
}
