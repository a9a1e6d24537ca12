//! What of a network's scene goes into the map.

use glam::Vec3;
use rayon::prelude::*;
use storm_model::scene::{Affine, RenderedView, Scene};
use storm_render::Intrinsics;

use crate::config::MapConfig;
use crate::engine::select::{SURFACE_OPACITY, speed_mps};
use crate::rigid::Rigid;
use crate::window::relative;

use super::fuse::MapWindow;
use super::place::Eye;
use super::{DepthView, MapCounts, StaticMap, color01, static_weight};

/// A pixel less opaque than this shows the sky: rays go on without end. (Between this and a surface nothing is said.)
const SKY_OPACITY: f32 = 0.1;

/// Weight of a picture that an earlier window has brought in already: its new prediction is no new look, but its
/// errors are others. The pictures of a window of four are predicted four times; together that is worth about one more.
const REPEAT_SHARE: f32 = 0.25;

/// A step's scene and where its pictures were taken.
#[derive(Debug, Clone, Copy)]
pub struct SceneLook<'a> {
    /// Stamp of the newest timestep, nanoseconds.
    pub stamp_ns: i64,
    /// The window's anchor in the map.
    pub map_from_anchor: &'a Rigid,
    /// The scene, in the anchor frame.
    pub scene: &'a Scene,
    /// One per camera, at the scene's picture size.
    pub cameras: &'a [Intrinsics],
    /// map_from_camera per picture, timestep by timestep.
    pub poses: &'a [Rigid],
    /// The newest timestep as the scene shows it, with flow, one per camera; empty: the Gaussians' own speed decides.
    pub rendered: &'a [RenderedView],
    /// How far each Gaussian's place is borne out by other looks, 0 to 1, 0.5 where nothing is known; empty: all alike.
    pub confidence: &'a [f32],
    /// First timestep that no earlier window had.
    pub first_new: usize,
}

impl StaticMap {
    /// Brings in what stands still of a scene: speed below the gate, drawn and its own, in a motion group that stands,
    /// and not beside something that moves. Timesteps that were brought in before refine what is there and start
    /// nothing new; the newest pictures take away what they see through.
    pub fn fuse_scene(&mut self, look: &SceneLook) -> MapCounts {
        let (scene, shape) = (look.scene, look.scene.shape);
        let pictures = shape.timesteps * shape.cameras;
        let n = scene.gaussians.len();
        let whole = look.poses.len() == pictures && look.cameras.len() == shape.cameras && n == shape.len();
        if !(whole && pictures > 0 && scene.depths.len() == n) {
            let counts = MapCounts { rejected: n as u64, ..Default::default() };
            self.counts.add(&counts);
            return counts;
        }
        let eyes: Vec<Eye> = (0..pictures)
            .map(|p| Eye {
                position: relative(look.map_from_anchor, &look.poses[p]).translation.as_vec3(),
                pixel_rad: 1.0 / look.cameras[p % shape.cameras].fx,
            })
            .collect();
        let standing = standing(look, &self.config);
        let views = depth_views(look);
        let exposure = Affine::mean(&scene.affine);
        let pixels = shape.height * shape.width;
        let window = MapWindow {
            stamp_ns: look.stamp_ns,
            map_from_anchor: look.map_from_anchor,
            gaussians: &scene.gaussians,
            eyes: &eyes,
            pixels,
            first_new: look.first_new * shape.cameras * pixels,
            views: &views,
        };
        let config = self.config.clone();
        let select = |i: usize| {
            let borne_out = 2.0 * look.confidence.get(i).copied().unwrap_or(0.5);
            let share = if i < window.first_new { REPEAT_SHARE * borne_out } else { borne_out };
            let weight = || static_weight(&config, scene.gaussians.opacities[i], 0.0, scene.depths[i]);
            if standing[i] { weight().map(|w| w * share) } else { None }
        };
        self.fuse(&window, select, |i| color01(&exposure.apply(scene.gaussians.colors[i])))
    }
}

/// Per Gaussian, whether it stands still.
fn standing(look: &SceneLook, config: &MapConfig) -> Vec<bool> {
    let (scene, shape) = (look.scene, look.scene.shape);
    let g = &scene.gaussians;
    let (w, h) = (shape.width, shape.height);
    let pixels = w * h;
    let gate = config.static_speed_mps as f32;
    let grouped = g.motion_count > 0;
    // Phrased so that a speed that is no number counts as moving.
    let (mut moves, groups): (Vec<bool>, Vec<u16>) = (0..g.len())
        .into_par_iter()
        .with_min_len(1024)
        .map(|i| {
            let stands = speed_mps(scene, i) <= gate;
            (!stands, if grouped { g.motion_id(i) } else { 0 })
        })
        .unzip();
    let group_moves = moving_groups(look, config, &moves, &groups);
    let newest = (shape.timesteps - 1) * shape.cameras;
    for (c, view) in look.rendered.iter().enumerate().take(shape.cameras) {
        let Some(flow) = view.flow.as_ref().filter(|f| f.len() == pixels) else { continue };
        for (p, v) in flow.iter().enumerate() {
            let stands = Vec3::from(*v).length() <= gate;
            moves[(newest + c) * pixels + p] |= !stands;
        }
    }
    // The colours of a pixel beside a moving surface are mixed with it.
    (0..g.len())
        .into_par_iter()
        .with_min_len(1024)
        .map(|i| {
            let (base, p) = (i - i % pixels, i % pixels);
            let (row, col) = (p / w, p % w);
            let rows = row.saturating_sub(1)..(row + 2).min(h);
            let near = |r: usize| moves[base + r * w + col.saturating_sub(1)..base + r * w + (col + 2).min(w)].iter();
            !rows.into_iter().any(|r| near(r).any(|m| *m)) && !group_moves[usize::from(groups[i])]
        })
        .collect()
}

/// Motion groups that move: more than the configured share of their opacity is faster than the gate.
fn moving_groups(look: &SceneLook, config: &MapConfig, moves: &[bool], groups: &[u16]) -> Vec<bool> {
    let g = &look.scene.gaussians;
    if g.motion_count == 0 {
        return vec![false];
    }
    let mut mass = vec![(0f64, 0f64); g.motion_count];
    for i in look.scene.shape.picture(look.scene.shape.timesteps - 1, 0).start..g.len() {
        let (moving, all) = &mut mass[usize::from(groups[i])];
        let opacity = f64::from(g.opacities[i]);
        *all += opacity;
        *moving += if moves[i] { opacity } else { 0.0 };
    }
    mass.iter().map(|(moving, all)| *moving > config.moving_group_share * all && *all > 0.0).collect()
}

/// What the newest pictures say about how far one can see.
fn depth_views(look: &SceneLook) -> Vec<DepthView> {
    let (scene, shape) = (look.scene, look.scene.shape);
    let newest = shape.timesteps - 1;
    (0..shape.cameras)
        .map(|c| {
            let map_from_camera = look.poses[newest * shape.cameras + c];
            let camera_from_anchor = relative(look.map_from_anchor, &map_from_camera).inverse().to_f32();
            let depth = shape.picture(newest, c).map(|i| {
                let opacity = scene.gaussians.opacities[i];
                if opacity >= SURFACE_OPACITY {
                    camera_from_anchor.transform_point3(scene.gaussians.means[i].into()).z
                } else if opacity <= SKY_OPACITY && scene.is_valid(i) {
                    f32::INFINITY
                } else {
                    0.0
                }
            });
            DepthView { map_from_camera, intrinsics: look.cameras[c], depth: depth.collect() }
        })
        .collect()
}
