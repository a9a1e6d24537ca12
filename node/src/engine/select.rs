//! Which Gaussians of a scene go where: the published cloud, the map, the trackers.

use glam::{Quat, Vec3};
use storm_model::scene::{Affine, Scene};
use storm_render::Gaussians;

use crate::config::TracksConfig;
use crate::map::color01;
use crate::objects::ObjectPoint;
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
    let exposure = Affine::mean(&scene.affine);
    from_step(scene, first)
        .filter(|&i| speed_mps(scene, i) as f64 >= config.min_speed_mps && g.opacities[i] as f64 >= config.min_opacity)
        .map(|i| TrackPoint {
            position_map: map_from_anchor.apply(Vec3::from(g.means[i]).as_dvec3()),
            velocity_map_mps: map_from_anchor.rotation * Vec3::from(g.velocity_forward[i]).as_dvec3(),
            opacity: g.opacities[i],
            motion_id: g.motion_id(i),
            color01: color01(&exposure.apply(g.colors[i])),
            distance_m: scene.depths[i],
            may_start: true,
        })
        .collect()
}

/// The newest timestep's moving Gaussians as parts of objects, in map coordinates, and their numbers within the timestep.
pub fn object_points(
    scene: &Scene,
    first: usize,
    map_from_anchor: &Rigid,
    config: &TracksConfig,
) -> (Vec<usize>, Vec<ObjectPoint>) {
    let g = &scene.gaussians;
    let exposure = Affine::mean(&scene.affine);
    let turn = map_from_anchor.rotation.as_quat();
    let range = from_step(scene, first);
    let start = range.start;
    range
        .filter(|&i| speed_mps(scene, i) as f64 >= config.min_speed_mps && g.opacities[i] as f64 >= config.min_opacity)
        .map(|i| {
            let [w, x, y, z] = unit_quat(g.quats[i]);
            let point = ObjectPoint {
                position_map: map_from_anchor.apply(Vec3::from(g.means[i]).as_dvec3()),
                velocity_map_mps: map_from_anchor.rotation * Vec3::from(g.velocity_forward[i]).as_dvec3(),
                motion_id: g.motion_id(i),
                opacity: g.opacities[i],
                color01: color01(&exposure.apply(g.colors[i])),
                rotation: turn * Quat::from_xyzw(x, y, z, w),
                scale: g.scales[i].into(),
                distance_m: scene.depths[i],
            };
            (i - start, point)
        })
        .unzip()
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
