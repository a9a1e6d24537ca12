//! What is written when: pictures of every camera, and poses at their stamps and on a regular grid, in order of stamps.

use storm_render::world::Drive;

use super::{ODOMETRY_HZ, SynthError};

/// One thing to write.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Event {
    /// The vehicle's pose.
    Pose {
        /// Stamp, nanoseconds.
        stamp_ns: i64,
        /// Time of the drive, seconds.
        time_sec: f64,
    },
    /// A camera's picture, its CameraInfo and ground truth.
    Picture {
        /// Stamp, nanoseconds.
        stamp_ns: i64,
        /// Time of the drive, seconds.
        time_sec: f64,
        /// Camera number.
        camera: usize,
    },
}

impl Event {
    /// Stamp, nanoseconds.
    pub fn stamp_ns(&self) -> i64 {
        match *self {
            Self::Pose { stamp_ns, .. } | Self::Picture { stamp_ns, .. } => stamp_ns,
        }
    }

    /// Order among equal stamps: the pose first, then cameras by number.
    fn rank(&self) -> usize {
        match *self {
            Self::Pose { .. } => 0,
            Self::Picture { camera, .. } => camera + 1,
        }
    }
}

/// When a camera takes a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ImageTime {
    pub stamp_ns: i64,
    pub time_sec: f64,
    pub camera: usize,
}

fn stamp(time_sec: f64, start_stamp_ns: i64) -> Result<i64, SynthError> {
    let offset_ns = (time_sec * 1e9).round();
    // Below 2^53, where every integer is an f64.
    let exact = offset_ns.abs() < 9e15;
    let sum = if exact { start_stamp_ns.checked_add(offset_ns as i64) } else { None };
    sum.filter(|&s| s >= 0).ok_or(SynthError::Stamp { time_sec, start_stamp_ns })
}

/// Every picture of the drive.
pub(super) fn image_times(drive: &Drive, start_stamp_ns: i64) -> Result<Vec<ImageTime>, SynthError> {
    let mut times = Vec::new();
    for frame in 0..drive.frame_count() {
        for camera in 0..drive.cameras().len() {
            let time_sec = drive.frame_time_sec(frame, camera);
            times.push(ImageTime { stamp_ns: stamp(time_sec, start_stamp_ns)?, time_sec, camera });
        }
    }
    Ok(times)
}

/// Pictures and poses in order of stamps; a pose stands at every picture's stamp and every 1 / [`ODOMETRY_HZ`] between
/// the first and the last.
pub(super) fn schedule(images: &[ImageTime], start_stamp_ns: i64) -> Result<Vec<Event>, SynthError> {
    let mut poses: Vec<(i64, f64)> = images.iter().map(|i| (i.stamp_ns, i.time_sec)).collect();
    let first = images.iter().map(|i| i.time_sec).fold(f64::INFINITY, f64::min);
    let last = images.iter().map(|i| i.time_sec).fold(f64::NEG_INFINITY, f64::max);
    if first <= last {
        let (from, to) = ((first * ODOMETRY_HZ).ceil() as i64, (last * ODOMETRY_HZ).floor() as i64);
        for k in from..=to {
            let time_sec = k as f64 / ODOMETRY_HZ;
            poses.push((stamp(time_sec, start_stamp_ns)?, time_sec));
        }
    }
    poses.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    poses.dedup_by_key(|p| p.0);
    let poses = poses.into_iter().map(|(stamp_ns, time_sec)| Event::Pose { stamp_ns, time_sec });
    let pictures =
        images.iter().map(|i| Event::Picture { stamp_ns: i.stamp_ns, time_sec: i.time_sec, camera: i.camera });
    let mut events: Vec<Event> = poses.chain(pictures).collect();
    events.sort_by_key(|e| (e.stamp_ns(), e.rank()));
    Ok(events)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_stand_at_every_picture_and_never_far_apart() {
        let start = 1_700_000_000_000_000_000;
        let images: Vec<ImageTime> = (0..12)
            .map(|i| {
                let (frame, camera) = (i / 3, i % 3);
                let time_sec = f64::from(frame) * 0.1 + 0.007 * f64::from(camera);
                ImageTime { stamp_ns: stamp(time_sec, start).unwrap(), time_sec, camera: camera as usize }
            })
            .collect();
        let events = schedule(&images, start).unwrap();
        assert!(events.windows(2).all(|w| (w[0].stamp_ns(), w[0].rank()) < (w[1].stamp_ns(), w[1].rank())));
        let poses: Vec<i64> = events.iter().filter(|e| matches!(e, Event::Pose { .. })).map(Event::stamp_ns).collect();
        assert!(images.iter().all(|i| poses.binary_search(&i.stamp_ns).is_ok()));
        assert!(poses.windows(2).all(|w| w[1] - w[0] <= 20_000_001));
        assert_eq!(events.len() - poses.len(), 12);
        assert_eq!((poses[0], poses[poses.len() - 1]), (start, start + 314_000_000));
    }

    #[test]
    fn stamps_that_do_not_fit_are_refused() {
        assert!(matches!(stamp(1.0, i64::MAX), Err(SynthError::Stamp { .. })));
        assert!(matches!(stamp(-1.0, 0), Err(SynthError::Stamp { .. })));
        assert!(matches!(stamp(f64::NAN, 5), Err(SynthError::Stamp { .. })));
        assert_eq!(schedule(&[], 0).unwrap(), []);
    }
}
