//! Trajectories in the TUM format: `timestamp tx ty tz qx qy qz qw`, one pose a line.
//!
//! Stamps are written from their integer nanoseconds and positions with as many digits as an `f64` needs, so neither
//! epoch-sized stamps nor UTM-sized coordinates lose anything.

use std::io::Write;
use std::path::Path;

use glam::{DQuat, DVec3};

use super::OutputError;
use super::atomic::write_atomic;
use crate::rigid::Rigid;

/// Nanoseconds as seconds with nine decimals.
pub fn seconds_text(stamp_ns: i64) -> String {
    let sign = if stamp_ns < 0 { "-" } else { "" };
    let ns = stamp_ns.unsigned_abs();
    format!("{sign}{}.{:09}", ns / 1_000_000_000, ns % 1_000_000_000)
}

/// Nanoseconds of decimal seconds; digits past the ninth decimal are cut. `None` when it is no such number.
fn stamp_from_text(text: &str) -> Option<i64> {
    let (sign, digits) = text.strip_prefix('-').map_or((1, text), |rest| (-1, rest));
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let all_digits = |s: &str| s.bytes().all(|b| b.is_ascii_digit());
    if whole.is_empty() || !all_digits(whole) || !all_digits(fraction) {
        return None;
    }
    let nanos: i64 = format!("{:0<9}", &fraction[..fraction.len().min(9)]).parse().ok()?;
    whole.parse::<i64>().ok()?.checked_mul(1_000_000_000)?.checked_add(nanos).map(|ns| sign * ns)
}

/// Writes poses (`frame` from `of`, metres) in the order given, below a comment that names the frames. Errors on a pose that
/// is not finite.
pub fn write_tum(
    path: &Path,
    frame: &str,
    of: &str,
    poses: impl IntoIterator<Item = (i64, Rigid)>,
) -> Result<(), OutputError> {
    // A line break in a frame's name would end the comment.
    let name = |frame: &str| frame.replace(char::is_control, " ");
    write_atomic(path, |out| {
        writeln!(out, "# {} in {}: timestamp tx ty tz qx qy qz qw", name(of), name(frame))
            .map_err(OutputError::io(path))?;
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

/// Reads a TUM file: stamps (nanoseconds) and poses. Empty lines and `#` comments are skipped.
///
/// # Errors
/// A line that is not eight finite numbers with a rotation; it is named by its number.
pub fn read_tum(path: &Path) -> Result<Vec<(i64, Rigid)>, OutputError> {
    let text = std::fs::read_to_string(path).map_err(OutputError::io(path))?;
    let mut poses = Vec::new();
    for (i, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.starts_with('#')) {
        let wrong = || OutputError::Format {
            path: path.to_owned(),
            reason: format!("line {} is not 'timestamp x y z qx qy qz qw': {line}", i + 1),
        };
        let mut words = line.split_whitespace();
        let stamp_ns = words.next().and_then(stamp_from_text).ok_or_else(wrong)?;
        let n: Vec<f64> = words.map(|w| w.parse().unwrap_or(f64::NAN)).collect();
        let &[x, y, z, qx, qy, qz, qw] = n.as_slice() else { return Err(wrong()) };
        let pose = Rigid::new(DQuat::from_xyzw(qx, qy, qz, qw), DVec3::new(x, y, z)).normalized().ok_or_else(wrong)?;
        poses.push((stamp_ns, pose));
    }
    Ok(poses)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_lost_in_the_text() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.tum");
        let pose =
            Rigid::new(DQuat::from_rotation_z(0.7), DVec3::new(691_234.123_456_789_1, 5_334_000.000_000_001, 1e-7));
        write_tum(&path, "map", "base_link", [(1_700_000_000_123_456_789, pose), (-1, Rigid::IDENTITY)]).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text.lines().next(), Some("# base_link in map: timestamp tx ty tz qx qy qz qw"));
        let lines: Vec<Vec<&str>> = text.lines().skip(1).map(|l| l.split(' ').collect()).collect();
        assert_eq!(lines[0][0], "1700000000.123456789");
        assert_eq!(lines[1][0], "-0.000000001");
        let numbers: Vec<f64> = lines[0][1..].iter().map(|s| s.parse().unwrap()).collect();
        let (t, q) = (pose.translation, pose.rotation);
        assert_eq!(numbers, [t.x, t.y, t.z, q.x, q.y, q.z, q.w]);
        assert!(!text.lines().skip(1).any(|l| l.contains('e')), "exponents trip simple readers");
        let back = read_tum(&path).unwrap();
        assert_eq!((back[0].0, back[0].1.translation), (1_700_000_000_123_456_789, pose.translation));
        assert_eq!(back[1].0, -1);
    }

    #[test]
    fn lines_that_are_no_pose_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.tum");
        for (line, good) in [
            ("1.5 0 0 0 0 0 0 1", true),
            ("2 0 0 0 0 0 0 2", true),
            ("1.5 0 0 0 0 0 0", false),
            ("x 0 0 0 0 0 0 1", false),
            ("1.5 0 NaN 0 0 0 0 1", false),
            ("1.5 0 0 0 0 0 0 0", false),
            ("99999999999999999999 0 0 0 0 0 0 1", false),
            ("1.\u{e9} 0 0 0 0 0 0 1", false),
        ] {
            std::fs::write(&path, format!("# a comment\n\n{line}\n")).unwrap();
            match read_tum(&path) {
                Ok(poses) => assert!(good && poses.len() == 1, "{line}"),
                Err(e) => assert!(!good && e.to_string().contains("line 3"), "{line}: {e}"),
            }
        }
    }

    #[test]
    fn a_pose_that_is_not_finite_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("t.tum");
        let bad = Rigid::new(DQuat::IDENTITY, DVec3::new(0.0, f64::NAN, 0.0));
        assert!(matches!(
            write_tum(&path, "map", "base_link", [(0, bad)]),
            Err(OutputError::NonFinite { index: 0, .. })
        ));
        assert!(!path.exists());
    }
}
