//! The per-frame setting (GS-LRM in the paper): the network sees each timestep alone, nothing moves.

use anyhow::{Context, Result};
use glam::{Quat, Vec3};
use storm_model::scene::{Scene, SceneShape};
use storm_render::Gaussians;

use super::Clip;
use super::prediction::{Placed, still};
use crate::engine::Engine;
use crate::rigid::Rigid;
use crate::window::{Window, camera_from_flu, relative};

/// Which Gaussians a picture is drawn from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Use {
    /// Those of all timesteps.
    All,
    /// Those of the nearest timestep.
    Nearest,
}

/// One scene per timestep, in that timestep's own frame, with its sky and exposure.
pub(super) fn scenes(clip: &Clip, engine: &mut Engine, which: Use) -> Result<Vec<Placed>> {
    let mut single = Vec::new();
    for set in &clip.window.steps {
        let reference = set.frames.get(clip.reference).context("no reference camera")?;
        let window = Window {
            epoch: clip.window.epoch,
            stamp_ns: set.stamp_ns,
            map_from_anchor: reference.map_from_camera * camera_from_flu(),
            steps: vec![set.clone()],
            prior: Vec::new(),
            time_sec: vec![vec![0.0; set.frames.len()]],
        };
        let scene = still(engine.step(&window, &clip.cameras)?);
        let stamp_ns = set.stamp_ns;
        single.push(Placed { stamp_ns, map_from_anchor: window.map_from_anchor, scene, pixel_aligned: true });
    }
    Ok(match which {
        Use::Nearest => single,
        Use::All => (0..single.len()).map(|k| together(&single, k)).collect(),
    })
}

/// All Gaussians in the frame of timestep `k`, before its sky and with its exposure.
fn together(single: &[Placed], k: usize) -> Placed {
    let base = &single[k];
    let mut gaussians = Gaussians { motion_count: base.scene.gaussians.motion_count, ..Gaussians::default() };
    let masked = single.iter().any(|one| !one.scene.valid.is_empty());
    let (mut depths, mut valid) = (Vec::new(), Vec::new());
    for other in single {
        append(&mut gaussians, &other.scene.gaussians, &relative(&base.map_from_anchor, &other.map_from_anchor));
        depths.extend_from_slice(&other.scene.depths);
        if masked {
            valid.extend((0..other.scene.shape.len()).map(|i| other.scene.is_valid(i)));
        }
    }
    let shape = SceneShape { timesteps: single.len(), ..base.scene.shape };
    let scene = Scene { gaussians, shape, depths, valid, ..base.scene.clone() };
    Placed { stamp_ns: base.stamp_ns, map_from_anchor: base.map_from_anchor, scene, pixel_aligned: true }
}

fn append(to: &mut Gaussians, from: &Gaussians, to_from_from: &Rigid) {
    let pose = to_from_from.to_f32();
    let rotation = to_from_from.rotation.as_quat();
    to.means.extend(from.means.iter().map(|&m| pose.transform_point3(Vec3::from(m)).to_array()));
    to.quats.extend(from.quats.iter().map(|&[w, x, y, z]| {
        let q = rotation * Quat::from_xyzw(x, y, z, w);
        [q.w, q.x, q.y, q.z]
    }));
    to.scales.extend_from_slice(&from.scales);
    to.opacities.extend_from_slice(&from.opacities);
    to.colors.extend_from_slice(&from.colors);
    to.velocity_backward.extend_from_slice(&from.velocity_backward);
    to.velocity_forward.extend_from_slice(&from.velocity_forward);
    to.time_sec.extend_from_slice(&from.time_sec);
    to.motion_weights.extend_from_slice(&from.motion_weights);
}
