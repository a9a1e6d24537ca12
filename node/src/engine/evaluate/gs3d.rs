//! Per-scene optimisation of a clip's context pictures (`baselines::gs3d`), from random points or from the network's Gaussians.

use std::sync::Arc;

use anyhow::{Result, bail};
use storm_model::config::ModelConfig;
use storm_model::scene::{Affine, Scene, SceneShape, Want};
use storm_render::raster::CpuRasterizer;
use storm_render::{Gaussians, View};

use super::{Clip, Placed, Prediction};
use crate::baselines::gs3d::{Params, Reference, Target, fit};
use crate::engine::truth::unit;

/// A context picture: view in the window's frame, camera, colours of 0-1, and the pixels that show something.
type Seen = (View, usize, Vec<f32>, Option<Arc<[bool]>>);

fn pictures(clip: &Clip) -> Vec<Seen> {
    let mut out = Vec::new();
    for (step, set) in clip.window.steps.iter().enumerate() {
        for (camera, (view, frame)) in clip.views(step).into_iter().zip(&set.frames).enumerate() {
            out.push((view, camera, unit(&frame.item.rgb.data), frame.item.valid.clone()));
        }
    }
    out
}

fn optimised(
    clip: &Clip,
    mut params: Params,
    start: Scene,
    iterations: u64,
    tick: &mut dyn FnMut(u64, u64),
) -> Result<Prediction> {
    let mut targets = Vec::new();
    let mut raster = CpuRasterizer::new(start.raster_settings())?;
    let empty = Scene { gaussians: Gaussians::default(), affine: Vec::new(), ..start.clone() };
    for (view, camera, rgb01, valid) in pictures(clip) {
        let (w, h) = (view.intrinsics.width, view.intrinsics.height);
        let sky = match &start.sky {
            None => Vec::new(),
            // Sky and exposure are kept as the network said.
            Some(_) => empty.render(&mut raster, &[(view, None)], 0.0, Want::default())?.remove(0).color,
        };
        let exposure = start.affine.get(camera).copied().unwrap_or(Affine::IDENTITY);
        targets.push(Target { view, picture: Reference::new(&rgb01, w, h), sky, exposure, valid });
    }
    let settings = start.raster_settings();
    fit(&mut params, &targets, settings, iterations, clip.seed, &mut |done, _| {
        tick(done, iterations);
        Ok(true)
    })?;
    let gaussians = params.gaussians();
    let finite = gaussians.means.iter().flatten().chain(gaussians.scales.iter().flatten()).all(|x| x.is_finite());
    if !finite {
        bail!("the optimised Gaussians are not finite");
    }
    Ok(Prediction::Scenes(vec![Placed::in_window(clip, Scene { gaussians, ..start }, false)]))
}

/// From random points on the pictures' rays; no sky model, no exposure.
pub(super) fn from_pictures(
    clip: &Clip,
    config: Arc<ModelConfig>,
    iterations: u64,
    tick: &mut dyn FnMut(u64, u64),
) -> Result<Prediction> {
    let seen = pictures(clip);
    let rays: Vec<(View, &[f32])> = seen.iter().map(|(view, _, rgb, _)| (*view, rgb.as_slice())).collect();
    let params = Params::random(&rays, clip.seed);
    let size = clip.cameras.first().map_or((0, 0), |c| (c.width, c.height));
    let start = Scene {
        gaussians: Gaussians::default(),
        shape: SceneShape {
            timesteps: clip.window.steps.len(),
            cameras: clip.cameras.len(),
            height: size.1,
            width: size.0,
        },
        depths: Vec::new(),
        valid: Vec::new(),
        sky: None,
        affine: Vec::new(),
        motion_bases: Vec::new(),
        config,
    };
    optimised(clip, params, start, iterations, tick)
}

/// From the network's Gaussians, motion dropped, before its sky and with its exposure.
pub(super) fn from_scene(
    clip: &Clip,
    scene: &Scene,
    iterations: u64,
    tick: &mut dyn FnMut(u64, u64),
) -> Result<Prediction> {
    optimised(clip, Params::of_gaussians(&scene.gaussians), scene.clone(), iterations, tick)
}
