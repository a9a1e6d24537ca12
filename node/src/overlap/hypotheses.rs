//! Two stories about a surface that is said to move: it stands, or it moves as said. Each says where it was when the
//! window's other pictures were taken, and there one can look.
//!
//! A picture bears a story out when it shows a surface of that colour at that place, contradicts it when it looks clearly
//! through the place, and has no say when something stands in front, when the place is out of sight, or when both
//! stories put the surface at the same place of the picture.

use glam::{Affine3A, Vec3};
use rayon::prelude::*;
use storm_model::scene::Scene;
use storm_render::Intrinsics;

use crate::engine::select::{MOVING_MPS, speed_mps};

/// Nearer than this to a camera nothing is judged, metres.
const NEAR_M: f32 = 0.3;
/// Added to every depth gate, metres: what pixels do not resolve close by.
const GATE_M: f32 = 0.1;
/// Places nearer to each other than this in a picture are the same place, pixels.
const APART_PX: f32 = 1.0;

/// One of the window's pictures as a depth image.
#[derive(Debug)]
pub(super) struct Picture {
    pub camera_from_anchor: Affine3A,
    pub intrinsics: Intrinsics,
    /// z-depth per pixel, metres; infinite: sky; NaN: no say.
    pub depth: Vec<f32>,
    /// Number of its first Gaussian.
    pub first: usize,
    /// Seconds since the window's first timestep.
    pub time_sec: f32,
}

/// How far off is still there.
#[derive(Debug, Clone, Copy)]
pub(super) struct Gates {
    /// Of depth, as a part of the depth.
    pub depth_part: f32,
    /// Of velocity, m/s: the story that a surface moves may be off by this times the time between the pictures.
    pub velocity_mps: f32,
    /// Of colour, root mean square over the channels, 0 to 1.
    pub color_step: f32,
}

/// What pictures say of a story.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Looks {
    /// A surface of that colour is there.
    pub there: u8,
    /// They look through the place.
    pub through: u8,
    /// Something stands before it.
    pub hidden: u8,
}

/// What one picture says of a place.
enum Say {
    There,
    Through,
    Hidden,
}

/// What the other pictures say of one Gaussian.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Verdict {
    /// The network says that it moves.
    pub claimed: bool,
    /// That it stands.
    pub still: Looks,
    /// That it moves as said; nothing where that was not claimed.
    pub moves: Looks,
}

impl Verdict {
    /// Found where it stands, and not where it would have been.
    pub fn stands(&self) -> bool {
        self.claimed && self.still.there > 0 && self.still.through == 0 && self.moves.there == 0
    }

    /// Looked through where it stands now, or found only where it would have been, while the place where it stands was
    /// hidden (by itself, mostly: a car ahead).
    pub fn moves(&self) -> bool {
        let gone = self.still.there == 0 && self.still.hidden > 0 && self.moves.there > 0;
        self.claimed && (self.still.through > self.still.there || gone)
    }

    /// Both stories are borne out: a surface that moves along itself, such as a bus's side, or the road.
    pub fn either(&self) -> bool {
        self.claimed && self.still.there > 0 && !self.stands() && !self.moves()
    }
}

/// Judges all Gaussians that are said to move, and of the newest timestep all (its pictures are new: nothing else is
/// known of them yet).
pub(super) fn judge(scene: &Scene, pictures: &[Picture], gates: &Gates) -> Vec<Verdict> {
    let shape = scene.shape;
    let newest = shape.picture(shape.timesteps - 1, 0).start;
    let pixels = shape.height * shape.width;
    let g = &scene.gaussians;
    (0..g.len())
        .into_par_iter()
        .with_min_len(1024)
        .map(|i| {
            let mut verdict = Verdict { claimed: speed_mps(scene, i) >= MOVING_MPS, ..Verdict::default() };
            let own = i / pixels;
            let surface = pictures[own].depth[i % pixels].is_finite();
            if !(surface && (verdict.claimed || i >= newest)) {
                return verdict;
            }
            let (mean, color) = (Vec3::from(g.means[i]), Vec3::from(g.colors[i]));
            for t in (0..shape.timesteps).filter(|t| *t != own / shape.cameras) {
                let dt_sec = pictures[t * shape.cameras].time_sec - g.time_sec[i];
                // As the window draws it: backward velocity for earlier times (paper eq. 1).
                let v = if dt_sec < 0.0 { g.velocity_backward[i] } else { g.velocity_forward[i] };
                let gone = mean + Vec3::from(v) * dt_sec;
                let at = |p: Vec3| see(scene, &pictures[t * shape.cameras..(t + 1) * shape.cameras], p);
                let (still, moved) = (at(mean), verdict.claimed.then(|| at(gone)).flatten());
                if let (Some(a), Some(b)) = (&still, &moved) {
                    let near = (a.u - b.u).abs().max((a.v - b.v).abs()) < APART_PX;
                    if a.picture.first == b.picture.first && near && (a.z - b.z).abs() < gates.depth_part * a.z {
                        continue;
                    }
                }
                let slack_m = gates.velocity_mps * dt_sec.abs();
                for (place, slack_m, looks) in [(still, 0.0, &mut verdict.still), (moved, slack_m, &mut verdict.moves)]
                {
                    match place.and_then(|p| p.look(scene, color, slack_m, gates)) {
                        Some(Say::There) => looks.there += 1,
                        Some(Say::Through) => looks.through += 1,
                        Some(Say::Hidden) => looks.hidden += 1,
                        None => {}
                    }
                }
            }
            verdict
        })
        .collect()
}

/// A place as a picture sees it.
struct Place<'a> {
    picture: &'a Picture,
    u: f32,
    v: f32,
    z: f32,
}

/// The first camera that has a place in its picture.
fn see<'a>(scene: &Scene, pictures: &'a [Picture], p: Vec3) -> Option<Place<'a>> {
    let (w, h) = (scene.shape.width as f32, scene.shape.height as f32);
    pictures.iter().find_map(|picture| {
        let c = picture.camera_from_anchor.transform_point3(p);
        let k = &picture.intrinsics;
        let (u, v) = (k.fx * c.x / c.z + k.cx, k.fy * c.y / c.z + k.cy);
        // With a neighbour on every side.
        let inside = c.z > NEAR_M && u >= 1.0 && v >= 1.0 && u < w - 1.0 && v < h - 1.0;
        inside.then_some(Place { picture, u, v, z: c.z })
    })
}

impl Place<'_> {
    /// None: no say.
    fn look(&self, scene: &Scene, color: Vec3, slack_m: f32, gates: &Gates) -> Option<Say> {
        let width = scene.shape.width;
        let gate_m = gates.depth_part * self.z + GATE_M + slack_m;
        let (row, col) = (self.v as usize, self.u as usize);
        let alike = |i: usize| {
            let off = Vec3::from(scene.gaussians.colors[self.picture.first + i]) - color;
            // Colours are -1 to 1: twice the step.
            (off.length_squared() / 3.0).sqrt() <= 2.0 * gates.color_step
        };
        if (self.surface(width) - self.z).abs() <= gate_m && alike(row * width + col) {
            return Some(Say::There);
        }
        let (mut through, mut hidden) = (true, true);
        for r in row - 1..=row + 1 {
            for c in col - 1..=col + 1 {
                let i = r * width + c;
                let depth = self.picture.depth[i];
                if (depth - self.z).abs() <= gate_m && alike(i) {
                    return Some(Say::There);
                }
                // Phrased so that a pixel without a say (NaN) is for neither.
                through &= depth > self.z + gate_m;
                hidden &= depth < self.z - gate_m;
            }
        }
        match (through, hidden) {
            (true, _) => Some(Say::Through),
            (_, true) => Some(Say::Hidden),
            _ => None,
        }
    }

    /// Depth of the surface between the four pixels around the place: over a plane the inverse of depth is linear in the
    /// picture, and rows of a road are metres apart.
    fn surface(&self, width: usize) -> f32 {
        let (x, y) = (self.u - 0.5, self.v - 0.5);
        let (a, b) = (x - x.floor(), y - y.floor());
        let first = y as usize * width + x as usize;
        let inverse = |i: usize| 1.0 / self.picture.depth[i];
        let above = (1.0 - a) * inverse(first) + a * inverse(first + 1);
        let below = (1.0 - a) * inverse(first + width) + a * inverse(first + width + 1);
        1.0 / ((1.0 - b) * above + b * below)
    }
}
