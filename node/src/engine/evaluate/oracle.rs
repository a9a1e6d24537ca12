//! Ceilings: the ground truth's depth and flow with the pictures' colours, as pixel-aligned Gaussians.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::{Quat, Vec3};
use storm_model::config::ModelConfig;
use storm_model::scene::{Scene, SceneShape};
use storm_render::Gaussians;

use super::clip::unproject;
use super::{Clip, ClipFrame};

/// Standard deviation of a Gaussian in its own picture, pixels, before the rasteriser's blur (which closes the gaps). Of 0.3,
/// 0.45 and 0.6 the smallest gave the best pictures at 96x64: 24.3, 24.0, 23.4 dB over seeds 10,000 to 10,002.
const FOOTPRINT_PX: f32 = 0.3;
/// The sky lies at this part of the far plane.
const SKY_OF_FAR: f32 = 0.9;

/// Which velocity Gaussians get.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Motion {
    /// Their pixel's own.
    PerPixel,
    /// Their object's at its first appearance in the context, one for all its pixels.
    PerInstance,
}

/// The scene; `None` without ground-truth depth, flow and instances.
pub(super) fn scene(clip: &Clip, config: &Arc<ModelConfig>, motion: Motion) -> Option<Scene> {
    let context: Vec<&ClipFrame> = clip.context().map(|(_, frame)| frame).collect();
    let first = first_velocities(&context)?;
    // Group 0 is what stands still; the others are the objects that ever move.
    let groups: BTreeMap<u16, usize> = first.keys().enumerate().map(|(k, &id)| (id, k + 1)).collect();
    let motion_count = groups.len() + 1;
    let mut g = Gaussians { motion_count, ..Gaussians::default() };
    let mut depths = Vec::new();
    let sky_depth = SKY_OF_FAR * config.far as f32;
    let anchor_from_map = clip.window.map_from_anchor.rotation.as_quat().conjugate();
    for (step, frame) in context.iter().enumerate() {
        for (camera, view) in clip.views(step).iter().enumerate() {
            let truth = frame.truth.get(camera)?;
            let (depth, flow) = (truth.depth.as_ref()?, truth.flow.as_ref()?);
            let instance = truth.instance.as_ref()?;
            let picture = &frame.set.frames.get(camera)?.item.rgb.data;
            let k = &view.intrinsics;
            let rotation = Quat::from_mat3a(&view.world_from_camera().matrix3);
            let time_sec = *clip.window.time_sec.get(step)?.get(camera)? as f32;
            for (i, color) in picture.chunks_exact(3).enumerate() {
                let known = depth[i] > 0.0;
                let z = if known { depth[i] } else { sky_depth };
                let velocity = match motion {
                    Motion::PerPixel => flow[i],
                    Motion::PerInstance => first.get(&instance[i]).copied().unwrap_or_default(),
                };
                let velocity = if known { (anchor_from_map * Vec3::from(velocity)).to_array() } else { [0.0; 3] };
                let size = [k.fx, k.fy].map(|f| FOOTPRINT_PX * z / f);
                g.means.push(unproject(view, i, z).to_array());
                g.quats.push([rotation.w, rotation.x, rotation.y, rotation.z]);
                g.scales.push([size[0], size[1], size[0].min(size[1])]);
                g.opacities.push(if truth.is_valid(i) { 1.0 } else { 0.0 });
                g.colors.push([color[0], color[1], color[2]].map(|c| f32::from(c) / 127.5 - 1.0));
                g.velocity_backward.push(velocity);
                g.velocity_forward.push(velocity);
                g.time_sec.push(time_sec);
                depths.push(z);
                let row = g.motion_weights.len();
                g.motion_weights.resize(row + motion_count, 0.0);
                g.motion_weights[row + groups.get(&instance[i]).copied().unwrap_or(0)] = 1.0;
            }
        }
    }
    let camera = clip.cameras.first()?;
    let shape = SceneShape {
        timesteps: context.len(),
        cameras: clip.cameras.len(),
        height: camera.height,
        width: camera.width,
    };
    // The true flow needs no gate against noise.
    let config = Arc::new(ModelConfig { flow_gate_mps: 0.0, time_fade_sec: 0.0, ..ModelConfig::clone(config) });
    let motion_bases = Vec::new();
    (g.len() == shape.len()).then_some(Scene {
        gaussians: g,
        shape,
        depths,
        valid: Vec::new(),
        sky: None,
        affine: Vec::new(),
        motion_bases,
        config,
    })
}

/// Mean flow of every moving object's pixels, all cameras together, in the first context frame that shows it, map axes.
fn first_velocities(context: &[&ClipFrame]) -> Option<BTreeMap<u16, [f32; 3]>> {
    let mut first: BTreeMap<u16, [f32; 3]> = BTreeMap::new();
    for frame in context {
        let mut sums: BTreeMap<u16, ([f64; 3], f64)> = BTreeMap::new();
        for truth in &frame.truth {
            for (&id, v) in truth.instance.as_ref()?.iter().zip(truth.flow.as_ref()?) {
                if id != 0 {
                    let (sum, count) = sums.entry(id).or_default();
                    (0..3).for_each(|k| sum[k] += f64::from(v[k]));
                    *count += 1.0;
                }
            }
        }
        for (id, (sum, count)) in sums {
            first.entry(id).or_insert(sum.map(|x| (x / count) as f32));
        }
    }
    first.retain(|_, v| *v != [0.0; 3]);
    Some(first)
}
