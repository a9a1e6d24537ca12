//! Per-scene optimisation of a saved map (the paper leaves it as future work, section "Limitations"): the merged Gaussians
//! are fitted to the pictures they came from, by the optimiser and the rasteriser's backward pass that the 3DGS baseline
//! uses (`baselines::gs3d`).
//!
//! Every so manieth moment of the recording is held out and never fitted to. Only pixels that the map covers at the start
//! are fitted and scored, the same ones throughout: the sky is not in a map, and neither is what moves (boxes of
//! `objects.csv`, where there are any).

mod frames;

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use serde::Serialize;
use storm_model::metrics::Mean;
use storm_model::metrics::image::{Image, psnr};
use storm_model::scene::Affine;
use storm_render::View;
use storm_render::raster::{CpuRasterizer, RasterSettings};

use crate::baselines::gs3d::{Params, Reference, Target, fit};
use crate::engine::select::SURFACE_OPACITY;

pub use frames::{Boxes, Shot, shots};

/// Most fitted pictures that are scored each time; they are spread evenly.
const SCORED: usize = 24;

/// How long, and how often to look.
#[derive(Debug, Clone, Copy)]
pub struct RefineOptions {
    /// Most iterations; the learning rate of positions falls over them.
    pub iterations: u64,
    /// Most time, minutes; infinite: all iterations.
    pub minutes: f64,
    /// Iterations between two looks at the figures.
    pub score_every: u64,
    /// For the order of the pictures.
    pub seed: u64,
}

/// How well the map draws its pictures at one moment of the optimisation.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Score {
    /// Iterations done.
    pub iteration: u64,
    /// Time taken, seconds, without the scoring.
    pub seconds: f64,
    /// Mean PSNR over (some of) the fitted pictures, dB.
    pub psnr_fitted: Option<f64>,
    /// Mean PSNR over the held-out pictures, dB.
    pub psnr_held_out: Option<f64>,
}

/// What a refinement found.
#[derive(Debug, Clone, Serialize)]
pub struct RefineReport {
    /// Gaussians.
    pub gaussians: usize,
    /// Pictures fitted to.
    pub fitted: usize,
    /// Pictures held out.
    pub held_out: usize,
    /// Share of the pictures' pixels that the map covers at the start.
    pub covered: f64,
    /// The figures over time; the first is before.
    pub scores: Vec<Score>,
}

/// A picture, and which of its pixels count.
struct Judged {
    view: View,
    rgb01: Vec<f32>,
    counts: Vec<bool>,
}

/// Draws at rest; colours 0 to 1 over mid-grey, and coverage.
fn draw(raster: &mut CpuRasterizer, params: &Params, view: View) -> Result<(Vec<f32>, Vec<f32>)> {
    let (mut scales, mut opacities) = (Vec::new(), Vec::new());
    params.activated(&mut scales, &mut opacities);
    let splats = params.splats(&scales, &opacities);
    let picture = raster.render(&splats, &[view])?.pop().context("the rasteriser gave no picture")?;
    Ok((picture.features.iter().map(|x| (0.5 * x + 0.5).clamp(0.0, 1.0)).collect(), picture.alpha))
}

fn score(raster: &mut CpuRasterizer, params: &Params, pictures: &[Judged], most: usize) -> Result<Option<f64>> {
    let mut mean = Mean::default();
    for judged in pictures.iter().step_by(pictures.len().div_ceil(most.max(1)).max(1)) {
        let k = judged.view.intrinsics;
        let (drawn, _) = draw(raster, params, judged.view)?;
        let image = |values| Image { width: k.width, height: k.height, channels: 3, values };
        mean.add(psnr(&image(&drawn), &image(&judged.rgb01), Some(&judged.counts))?);
    }
    Ok(mean.value())
}

/// Optimises `params` on the fitted shots, in place. `hear` gets iterations done and, each time they are worked out, the
/// figures; false: enough, and what is done so far stands.
///
/// # Errors
/// No pictures, nothing of the map in them, or numbers that are not finite.
pub fn refine(
    params: &mut Params,
    shots: &[Shot],
    settings: RasterSettings,
    options: &RefineOptions,
    hear: &mut dyn FnMut(u64, Option<&Score>) -> bool,
) -> Result<RefineReport> {
    let mut raster = CpuRasterizer::new(settings)?;
    let (mut fitted, mut held_out, mut targets) = (Vec::new(), Vec::new(), Vec::new());
    let (mut covered, mut pixels) = (0usize, 0usize);
    for shot in shots {
        let k = shot.view.intrinsics;
        let (drawn, alpha) = draw(&mut raster, params, shot.view)?;
        let counts: Vec<bool> = alpha.iter().zip(&shot.moves).map(|(a, m)| *a >= SURFACE_OPACITY && !m).collect();
        covered += counts.iter().filter(|c| **c).count();
        pixels += counts.len();
        if !shot.held_out {
            // Where nothing is to be learned the picture is what is drawn already, over what is behind already.
            let mut wanted = shot.rgb01.clone();
            for (i, _) in counts.iter().enumerate().filter(|(_, c)| !**c) {
                wanted[3 * i..3 * i + 3].copy_from_slice(&drawn[3 * i..3 * i + 3]);
            }
            let picture = Reference::new(&wanted, k.width, k.height);
            targets.push(Target { view: shot.view, picture, sky: Vec::new(), exposure: Affine::IDENTITY, valid: None });
        }
        let judged = Judged { view: shot.view, rgb01: shot.rgb01.clone(), counts };
        if shot.held_out { &mut held_out } else { &mut fitted }.push(judged);
    }
    ensure!(!targets.is_empty(), "no pictures to fit the map to");
    ensure!(covered > 0, "the map is in none of the {} pictures; is it of another recording?", shots.len());
    let mut scores = Vec::new();
    let mut look = |iteration: u64, seconds: f64, params: &Params| -> Result<Score> {
        Ok(Score {
            iteration,
            seconds,
            psnr_fitted: score(&mut raster, params, &fitted, SCORED)?,
            psnr_held_out: score(&mut raster, params, &held_out, usize::MAX)?,
        })
    };
    scores.push(look(0, 0.0, params)?);
    hear(0, scores.last());
    let limit = Duration::try_from_secs_f64(60.0 * options.minutes).unwrap_or(Duration::MAX);
    let (start, mut scoring) = (Instant::now(), Duration::ZERO);
    let mut done = 0;
    fit(params, &targets, settings, options.iterations, options.seed, &mut |n, params| {
        done = n;
        let taken = start.elapsed().saturating_sub(scoring);
        let mut score = None;
        if n.is_multiple_of(options.score_every.max(1)) && n < options.iterations {
            let began = Instant::now();
            score = Some(look(n, taken.as_secs_f64(), params)?);
            scoring += began.elapsed();
        }
        let go_on = hear(n, score.as_ref()) && taken < limit;
        scores.extend(score);
        Ok(go_on)
    })?;
    if scores.last().is_some_and(|s| s.iteration != done) {
        let taken = start.elapsed().saturating_sub(scoring);
        scores.push(look(done, taken.as_secs_f64(), params)?);
        hear(done, scores.last());
    }
    Ok(RefineReport {
        gaussians: params.len(),
        fitted: fitted.len(),
        held_out: held_out.len(),
        covered: covered as f64 / pixels.max(1) as f64,
        scores,
    })
}

#[cfg(test)]
mod tests;
