//! Per-scene optimisation of static Gaussians (3DGS, Kerbl et al., 2023) from a window's pictures alone, with this program's
//! own rasteriser.
//!
//! As 3DGS: loss, Adam, learning rates and their schedule, start sizes, one random picture per iteration. Left out:
//! densification and opacity resets, since the start holds a Gaussian for every pixel already; spherical harmonics beyond
//! degree 0. The paper's baselines run 5,000 iterations.

mod loss;
mod params;

use std::sync::Arc;

use anyhow::{Result, ensure};
use glam::Vec3;
use storm_model::scene::Affine;
use storm_render::View;
use storm_render::raster::{CpuRasterizer, PictureGradient, RasterSettings, SplatGradients};

pub use loss::Reference;
pub use params::{Optimizer, Params, extent_m};

use crate::dice::Dice;

/// Iterations of the paper's per-scene baselines.
pub const ITERATIONS: u64 = 5_000;
/// Least extent, metres: a vehicle that stands still must still be able to move points.
const LEAST_EXTENT_M: f32 = 5.0;

/// One picture to reproduce.
pub struct Target {
    /// From where it was taken, in the Gaussians' frame.
    pub view: View,
    /// The picture.
    pub picture: Reference,
    /// Colours behind the Gaussians, one per pixel; empty: mid-grey (0).
    pub sky: Vec<[f32; 3]>,
    /// Applied to the drawn colours.
    pub exposure: Affine,
    /// Pixels to reproduce, row by row; none: all.
    pub valid: Option<Arc<[bool]>>,
}

/// Hears the number of iterations done and the Gaussians then; false: enough.
pub type Tick<'a> = dyn FnMut(u64, &Params) -> Result<bool> + 'a;

/// Optimises `params` in place and gives the loss of every iteration.
pub fn fit(
    params: &mut Params,
    targets: &[Target],
    settings: RasterSettings,
    iterations: u64,
    seed: u64,
    tick: &mut Tick,
) -> Result<Vec<f64>> {
    ensure!(!targets.is_empty(), "no pictures to fit Gaussians to");
    let mut raster = CpuRasterizer::new(settings)?;
    let centres: Vec<Vec3> = targets.iter().map(|t| t.view.world_from_camera().translation.into()).collect();
    let mut optimizer = Optimizer::new(params.len(), extent_m(&centres, LEAST_EXTENT_M));
    let (mut scales, mut opacities) = (Vec::new(), Vec::new());
    let mut gradients = SplatGradients::default();
    let (mut pictures, mut losses) = (Vec::new(), Vec::new());
    let mut dice = Dice::new(seed);
    let mut stack: Vec<usize> = Vec::new();
    for iteration in 0..iterations {
        // Every picture once in random order, then again.
        if stack.is_empty() {
            stack.extend(0..targets.len());
            dice.shuffle(&mut stack);
        }
        let Some(target) = stack.pop().and_then(|i| targets.get(i)) else { break };
        params.activated(&mut scales, &mut opacities);
        let splats = params.splats(&scales, &opacities);
        let views = [target.view];
        raster.render_into(&splats, &views, &mut pictures)?;
        let (loss, upstream) = target.loss(&pictures[0].features, &pictures[0].alpha);
        ensure!(loss.is_finite(), "the loss of iteration {iteration} is {loss}");
        raster.backward_into(&splats, &views, &pictures, &[upstream], &mut gradients)?;
        optimizer.step(params, &mut gradients, &scales, &opacities, iteration as f32 / iterations as f32);
        losses.push(loss);
        if !tick(iteration + 1, params)? {
            break;
        }
    }
    Ok(losses)
}

impl Target {
    /// The loss of what was drawn, and its gradient with respect to it.
    fn loss(&self, features: &[f32], alpha: &[f32]) -> (f64, PictureGradient) {
        let sky = |i: usize| self.sky.get(i).copied().unwrap_or_default();
        let mut seen = Vec::with_capacity(features.len());
        for (i, c) in features.chunks_exact(3).enumerate() {
            let (gap, behind) = (1.0 - alpha[i], sky(i));
            let shown = self.exposure.apply([0, 1, 2].map(|k| c[k] + gap * behind[k]));
            seen.extend(shown.map(|x| 0.5 * x + 0.5));
        }
        let hidden = |i: usize| self.valid.as_ref().is_some_and(|valid| valid.get(i / 3) == Some(&false));
        if self.valid.is_some() {
            (0..seen.len()).filter(|&i| hidden(i)).for_each(|i| seen[i] = self.picture.value(i));
        }
        let (loss, mut by_seen) = self.picture.compare(&seen);
        if self.valid.is_some() {
            (0..seen.len()).filter(|&i| hidden(i)).for_each(|i| by_seen[i] = 0.0);
        }
        let mut upstream =
            PictureGradient { features: Vec::with_capacity(features.len()), alpha: Vec::new(), depth: Vec::new() };
        let m = &self.exposure.matrix;
        for (i, g) in by_seen.chunks_exact(3).enumerate() {
            let by_color = [0, 1, 2].map(|k| 0.5 * (m[0][k] * g[0] + m[1][k] * g[1] + m[2][k] * g[2]));
            upstream.features.extend(by_color);
            let behind = sky(i);
            upstream.alpha.push(-(0..3).map(|k| by_color[k] * behind[k]).sum::<f32>());
        }
        (loss, upstream)
    }
}

#[cfg(test)]
mod tests {
    use glam::{Affine3A, Quat};
    use storm_render::Intrinsics;

    use super::*;

    const W: usize = 24;
    const H: usize = 16;

    /// A wall of coloured Gaussians seen by two cameras, and what they see.
    fn wall() -> (Params, Vec<(View, Vec<f32>)>) {
        let k = Intrinsics::from_fov(60.0, W, H);
        let mut p = Params::default();
        for i in 0..160 {
            let (x, y) = ((i % 16) as f32 - 7.5, (i / 16) as f32 - 4.5);
            p.means.push([0.6 * x, 0.6 * y, 8.0]);
            p.colors.push([(x * 0.7).sin(), (y * 0.9).cos(), (x + y).sin() * 0.5]);
        }
        p.log_scales = vec![[-1.0; 3]; 160];
        p.quats = vec![[1.0, 0.0, 0.0, 0.0]; 160];
        p.logits = vec![2.0; 160];
        let views = [-0.4f32, 0.5].map(|x| {
            let pose = Affine3A::from_rotation_translation(Quat::from_rotation_y(0.05 * x), Vec3::new(x, 0.0, 0.0));
            View::from_pose(pose, k)
        });
        let (mut scales, mut opacities) = (Vec::new(), Vec::new());
        p.activated(&mut scales, &mut opacities);
        let splats = p.splats(&scales, &opacities);
        let drawn = CpuRasterizer::new(RasterSettings::default()).unwrap().render(&splats, &views).unwrap();
        let rgb = drawn.iter().map(|d| d.features.iter().map(|x| 0.5 * x + 0.5).collect());
        (p.clone(), views.into_iter().zip(rgb).collect())
    }

    fn targets(seen: &[(View, Vec<f32>)]) -> Vec<Target> {
        let target = |(view, rgb): &(View, Vec<f32>)| Target {
            view: *view,
            picture: Reference::new(rgb, W, H),
            sky: Vec::new(),
            exposure: Affine::IDENTITY,
            valid: None,
        };
        seen.iter().map(target).collect()
    }

    fn mean(x: &[f64]) -> f64 {
        x.iter().sum::<f64>() / x.len() as f64
    }

    #[test]
    fn random_points_learn_the_pictures_and_do_so_twice_alike() {
        let (_, seen) = wall();
        let pictures: Vec<(View, &[f32])> = seen.iter().map(|(v, rgb)| (*v, rgb.as_slice())).collect();
        let start = Params::random(&pictures, 5);
        assert_eq!(start.len(), 2 * W * H);
        let run = || {
            let mut p = start.clone();
            let losses = fit(&mut p, &targets(&seen), RasterSettings::default(), 300, 9, &mut |_, _| Ok(true)).unwrap();
            (p, losses)
        };
        let (a, losses) = run();
        let (first, last) = (mean(&losses[..20]), mean(&losses[280..]));
        assert!(last < 0.35 * first, "{first} to {last}");
        assert_eq!(run(), (a, losses));
        let mut p = start.clone();
        let stopped = fit(&mut p, &targets(&seen), RasterSettings::default(), 300, 9, &mut |n, _| Ok(n < 5)).unwrap();
        assert_eq!(stopped.len(), 5);
    }

    #[test]
    fn the_answer_is_kept_and_sky_and_exposure_pass_their_gradients() {
        let (truth, seen) = wall();
        let mut p = truth.clone();
        let losses = fit(&mut p, &targets(&seen), RasterSettings::default(), 4, 1, &mut |_, _| Ok(true)).unwrap();
        assert!(losses[0] < 1e-6, "{}", losses[0]);
        // Central differences through sky and exposure.
        let mut target = targets(&seen).remove(0);
        target.sky = vec![[0.4, -0.2, 0.9]; W * H];
        target.exposure.matrix = [[1.1, 0.1, 0.0], [0.0, 0.8, 0.2], [0.1, 0.0, 0.9]];
        target.exposure.bias = [0.1, 0.0, -0.2];
        let (features, alpha) = (vec![0.2f32; 3 * W * H], vec![0.6f32; W * H]);
        let (_, g) = target.loss(&features, &alpha);
        // An f32 picture in an f64 sum: rounding of 1e-8 over the step.
        let step = 4e-3f32;
        for i in [0, 100, 371] {
            let at = |d: f32| {
                let mut f = features.clone();
                f[i] += d;
                target.loss(&f, &alpha).0
            };
            let slope = (at(step) - at(-step)) / f64::from(2.0 * step);
            assert!((slope - f64::from(g.features[i])).abs() < 2e-5, "{slope} {}", g.features[i]);
            let at = |d: f32| {
                let mut a = alpha.clone();
                a[i] += d;
                target.loss(&features, &a).0
            };
            let slope = (at(step) - at(-step)) / f64::from(2.0 * step);
            assert!((slope - f64::from(g.alpha[i])).abs() < 2e-5, "{slope} {}", g.alpha[i]);
        }
        assert!(fit(&mut p, &[], RasterSettings::default(), 1, 1, &mut |_, _| Ok(true)).is_err());
    }
}
