//! Trajectories of moving points as CSV, one observation a row.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use super::OutputError;

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

/// Writes rows as they come. Until it is finished the file has a temporary name beside its place, complete up to the
/// last flushed row: what a killed run leaves.
#[derive(Debug)]
pub struct TracksWriter {
    out: BufWriter<File>,
    part: PathBuf,
    path: PathBuf,
    rows: usize,
}

impl TracksWriter {
    /// Starts `path` (under its temporary name) with the header line.
    pub fn create(path: &Path) -> Result<Self, OutputError> {
        let part = path.with_extension("csv.part");
        let mut out = BufWriter::new(File::create(&part).map_err(OutputError::io(&part))?);
        writeln!(out, "{TRACKS_HEADER}").map_err(OutputError::io(&part))?;
        Ok(Self { out, part, path: path.to_owned(), rows: 0 })
    }

    /// Adds rows. Errors on a number that is not finite; rows before it are written.
    pub fn write<'a>(&mut self, rows: impl IntoIterator<Item = &'a TrackRow>) -> Result<(), OutputError> {
        for row in rows {
            let [x, y, z] = row.position_m;
            let [vx, vy, vz] = row.velocity_mps;
            let all = [x, y, z, f64::from(vx), f64::from(vy), f64::from(vz)];
            if let Some(value) = all.into_iter().find(|v| !v.is_finite()) {
                let what = format!("row of track {}", row.track_id);
                return Err(OutputError::NonFinite { what, index: self.rows, value });
            }
            // Tenths of a millimetre, and of mm/s: far below what a picture shows.
            let (id, stamp_ns, motion_id) = (row.track_id, row.stamp_ns, row.motion_id);
            writeln!(self.out, "{id},{stamp_ns},{x:.4},{y:.4},{z:.4},{vx:.4},{vy:.4},{vz:.4},{motion_id}")
                .map_err(OutputError::io(&self.part))?;
            self.rows += 1;
        }
        Ok(())
    }

    /// Hands everything to the system: a killed process loses none of it.
    pub fn flush(&mut self) -> Result<(), OutputError> {
        self.out.flush().map_err(OutputError::io(&self.part))
    }

    /// Gives the file its name.
    pub fn finish(mut self) -> Result<(), OutputError> {
        self.flush()?;
        std::fs::rename(&self.part, &self.path).map_err(OutputError::io(&self.path))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_read_back_and_bad_ones_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("tracks.csv");
        let row = TrackRow {
            track_id: 7,
            stamp_ns: 1_700_000_000_000_000_001,
            position_m: [5_334_000.123_456_789, -0.1, 1.0 / 3.0],
            velocity_mps: [1.1, -2.5, 0.0],
            motion_id: 3,
        };
        let mut writer = TracksWriter::create(&path).unwrap();
        writer.write([&row]).unwrap();
        writer.flush().unwrap();
        assert!(!path.exists(), "not before it is finished");
        let killed = std::fs::read_to_string(dir.path().join("tracks.csv.part")).unwrap();
        writer.write([&row]).unwrap();
        let bad = TrackRow { velocity_mps: [f32::INFINITY, 0.0, 0.0], ..row };
        assert!(matches!(writer.write([&row, &bad]), Err(OutputError::NonFinite { index: 3, .. })));
        writer.finish().unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(killed.lines().count() == 2 && text.starts_with(&killed) && text.lines().count() == 4);
        let mut lines = text.lines();
        assert_eq!(lines.next(), Some(TRACKS_HEADER));
        let cells: Vec<&str> = lines.next().unwrap().split(',').collect();
        assert_eq!(cells.len(), TRACKS_HEADER.split(',').count());
        assert_eq!(cells[1].parse(), Ok(row.stamp_ns));
        for k in 0..3 {
            let read = |cell: &str| cell.parse::<f64>().unwrap();
            assert!((read(cells[2 + k]) - row.position_m[k]).abs() <= 0.5001e-4);
            assert!((read(cells[5 + k]) - f64::from(row.velocity_mps[k])).abs() <= 0.5001e-4);
        }
    }
}
