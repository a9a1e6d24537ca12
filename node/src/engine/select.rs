//! Which Gaussians of a scene go where: the published cloud, the map, the trackers.

use glam::Vec3;
use storm_model::scene::Scene;
use storm_render::Gaussians;

use crate::config::TracksConfig;
use crate::rigid::Rigid;
use crate::tracks::TrackPoint;

/// Coverage from which a pixel shows a surface and not the sky.
pub const SURFACE_OPACITY: f32 = 0.5;
/// Rendered speed from which a pixel counts as moving, m/s (the authors' flow gate).
pub const MOVING_MPS: f32 = 1.0;

/// Speed a Gaussian counts with, m/s: the larger of its two velocities.
pub fn speed_mps(scene: &Scene, i: usize) -> f32 {
    let forward = Vec3::from(scene.gaussians.velocity_forward[i]).length();
    forward.max(Vec3::from(scene.gaussians.velocity_backward[i]).length())
}

/// Indices of the Gaussians seen at timesteps `first..`.
pub fn from_step(scene: &Scene, first: usize) -> std::ops::Range<usize> {
    scene.shape.picture(first, 0).start..scene.gaussians.len()
}

/// The newest timestep's moving Gaussians in map coordinates.
pub fn moving_points(scene: &Scene, first: usize, map_from_anchor: &Rigid, config: &TracksConfig) -> Vec<TrackPoint> {
    let g = &scene.gaussians;
    from_step(scene, first)
        .filter(|&i| speed_mps(scene, i) as f64 >= config.min_speed_mps && g.opacities[i] as f64 >= config.min_opacity)
        .map(|i| TrackPoint {
            position_map: map_from_anchor.apply(Vec3::from(g.means[i]).as_dvec3()),
            velocity_map_mps: map_from_anchor.rotation * Vec3::from(g.velocity_forward[i]).as_dvec3(),
            opacity: g.opacities[i],
            motion_id: g.motion_id(i),
        })
        .collect()
}

/// Indices of the Gaussians that are published: at least `min_opacity`, and at most `limit` of the most opaque (0: no
/// limit). Second: how many the limit left out.
pub fn opaque_enough(g: &Gaussians, min_opacity: f64, limit: usize) -> (Vec<usize>, usize) {
    let mut picked: Vec<usize> = (0..g.len()).filter(|&i| g.opacities[i] as f64 >= min_opacity).collect();
    if limit == 0 || picked.len() <= limit {
        return (picked, 0);
    }
    let left_out = picked.len() - limit;
    picked.sort_by(|&a, &b| g.opacities[b].total_cmp(&g.opacities[a]).then(a.cmp(&b)));
    picked.truncate(limit);
    picked.sort_unstable();
    (picked, left_out)
}

/// The quaternion at unit length; no rotation where it has none.
pub fn unit_quat(q: [f32; 4]) -> [f32; 4] {
    let n = q.iter().map(|x| x * x).sum::<f32>().sqrt();
    if n.is_finite() && n > 1e-12 { q.map(|x| x / n) } else { [1.0, 0.0, 0.0, 0.0] }
}
