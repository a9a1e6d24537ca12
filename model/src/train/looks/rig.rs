//! Lenses of real vehicles' cameras.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Least and most field of view across, degrees.
const FOV_DEG: [f64; 2] = [35.0, 105.0];
/// Sides of the images that cameras give, or that are left of them after cutting and rectifying: width over height. Networks take
/// them squeezed to their own sides, so pixels are not square.
const ASPECTS: [f64; 7] = [4.0 / 3.0, 1.5, 1.6, 16.0 / 9.0, 2.0, 2.4, 3.3];
/// Field of view of a drive's own front camera, degrees.
const OWN_FOV_DEG: f64 = 50.0;

/// Factors on the focal lengths across and down for images of `width` x `height`.
pub(in crate::train) fn zoom(seed: u64, width: usize, height: usize) -> [f32; 2] {
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x4c4f_4f4b_5332);
    let [low, high] = FOV_DEG;
    let fov = low * (high / low).powf(rng.random::<f64>());
    let aspect = ASPECTS[rng.random_range(0..ASPECTS.len())];
    let half = |degrees: f64| (0.5 * degrees).to_radians().tan();
    let across = half(OWN_FOV_DEG) / half(fov);
    let down = across * aspect * height as f64 / width as f64;
    [across as f32, down as f32]
}
