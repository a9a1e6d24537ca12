//! Parked vehicles that leave their place: out into the lane, on for a few lengths, and to a stop there.

use super::dice::Dice;
use super::scene::BodyState;
use super::site::StaticBody;
use super::stream::{Actor, Model};
use glam::DVec2;

/// Share of the parked vehicles that leave during a drive.
const SHARE: f64 = 0.3;
/// How far to the side they go, over how much of the way, metres.
const ASIDE_M: f64 = 2.6;
const OUT_M: f64 = 11.0;

/// One vehicle's way out of its place; the rear axle follows a curve, speed rises from 0 and falls back to 0.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PullOut {
    from_sec: f64,
    seconds: f64,
    way: f64,
    /// To the left (1) or to the right (-1).
    side: f64,
}

impl PullOut {
    /// The way of parked vehicle `index` of leg `leg` of the drive of `seed`, if it has one. `hand` is the town's: 1 drives on the
    /// right.
    pub(crate) fn roll(seed: u64, leg: usize, index: usize, seconds: f64, hand: f64) -> Option<Self> {
        let mut dice = Dice::new(seed, &[75, leg as u64, index as u64]);
        let goes = dice.chance(SHARE);
        let (way, lasts) = (dice.range(14.0, 30.0), dice.range(4.5, 7.0));
        goes.then(|| Self { from_sec: dice.range(-2.0, seconds), seconds: lasts, way, side: hand })
    }

    /// When it moves, seconds.
    pub(crate) fn span(&self) -> (f64, f64) {
        (self.from_sec, self.from_sec + self.seconds)
    }

    /// The vehicle at a time.
    pub(crate) fn actor(&self, body: &StaticBody, model: Model, time: f64) -> Actor {
        let u = ((time - self.from_sec) / self.seconds).clamp(0.0, 1.0);
        let x = self.way * u * u * (3.0 - 2.0 * u);
        let speed = self.way * 6.0 * u * (1.0 - u) / self.seconds;
        // To the side by a quintic step, whose slope and curvature begin and end at 0.
        let q = (x / OUT_M).clamp(0.0, 1.0);
        let aside = self.side * ASIDE_M;
        let y = aside * q * q * q * (10.0 - 15.0 * q + 6.0 * q * q);
        let slope = aside / OUT_M * 30.0 * q * q * (1.0 - q) * (1.0 - q);
        let bend = aside / (OUT_M * OUT_M) * 60.0 * q * (1.0 - q) * (1.0 - 2.0 * q);
        let (dir, left) = (DVec2::from_angle(body.yaw), DVec2::from_angle(body.yaw).perp());
        Actor {
            id: 0,
            instance: body.instance,
            model,
            pos: body.origin + (dir * x + left * y).extend(0.0),
            yaw: body.yaw + slope.atan(),
            vel: ((dir + left * slope) * speed).extend(0.0),
            yaw_rate: bend * speed / (1.0 + slope * slope),
            way: x,
            speed,
        }
    }
}

/// A vehicle that never left.
pub(crate) fn standing(body: &StaticBody) -> BodyState {
    let (origin, yaw, instance) = (body.origin, body.yaw, body.instance);
    BodyState { origin, yaw, vel: glam::DVec3::ZERO, yaw_rate: 0.0, instance }
}
