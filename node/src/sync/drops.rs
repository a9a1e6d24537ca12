//! Why images were dropped, and how many.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

/// Why an image never reached the network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DropReason {
    /// Older than a set that was already emitted.
    Late,
    /// A second image of one camera with the same stamp. Not a loss.
    Duplicate,
    /// Its set never became complete: another camera's image is missing.
    Incomplete,
    /// Its camera sends more often than the slowest one, and no set could take it. Not a loss.
    Surplus,
    /// At the start or end of the recording, where the poses or the other cameras have not begun or have ended. Not a loss.
    Edge,
    /// No pose for its stamp: older than the first pose, or none came within the bounded wait.
    NoPose,
    /// The poses around its stamp lie too far apart to be interpolated.
    PoseGap,
    /// No usable intrinsics or mounting for its camera.
    NoCalibration,
    /// Held when the clock jumped, the recording looped, or the stage was reset; or its own stamp is far from all
    /// others.
    ClockJump,
    /// Its bytes cannot be decoded.
    Decode,
    /// A bounded queue was full; the oldest goes first.
    Overflow,
    /// The stage that had it panicked and was started anew.
    Panic,
}

impl DropReason {
    /// Every reason, in order.
    pub const ALL: [Self; 12] = [
        Self::Late,
        Self::Duplicate,
        Self::Incomplete,
        Self::Surplus,
        Self::Edge,
        Self::NoPose,
        Self::PoseGap,
        Self::NoCalibration,
        Self::ClockJump,
        Self::Decode,
        Self::Overflow,
        Self::Panic,
    ];

    /// False for images that nothing could have been made of in any case.
    pub fn is_loss(self) -> bool {
        !matches!(self, Self::Duplicate | Self::Surplus | Self::Edge)
    }

    /// The name used in logs and `metrics.json`.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Late => "late",
            Self::Duplicate => "duplicate",
            Self::Incomplete => "incomplete",
            Self::Surplus => "surplus",
            Self::Edge => "edge",
            Self::NoPose => "no_pose",
            Self::PoseGap => "pose_gap",
            Self::NoCalibration => "no_calibration",
            Self::ClockJump => "clock_jump",
            Self::Decode => "decode",
            Self::Overflow => "overflow",
            Self::Panic => "panic",
        }
    }
}

impl fmt::Display for DropReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// Dropped images by reason, in the order of [`DropReason`]; serialises as one object, reason to count.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
#[serde(transparent)]
pub struct DropCounts(BTreeMap<DropReason, u64>);

impl DropCounts {
    /// Counts `n` more images; 0 leaves no entry behind.
    pub fn add(&mut self, reason: DropReason, n: u64) {
        if n > 0 {
            *self.0.entry(reason).or_insert(0) += n;
        }
    }

    /// Counts `n` images for another reason than before, as far as there are so many.
    pub fn recount(&mut self, from: DropReason, to: DropReason, n: u64) {
        let moved = n.min(self.get(from));
        if let Some(count) = self.0.get_mut(&from) {
            *count -= moved;
        }
        self.0.retain(|_, count| *count > 0);
        self.add(to, moved);
    }

    /// Images that were lost: all but those counted for a reason that is no loss.
    pub fn lost(&self) -> u64 {
        self.iter().filter(|(reason, _)| reason.is_loss()).map(|(_, n)| n).sum()
    }

    /// Images dropped for this reason.
    pub fn get(&self, reason: DropReason) -> u64 {
        self.0.get(&reason).copied().unwrap_or(0)
    }

    /// Images dropped for any reason.
    pub fn total(&self) -> u64 {
        self.0.values().sum()
    }

    /// Reasons that occurred, with their counts.
    pub fn iter(&self) -> impl Iterator<Item = (DropReason, u64)> + '_ {
        self.0.iter().map(|(&reason, &n)| (reason, n))
    }

    /// Adds another stage's counts.
    pub fn merge(&mut self, other: &Self) {
        for (reason, n) in other.iter() {
            self.add(reason, n);
        }
    }
}

impl fmt::Display for DropCounts {
    /// `incomplete 3, late 1`, or `none`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.0.is_empty() {
            return f.write_str("none");
        }
        for (i, (reason, n)) in self.iter().enumerate() {
            write!(f, "{}{reason} {n}", if i == 0 { "" } else { ", " })?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_agree_and_counts_add_up() {
        let mut a = DropCounts::default();
        a.add(DropReason::Late, 2);
        a.add(DropReason::NoPose, 0);
        let mut b = DropCounts::default();
        b.add(DropReason::NoCalibration, 1);
        b.merge(&a);
        assert_eq!((b.total(), b.get(DropReason::Late), b.get(DropReason::NoPose)), (3, 2, 0));
        assert_eq!(serde_json::to_string(&b).unwrap(), r#"{"late":2,"no_calibration":1}"#);
        assert_eq!(b.to_string(), "late 2, no_calibration 1");
        assert_eq!(DropCounts::default().to_string(), "none");
        for (reason, _) in b.iter() {
            assert_eq!(serde_json::to_string(&reason).unwrap(), format!("\"{reason}\""));
        }
    }
}
