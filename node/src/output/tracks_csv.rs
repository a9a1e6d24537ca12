//! Trajectories of moving points as CSV, one observation a row.

use std::io::Write;
use std::path::Path;

use super::OutputError;
use super::atomic::write_atomic;

/// The header line.
pub const TRACKS_HEADER: &str = "track_id,stamp_ns,x_m,y_m,z_m,vx_mps,vy_mps,vz_mps,motion_id";

/// One observation of one trajectory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackRow {
    /// Which trajectory.
    pub track_id: u32,
    /// When, nanoseconds.
    pub stamp_ns: i64,
    /// Where, metres, map frame.
    pub position_m: [f64; 3],
    /// How fast, m/s, map axes.
    pub velocity_mps: [f32; 3],
    /// Motion group.
    pub motion_id: u16,
}

/// Writes rows in the order given. Errors on a number that is not finite.
pub fn write_tracks_csv<'a>(path: &Path, rows: impl IntoIterator<Item = &'a TrackRow>) -> Result<(), OutputError> {
    write_atomic(path, |out| {
        writeln!(out, "{TRACKS_HEADER}").map_err(OutputError::io(path))?;
        for (index, row) in rows.into_iter().enumerate() {
            let [x, y, z] = row.position_m;
            let [vx, vy, vz] = row.velocity_mps;
            let all = [x, y, z, f64::from(vx), f64::from(vy), f64::from(vz)];
            if let Some(value) = all.into_iter().find(|v| !v.is_finite()) {
                return Err(OutputError::NonFinite { what: format!("row of track {}", row.track_id), index, value });
            }
            // `{}` prints the shortest text that reads back as the same number.
            writeln!(out, "{},{},{x},{y},{z},{vx},{vy},{vz},{}", row.track_id, row.stamp_ns, row.motion_id)
                .map_err(OutputError::io(path))?;
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_read_back_exactly_and_bad_ones_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("tracks.csv");
        let row = TrackRow {
            track_id: 7,
            stamp_ns: 1_700_000_000_000_000_001,
            position_m: [5_334_000.123_456_789, -0.1, 1.0 / 3.0],
            velocity_mps: [1.1, -2.5, 0.0],
            motion_id: 3,
        };
        write_tracks_csv(&path, [&row]).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let mut lines = text.lines();
        assert_eq!(lines.next(), Some(TRACKS_HEADER));
        let cells: Vec<&str> = lines.next().unwrap().split(',').collect();
        assert_eq!(cells.len(), TRACKS_HEADER.split(',').count());
        assert_eq!(cells[1].parse(), Ok(row.stamp_ns));
        for k in 0..3 {
            assert_eq!(cells[2 + k].parse(), Ok(row.position_m[k]));
            assert_eq!(cells[5 + k].parse(), Ok(row.velocity_mps[k]));
        }
        let bad = TrackRow { velocity_mps: [f32::INFINITY, 0.0, 0.0], ..row };
        assert!(matches!(write_tracks_csv(&path, [&row, &bad]), Err(OutputError::NonFinite { index: 1, .. })));
        assert_eq!(std::fs::read_to_string(&path).unwrap(), text, "a refused file replaces nothing");
    }
}
