//! A rig of cameras as one clip sees through it. Works on finished images: counts back to light, then lens, sensor and
//! compression of another camera. What belongs to a camera stays the same over the clip; exposure drifts from image to image.

use glam::{Mat3, Vec2, Vec3};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use storm_render::world::{WorldFrame, light_of_count};

use super::jpeg;
use super::motion::{Shutter, blurred};
use crate::train::error::TrainError;

/// Share of the clips whose cameras stay the drive's own.
const OWN_SHARE: f64 = 0.1;
/// Share of the other clips that are grey.
const GREY_SHARE: f64 = 0.4;
/// The tone curve is looked up by the square root of light, 0 to the drive's white, in this many steps.
const STEPS: usize = 512;
/// Light the drive's own tone curve shows as white.
const WHITE: f32 = 4.0;
/// How much light a grey value takes of red, green and blue (Rec. 709).
const LUMA: Vec3 = Vec3::new(0.2126, 0.7152, 0.0722);

/// The cameras of a rig.
#[derive(Debug, Clone)]
pub(in crate::train) struct RigLook {
    /// Counts by the square root of light.
    curve: Vec<f32>,
    noise: f32,
    /// JPEG's quality; none: not compressed.
    quality: Option<u8>,
    /// Seconds the shutter is open; 0: no blur by motion.
    open_sec: f64,
    grey: bool,
    cameras: Vec<CameraLook>,
    seed: u64,
}

/// What differs between the cameras of a rig.
#[derive(Debug, Clone)]
struct CameraLook {
    /// Light of the drive to light on this sensor.
    color: Mat3,
    /// Exposure drifts by `swing` stops around its mean, `rate` rad/s from `phase` on.
    swing: f32,
    rate: f64,
    phase: f64,
    /// Share of the light that is missing in the corners.
    vignette: f32,
    /// Share of the image's mean that the lens spreads over all of it.
    glare: f32,
    lens: [f32; 3],
}

fn log_uniform(rng: &mut ChaCha8Rng, low: f32, high: f32) -> f32 {
    low * (high / low).powf(rng.random::<f32>())
}

fn between(rng: &mut ChaCha8Rng, low: f32, high: f32) -> f32 {
    low + (high - low) * rng.random::<f32>()
}

/// Nearly normal: the sum of four bytes, mean 0, deviation 1 (variance of the sum: 4 (256^2 - 1) / 12).
fn normal(bits: u32) -> f32 {
    let sum: u32 = bits.to_le_bytes().iter().map(|&b| u32::from(b)).sum();
    (sum as f32 - 510.0) * (1.0 / 147.8)
}

impl RigLook {
    /// The rig of the clip of `seed`; `None` for those that keep the drive's own.
    pub(in crate::train) fn draw(seed: u64, cameras: usize) -> Option<Self> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x4c4f_4f4b_5331);
        if rng.random::<f64>() < OWN_SHARE {
            return None;
        }
        let grey = rng.random::<f64>() < GREY_SHARE;
        let curve = curve(&mut rng);
        let noise = log_uniform(&mut rng, 0.3, 5.0);
        let quality = (rng.random::<f64>() < 0.4).then(|| rng.random_range(45..=95));
        let open_sec = if rng.random::<f64>() < 0.6 { f64::from(log_uniform(&mut rng, 0.001, 0.025)) } else { 0.0 };
        let stops = between(&mut rng, -1.0, 1.0) + between(&mut rng, -0.6, 0.6);
        // One rig in five has cameras that disagree about the light.
        let apart = if rng.random::<f64>() < 0.2 { 0.8 } else { 0.25 };
        let saturation = between(&mut rng, 0.4, 1.5);
        let warm = between(&mut rng, -0.18, 0.18);
        let vignette = between(&mut rng, -0.2, 0.5).max(0.0);
        let glare = between(&mut rng, -0.04, 0.08).max(0.0);
        let swing = between(&mut rng, 0.0, 0.35);
        // Negative: sharpened by the camera.
        let softness = between(&mut rng, -0.4, 1.0);
        let grey_weights = (LUMA + Vec3::from_array([0; 3].map(|_| between(&mut rng, 0.0, 0.5)))).normalize();
        let grey_weights = grey_weights / grey_weights.element_sum();
        let cameras = (0..cameras)
            .map(|_| {
                let gain = (stops + between(&mut rng, -apart, apart)).exp2();
                let warm = warm + between(&mut rng, -0.05, 0.05);
                let tint = between(&mut rng, -0.05, 0.05);
                let balance = Vec3::new(warm, tint, -warm).map(f32::exp2) * gain;
                let mix = |own: Vec3| LUMA + (own - LUMA) * saturation;
                let color = if grey {
                    Mat3::from_cols_array_2d(&[grey_weights.to_array(); 3]).transpose() * Mat3::from_diagonal(balance)
                } else {
                    let rows = [mix(Vec3::X), mix(Vec3::Y), mix(Vec3::Z)].map(|row| row.to_array());
                    Mat3::from_diagonal(balance) * Mat3::from_cols_array_2d(&rows).transpose()
                };
                CameraLook {
                    color,
                    swing: swing * between(&mut rng, 0.5, 1.5),
                    rate: f64::from(between(&mut rng, 0.5, 6.0)),
                    phase: f64::from(between(&mut rng, 0.0, std::f32::consts::TAU)),
                    vignette: (vignette + between(&mut rng, -0.05, 0.05)).max(0.0),
                    glare,
                    lens: kernel(softness + between(&mut rng, -0.1, 0.1)),
                }
            })
            .collect();
        Some(Self { curve, noise, quality, open_sec, grey, cameras, seed })
    }

    /// How long the shutter is open, seconds.
    pub(in crate::train) fn open_sec(&self) -> f64 {
        self.open_sec
    }

    /// An image as `camera` of this rig takes it at `time_sec`. `shutter` says how the camera moves meanwhile.
    ///
    /// # Errors
    /// What JPEG cannot hold.
    pub(in crate::train) fn take(
        &self,
        frame: &mut WorldFrame,
        camera: usize,
        time_sec: f64,
        shutter: Option<&Shutter>,
    ) -> Result<(), TrainError> {
        let Some(look) = self.cameras.get(camera) else { return Ok(()) };
        let (width, height) = (frame.width, frame.height);
        if width == 0 || height == 0 {
            return Ok(());
        }
        let light = lights();
        let drift = (look.swing * (look.rate * time_sec + look.phase).sin() as f32).exp2();
        let color = look.color * drift;
        let middle = Vec2::new(width as f32, height as f32) * 0.5;
        let mut image: Vec<Vec3> = frame
            .rgb
            .chunks_exact(3)
            .enumerate()
            .map(|(i, c)| {
                let off = (Vec2::new((i % width) as f32 + 0.5, (i / width) as f32 + 0.5) - middle) / middle;
                let fall = 1.0 - look.vignette * 0.5 * off.length_squared();
                let own = Vec3::new(light[usize::from(c[0])], light[usize::from(c[1])], light[usize::from(c[2])]);
                (color * own * fall).max(Vec3::ZERO)
            })
            .collect();
        if let Some(shutter) = shutter {
            image = blurred(&image, width, height, &shutter.motion(frame));
        }
        if look.lens[0] != 1.0 {
            image = filtered(&image, width, height, &look.lens);
        }
        if look.glare > 0.0 {
            let mean = image.iter().sum::<Vec3>() / image.len() as f32;
            image.iter_mut().for_each(|x| *x += (mean - *x) * look.glare);
        }
        self.develop(&image, camera, time_sec, &mut frame.rgb);
        if let Some(quality) = self.quality {
            jpeg::compress(&mut frame.rgb, width, height, quality)
                .map_err(|e| TrainError::Source(format!("a training image of {width}x{height} as JPEG: {e}")))?;
        }
        Ok(())
    }

    /// Light to counts, with noise.
    fn develop(&self, image: &[Vec3], camera: usize, time_sec: f64, rgb: &mut [u8]) {
        // The same camera at the same moment takes the same image.
        let stamp = (time_sec * 1e6).round() as i64 as u64;
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed ^ (stamp << 4) ^ camera as u64);
        for (x, out) in image.iter().zip(rgb.chunks_exact_mut(3)) {
            let count = |x: f32, bits: u32| {
                let at = (x / WHITE).sqrt().min(1.0) * STEPS as f32;
                let i = (at as usize).min(STEPS - 1);
                let clean = self.curve[i] + (self.curve[i + 1] - self.curve[i]) * (at - i as f32);
                // A tone curve is steeper in the dark, and lifts its noise.
                let noise = normal(bits) * self.noise * (1.3 - 0.8 * clean / 255.0);
                (clean + noise + 0.5).clamp(0.0, 255.0) as u8
            };
            if self.grey {
                out.fill(count(x.x, rng.next_u32()));
            } else {
                for (k, out) in out.iter_mut().enumerate() {
                    *out = count(x[k], rng.next_u32());
                }
            }
        }
    }
}

/// Light of every count of the drive's own cameras.
fn lights() -> &'static [f32; 256] {
    static LIGHTS: std::sync::OnceLock<[f32; 256]> = std::sync::OnceLock::new();
    LIGHTS.get_or_init(|| std::array::from_fn(|i| light_of_count(i as u8)))
}

/// A tone curve: from light that clips hard to a long shoulder, gammas, contrast and lifted blacks.
fn curve(rng: &mut ChaCha8Rng) -> Vec<f32> {
    let hard = rng.random::<f64>() < 0.5;
    // Light that becomes white.
    let white = if hard { log_uniform(rng, 0.5, 2.0) } else { log_uniform(rng, 1.5, 6.0) };
    let gamma = between(rng, 1.5, 2.5);
    let contrast = between(rng, -0.3, 1.0);
    let black = between(rng, -0.06, 0.06);
    let top = WHITE.sqrt();
    (0..=STEPS)
        .map(|i| {
            let x = (i as f32 / STEPS as f32 * top).powi(2);
            let y = if hard { x / white } else { x * (1.0 + x / (white * white)) / (1.0 + x) };
            let y = y.min(1.0).powf(1.0 / gamma);
            let y = y + contrast * (y * y * (3.0 - 2.0 * y) - y);
            // Lifted blacks, or crushed ones.
            (black + (1.0 - black) * y).clamp(0.0, 1.0) * 255.0
        })
        .collect()
}

/// Weights of a pixel and of its neighbours at one and two pixels for a softness of -1 (sharpened) to 1 (a deviation of 0.8 pixels).
fn kernel(softness: f32) -> [f32; 3] {
    let (sigma, share) = if softness > 0.0 { (0.8 * softness, 1.0) } else { (0.7, softness) };
    let weight = |d: f32| if sigma < 0.1 { f32::from(d == 0.0) } else { (-0.5 * (d / sigma).powi(2)).exp() };
    let raw = [weight(0.0), weight(1.0), weight(2.0)];
    let sum = raw[0] + 2.0 * (raw[1] + raw[2]);
    let blur = raw.map(|w| w / sum);
    [1.0 + share * (blur[0] - 1.0), share * blur[1], share * blur[2]]
}

/// The image through a symmetric, separable kernel; borders repeat, nothing falls below black.
fn filtered(image: &[Vec3], width: usize, height: usize, kernel: &[f32; 3]) -> Vec<Vec3> {
    let [a, b, c] = *kernel;
    let pass = |from: &[Vec3], along: usize, step: usize| -> Vec<Vec3> {
        let side = if step == 1 { width } else { height };
        (0..from.len())
            .map(|i| {
                let at = i / along % side;
                let near = |d: usize| (from[i - step * d.min(at)], from[i + step * d.min(side - 1 - at)]);
                let ((l1, r1), (l2, r2)) = (near(1), near(2));
                from[i] * a + (l1 + r1) * b + (l2 + r2) * c
            })
            .collect()
    };
    let across = pass(image, 1, 1);
    pass(&across, width, width).into_iter().map(|x| x.max(Vec3::ZERO)).collect()
}
