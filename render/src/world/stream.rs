//! Streams: road users that follow one line one after another, each a closed form of time.
//!
//! Slot `j` of a stream enters at a fixed time and follows the same pace as all others, so nobody of one stream ever meets
//! another of it, any moment can be asked for directly, and nothing needs to be simulated up to it.

use super::dice::{Dice, fold};
use super::ego::{Ride, ride};
use super::part::PartSpec;
use super::path::Path;
use super::people::{BICYCLE_WHEELBASE_M, CyclistModel, PersonModel};
use super::vehicles::{Build, VehicleModel};
use glam::{DVec2, DVec3};

/// Class of a road user.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum MoverClass {
    /// Saloon, hatchback or sport utility vehicle.
    Car,
    /// Van.
    Van,
    /// Lorry.
    Lorry,
    /// Bus.
    Bus,
    /// Cyclist with bicycle.
    Cyclist,
    /// Pedestrian.
    Pedestrian,
}

/// Somebody's looks.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Model {
    Vehicle(VehicleModel),
    Cyclist(CyclistModel),
    Person(PersonModel),
}

impl Model {
    pub(crate) fn class(&self) -> MoverClass {
        match self {
            Self::Vehicle(v) => match v.build {
                Build::Van => MoverClass::Van,
                Build::Lorry => MoverClass::Lorry,
                Build::Bus => MoverClass::Bus,
                _ => MoverClass::Car,
            },
            Self::Cyclist(_) => MoverClass::Cyclist,
            Self::Person(_) => MoverClass::Pedestrian,
        }
    }

    pub(crate) fn wheelbase(&self) -> f64 {
        match self {
            Self::Vehicle(v) => f64::from(v.wheelbase),
            Self::Cyclist(_) => f64::from(BICYCLE_WHEELBASE_M),
            Self::Person(_) => 0.0,
        }
    }

    /// Size of the box around, and its middle's x in the body frame.
    pub(crate) fn size(&self) -> (DVec3, f64) {
        match self {
            Self::Vehicle(v) => (glam::Vec3::new(v.length, v.width, v.height).as_dvec3(), f64::from(v.middle())),
            Self::Cyclist(_) => (DVec3::new(1.75, 0.6, 1.75), 0.53),
            Self::Person(p) => (DVec3::new(0.6, 0.55, 1.0) * f64::from(p.height).max(1.0), 0.0),
        }
    }

    pub(crate) fn parts(&self, way: f64, speed: f64, out: &mut Vec<PartSpec>) {
        match self {
            Self::Vehicle(v) => v.parts(way, speed as f32, out),
            Self::Cyclist(c) => c.parts(way, speed as f32, out),
            Self::Person(p) => p.parts(way, speed as f32, out),
        }
    }
}

/// Speed over time since entering: v - a cos(w t + phase); its integral is the way.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pace {
    pub v: f64,
    pub a: f64,
    pub w: f64,
    pub phase: f64,
}

impl Pace {
    pub(crate) fn steady(v: f64) -> Self {
        Self { v, a: 0.0, w: 1.0, phase: 0.0 }
    }

    pub(crate) fn way(&self, t: f64) -> f64 {
        self.v * t - self.a / self.w * ((self.w * t + self.phase).sin() - self.phase.sin())
    }

    pub(crate) fn speed(&self, t: f64) -> f64 {
        self.v - self.a * (self.w * t + self.phase).cos()
    }

    pub(crate) fn top(&self) -> f64 {
        self.v + self.a
    }

    /// When `way` metres are done (the way grows strictly, since a < v).
    pub(crate) fn time_of(&self, way: f64) -> f64 {
        let slack = 2.0 * self.a / self.w;
        let (mut lo, mut hi) = ((way - slack) / self.v, (way + slack) / self.v);
        for _ in 0..40 {
            let mid = 0.5 * (lo + hi);
            if self.way(mid) < way { lo = mid } else { hi = mid }
        }
        0.5 * (lo + hi)
    }
}

/// Who travels in a stream.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Crowd {
    /// Vehicles, a share of them larger than cars.
    Vehicles {
        big: f64,
    },
    Cyclists,
    Pedestrians,
}

/// A stream.
#[derive(Debug, Clone)]
pub(crate) struct Stream {
    pub crowd: Crowd,
    pub path: Path,
    pub pace: Pace,
    /// Seconds between slots.
    pub interval: f64,
    /// Share of slots that are taken.
    pub share: f64,
    pub seed: u64,
    /// Instance number of slot 0, and how many follow before they come round again.
    pub id: u32,
    pub ids: u32,
    /// Height of the ground walked on, and the stretches of the path that lie on asphalt instead.
    pub height: f64,
    pub dips: Vec<(f64, f64)>,
}

/// Length over which a pedestrian steps up or down a kerb.
const STEP_M: f64 = 0.5;

/// Somebody at a moment. The frame: x forward, y left, z up, on the ground (vehicles: under the rear axle).
#[derive(Debug, Clone, Copy)]
pub(crate) struct Actor {
    pub id: u64,
    pub instance: u16,
    pub model: Model,
    pub pos: DVec3,
    pub yaw: f64,
    pub vel: DVec3,
    pub yaw_rate: f64,
    /// Metres travelled: turns wheels and swings legs.
    pub way: f64,
    pub speed: f64,
}

/// A rectangle on the ground.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Footprint {
    pub centre: DVec2,
    pub dir: DVec2,
    pub half: DVec2,
}

impl Footprint {
    pub(crate) fn overlaps(&self, other: &Self) -> bool {
        let gap = other.centre - self.centre;
        [self.dir, self.dir.perp(), other.dir, other.dir.perp()].iter().all(|axis| {
            let reach = |f: &Self| f.half.x * f.dir.dot(*axis).abs() + f.half.y * f.dir.perp().dot(*axis).abs();
            gap.dot(*axis).abs() < reach(self) + reach(other)
        })
    }
}

impl Actor {
    pub(crate) fn footprint(&self, margin: f64) -> Footprint {
        let (size, middle) = self.model.size();
        let dir = DVec2::from_angle(self.yaw);
        let half = 0.5 * size.truncate() + DVec2::splat(margin);
        Footprint { centre: self.pos.truncate() + dir * middle, dir, half }
    }
}

impl Stream {
    fn enters(&self, slot: i64) -> f64 {
        let jitter = Dice::new(self.seed, &[1, slot as u64]).range(-0.25, 0.25);
        (slot as f64 + jitter) * self.interval
    }

    pub(crate) fn taken(&self, slot: i64) -> bool {
        Dice::new(self.seed, &[2, slot as u64]).chance(self.share)
    }

    /// Slots that may be on the path at a time.
    pub(crate) fn slots(&self, time: f64) -> std::ops::RangeInclusive<i64> {
        let life = self.pace.time_of(self.path.length()).max(0.0);
        ((time - life) / self.interval).floor() as i64 - 1..=(time / self.interval).ceil() as i64 + 1
    }

    pub(crate) fn model(&self, slot: i64) -> Model {
        let mut dice = Dice::new(self.seed, &[3, slot as u64]);
        match self.crowd {
            Crowd::Vehicles { big } => Model::Vehicle(VehicleModel::roll(&mut dice, big)),
            Crowd::Cyclists => Model::Cyclist(CyclistModel::roll(&mut dice)),
            Crowd::Pedestrians => Model::Person(PersonModel::roll(&mut dice)),
        }
    }

    /// Position along the path and speed.
    pub(crate) fn progress(&self, slot: i64, time: f64) -> (f64, f64) {
        let t = time - self.enters(slot);
        (self.pace.way(t), self.pace.speed(t))
    }

    pub(crate) fn on_path(&self, s: f64) -> bool {
        (0.0..=self.path.length()).contains(&s)
    }

    /// When a slot is at `s` of the path.
    pub(crate) fn time_at(&self, slot: i64, s: f64) -> f64 {
        self.enters(slot) + self.pace.time_of(s)
    }

    /// Whether any taken slot is within `window` seconds of passing `s` at `time`.
    pub(crate) fn passes(&self, s: f64, time: f64, window: f64) -> bool {
        let lag = self.pace.time_of(s);
        let first = ((time - lag - window) / self.interval).floor() as i64 - 1;
        let last = ((time - lag + window) / self.interval).ceil() as i64 + 1;
        (first..=last).any(|j| (self.enters(j) + lag - time).abs() < window && self.taken(j))
    }

    pub(crate) fn actor(&self, slot: i64, time: f64) -> Actor {
        let (s, v) = self.progress(slot, time);
        let model = self.model(slot);
        let Ride { pos, yaw, vel, yaw_rate } = ride(&self.path, s, v, model.wheelbase());
        let (mut z, mut slope) = (self.height, 0.0);
        for &(from, to) in &self.dips {
            // Down over the first step, up over the last: a product of two smoothsteps and its derivative.
            let (a, da) = smooth((s - from) / STEP_M);
            let (b, db) = smooth((to - s) / STEP_M);
            z -= self.height * a * b;
            slope -= self.height * (da * b - a * db) / STEP_M;
        }
        Actor {
            id: fold(self.seed, &[4, slot as u64]),
            instance: (self.id + slot.rem_euclid(i64::from(self.ids.max(1))) as u32) as u16,
            model,
            pos: pos.extend(z),
            yaw,
            vel: vel.extend(slope * v),
            yaw_rate,
            way: s,
            speed: v,
        }
    }
}

/// Smoothstep of `x` clamped to 0-1, and its derivative.
fn smooth(x: f64) -> (f64, f64) {
    let x = x.clamp(0.0, 1.0);
    (x * x * (3.0 - 2.0 * x), 6.0 * x * (1.0 - x))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pace_inverts_and_integrates() {
        let pace = Pace { v: 8.0, a: 5.0, w: 0.7, phase: 1.0 };
        for k in 1..200 {
            let t = f64::from(k) * 0.13;
            assert!((pace.time_of(pace.way(t)) - t).abs() < 1e-6);
            let numeric = (pace.way(t + 1e-4) - pace.way(t - 1e-4)) / 2e-4;
            assert!((numeric - pace.speed(t)).abs() < 1e-6);
        }
    }

    #[test]
    fn actors_move_as_their_velocity_says_also_over_kerbs_and_bends() {
        let mut path = Path::new(DVec2::new(5.0, 1.0), 0.3);
        path.push(20.0, 0.0);
        path.push(15.0, 0.05);
        path.push(20.0, 0.0);
        for crowd in [Crowd::Pedestrians, Crowd::Vehicles { big: 0.3 }, Crowd::Cyclists] {
            let stream = Stream {
                crowd,
                path: path.clone(),
                pace: Pace { v: 3.0, a: 1.0, w: 0.5, phase: 0.0 },
                interval: 4.0,
                share: 1.0,
                seed: 3,
                id: 10,
                ids: 8,
                height: 0.12,
                dips: vec![(10.0, 14.0)],
            };
            let h = 1e-4;
            for k in 0..150 {
                let t = f64::from(k) * 0.111;
                let (a, b, c) = (stream.actor(0, t - h), stream.actor(0, t), stream.actor(0, t + h));
                // Pieces join with a jump in curvature, which a central difference sees as an error of h/2 times it.
                assert!(((c.pos - a.pos) / (2.0 * h)).distance(b.vel) < 2e-3, "{t}");
                assert!(((c.yaw - a.yaw) / (2.0 * h) - b.yaw_rate).abs() < 2e-3 || b.model.wheelbase() == 0.0, "{t}");
                assert!(stream.slots(t).contains(&0) || !stream.on_path(b.way));
            }
        }
    }
}
