//! One step: a window through the network, its pictures, and what it adds to the map and the trajectories.

use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use storm_model::ModelError;
use storm_model::scene::{Affine, RenderedView, Scene, Want};
use storm_render::Intrinsics;
use tracing::warn;

use crate::config::{Config, MapConfig};
use crate::engine::{Engine, select, views_of};
use crate::map::{VoxelMap, color01, static_weight};
use crate::source::Frame;
use crate::tracks::{Track, Tracker};
use crate::window::Window;

use super::timing::Timings;

/// What one step gives.
pub struct Step {
    /// Number of the step, from 0.
    pub index: u64,
    /// The window it came from.
    pub window: Window<Frame>,
    /// Gaussians in the anchor frame, sky and exposure.
    pub scene: Arc<Scene>,
    /// The newest timestep's cameras as the scene shows them.
    pub views: Vec<RenderedView>,
    /// Milliseconds from window to here.
    pub total_ms: f64,
}

/// Runs steps; owns the network, the map and the trackers.
pub struct StepMaker {
    engine: Engine,
    cameras: Vec<Intrinsics>,
    config: Config,
    map: VoxelMap,
    tracker: Tracker,
    timings: Timings,
    steps: u64,
    non_finite: u64,
}

impl StepMaker {
    /// For one run.
    pub fn new(engine: Engine, cameras: Vec<Intrinsics>, config: &Config) -> Self {
        Self {
            engine,
            cameras,
            map: VoxelMap::new(&config.map),
            tracker: Tracker::new(&config.tracks),
            config: config.clone(),
            timings: Timings::default(),
            steps: 0,
            non_finite: 0,
        }
    }

    /// Runs one window. `None` when the network's result was not finite: the window is dropped, counted and said.
    pub fn run(&mut self, window: Window<Frame>) -> Result<Option<Step>> {
        let start = Instant::now();
        let scene = match self.timings.time("network", || self.engine.step(&window, &self.cameras)) {
            Ok(scene) => scene,
            Err(e) => match e.downcast_ref::<ModelError>() {
                Some(ModelError::NonFinite { .. }) => {
                    self.non_finite += 1;
                    warn!("window at {} ns dropped: {e:#}", window.stamp_ns);
                    return Ok(None);
                }
                _ => return Err(e),
            },
        };
        let newest = window.steps.len() - 1;
        let views = {
            let targets = views_of(&window.steps[newest], &window.map_from_anchor, &self.cameras);
            let time_sec = newest_time_sec(&window);
            let want = Want { flow: true, motion: true };
            self.timings.time("render", || self.engine.render(&scene, &targets, time_sec, want))?
        };
        self.timings.time("map", || add_to_map(&mut self.map, &scene, &window, &self.config.map));
        let points = select::moving_points(&scene, newest, &window.map_from_anchor, &self.config.tracks);
        self.timings.time("tracks", || self.tracker.step(window.stamp_ns, window.epoch, &points));
        let total_ms = start.elapsed().as_secs_f64() * 1e3;
        self.timings.add("step", total_ms);
        let index = self.steps;
        self.steps += 1;
        Ok(Some(Step { index, window, scene: Arc::new(scene), views, total_ms }))
    }

    /// What is left at the end: the map, all trajectories, the stage times, and windows dropped as not finite.
    pub fn finish(mut self) -> Finished {
        let tracks = self.tracker.finish();
        Finished {
            map: self.map,
            tracks,
            timings: self.timings,
            steps: self.steps,
            non_finite_windows: self.non_finite,
        }
    }
}

/// What a run leaves in memory.
pub struct Finished {
    /// The map.
    pub map: VoxelMap,
    /// Every trajectory.
    pub tracks: Vec<Track>,
    /// Stage times.
    pub timings: Timings,
    /// Steps run.
    pub steps: u64,
    /// Windows whose result was not finite and was thrown away.
    pub non_finite_windows: u64,
}

/// Time of the newest timestep's reference camera in the window's clock.
pub fn newest_time_sec(window: &Window<Frame>) -> f32 {
    let first = window.steps.first().map_or(window.stamp_ns, |s| s.stamp_ns);
    (window.stamp_ns.saturating_sub(first) as f64 * 1e-9) as f32
}

/// Merges what stands still into the map, once per image: only timesteps that were in no earlier window.
fn add_to_map(map: &mut VoxelMap, scene: &Scene, window: &Window<Frame>, config: &MapConfig) {
    let first_new = window.steps.len() - window.new_steps.min(window.steps.len());
    let picked = select::from_step(scene, first_new);
    let exposure = Affine::mean(&scene.affine);
    map.insert(
        &window.map_from_anchor,
        &scene.gaussians,
        |i| {
            let opacity = scene.gaussians.opacities[i];
            let weight = || static_weight(config, opacity, select::speed_mps(scene, i), scene.depths[i]);
            if picked.contains(&i) { weight() } else { None }
        },
        |i| color01(&exposure.apply(scene.gaussians.colors[i])),
    );
}
