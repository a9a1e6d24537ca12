//! Whether what was seen, moved on, explains new pictures: then nobody needs the network to know what they show.
//!
//! The Gaussians of the last computed step are moved by their velocities and drawn from where the cameras are now. What the new
//! pictures show beyond that is compared, surface by surface, with what the last computed step's own pictures showed beyond its own
//! drawing: a network that draws bricks as a grey wall did so then and does so now. A residual that has changed by more than noise,
//! and by more than a texture that lies half a pixel off changes it, is something new: a mover whose speed is wrong, somebody who
//! steps out, light that has changed, a place never seen. It is looked for in every patch, never in the mean.

use std::sync::Arc;

use glam::{Affine3A, Vec3};
use rayon::prelude::*;
use storm_model::scene::{RenderedView, Scene};
use storm_render::{Intrinsics, View};

use super::change::{Change, Sensitivity, first_beyond, leave_out};
use super::skipper::Computed;
use super::{Angle, pictures_mean, shown};
use crate::config::SkipConfig;
use crate::engine::select::SURFACE_OPACITY;
use crate::source::Frame;
use crate::sync::clock::seconds_between;
use crate::window::{PosedSet, Window, relative};

/// Where the sky is looked for in the picture before, metres.
const SKY_M: f32 = 1e4;
/// A place the last pictures did not show may differ from its drawing by this many times what they did in the root mean square.
const UNSEEN_RMS: f32 = 2.0;

/// Why a prediction does not do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Unexplained {
    /// A picture shows something else than predicted.
    Picture {
        /// Camera.
        camera: usize,
        /// Where, and by how much more than when last computed.
        change: Change,
    },
    /// A whole picture is brighter or darker than predicted.
    Exposure {
        /// Camera.
        camera: usize,
        /// By so many 8-bit levels.
        levels: f32,
    },
    /// Pictures and drawings do not fit together.
    Shape,
}

/// What a pixel of the newest pictures shows: as the newest timestep's Gaussians say it of a computed step.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PixelFlow {
    /// Anchor frame, metres.
    pub positions: Vec<[f32; 3]>,
    /// m/s.
    pub velocities: Vec<[f32; 3]>,
    /// Whether there is a surface.
    pub valid: Vec<bool>,
}

/// Whether the window is near enough to the computed one, in time and place, to be predicted from it.
pub fn in_reach(config: &SkipConfig, computed: &Window<Frame>, new: &Window<Frame>) -> bool {
    let (Some(a), Some(b)) = (computed.steps.last(), new.steps.last()) else { return false };
    let ahead_sec = seconds_between(computed.stamp_ns, new.stamp_ns);
    let near = |(a, b): (&crate::window::PosedFrame<Frame>, &crate::window::PosedFrame<Frame>)| {
        let gap = relative(&a.map_from_camera, &b.map_from_camera);
        gap.translation.length() <= config.predict_m
            && gap.rotation.angle_to_identity() <= config.predict_deg.to_radians()
    };
    computed.epoch == new.epoch
        && computed.steps.len() == new.steps.len()
        && a.frames.len() == b.frames.len()
        && ahead_sec > 0.0
        && ahead_sec <= config.predict_sec
        && a.frames.iter().zip(&b.frames).all(near)
}

/// The scene of `computed` on the clock of `new`, which begins later. The newest timestep's Gaussians are moved to its newest
/// stamp, so that they are what they are in a computed step: where surfaces are now. The others keep the moment they were seen at.
pub fn moved_on(scene: &Scene, computed: &Window<Frame>, new: &Window<Frame>) -> Scene {
    let first_ns = |w: &Window<Frame>| w.steps.first().map_or(w.stamp_ns, |s| s.stamp_ns);
    let later_sec = seconds_between(first_ns(computed), first_ns(new)) as f32;
    let now_sec = seconds_between(first_ns(new), new.stamp_ns) as f32;
    let mut scene = scene.clone();
    let newest = scene.shape.picture(scene.shape.timesteps - 1, 0).start;
    let g = &mut scene.gaussians;
    g.time_sec.iter_mut().for_each(|t| *t -= later_sec);
    for i in newest..g.len() {
        g.means[i] = g.mean_at(i, now_sec);
        g.time_sec[i] = now_sec;
    }
    scene
}

/// The newest cameras' poses in the computed window's anchor.
fn poses(computed: &Window<Frame>, set: &PosedSet<Frame>) -> Vec<Affine3A> {
    set.frames.iter().map(|f| relative(&computed.map_from_anchor, &f.map_from_camera).snapped().to_f32()).collect()
}

/// What the pixels of predicted views show.
pub fn pixel_flow(
    computed: &Window<Frame>,
    new: &Window<Frame>,
    views: &[RenderedView],
    cameras: &[Intrinsics],
) -> PixelFlow {
    let mut all = PixelFlow::default();
    let Some(newest) = new.steps.last() else { return all };
    for (((view, pose), camera), frame) in views.iter().zip(poses(computed, newest)).zip(cameras).zip(&newest.frames) {
        for i in 0..view.depth.len() {
            let ray = camera.ray((i % view.width) as f32 + 0.5, (i / view.width) as f32 + 0.5);
            let solid = view.alpha[i] >= SURFACE_OPACITY;
            all.positions.push(pose.transform_point3(ray * view.depth[i]).to_array());
            all.velocities.push(velocity(view, i).to_array());
            all.valid.push(solid && view.depth[i] > 0.0 && frame.item.is_valid(i));
        }
    }
    all
}

/// Of the surface at a pixel; drawn flow is weighted by coverage.
fn velocity(view: &RenderedView, i: usize) -> Vec3 {
    let Some(flow) = view.flow.as_ref().filter(|_| view.alpha[i] >= SURFACE_OPACITY) else { return Vec3::ZERO };
    Vec3::from(flow[i]) / view.alpha[i]
}

/// Picture less drawing, summed over the channels, 8-bit levels.
fn residual(frame: &Frame, view: &RenderedView) -> Option<Vec<i16>> {
    let (seen, drawn) = (&frame.rgb.data, view.rgb8());
    (seen.len() == drawn.len() && seen.len() == 3 * view.width * view.height).then(|| {
        let sum = |(a, b): (&[u8], &[u8])| (0..3).map(|c| i16::from(a[c]) - i16::from(b[c])).sum();
        seen.chunks_exact(3).zip(drawn.chunks_exact(3)).map(sum).collect()
    })
}

/// By how much a picture changes within a pixel's distance, summed over the channels.
fn steepness(frame: &Frame, (w, h): (usize, usize)) -> Vec<f32> {
    let rgb = &frame.rgb.data;
    let at = |x: usize, y: usize| (0..3).map(|c| i32::from(rgb[3 * (y * w + x) + c])).sum::<i32>();
    let pixel = |i: usize| {
        let (x, y) = (i % w, i / w);
        let here = at(x, y);
        let ways =
            [(x.saturating_sub(1), y), ((x + 1).min(w - 1), y), (x, y.saturating_sub(1)), (x, (y + 1).min(h - 1))];
        ways.iter().map(|&(x, y)| (at(x, y) - here).abs()).max().unwrap_or(0) as f32
    };
    (0..w * h).map(pixel).collect()
}

/// The last computed step's newest picture of one camera, to compare with.
struct Known {
    view: View,
    residual: Vec<i16>,
    valid: Option<Arc<[bool]>>,
    steepness: Vec<f32>,
    rms: f32,
}

impl Known {
    /// Residual and steepness at a point of the anchor frame; none where the picture does not show it.
    fn at(&self, p: Vec3) -> Option<(f32, f32)> {
        let k = &self.view.intrinsics;
        let (u, v) = k.project(self.view.camera_from_world.transform_point3(p))?;
        let (x, y) = (u - 0.5, v - 0.5);
        // Phrased so that what is no number is outside.
        if !(x >= 0.0 && y >= 0.0 && x < (k.width - 1) as f32 && y < (k.height - 1) as f32) {
            return None;
        }
        let (a, b) = (x.fract(), y.fract());
        let first = y as usize * k.width + x as usize;
        let four = [
            (first, (1.0 - a) * (1.0 - b)),
            (first + 1, a * (1.0 - b)),
            (first + k.width, (1.0 - a) * b),
            (first + k.width + 1, a * b),
        ];
        if self.valid.as_ref().is_some_and(|valid| four.iter().any(|&(i, _)| !valid[i])) {
            return None;
        }
        let residual = four.iter().map(|&(i, w)| w * f32::from(self.residual[i])).sum();
        let steepness = four.iter().map(|&(i, _)| self.steepness[i]).fold(0.0, f32::max);
        Some((residual, steepness))
    }
}

/// Whether `views`, what `computed` predicts for the newest pictures of `new`, explain them everywhere; else the first place found.
///
/// # Errors
/// The place, which is the reason to run the network.
pub fn explains(
    config: &SkipConfig,
    computed: &Computed,
    new: &Window<Frame>,
    views: &[RenderedView],
    cameras: &[Intrinsics],
) -> Result<(), Unexplained> {
    let (Some(then), Some(now)) = (computed.window.steps.last(), new.steps.last()) else {
        return Err(Unexplained::Shape);
    };
    let count = cameras.len();
    if [then.frames.len(), now.frames.len(), computed.views.len(), views.len()].iter().any(|n| *n != count) {
        return Err(Unexplained::Shape);
    }
    let then_poses = poses(&computed.window, then);
    let known: Vec<Known> = (0..count)
        .into_par_iter()
        .map(|c| {
            let (frame, view) = (&then.frames[c].item, &computed.views[c]);
            let residual = residual(frame, view)?;
            let valid = frame.valid.clone();
            let powers = residual.iter().enumerate().filter(|(i, _)| frame.is_valid(*i));
            let power =
                powers.map(|(_, &r)| f32::from(r).powi(2)).sum::<f32>() / shown(residual.len(), valid.as_deref());
            let steepness = steepness(frame, (view.width, view.height));
            Some(Known {
                view: View::from_pose(then_poses[c], cameras[c]),
                residual,
                valid,
                steepness,
                rms: power.sqrt(),
            })
        })
        .collect::<Option<_>>()
        .ok_or(Unexplained::Shape)?;
    let ahead_sec = seconds_between(computed.window.stamp_ns, new.stamp_ns) as f32;
    let sensitivity = Sensitivity { sigmas: config.still_sigmas as f32, levels: config.predict_levels as f32 };
    let poses = poses(&computed.window, now);
    (0..count).into_par_iter().try_for_each(|camera| {
        let view = &views[camera];
        let (w, h) = (view.width, view.height);
        let frame = &now.frames[camera].item;
        let now = residual(frame, view).ok_or(Unexplained::Shape)?;
        let own = cameras[camera];
        let mut slack = vec![0f32; w * h];
        let mut off = vec![0i16; w * h];
        for i in 0..w * h {
            let ray = own.ray((i % w) as f32 + 0.5, (i / w) as f32 + 0.5);
            let solid = view.alpha[i] >= SURFACE_OPACITY && view.depth[i] > 0.0;
            let there = poses[camera].transform_point3(ray * if solid { view.depth[i] } else { SKY_M });
            let was = there - velocity(view, i) * ahead_sec;
            let order = std::iter::once(camera).chain((0..count).filter(|c| *c != camera));
            let before = order.into_iter().find_map(|c| known[c].at(was));
            let here = f32::from(now[i]);
            let (gap, allowed) = match before {
                Some((then, steepness)) => (here - then, config.predict_px as f32 * steepness),
                None => (here, UNSEEN_RMS * known[camera].rms),
            };
            off[i] = gap.round() as i16;
            slack[i] = allowed;
        }
        let valid = frame.valid.as_deref();
        leave_out(&mut off, valid);
        let levels = pictures_mean(&off, valid) / 3.0;
        if levels.abs() > config.still_levels as f32 {
            return Err(Unexplained::Exposure { camera, levels });
        }
        match first_beyond(&off, Some(&slack), valid, (w, h), sensitivity) {
            Some(change) => Err(Unexplained::Picture { camera, change }),
            None => Ok(()),
        }
    })
}

#[cfg(test)]
mod tests;
