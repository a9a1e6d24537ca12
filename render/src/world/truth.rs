//! Ground truth beyond pictures: boxes of road users and trajectories of surface points.

use super::dice::Dice;
use super::drive::Drive;
use super::scene::BodyKey;
use super::stream::{Model, MoverClass};
use super::trace::Hit;
use glam::{DAffine3, DMat3, DVec3, Vec3};

/// A road user, moving or parked.
#[derive(Debug, Clone, PartialEq)]
pub struct Mover {
    /// The same for the same road user at all times, and for no other one.
    pub id: u64,
    /// Its number in [`super::WorldFrame::instance`] (unique within several kilometres).
    pub instance: u16,
    /// What it is.
    pub class: MoverClass,
    /// map_from_object: the box's centre, x forward, y left, z up.
    pub map_from_object: DAffine3,
    /// Length, width, height, metres.
    pub size: DVec3,
    /// Velocity of the box's centre, map axes, m/s.
    pub velocity_mps: DVec3,
    /// Angular velocity about z, rad/s.
    pub yaw_rate: f64,
    /// Whether it moves at this moment.
    pub moving: bool,
}

impl Mover {
    pub(crate) fn new(id: u64, instance: u16, model: &Model, pose: (DVec3, f64), motion: (DVec3, f64)) -> Self {
        let (size, middle) = model.size();
        let rotation = DMat3::from_rotation_z(pose.1);
        let arm = rotation * DVec3::new(middle, 0.0, 0.5 * size.z);
        let velocity_mps = motion.0 + DVec3::new(0.0, 0.0, motion.1).cross(arm);
        Self {
            id,
            instance,
            class: model.class(),
            map_from_object: DAffine3::from_mat3_translation(rotation, pose.0 + arm),
            size,
            velocity_mps,
            yaw_rate: motion.1,
            moving: velocity_mps.length() > f64::from(super::MOVING_MPS),
        }
    }
}

/// Which points [`Drive::trajectories`] follows, and when.
#[derive(Debug, Clone, PartialEq)]
pub struct TrajectoryOptions {
    /// Times, seconds; visibility is judged in every camera at each of them.
    pub times_sec: Vec<f64>,
    /// Number of points wanted (fewer where the pictures do not show enough).
    pub points: usize,
    /// Share of the points to be taken from surfaces that move when they are chosen, if there are any.
    pub moving_share: f64,
    /// Chooses the points.
    pub seed: u64,
}

/// One surface point over time.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    /// Instance number, 0 for static surroundings.
    pub instance: u16,
    /// Whether the point moves at any of the times.
    pub moves: bool,
    /// Camera and index of the time at which the point was chosen.
    pub query: (usize, usize),
    /// Where it was seen then, pixels (column, row; pixel centres at .5).
    pub query_pixel: [f32; 2],
    /// Position in the map at every time, metres.
    pub positions: Vec<DVec3>,
    /// For every time, bit `c` set where camera `c` sees the point: in its picture and in front of everything else.
    pub visible: Vec<u8>,
}

/// Trajectories and the times they are given at.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectories {
    /// As asked for, seconds.
    pub times_sec: Vec<f64>,
    /// The points.
    pub points: Vec<Trajectory>,
}

/// A point of a surface, independent of time.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Anchor {
    /// Fixed in the local frame.
    Fixed(DVec3),
    /// Fixed to a part of a body.
    Part { body: BodyKey, part: usize, local: Vec3 },
}

/// A chosen point.
struct Choice {
    anchor: Anchor,
    instance: u16,
    moving: bool,
    query: (usize, usize),
    pixel: [f32; 2],
}

/// A point is visible where the ray through it meets a surface no more than this before it: relative to its depth (rounding of f32
/// positions relative to the eye) and at least a few millimetres (the ray grazes the part it lies on).
const VISIBLE_REL: f32 = 2e-3;
const VISIBLE_M: f32 = 5e-3;
/// Picks tried per point wanted.
const TRIES: usize = 12;

impl Drive {
    /// Follows surface points, of static surroundings and of everything that moves, limbs and wheels included.
    ///
    /// Points are drawn from what the cameras see at random ones of the times, so each is seen at least once.
    pub fn trajectories(&self, options: &TrajectoryOptions) -> Trajectories {
        let choices = self.choose(options);
        let mut points: Vec<Trajectory> = choices
            .iter()
            .map(|c| Trajectory {
                instance: c.instance,
                moves: false,
                query: c.query,
                query_pixel: c.pixel,
                positions: Vec::with_capacity(options.times_sec.len()),
                visible: Vec::with_capacity(options.times_sec.len()),
            })
            .collect();
        let origin = self.origin();
        for &time in &options.times_sec {
            let views: Vec<_> = (0..self.cameras().len()).map(|c| self.view(c, time)).collect();
            for (choice, point) in choices.iter().zip(&mut points) {
                let local = self.locate(&choice.anchor, time);
                let mut visible = 0u8;
                for (c, view) in views.iter().enumerate() {
                    let p = view.camera_from_local(local);
                    let Some((u, v)) = view.camera.project(p) else { continue };
                    let inside = u >= 0.0 && v >= 0.0 && u < view.camera.width as f32 && v < view.camera.height as f32;
                    if inside && view.alive(&choice.anchor.body()) {
                        let depth = view.tracer(self.sky()).hit(u, v).depth();
                        let gap = VISIBLE_M.max(VISIBLE_REL * p.z);
                        visible |= u8::from(depth > 0.0 && depth > p.z - gap) << c;
                    }
                }
                point.positions.push(local + origin);
                point.visible.push(visible);
            }
        }
        for point in &mut points {
            point.moves = point.positions.windows(2).any(|w| w[0] != w[1]);
        }
        Trajectories { times_sec: options.times_sec.clone(), points }
    }

    fn choose(&self, options: &TrajectoryOptions) -> Vec<Choice> {
        let mut dice = Dice::new(options.seed, &[90]);
        let mut choices: Vec<Choice> = Vec::new();
        if options.times_sec.is_empty() || options.points == 0 {
            return choices;
        }
        let wanted_moving = (options.points as f64 * options.moving_share.clamp(0.0, 1.0)).round() as usize;
        let cameras = self.cameras().len();
        // A handful of pictures is enough to draw from; all points of one picture share its scene.
        let pictures = (options.times_sec.len() * cameras).min(8);
        let (mut still, mut moving): (Vec<Choice>, Vec<Choice>) = (Vec::new(), Vec::new());
        for _ in 0..pictures {
            let (t, c) = (dice.below(options.times_sec.len()), dice.below(cameras));
            let view = self.view(c, options.times_sec[t]);
            let tracer = view.tracer(self.sky());
            for _ in 0..(options.points * TRIES).div_ceil(pictures) {
                let u = dice.range32(0.0, view.camera.width as f32);
                let v = dice.range32(0.0, view.camera.height as f32);
                let hit = tracer.hit(u, v);
                let d = view.direction(u, v);
                let (anchor, instance, moves) = match hit {
                    Hit::Sky => continue,
                    Hit::Ground(g) => (Anchor::Fixed(view.scene.eye + (d * g.t).as_dvec3()), 0, false),
                    Hit::Part { t, part, .. } => {
                        let part = &view.scene.parts[part as usize];
                        let p = d * t;
                        let local = part.rot.transpose() * (p - part.pos);
                        let anchor = if part.instance == 0 {
                            Anchor::Fixed(view.scene.eye + p.as_dvec3())
                        } else {
                            Anchor::Part { body: part.body, part: usize::from(part.index), local }
                        };
                        (anchor, part.instance, part.velocity(p).length() > super::MOVING_MPS)
                    }
                };
                let choice = Choice { anchor, instance, moving: moves, query: (c, t), pixel: [u, v] };
                if choice.moving { moving.push(choice) } else { still.push(choice) }
            }
        }
        // Draw without replacement: the wanted share of moving ones, the rest from the static ones, then whatever is left.
        let mut take = |from: &mut Vec<Choice>, count: usize| {
            for _ in 0..count.min(from.len()) {
                choices.push(from.swap_remove(dice.below(from.len())));
            }
        };
        take(&mut moving, wanted_moving);
        let left = options.points - wanted_moving.min(options.points);
        take(&mut still, left);
        let missing = options.points.saturating_sub(choices.len());
        let mut take = |from: &mut Vec<Choice>, count: usize| {
            for _ in 0..count.min(from.len()) {
                choices.push(from.swap_remove(0));
            }
        };
        take(&mut still, missing);
        choices
    }

    /// Where an anchored point is at a time, local frame.
    fn locate(&self, anchor: &Anchor, time: f64) -> DVec3 {
        match *anchor {
            Anchor::Fixed(p) => p,
            Anchor::Part { body, part, local } => self.point_on(body, part, local, time).unwrap_or(DVec3::NAN),
        }
    }
}

impl Anchor {
    fn body(&self) -> Option<BodyKey> {
        match *self {
            Self::Fixed(_) => None,
            Self::Part { body, .. } => Some(body),
        }
    }
}
