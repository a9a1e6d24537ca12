//! The vehicle's poses of a run. When the recording's clock jumps back (it was made while another one looped) a new epoch
//! begins; stamps rise within each.

use std::path::{Path, PathBuf};

use crate::output::OutputError;
use crate::output::tum::write_tum;
use crate::rigid::Rigid;

/// Poses by epoch.
#[derive(Debug, Default)]
pub struct Trajectory {
    epochs: Vec<(u32, Vec<(i64, Rigid)>)>,
}

impl Trajectory {
    /// Takes one pose, `map_from_base` in metres. A stamp that does not rise within its epoch is left out: there is a pose
    /// for that time already.
    pub fn push(&mut self, epoch: u32, stamp_ns: i64, map_from_base: Rigid) {
        match self.epochs.last_mut() {
            Some((last, poses)) if *last == epoch => {
                if poses.last().is_none_or(|(last_ns, _)| *last_ns < stamp_ns) {
                    poses.push((stamp_ns, map_from_base));
                }
            }
            _ => self.epochs.push((epoch, vec![(stamp_ns, map_from_base)])),
        }
    }

    /// The epochs that have poses, in order, by their number.
    pub fn epochs(&self) -> impl Iterator<Item = (u32, &[(i64, Rigid)])> {
        self.epochs.iter().map(|(epoch, poses)| (*epoch, poses.as_slice()))
    }

    /// All poses in the order they came.
    pub fn all(&self) -> Vec<(i64, Rigid)> {
        self.epochs.iter().flat_map(|(_, poses)| poses).copied().collect()
    }

    /// Stamp of the last pose.
    pub fn last_ns(&self) -> Option<i64> {
        self.epochs.last().and_then(|(_, poses)| poses.last()).map(|(stamp_ns, _)| *stamp_ns)
    }

    /// Time recorded, nanoseconds: the sum over the epochs.
    pub fn recorded_ns(&self) -> i64 {
        let span = |poses: &[(i64, Rigid)]| match (poses.first(), poses.last()) {
            (Some(first), Some(last)) => last.0.saturating_sub(first.0),
            _ => 0,
        };
        self.epochs().fold(0, |sum, (_, poses)| sum.saturating_add(span(poses)))
    }

    /// Writes one TUM file for each epoch into `folder`: `trajectory.tum` for the first, `trajectory_2.tum` for the second.
    /// `frame` and `of` are the fixed and the vehicle frame.
    ///
    /// # Errors
    /// What the system says, or a pose that is not finite.
    pub fn write(&self, folder: &Path, frame: &str, of: &str) -> Result<(), OutputError> {
        if self.epochs.is_empty() {
            return write_tum(&file(folder, 0), frame, of, []);
        }
        self.epochs()
            .enumerate()
            .try_for_each(|(i, (_, poses))| write_tum(&file(folder, i), frame, of, poses.iter().copied()))
    }
}

fn file(folder: &Path, epoch: usize) -> PathBuf {
    folder.join(if epoch == 0 { "trajectory.tum".into() } else { format!("trajectory_{}.tum", epoch + 1) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::tum::read_tum;

    #[test]
    fn every_epoch_has_a_file_of_rising_stamps() {
        let mut trajectory = Trajectory::default();
        for (epoch, stamp_ns) in [(0, 5), (0, 7), (0, 7), (0, 6), (0, 9), (1, 5), (1, 8)] {
            trajectory.push(epoch, stamp_ns, Rigid::IDENTITY);
        }
        let dir = tempfile::tempdir().unwrap();
        trajectory.write(dir.path(), "odom", "base_link").unwrap();
        let stamps = |name: &str| -> Vec<i64> {
            read_tum(&dir.path().join(name)).unwrap().into_iter().map(|(stamp_ns, _)| stamp_ns).collect()
        };
        assert_eq!((stamps("trajectory.tum"), stamps("trajectory_2.tum")), (vec![5, 7, 9], vec![5, 8]));
        assert!(std::fs::read_to_string(dir.path().join("trajectory.tum")).unwrap().contains("odom"));
        assert_eq!((trajectory.recorded_ns(), trajectory.last_ns(), trajectory.all().len()), (7, Some(8), 5));
        let empty = tempfile::tempdir().unwrap();
        Trajectory::default().write(empty.path(), "map", "base_link").unwrap();
        assert!(empty.path().join("trajectory.tum").exists());
    }
}
