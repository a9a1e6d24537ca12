//! Trajectories in the TUM format: `timestamp tx ty tz qx qy qz qw`, one pose a line.
//!
//! Stamps are written from their integer nanoseconds and positions with as many digits as an `f64` needs, so neither
//! epoch-sized stamps nor UTM-sized coordinates lose anything.

use std::io::Write;
use std::path::Path;

use super::OutputError;
use super::atomic::write_atomic;
use crate::rigid::Rigid;

/// Nanoseconds as seconds with nine decimals.
pub fn seconds_text(stamp_ns: i64) -> String {
    let sign = if stamp_ns < 0 { "-" } else { "" };
    let ns = stamp_ns.unsigned_abs();
    format!("{sign}{}.{:09}", ns / 1_000_000_000, ns % 1_000_000_000)
}

/// Writes poses (`map_from_base`, metres) in the order given. Errors on a pose that is not finite.
pub fn write_tum(path: &Path, poses: impl IntoIterator<Item = (i64, Rigid)>) -> Result<(), OutputError> {
    write_atomic(path, |out| {
        for (index, (stamp_ns, pose)) in poses.into_iter().enumerate() {
            let (t, q) = (pose.translation, pose.rotation);
            if let Some(value) = [t.x, t.y, t.z, q.x, q.y, q.z, q.w].into_iter().find(|v| !v.is_finite()) {
                return Err(OutputError::NonFinite { what: "trajectory pose".into(), index, value });
            }
            writeln!(out, "{} {} {} {} {} {} {} {}", seconds_text(stamp_ns), t.x, t.y, t.z, q.x, q.y, q.z, q.w)
                .map_err(OutputError::io(path))?;
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DQuat, DVec3};

    #[test]
    fn nothing_is_lost_in_the_text() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.tum");
        let pose =
            Rigid::new(DQuat::from_rotation_z(0.7), DVec3::new(691_234.123_456_789_1, 5_334_000.000_000_001, 1e-7));
        write_tum(&path, [(1_700_000_000_123_456_789, pose), (-1, Rigid::IDENTITY)]).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let lines: Vec<Vec<&str>> = text.lines().map(|l| l.split(' ').collect()).collect();
        assert_eq!(lines[0][0], "1700000000.123456789");
        assert_eq!(lines[1][0], "-0.000000001");
        let numbers: Vec<f64> = lines[0][1..].iter().map(|s| s.parse().unwrap()).collect();
        let (t, q) = (pose.translation, pose.rotation);
        assert_eq!(numbers, [t.x, t.y, t.z, q.x, q.y, q.z, q.w]);
        assert!(!text.contains('e'), "exponents trip simple readers");
    }

    #[test]
    fn a_pose_that_is_not_finite_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.tum");
        let bad = Rigid::new(DQuat::IDENTITY, DVec3::new(0.0, f64::NAN, 0.0));
        assert!(matches!(write_tum(&path, [(0, bad)]), Err(OutputError::NonFinite { index: 0, .. })));
        assert!(!path.exists());
    }
}
