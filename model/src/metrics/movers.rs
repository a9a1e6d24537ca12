//! What is wrong with the flow of road users that move: missed, slow, wrong direction or wrong speed; speed and direction apart.
//!
//! Pooled over pixels, not over frames: shares say of which kind of pixel the whole error is made.

use serde::Serialize;

use super::flow::{Flow, difference, norm, widen};
use super::{Mean, MetricError};

/// A mover counts as missed where its predicted speed is below this, m/s (the speed below which flow is rendered as still) ...
pub const MISSED_BELOW_MPS: f64 = 1.0;
/// ... and its true speed above this, m/s.
pub const MISSED_ABOVE_MPS: f64 = 2.0;
/// A direction further from the true one than this is wrong, radians: more of the predicted motion is then sideways than along.
pub const WRONG_DIRECTION_RAD: f64 = std::f64::consts::FRAC_PI_4;

/// The four kinds of movers' pixels, each of exactly one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MoverKind {
    /// Predicted below [`MISSED_BELOW_MPS`], in truth above [`MISSED_ABOVE_MPS`].
    Missed,
    /// In truth at most [`MISSED_ABOVE_MPS`].
    Slow,
    /// Seen to move, by more than [`WRONG_DIRECTION_RAD`] in the wrong direction.
    WrongDirection,
    /// Seen to move in the right direction; what is left is the error of the speed.
    RightDirection,
}

impl MoverKind {
    /// All, in the order of the tables.
    pub const ALL: [Self; 4] = [Self::Missed, Self::RightDirection, Self::WrongDirection, Self::Slow];

    /// Its name in tables and JSON.
    pub fn name(self) -> &'static str {
        match self {
            Self::Missed => "missed",
            Self::Slow => "slow",
            Self::WrongDirection => "wrong_direction",
            Self::RightDirection => "right_direction",
        }
    }
}

/// Errors of movers' pixels, summed up.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct MoverErrors {
    /// End-point errors by kind, in the order of [`MoverKind::ALL`].
    kinds: [Mean; 4],
    speed: Mean,
    direction: Mean,
}

/// Figures of [`MoverErrors`]; `None` of no pixel.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct MoverFigures {
    /// Movers' pixels counted.
    pub pixels: usize,
    /// Mean end-point error, m/s.
    pub epe3d: Option<f64>,
    /// Share of the pixels that are missed, 0-1.
    pub missed_share: Option<f64>,
    /// Mean absolute error of the speed, m/s.
    pub speed_error: Option<f64>,
    /// Mean angle to the true direction where the predicted speed is at least [`MISSED_BELOW_MPS`], radians.
    pub direction_error: Option<f64>,
}

/// How much of the pixels and of their error is of one kind.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct KindShare {
    /// [`MoverKind::name`].
    pub kind: &'static str,
    /// Share of movers' pixels, 0-1.
    pub pixels: f64,
    /// Share of movers' summed end-point error, 0-1; none where there is no error.
    pub error: Option<f64>,
}

impl MoverErrors {
    /// Counts a mover's pixel.
    ///
    /// # Errors
    /// A flow that is not finite; `index` names it.
    pub fn add(&mut self, index: usize, pred: Flow, truth: Flow) -> Result<(), MetricError> {
        let (p, t) = (widen("predicted flow", index, pred)?, widen("true flow", index, truth)?);
        let (said, speed) = (norm(p), norm(t));
        let angle = (said >= MISSED_BELOW_MPS && speed > 0.0).then(|| {
            let dot: f64 = p.iter().zip(&t).map(|(a, b)| a * b).sum();
            (dot / (said * speed)).clamp(-1.0, 1.0).acos()
        });
        let kind = match angle {
            _ if speed <= MISSED_ABOVE_MPS => MoverKind::Slow,
            None => MoverKind::Missed,
            Some(angle) if angle > WRONG_DIRECTION_RAD => MoverKind::WrongDirection,
            Some(_) => MoverKind::RightDirection,
        };
        let error = norm(difference(p, t));
        MoverKind::ALL.iter().zip(&mut self.kinds).filter(|(k, _)| **k == kind).for_each(|(_, m)| m.add(Some(error)));
        self.speed.add(Some((said - speed).abs()));
        self.direction.add(angle);
        Ok(())
    }

    /// Counts what the other counted too.
    pub fn join(&mut self, other: &Self) {
        self.kinds.iter_mut().zip(&other.kinds).for_each(|(mean, other)| mean.join(other));
        self.speed.join(&other.speed);
        self.direction.join(&other.direction);
    }

    fn all(&self) -> Mean {
        let mut all = Mean::default();
        self.kinds.iter().for_each(|kind| all.join(kind));
        all
    }

    /// Sum of the end-point errors, m/s.
    pub fn sum(&self) -> f64 {
        self.all().sum
    }

    /// The figures so far.
    pub fn figures(&self) -> MoverFigures {
        let all = self.all();
        let pixels = all.count();
        let [missed, ..] = &self.kinds;
        MoverFigures {
            pixels,
            epe3d: all.value(),
            missed_share: (pixels > 0).then(|| missed.count() as f64 / pixels as f64),
            speed_error: self.speed.value(),
            direction_error: self.direction.value(),
        }
    }

    /// Of which kinds pixels and error are; empty of no pixel.
    pub fn shares(&self) -> Vec<KindShare> {
        let all = self.all();
        if all.count() == 0 {
            return Vec::new();
        }
        let share = |(kind, mean): (&MoverKind, &Mean)| KindShare {
            kind: kind.name(),
            pixels: mean.count() as f64 / all.count() as f64,
            error: (all.sum > 0.0).then(|| mean.sum / all.sum),
        };
        MoverKind::ALL.iter().zip(&self.kinds).map(share).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn errors(pairs: &[(Flow, Flow)]) -> MoverErrors {
        let mut errors = MoverErrors::default();
        pairs.iter().enumerate().for_each(|(i, &(p, t))| errors.add(i, p, t).unwrap());
        errors
    }

    /// Inputs such as 0.9 are f32: off by 3e-8.
    const EPS: f64 = 1e-6;

    #[test]
    fn each_pixel_is_of_one_kind() {
        let missed = ([0.0, 0.9, 0.0], [0.0, 5.0, 0.0]);
        let slow = ([0.0; 3], [2.0, 0.0, 0.0]);
        let turned = ([0.0, 3.0, 0.0], [3.0, 0.0, 0.0]);
        let fast = ([8.0, 0.0, 0.0], [5.0, 0.0, 0.0]);
        let all = errors(&[missed, slow, turned, fast]);
        let shares = all.shares();
        assert!(shares.iter().all(|s| s.pixels == 0.25), "{shares:?}");
        let sum = 4.1 + 2.0 + 18f64.sqrt() + 3.0;
        for (name, error) in
            [("missed", 4.1), ("slow", 2.0), ("wrong_direction", 18f64.sqrt()), ("right_direction", 3.0)]
        {
            let share = shares.iter().find(|s| s.kind == name).unwrap();
            assert!((share.error.unwrap() - error / sum).abs() < EPS, "{name}: {share:?}");
        }
        let f = all.figures();
        assert_eq!((f.pixels, f.missed_share), (4, Some(0.25)));
        assert!((f.speed_error.unwrap() - (4.1 + 2.0 + 0.0 + 3.0) / 4.0).abs() < EPS, "{f:?}");
        // A right angle and none: those that are not seen to move have no direction.
        assert!((f.direction_error.unwrap() - std::f64::consts::FRAC_PI_2 / 2.0).abs() < EPS, "{f:?}");
        assert!((f.epe3d.unwrap() - sum / 4.0).abs() < EPS && (all.sum() - sum).abs() < EPS);
    }

    #[test]
    fn parts_join_and_nothing_is_none() {
        let pairs = [([1.0, 0.0, 0.0], [4.0, 0.0, 0.0]), ([0.0; 3], [0.0, 7.0, 0.0]), ([2.0; 3], [1.0; 3])];
        let mut apart = errors(&pairs[..1]);
        apart.join(&errors(&pairs[1..]));
        assert_eq!(apart, errors(&pairs));
        assert_eq!(MoverErrors::default().figures(), MoverFigures::default());
        assert!(MoverErrors::default().shares().is_empty());
        let bad = MoverErrors::default().add(3, [f32::NAN; 3], [1.0; 3]);
        assert!(matches!(bad, Err(MetricError::NonFinite { index: 3, .. })), "{bad:?}");
    }
}
