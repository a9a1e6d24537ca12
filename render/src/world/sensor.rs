//! From light to 8-bit counts: exposure, white balance, tone curve, noise.

use super::dice::{fold, mix};
use super::rig::DriveCamera;
use glam::Vec3;

/// Light at which the tone curve reaches white.
const WHITE: f32 = 4.0;
/// Counts of the tone curve are looked up by the square root of light in this many steps.
const STEPS: usize = 1024;
/// The display gamma behind the shoulder.
const GAMMA: f32 = 1.9;

/// Counts, 0 to 255, of an amount of light: a gentle shoulder (extended Reinhard) and a display gamma.
fn tone(light: f32) -> f32 {
    (light * (1.0 + light / (WHITE * WHITE)) / (1.0 + light)).min(1.0).powf(1.0 / GAMMA) * 255.0
}

/// The light, 0 to 4, that a drive's camera without noise shows as this count: what its tone curve took away is put back.
pub fn light_of_count(count: u8) -> f32 {
    let y = (f32::from(count) / 255.0).powf(GAMMA);
    // x (1 + x / W^2) = y (1 + x) for x.
    let half = 0.5 * WHITE * WHITE;
    half * (y - 1.0 + ((1.0 - y) * (1.0 - y) + 2.0 * y / half).sqrt())
}

/// One camera's sensor at one moment.
pub(crate) struct Sensor {
    gain: Vec3,
    noise: f32,
    key: u64,
    curve: Vec<f32>,
}

impl Sensor {
    pub(crate) fn new(camera: &DriveCamera, brightness: f32, noise: f32, key: [u64; 3]) -> Self {
        let gain = Vec3::from(camera.white_balance) * (camera.exposure_gain * brightness);
        let top = WHITE.sqrt();
        let curve = (0..=STEPS + 1).map(|i| tone((i as f32 / STEPS as f32 * top).powi(2))).collect();
        Self { gain, noise, key: fold(key[0], &key[1..]), curve }
    }

    fn count(&self, light: f32) -> f32 {
        let x = (light.max(0.0) / WHITE).sqrt().min(1.0) * STEPS as f32;
        let i = (x as usize).min(STEPS);
        self.curve[i] + (self.curve[i + 1] - self.curve[i]) * (x - i as f32)
    }

    /// Counts of one pixel.
    #[inline]
    pub(crate) fn expose(&self, light: Vec3, pixel: usize) -> [u8; 3] {
        let light = light * self.gain;
        let (a, b) = if self.noise > 0.0 {
            let a = mix(self.key.wrapping_add(pixel as u64));
            (a, mix(a ^ 0x9e37_79b9_7f4a_7c15))
        } else {
            (0, 0)
        };
        std::array::from_fn(|k| {
            // The sum of four bytes is nearly normal: mean 510, variance 4 (256^2 - 1) / 12.
            let bits = if k < 2 { a >> (32 * k) } else { b };
            let sum: u64 = (0..4).map(|i| (bits >> (8 * i)) & 0xff).sum();
            let noise = if self.noise > 0.0 { (sum as f32 - 510.0) * (self.noise / 147.8) } else { 0.0 };
            (self.count(light[k]) + noise + 0.5).clamp(0.0, 255.0) as u8
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::world::DriveOptions;

    #[test]
    fn light_comes_back_from_counts() {
        for count in 0..=255u8 {
            let light = light_of_count(count);
            assert!((0.0..=WHITE + 1e-3).contains(&light), "{count}: {light}");
            assert!((tone(light) - f32::from(count)).abs() < 0.02, "{count}: {}", tone(light));
        }
    }

    #[test]
    fn noise_has_the_asked_spread_and_no_bias() {
        let camera = super::super::rig::rig(&DriveOptions { exposure: false, ..Default::default() }).remove(0);
        let light = Vec3::splat(0.4);
        let clean = Sensor::new(&camera, 1.0, 0.0, [1, 2, 3]).count(0.4);
        let sensor = Sensor::new(&camera, 1.0, 4.0, [1, 2, 3]);
        let values: Vec<f32> =
            (0..30_000).flat_map(|i| sensor.expose(light, i)).map(|v| f32::from(v) - clean).collect();
        let mean = values.iter().sum::<f32>() / values.len() as f32;
        let sigma = (values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / values.len() as f32).sqrt();
        // 90 000 draws: three sigma of the mean is 0.04, rounding adds 1/12 to the variance.
        assert!(mean.abs() < 0.05 && (sigma - 4.0).abs() < 0.1, "{mean} {sigma}");
    }
}
