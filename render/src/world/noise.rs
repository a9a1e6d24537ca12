//! Value noise on lattices, faded out where a pixel covers more than a cell.

use glam::Vec2;

/// Lattice points repeat after this many cells: world-anchored coordinates wrap every 4096 m (`TEXTURE_PERIOD_M`), which is a
/// multiple of it for every power-of-two frequency from 1/16 per metre up.
const PERIOD: i32 = 1 << 8;

#[inline]
fn lattice(x: i32, y: i32, seed: u32) -> f32 {
    let (x, y) = ((x & (PERIOD - 1)) as u32, (y & (PERIOD - 1)) as u32);
    let mut h = x.wrapping_mul(0x9e37_79b1) ^ y.wrapping_mul(0x85eb_ca77) ^ seed.wrapping_mul(0xc2b2_ae3d);
    h ^= h >> 15;
    h = h.wrapping_mul(0x2c1b_3c6d);
    h ^= h >> 12;
    h = h.wrapping_mul(0x297a_2d39);
    h ^= h >> 15;
    h as f32 * (1.0 / 2_147_483_648.0) - 1.0
}

/// A number in -1..1 for a cell.
#[inline]
pub(crate) fn cell(p: Vec2, seed: u32) -> f32 {
    lattice(p.x.floor() as i32, p.y.floor() as i32, seed)
}

/// Smooth noise in -1..1 with cells of side 1.
#[inline]
pub(crate) fn noise(p: Vec2, seed: u32) -> f32 {
    let base = p.floor();
    let f = p - base;
    let f = f * f * (3.0 - 2.0 * f);
    let (x, y) = (base.x as i32, base.y as i32);
    let a = lattice(x, y, seed);
    let b = lattice(x + 1, y, seed);
    let c = lattice(x, y + 1, seed);
    let d = lattice(x + 1, y + 1, seed);
    let (low, high) = (a + (b - a) * f.x, c + (d - c) * f.x);
    low + (high - low) * f.y
}

/// Noise of `per_metre` cells per metre as a pixel that covers `foot` metres sees it.
#[inline]
pub(crate) fn grain(p: Vec2, per_metre: f32, foot: f32, seed: u32) -> f32 {
    let fade = (1.6 - 1.6 * foot * per_metre).clamp(0.0, 1.0);
    if fade > 0.0 { fade * noise(p * per_metre, seed) } else { 0.0 }
}

/// Share of the window `[x - foot/2, x + foot/2]` that lies in `[from, to]` of a pattern with period 1: exact box filtering.
#[inline]
pub(crate) fn pulse(x: f32, from: f32, to: f32, foot: f32) -> f32 {
    let foot = foot.max(1e-3);
    let integral = |x: f32| x.floor() * (to - from) + (x - x.floor() - from).clamp(0.0, to - from);
    (integral(x + 0.5 * foot) - integral(x - 0.5 * foot)) / foot
}

/// The same for one interval that does not repeat.
#[inline]
pub(crate) fn band(x: f32, from: f32, to: f32, foot: f32) -> f32 {
    let foot = foot.max(1e-3);
    ((x + 0.5 * foot).clamp(from, to) - (x - 0.5 * foot).clamp(from, to)) / foot
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn filters_match_dense_sampling() {
        for k in 0..200 {
            let (x, foot) = (k as f32 * 0.037 - 3.0, 0.05 + (k % 17) as f32 * 0.11);
            let mean = |f: &dyn Fn(f32) -> bool| {
                (0..2000).filter(|i| f(x - 0.5 * foot + foot * (*i as f32 + 0.5) / 2000.0)).count() as f32 / 2000.0
            };
            // Sampling 2000 points leaves 1/2000 per edge inside the window, f32 a little more.
            let inside = |y: f32| (0.2..0.7).contains(&(y - y.floor()));
            assert!((pulse(x, 0.2, 0.7, foot) - mean(&inside)).abs() < 4e-3);
            assert!((band(x, 0.2, 0.7, foot) - mean(&|y| (0.2..0.7).contains(&y))).abs() < 4e-3);
        }
    }

    #[test]
    fn noise_is_continuous_and_bounded() {
        let mut last = noise(Vec2::new(-5.0, 0.3), 7);
        for k in 1..5000 {
            let v = noise(Vec2::new(-5.0 + k as f32 * 0.002, 0.3), 7);
            assert!(v.abs() <= 1.0 && (v - last).abs() < 0.01);
            last = v;
        }
    }
}
