//! Errors of the poses a network is given: no odometry, calibration or clock is exact.

use glam::{DAffine3, DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Share of the clips whose poses are exact.
const EXACT_SHARE: f64 = 0.3;
/// Largest spreads: of a camera's mounting (radians, metres), of single poses, of clocks (seconds).
const MOUNT: [f64; 2] = [0.003, 0.01];
const SINGLE: [f64; 2] = [0.001, 0.01];
const CLOCK_SEC: f64 = 0.008;

/// The errors of one clip.
#[derive(Debug, Clone, Copy)]
pub(in crate::train) struct PoseErrors {
    seed: u64,
    /// Share of the largest spreads.
    share: f64,
}

/// A direction and length that are nearly normal with deviation 1 on each axis.
fn normal(rng: &mut ChaCha8Rng) -> DVec3 {
    // The sum of twelve uniforms has variance 1.
    DVec3::from_array([0; 3].map(|_| (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0))
}

fn error(rng: &mut ChaCha8Rng, [turn, shift]: [f64; 2]) -> DAffine3 {
    let turn = DQuat::from_scaled_axis(normal(rng) * turn);
    DAffine3::from_rotation_translation(turn, normal(rng) * shift)
}

impl PoseErrors {
    /// The errors of the clip of `seed`; `None`: its poses are exact.
    pub(in crate::train) fn draw(seed: u64) -> Option<Self> {
        let seed = seed ^ 0x4c4f_4f4b_5333;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        (rng.random::<f64>() >= EXACT_SHARE).then(|| Self { seed, share: rng.random::<f64>() })
    }

    /// How much later than its image `camera`'s pose is taken, seconds: one clock for the clip and a little for each camera.
    pub(in crate::train) fn late_sec(&self, camera: usize) -> f64 {
        let of = |key: u64| normal(&mut ChaCha8Rng::seed_from_u64(self.seed ^ key)).x;
        self.share * CLOCK_SEC * (of(1 << 8) + 0.3 * of(1 << 8 | (camera as u64 + 1))).clamp(-3.0, 3.0)
    }

    /// given_from_true camera axes: the mounting's error, the same over the clip, and that of the pose at `time_sec`.
    pub(in crate::train) fn at(&self, camera: usize, time_sec: f64) -> DAffine3 {
        let mut mounting = ChaCha8Rng::seed_from_u64(self.seed ^ (2 << 8 | camera as u64));
        let stamp = (time_sec * 1e6).round() as i64 as u64;
        let mut single = ChaCha8Rng::seed_from_u64(self.seed ^ (stamp << 12) ^ (3 << 8 | camera as u64));
        error(&mut mounting, MOUNT.map(|x| x * self.share)) * error(&mut single, SINGLE.map(|x| x * self.share))
    }
}
