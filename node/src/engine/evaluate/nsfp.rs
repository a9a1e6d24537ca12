//! Scene flow of the context frames fitted to their ground-truth points alone (`baselines::nsfp`).

use glam::Vec3;

use super::clip::unproject;
use super::{Clip, Prediction};
use crate::baselines::nsfp::{Flow, ground};
use crate::sync::clock::seconds_between;

/// Points beyond this (and the ground) are neither fitted nor moved, metres of z-depth: what a vehicle's LiDAR reaches.
const REACH_M: f32 = 80.0;

/// The points of one context frame off the ground, all cameras: which pixels, and where in the window's frame (z up).
struct Points {
    pixels: Vec<(usize, usize)>,
    places: Vec<[f32; 3]>,
}

fn points(clip: &Clip, step: usize) -> Option<Points> {
    let (_, frame) = clip.context().find(|(k, _)| *k == step)?;
    let mut out = Points { pixels: Vec::new(), places: Vec::new() };
    for (camera, view) in clip.views(step).iter().enumerate() {
        let depth = frame.truth.get(camera)?.depth.as_ref()?;
        for (i, &z) in depth.iter().enumerate().filter(|(_, z)| **z > 0.0 && **z <= REACH_M) {
            out.pixels.push((camera, i));
            out.places.push(unproject(view, i, z).to_array());
        }
    }
    let ground = ground(&out.places);
    let mut keep = ground.iter();
    out.pixels.retain(|_| keep.next() == Some(&false));
    let mut keep = ground.iter();
    out.places.retain(|_| keep.next() == Some(&false));
    Some(out)
}

/// Flow of every context pixel; `None` without ground-truth depth, or with fewer than two timesteps.
pub(super) fn flow(clip: &Clip, iterations: u64, tick: &mut dyn FnMut(u64, u64)) -> Option<Prediction> {
    let steps = clip.window.steps.len();
    let clouds = (0..steps).map(|step| points(clip, step)).collect::<Option<Vec<_>>>()?;
    let pairs = steps.checked_sub(1).filter(|&n| n > 0)?;
    let map_from_anchor = clip.window.map_from_anchor.rotation.as_quat();
    let mut out: Vec<Vec<Vec<[f32; 3]>>> =
        vec![clip.cameras.iter().map(|c| vec![[0.0; 3]; c.width * c.height]).collect(); steps];
    for pair in 0..pairs {
        tick(pair as u64, pairs as u64);
        let (from, to) = (&clouds[pair], &clouds[pair + 1]);
        let sec = seconds_between(clip.window.steps[pair].stamp_ns, clip.window.steps[pair + 1].stamp_ns) as f32;
        let Some(fit) = Flow::fit(&from.places, &to.places, iterations, clip.seed ^ pair as u64) else { continue };
        let mut write = |step: usize, points: &Points, moves: Vec<[f32; 3]>, per_sec: f32| {
            for (&(camera, pixel), m) in points.pixels.iter().zip(moves) {
                out[step][camera][pixel] = (map_from_anchor * (Vec3::from(m) * per_sec)).to_array();
            }
        };
        write(pair, from, fit.ahead(&from.places), 1.0 / sec);
        if pair + 1 == pairs {
            // Nothing follows the last timestep: the way back, turned around.
            write(pairs, to, fit.back(&to.places), -1.0 / sec);
        }
    }
    Some(Prediction::Flow(out))
}
