//! What a drive is asked to be, and what is refused.

use super::looks::DriveLooks;
use thiserror::Error;

/// Most cameras a rig carries.
pub const CAMERAS_MAX: usize = 6;
/// Longest drive, seconds (a day). The layout is kept whole in memory: about 3 MB per hour.
pub const SECONDS_MAX: f64 = 86_400.0;
/// Largest picture side, pixels.
pub const SIDE_MAX: usize = 8192;

/// What to drive, with which cameras. The same options always give the same pictures and the same ground truth.
#[derive(Debug, Clone, PartialEq)]
pub struct DriveOptions {
    /// Chooses everything the other options leave open: town, light, traffic, the ego's manoeuvres, camera mounts.
    pub seed: u64,
    /// Length, seconds.
    pub seconds: f64,
    /// Number of cameras, 1-6: front; a front-left/front-right stereo pair; front-left, front, front-right; then left, right, rear.
    pub cameras: usize,
    /// Picture width, pixels.
    pub width: usize,
    /// Picture height, pixels.
    pub height: usize,
    /// Frames per second of every camera.
    pub rate_hz: f64,
    /// Camera `i` takes its picture `i * stagger_sec` after camera 0.
    pub stagger_sec: f64,
    /// Standard deviation of the sensor noise, in counts of 0-255.
    pub noise: f32,
    /// Whether every camera has an exposure and a white balance of its own.
    pub exposure: bool,
    /// Where the local origin lies in the map, metres (for example UTM 500000, 4000000, 0).
    pub origin: [f64; 3],
    /// Density of vehicles, cyclists and pedestrians relative to the usual, 0 (nobody) to 3.
    pub traffic: f64,
    /// Factors on the focal lengths across and down: other lenses, and pictures squeezed along one side.
    pub zoom: [f32; 2],
    /// Whether edges are smoothed by extra rays (colour only; depth, flow and labels always belong to the pixel's centre).
    pub smooth_edges: bool,
    /// What of the look varies beyond the usual.
    pub looks: DriveLooks,
}

impl Default for DriveOptions {
    fn default() -> Self {
        Self {
            seed: 0,
            seconds: 10.0,
            cameras: 3,
            width: 240,
            height: 160,
            rate_hz: 10.0,
            stagger_sec: 0.0,
            noise: 1.5,
            exposure: true,
            origin: [0.0; 3],
            traffic: 1.0,
            zoom: [1.0; 2],
            smooth_edges: true,
            looks: DriveLooks::default(),
        }
    }
}

/// Why a drive cannot be made.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum WorldError {
    /// An option is outside its range.
    #[error("drive option `{name}` is {value}; give {allowed}")]
    Option {
        /// Field of [`DriveOptions`].
        name: &'static str,
        /// What was given.
        value: String,
        /// What is allowed.
        allowed: &'static str,
    },
    /// More frames than can be counted were asked for.
    #[error("{seconds} s at {rate_hz} Hz is more than {max} frames; lower `seconds` or `rate_hz`")]
    TooManyFrames {
        /// Length asked for.
        seconds: f64,
        /// Rate asked for.
        rate_hz: f64,
        /// Most frames.
        max: u64,
    },
}

/// Most frames of one drive per camera.
const FRAMES_MAX: u64 = 100_000_000;

impl DriveOptions {
    /// Refuses what cannot be driven.
    ///
    /// # Errors
    /// [`WorldError`] naming the first option outside its range.
    pub fn check(&self) -> Result<(), WorldError> {
        let rule = |ok: bool, name, value: String, allowed| {
            if ok { Ok(()) } else { Err(WorldError::Option { name, value, allowed }) }
        };
        let side = 1..=SIDE_MAX;
        rule(
            self.seconds > 0.0 && self.seconds <= SECONDS_MAX,
            "seconds",
            self.seconds.to_string(),
            "more than 0 and at most 86400",
        )?;
        rule((1..=CAMERAS_MAX).contains(&self.cameras), "cameras", self.cameras.to_string(), "1 to 6")?;
        rule(side.contains(&self.width), "width", self.width.to_string(), "1 to 8192")?;
        rule(side.contains(&self.height), "height", self.height.to_string(), "1 to 8192")?;
        rule(
            self.rate_hz > 0.0 && self.rate_hz <= 1e6,
            "rate_hz",
            self.rate_hz.to_string(),
            "more than 0 and at most 1e6",
        )?;
        rule(self.stagger_sec.abs() <= 1.0, "stagger_sec", self.stagger_sec.to_string(), "-1 to 1")?;
        rule(self.noise >= 0.0 && self.noise <= 64.0, "noise", self.noise.to_string(), "0 to 64")?;
        rule(self.origin.iter().all(|x| x.abs() <= 1e9), "origin", format!("{:?}", self.origin), "within 1e9 m of 0")?;
        let zoom = |z: &f32| *z >= 0.1 && *z <= 10.0;
        rule(self.zoom.iter().all(zoom), "zoom", format!("{:?}", self.zoom), "0.1 to 10")?;
        rule(self.traffic >= 0.0 && self.traffic <= 3.0, "traffic", self.traffic.to_string(), "0 to 3")?;
        if self.seconds * self.rate_hz <= FRAMES_MAX as f64 {
            return Ok(());
        }
        Err(WorldError::TooManyFrames { seconds: self.seconds, rate_hz: self.rate_hz, max: FRAMES_MAX })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_pass_and_nonsense_is_refused_by_name() {
        assert_eq!(DriveOptions::default().check(), Ok(()));
        let bad = [
            ("seconds", DriveOptions { seconds: f64::NAN, ..Default::default() }),
            ("seconds", DriveOptions { seconds: 0.0, ..Default::default() }),
            ("cameras", DriveOptions { cameras: 7, ..Default::default() }),
            ("width", DriveOptions { width: 0, ..Default::default() }),
            ("height", DriveOptions { height: usize::MAX, ..Default::default() }),
            ("rate_hz", DriveOptions { rate_hz: f64::INFINITY, ..Default::default() }),
            ("stagger_sec", DriveOptions { stagger_sec: f64::NAN, ..Default::default() }),
            ("noise", DriveOptions { noise: -1.0, ..Default::default() }),
            ("origin", DriveOptions { origin: [0.0, f64::NAN, 0.0], ..Default::default() }),
            ("traffic", DriveOptions { traffic: 4.0, ..Default::default() }),
            ("zoom", DriveOptions { zoom: [1.0, f32::NAN], ..Default::default() }),
        ];
        for (name, options) in bad {
            assert!(options.check().unwrap_err().to_string().contains(name), "{name}");
        }
        let many = DriveOptions { seconds: 80_000.0, rate_hz: 1e6, ..Default::default() };
        assert!(matches!(many.check(), Err(WorldError::TooManyFrames { .. })));
    }
}
