//! The world at one moment as seen from one eye: solids placed relative to the eye in `f32`, the ground, and what casts shadows.

use super::ground::Ground;
use super::light::Lamps;
use super::material::Material;
use super::part::PartSpec;
use super::shadow::Shadows;
use super::shapes::Shape;
use super::stream::Actor;
use glam::{DVec3, Mat3, Vec3};

/// Bodies farther than this from the eye are left out.
pub(crate) const BODY_REACH_M: f64 = 260.0;
/// Bodies nearer than this cast shadows even where the camera does not see them.
const CASTER_M: f32 = 60.0;

/// Which body a part belongs to: enough to find the same point again at another time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum BodyKey {
    Static { leg: u32, index: u32 },
    Companion { index: u32 },
    Slot { leg: u32, flow: u32, slot: i64 },
    Solid { index: u32 },
}

/// A solid placed relative to the eye, axes as the map's.
#[derive(Debug, Clone)]
pub(crate) struct Part {
    pub shape: Shape,
    pub material: Material,
    pub pos: Vec3,
    /// view_from_part rotation.
    pub rot: Mat3,
    /// The eye in the part's frame: where rays start.
    pub eye: Vec3,
    /// Velocity of the centre and angular velocity, map axes.
    pub vel: Vec3,
    pub omega: Vec3,
    pub moves: bool,
    pub instance: u16,
    pub body: BodyKey,
    pub index: u16,
}

impl Part {
    /// Velocity of a point of the solid, m/s.
    #[inline]
    pub(crate) fn velocity(&self, p: Vec3) -> Vec3 {
        if self.moves { self.vel + self.omega.cross(p - self.pos) } else { Vec3::ZERO }
    }
}

/// Where a body is and how it moves.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BodyState {
    pub origin: DVec3,
    pub yaw: f64,
    pub vel: DVec3,
    pub yaw_rate: f64,
    pub instance: u16,
}

impl BodyState {
    pub(crate) fn of(actor: &Actor) -> Self {
        let Actor { pos, yaw, vel, yaw_rate, instance, .. } = *actor;
        Self { origin: pos, yaw, vel, yaw_rate, instance }
    }
}

/// The four side planes of a view, through the eye, normals inward.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Frustum {
    pub normals: [Vec3; 4],
}

impl Frustum {
    fn sees(&self, centre: Vec3, radius: f32) -> bool {
        self.normals.iter().all(|n| n.dot(centre) > -radius)
    }
}

/// The scene.
#[derive(Debug, Clone)]
pub(crate) struct Scene {
    pub eye: DVec3,
    pub parts: Vec<Part>,
    pub ground: Ground,
    pub shadows: Shadows,
    pub lamps: Lamps,
    frustum: Frustum,
}

impl Scene {
    pub(crate) fn new(eye: DVec3, ground: Ground, frustum: Frustum) -> Self {
        Self { eye, parts: Vec::new(), ground, shadows: Shadows::default(), lamps: Lamps::default(), frustum }
    }

    /// Whether a body whose parts lie within `reach` of `origin` matters for the picture.
    pub(crate) fn wants(&self, origin: DVec3, reach: f32) -> bool {
        let gap = origin - self.eye;
        if gap.length_squared() > BODY_REACH_M * BODY_REACH_M {
            return false;
        }
        let gap = gap.as_vec3();
        gap.length() < CASTER_M + reach || self.frustum.sees(gap, reach)
    }

    /// Places a body's parts.
    pub(crate) fn add(&mut self, key: BodyKey, state: &BodyState, specs: &[PartSpec]) {
        let turn = Mat3::from_rotation_z(state.yaw as f32);
        let origin = (state.origin - self.eye).as_vec3();
        let (vel, spin) = (state.vel.as_vec3(), Vec3::new(0.0, 0.0, state.yaw_rate as f32));
        for (index, spec) in specs.iter().enumerate() {
            let arm = turn * spec.pos;
            let pos = origin + arm;
            let rot = turn * spec.rot;
            let part_vel = vel + spin.cross(arm) + turn * spec.vel;
            let omega = spin + turn * spec.omega;
            self.parts.push(Part {
                shape: spec.shape,
                material: spec.material,
                pos,
                rot,
                eye: -(rot.transpose() * pos),
                vel: part_vel,
                omega,
                moves: part_vel != Vec3::ZERO || omega != Vec3::ZERO,
                instance: state.instance,
                body: key,
                index: index as u16,
            });
        }
    }
}
