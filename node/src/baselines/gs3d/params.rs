//! What 3DGS optimises: one static Gaussian's numbers in their unconstrained form, all in arrays.

use std::num::NonZeroUsize;

use glam::{Quat, Vec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use storm_render::raster::SplatGradients;
use storm_render::raster::Splats;
use storm_render::{Gaussians, View};

use crate::baselines::adam::Adam;
use crate::dice::Dice;

/// Random points lie this far from their camera, metres, evenly in the logarithm: what a street shows.
const DEPTH_RANGE_M: [f32; 2] = [2.0, 200.0];
/// Opacity a random Gaussian starts with (3DGS).
const START_OPACITY: f32 = 0.1;
/// Neighbours whose mean distance a random Gaussian starts with (3DGS).
const NEIGHBOURS: usize = 3;
/// Smallest start scale, metres (3DGS clamps the squared distance at 1e-7).
const LEAST_SCALE_M: f32 = 3e-4;
/// Logits are kept inside this, where the sigmoid is within 1e-4 of its ends and still has a slope.
const LOGIT_LIMIT: f32 = 9.0;

/// Learning rates of 3DGS. Positions: times the scene's extent, exponentially down to a hundredth over the run.
const RATE_MEANS: [f32; 2] = [1.6e-4, 1.6e-6];
const RATE_SCALES: f32 = 5e-3;
const RATE_QUATS: f32 = 1e-3;
const RATE_OPACITY: f32 = 5e-2;
/// 2.5e-3 per spherical harmonic of degree 0; a colour of -1 to 1 is 0.5642 times that number.
const RATE_COLORS: f32 = 2.5e-3 * 0.564_189_6;
/// Adam's eps in 3DGS.
const EPS: f32 = 1e-15;

/// Static Gaussians while they are optimised. The frame is the caller's.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Params {
    /// Centres, metres.
    pub means: Vec<[f32; 3]>,
    /// Logarithms of the standard deviations in metres.
    pub log_scales: Vec<[f32; 3]>,
    /// Quaternions w, x, y, z, any length.
    pub quats: Vec<[f32; 4]>,
    /// Opacities before the sigmoid.
    pub logits: Vec<f32>,
    /// Colours, -1 to 1 is black to white.
    pub colors: Vec<[f32; 3]>,
}

fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

impl Params {
    /// From finished Gaussians; their motion is dropped.
    pub fn of_gaussians(g: &Gaussians) -> Self {
        let logit = |o: f32| (o / (1.0 - o)).ln().clamp(-LOGIT_LIMIT, LOGIT_LIMIT);
        Self {
            means: g.means.clone(),
            log_scales: g.scales.iter().map(|s| s.map(|x| x.max(LEAST_SCALE_M).ln())).collect(),
            quats: g.quats.clone(),
            logits: g.opacities.iter().map(|&o| logit(o)).collect(),
            colors: g.colors.clone(),
        }
    }

    /// One Gaussian on the ray of every pixel of `pictures` (view and colours of 0-1) at a random distance, in the pixel's
    /// colour; size and opacity as 3DGS starts points with. Nothing but the pictures and their poses is used.
    pub fn random(pictures: &[(View, &[f32])], seed: u64) -> Self {
        let mut dice = Dice::new(seed);
        let mut out = Self::default();
        let [near, far] = DEPTH_RANGE_M;
        for (view, rgb01) in pictures {
            let pose = view.world_from_camera();
            for (i, color) in rgb01.chunks_exact(3).enumerate() {
                let width = view.intrinsics.width.max(1);
                let (u, v) = ((i % width) as f32 + 0.5, (i / width) as f32 + 0.5);
                let depth = near * (far / near).powf(dice.unit());
                out.means.push(pose.transform_point3(view.intrinsics.ray(u, v) * depth).to_array());
                out.colors.push([color[0], color[1], color[2]].map(|c| 2.0 * c - 1.0));
            }
        }
        let n = out.means.len();
        out.log_scales = start_scales(&out.means).into_iter().map(|s| [s.max(LEAST_SCALE_M).ln(); 3]).collect();
        out.quats = vec![[1.0, 0.0, 0.0, 0.0]; n];
        out.logits = vec![(START_OPACITY / (1.0 - START_OPACITY)).ln(); n];
        out
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// True when there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Standard deviations and opacities as the rasteriser takes them.
    pub fn activated(&self, scales: &mut Vec<[f32; 3]>, opacities: &mut Vec<f32>) {
        scales.clear();
        scales.extend(self.log_scales.iter().map(|s| s.map(f32::exp)));
        opacities.clear();
        opacities.extend(self.logits.iter().map(|&x| sigmoid(x)));
    }

    /// What the rasteriser draws; `scales` and `opacities` are those of [`Params::activated`].
    pub fn splats<'a>(&'a self, scales: &'a [[f32; 3]], opacities: &'a [f32]) -> Splats<'a> {
        Splats {
            means: &self.means,
            quats: &self.quats,
            scales,
            opacities,
            features: bytemuck::cast_slice(&self.colors),
            feature_count: 3,
        }
    }

    /// Finished Gaussians that stand still, seen at time 0.
    pub fn gaussians(&self) -> Gaussians {
        let n = self.len();
        let (mut scales, mut opacities) = (Vec::new(), Vec::new());
        self.activated(&mut scales, &mut opacities);
        Gaussians {
            means: self.means.clone(),
            quats: self.quats.iter().map(|&[w, x, y, z]| unit(w, x, y, z)).collect(),
            scales,
            opacities,
            colors: self.colors.clone(),
            velocity_backward: vec![[0.0; 3]; n],
            velocity_forward: vec![[0.0; 3]; n],
            time_sec: vec![0.0; n],
            motion_count: 0,
            motion_weights: Vec::new(),
        }
    }
}

fn unit(w: f32, x: f32, y: f32, z: f32) -> [f32; 4] {
    let q = Quat::from_xyzw(x, y, z, w);
    let q = if q.length_squared() > 1e-12 { q.normalize() } else { Quat::IDENTITY };
    [q.w, q.x, q.y, q.z]
}

/// Root of the mean squared distance to the nearest neighbours, metres.
fn start_scales(means: &[[f32; 3]]) -> Vec<f32> {
    let fallback = || vec![1.0; means.len()];
    let Some(wanted) = NonZeroUsize::new(NEIGHBOURS + 1) else { return fallback() };
    let tree = ImmutableKdTree::<f32, 3>::builder().with_serial_construction().build_from_slice(means);
    let Ok(tree) = tree else { return fallback() };
    means
        .iter()
        .map(|m| {
            // The nearest is the point itself.
            let near = tree.query(m).nearest_n::<SquaredEuclidean<f32>>(wanted).execute();
            let others = near.len().saturating_sub(1).max(1) as f32;
            (near.iter().map(|hit| hit.distance).sum::<f32>() / others).sqrt()
        })
        .collect()
}

/// Adam over all arrays, with the learning rates of 3DGS.
pub struct Optimizer {
    extent_m: f32,
    means: Adam,
    scales: Adam,
    quats: Adam,
    logits: Adam,
    colors: Adam,
}

impl Optimizer {
    /// For `n` Gaussians; `extent_m` is the radius of the cameras' places.
    pub fn new(n: usize, extent_m: f32) -> Self {
        let adam = |k: usize| Adam::new(n * k, EPS);
        Self { extent_m, means: adam(3), scales: adam(3), quats: adam(4), logits: adam(1), colors: adam(3) }
    }

    /// One step; `g` is with respect to what was drawn, and is turned into the parameters' own gradient in place.
    /// `progress` runs from 0 to 1 over the optimisation.
    pub fn step(
        &mut self,
        p: &mut Params,
        g: &mut SplatGradients,
        scales: &[[f32; 3]],
        opacities: &[f32],
        progress: f32,
    ) {
        for (g, s) in g.scales.iter_mut().zip(scales) {
            (0..3).for_each(|k| g[k] *= s[k]);
        }
        for (g, o) in g.opacities.iter_mut().zip(opacities) {
            *g *= o * (1.0 - o);
        }
        let [from, to] = RATE_MEANS;
        let rate = self.extent_m * from * (to / from).powf(progress);
        self.means.step(bytemuck::cast_slice_mut(&mut p.means), bytemuck::cast_slice(&g.means), rate);
        self.scales.step(bytemuck::cast_slice_mut(&mut p.log_scales), bytemuck::cast_slice(&g.scales), RATE_SCALES);
        self.quats.step(bytemuck::cast_slice_mut(&mut p.quats), bytemuck::cast_slice(&g.quats), RATE_QUATS);
        self.logits.step(&mut p.logits, &g.opacities, RATE_OPACITY);
        self.colors.step(bytemuck::cast_slice_mut(&mut p.colors), &g.features, RATE_COLORS);
    }
}

/// Radius of the cameras' places as 3DGS takes it (1.1 times the largest distance from their mean), at least `least_m`.
pub fn extent_m(centres: &[Vec3], least_m: f32) -> f32 {
    let mean = centres.iter().sum::<Vec3>() / centres.len().max(1) as f32;
    centres.iter().map(|c| 1.1 * c.distance(mean)).fold(least_m, f32::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn start_scales_are_the_neighbours_distances() {
        let line: Vec<[f32; 3]> = (0..8).map(|i| [2.0 * i as f32, 0.0, 0.0]).collect();
        let scales = start_scales(&line);
        // Inside: neighbours at 2, 2, 4; at the end: 2, 4, 6.
        assert!((scales[3] - (24f32 / 3.0).sqrt()).abs() < 1e-5, "{scales:?}");
        assert!((scales[0] - (56f32 / 3.0).sqrt()).abs() < 1e-5, "{scales:?}");
        assert_eq!(start_scales(&[[1.0; 3]]).len(), 1);
        assert!(start_scales(&[]).is_empty());
    }

    #[test]
    fn gaussians_come_back_as_they_went_in() {
        let g = Gaussians {
            means: vec![[1.0, 2.0, 3.0]],
            quats: vec![[0.0, 0.0, 2.0, 0.0]],
            scales: vec![[0.1, 0.2, 0.3]],
            opacities: vec![0.7],
            colors: vec![[0.5, -0.5, 0.0]],
            velocity_backward: vec![[9.0; 3]],
            velocity_forward: vec![[9.0; 3]],
            time_sec: vec![1.0],
            motion_count: 0,
            motion_weights: Vec::new(),
        };
        let back = Params::of_gaussians(&g).gaussians();
        assert_eq!(back.quats, [[0.0, 0.0, 1.0, 0.0]]);
        assert_eq!(back.velocity_forward, [[0.0; 3]]);
        assert!((back.opacities[0] - 0.7).abs() < 1e-6);
        (0..3).for_each(|k| assert!((back.scales[0][k] - g.scales[0][k]).abs() < 1e-6));
        let full = Params::of_gaussians(&Gaussians { opacities: vec![1.0], ..g });
        assert!(full.logits[0].is_finite());
    }

    #[test]
    fn the_extent_is_the_radius_of_the_places() {
        let places = [Vec3::ZERO, Vec3::X * 20.0];
        assert!((extent_m(&places, 5.0) - 11.0).abs() < 1e-5);
        assert_eq!(extent_m(&places[..1], 5.0), 5.0);
        assert_eq!(extent_m(&[], 5.0), 5.0);
    }
}
