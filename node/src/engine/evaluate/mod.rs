//! The paper's protocol (section 4): a clip's context frames go in, all its other frames are drawn at their own time and pose
//! and compared; flow, motion masks and trajectories are scored on the context frames.
//!
//! The data's way: [`Clip`] (a procedural drive, or a piece of a bag) -> a [`Method`] -> [`Prediction`] -> [`Tally`] ->
//! [`Figures`].

pub mod bag;
mod breakdown;
pub(crate) mod clip;
mod gs3d;
mod method;
mod nsfp;
mod oracle;
mod per_frame;
mod prediction;
mod spread;
mod tally;
#[cfg(test)]
mod tests;
mod tracks;

use std::time::Instant;

use anyhow::{Context, Result};
use storm_model::scene::Scene;

pub use breakdown::{BinFigures, BreakdownFigures};
pub use clip::{CLIP_FRAMES, CLIP_HZ, Clip, ClipFrame, HELD_OUT_SEEDS, TAIL_SEC};
pub use method::Method;
pub use prediction::{Placed, Prediction};
pub use tally::Tally;
pub use tracks::{StepCloud, TrackTruth};

use super::Engine;
use super::figures::Figures;

/// How long the expensive methods may work.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Effort {
    /// Iterations of 3DGS.
    pub gs3d_iterations: u64,
    /// Most iterations of one scene flow fit.
    pub nsfp_iterations: u64,
}

impl Default for Effort {
    fn default() -> Self {
        Self {
            gs3d_iterations: crate::baselines::gs3d::ITERATIONS,
            nsfp_iterations: crate::baselines::nsfp::ITERATIONS,
        }
    }
}

/// Called with the method at work, and steps done and in all where it counts them.
pub type Say<'a> = &'a mut dyn FnMut(Method, Option<(u64, u64)>);

/// Methods over the same clips.
pub struct Evaluation {
    engine: Engine,
    per_frame: Option<Engine>,
    effort: Effort,
    /// Of every method a tally per clip.
    tallies: Vec<(Method, Vec<Tally>)>,
    warm: bool,
}

impl Evaluation {
    /// Of `methods` on `engine`'s network; `per_frame` is a network of its own for the per-frame setting.
    pub fn new(engine: Engine, per_frame: Option<Engine>, methods: &[Method], effort: Effort) -> Self {
        let tallies = methods.iter().map(|&m| (m, Vec::new())).collect();
        Self { engine, per_frame, effort, tallies, warm: false }
    }

    /// The network.
    pub fn engine(&self) -> &Engine {
        &self.engine
    }

    /// Runs and scores every method on a clip.
    pub fn add(&mut self, clip: &Clip, say: Say) -> Result<()> {
        let Self { engine, per_frame, effort, tallies, warm } = self;
        if !*warm {
            // The first pass also packs weights; run times are those of a running program.
            engine.step(&clip.window, &clip.cameras)?;
            if let Some(engine) = per_frame.as_mut() {
                engine.step(&clip.window, &clip.cameras)?;
            }
            *warm = true;
        }
        let (scene, scene_ms) = timed(|| engine.step(&clip.window, &clip.cameras))?;
        for (method, tallies) in tallies {
            let method = *method;
            say(method, None);
            let (prediction, ms) = timed(|| {
                let single = per_frame.as_mut().unwrap_or(engine);
                predict(method, clip, &scene, single, effort, &mut |done, all| say(method, Some((done, all))))
            })
            .with_context(|| format!("{}, {}", clip.name, method.name()))?;
            let ms = match method {
                Method::Storm | Method::Static => Some(scene_ms),
                // What starts from the network's Gaussians pays for them.
                Method::Gs3dInit => Some(scene_ms + ms),
                Method::PerFrame | Method::PerFrameNearest | Method::Gs3d | Method::Nsfp => Some(ms),
                Method::ConstantVelocity | Method::OracleGeometry | Method::NearestContext => None,
            };
            if let Some(prediction) = prediction {
                let mut tally = Tally::default();
                tally.add(clip, &prediction, ms).with_context(|| format!("{}, {}", clip.name, method.name()))?;
                tallies.push(tally);
            }
        }
        Ok(())
    }

    /// Every method's means over everything scored, in the order asked for.
    pub fn figures(&self) -> Vec<(Method, Figures)> {
        self.tallies.iter().map(|(method, clips)| (*method, spread::whole(clips).figures())).collect()
    }

    /// The standard errors of [`Self::figures`] over the clips: how far other clips of the same kind would put them.
    pub fn standard_errors(&self) -> Vec<(Method, Figures)> {
        self.tallies.iter().map(|(method, clips)| (*method, spread::standard_errors(clips))).collect()
    }

    /// Where every method's error is, in the order of [`Self::figures`].
    pub fn breakdowns(&self) -> Vec<(Method, BreakdownFigures)> {
        self.tallies.iter().map(|(method, clips)| (*method, spread::whole(clips).breakdown())).collect()
    }

    /// Held-out pictures scored (by whichever method scored most).
    pub fn images(&self) -> usize {
        self.tallies.iter().map(|(_, clips)| clips.iter().map(Tally::images).sum()).max().unwrap_or(0)
    }
}

fn timed<T>(work: impl FnOnce() -> Result<T>) -> Result<(T, f64)> {
    let start = Instant::now();
    Ok((work()?, start.elapsed().as_secs_f64() * 1e3))
}

/// What a method says of a clip; `None` where the clip lacks the ground truth it needs.
fn predict(
    method: Method,
    clip: &Clip,
    scene: &Scene,
    per_frame: &mut Engine,
    effort: &Effort,
    tick: &mut dyn FnMut(u64, u64),
) -> Result<Option<Prediction>> {
    let one = |scene: Scene| Some(Prediction::Scenes(vec![Placed::in_window(clip, scene, true)]));
    let config = || scene.config.clone();
    Ok(match method {
        Method::Storm => one(scene.clone()),
        Method::Static => one(prediction::still(scene.clone())),
        Method::PerFrame => Some(Prediction::Scenes(per_frame::scenes(clip, per_frame, per_frame::Use::All)?)),
        Method::PerFrameNearest => {
            Some(Prediction::Scenes(per_frame::scenes(clip, per_frame, per_frame::Use::Nearest)?))
        }
        Method::Gs3d => Some(gs3d::from_pictures(clip, config(), effort.gs3d_iterations, tick)?),
        Method::Gs3dInit => Some(gs3d::from_scene(clip, scene, effort.gs3d_iterations, tick)?),
        Method::Nsfp => nsfp::flow(clip, effort.nsfp_iterations, tick),
        Method::ConstantVelocity => oracle::scene(clip, &scene.config, oracle::Motion::PerInstance).and_then(one),
        Method::OracleGeometry => oracle::scene(clip, &scene.config, oracle::Motion::PerPixel).and_then(one),
        Method::NearestContext => Some(Prediction::NearestContext),
    })
}
