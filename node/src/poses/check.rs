//! Which poses are taken as they are, which are put right, and which are refused.

use serde::Serialize;
use thiserror::Error;

use crate::rigid::{Rigid, UNIT_QUAT_TOLERANCE};

/// Squared-norm deviation beyond which a quaternion is refused. Rounding to two decimals stays below it; a quaternion
/// that is not filled in (all zero) or holds something else (Euler angles, w and x swapped with a length) does not.
pub const REFUSE_QUAT_TOLERANCE: f64 = 0.1;

/// Positions beyond this are refused, metres: farther than any Earth-fixed frame reaches, and small enough that f64
/// still resolves a micrometre.
pub const MAX_POSITION_M: f64 = 1e9;

/// What was done with a pose that was not refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PoseNote {
    /// Taken.
    Taken,
    /// Taken, after its quaternion was brought to unit length (it was visibly off).
    Renormalized,
    /// There is one with this stamp already; that one stays.
    Duplicate,
    /// Its stamp is far from the others': held until the next pose tells whether the clock jumped.
    Held,
    /// The clock jumped: older poses are forgotten, this one and the held one are taken.
    ClockJump,
}

/// Why a pose was refused.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum PoseReject {
    /// A number is NaN or infinite.
    #[error("pose has a number that is not finite")]
    NonFinite,
    /// The quaternion is far from unit length.
    #[error("pose quaternion has length {length}, wants 1; check the order of its fields and that it is filled in")]
    NotUnit {
        /// Its length.
        length: f64,
    },
    /// The position is absurdly far out.
    #[error("pose is {distance_m:e} m from its frame's origin, more than {MAX_POSITION_M:e} m")]
    TooFar {
        /// Its distance from the origin.
        distance_m: f64,
    },
    /// Older than everything kept, and the buffer is full.
    #[error("pose is older than the oldest one kept")]
    TooOld,
}

/// Poses by what became of them.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct PoseCounts {
    /// Taken, renormalised ones included.
    pub taken: u64,
    /// Taken after normalising a quaternion that was visibly off.
    pub renormalized: u64,
    /// Ignored: the stamp was there already.
    pub duplicate: u64,
    /// Held on suspicion of a clock jump (taken with the next pose, or discarded).
    pub held: u64,
    /// Clock jumps.
    pub clock_jumps: u64,
    /// Refused: not finite.
    pub non_finite: u64,
    /// Refused: quaternion not unit, or position absurd.
    pub not_rigid: u64,
    /// Refused: too old.
    pub too_old: u64,
}

impl PoseCounts {
    /// Counts one outcome.
    pub fn count(&mut self, outcome: &Result<PoseNote, PoseReject>) {
        let n = match outcome {
            Ok(PoseNote::Taken) => &mut self.taken,
            Ok(PoseNote::Renormalized) => {
                self.taken += 1;
                &mut self.renormalized
            }
            Ok(PoseNote::Duplicate) => &mut self.duplicate,
            Ok(PoseNote::Held) => &mut self.held,
            Ok(PoseNote::ClockJump) => {
                self.taken += 2;
                &mut self.clock_jumps
            }
            Err(PoseReject::NonFinite) => &mut self.non_finite,
            Err(PoseReject::NotUnit { .. } | PoseReject::TooFar { .. }) => &mut self.not_rigid,
            Err(PoseReject::TooOld) => &mut self.too_old,
        };
        *n += 1;
    }
}

/// The transform with a unit quaternion, or why it is refused.
pub fn checked(transform: &Rigid) -> Result<(Rigid, PoseNote), PoseReject> {
    if !transform.is_finite() {
        return Err(PoseReject::NonFinite);
    }
    let norm2 = transform.rotation.length_squared();
    let far = PoseReject::NotUnit { length: norm2.sqrt() };
    let note = match (norm2 - 1.0).abs() {
        off if off <= UNIT_QUAT_TOLERANCE => PoseNote::Taken,
        off if off <= REFUSE_QUAT_TOLERANCE => PoseNote::Renormalized,
        _ => return Err(far),
    };
    let distance_m = transform.translation.length();
    if distance_m <= MAX_POSITION_M {
        return transform.normalized().map(|t| (t, note)).ok_or(far);
    }
    Err(PoseReject::TooFar { distance_m })
}
