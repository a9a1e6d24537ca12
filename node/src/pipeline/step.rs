//! One step: a window through the network, its pictures, and what it adds to the map and the trajectories.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use storm_model::ModelError;
use storm_model::scene::{RenderedView, Scene, Want};
use storm_render::Intrinsics;
use tracing::warn;

use crate::config::Config;
use crate::engine::{Engine, select, views_of};
use crate::map::{MapError, SceneLook, StaticMap};
use crate::objects::{MovingObject, ObjectCounts, ObjectTracker};
use crate::overlap::{Agreement, Overlap, OverlapCounts, OverlapLook};
use crate::rigid::Rigid;
use crate::source::Frame;
use crate::tracks::{Track, TrackCounts, Tracker};
use crate::window::Window;

use super::timing::Timings;

/// A surface the map has seen at one place for this long stands, whatever a network under fast ego motion says of its
/// speed: nothing that moves at a gate of 1 m/s stays in a voxel that long.
const STANDS_SEC: f64 = 1.0;

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
    /// How far this window and earlier ones agree about its Gaussians.
    pub agreement: Agreement,
    /// Milliseconds from window to here.
    pub total_ms: f64,
}

/// What became of one window.
pub struct StepResult {
    /// The step; none when the network's result was not finite: the window is dropped, counted and said.
    pub step: Option<Step>,
    /// Trajectories that ended with it.
    pub tracks: Vec<Track>,
    /// Moving objects that ended with it.
    pub objects: Vec<MovingObject>,
}

/// Runs steps; owns the network, the map and the trackers.
pub struct StepMaker {
    engine: Engine,
    cameras: Vec<Intrinsics>,
    config: Config,
    map: StaticMap,
    tracker: Tracker,
    objects: ObjectTracker,
    overlap: Overlap,
    timings: Timings,
    steps: u64,
    non_finite: u64,
}

impl StepMaker {
    /// For one run. The map's tiles and saves go to `map_dir`; none: it lives in memory alone.
    ///
    /// # Errors
    /// A folder that cannot be made, or a map to go on from that cannot be read.
    pub fn new(
        engine: Engine,
        cameras: Vec<Intrinsics>,
        config: &Config,
        map_dir: Option<&Path>,
    ) -> Result<Self, MapError> {
        let map = match map_dir {
            Some(dir) if !config.map.load.is_empty() => {
                StaticMap::copied(&config.map, Path::new(&config.map.load), dir)?
            }
            Some(dir) => StaticMap::in_folder(&config.map, dir)?,
            None => StaticMap::new(&config.map),
        };
        Ok(Self {
            engine,
            cameras,
            map,
            tracker: Tracker::new(&config.tracks),
            objects: ObjectTracker::new(&config.objects),
            overlap: Overlap::new(&config.overlap),
            config: config.clone(),
            timings: Timings::default(),
            steps: 0,
            non_finite: 0,
        })
    }

    /// Runs one window. `None` when the network's result was not finite: the window is dropped, counted and said.
    pub fn run(&mut self, window: Window<Frame>) -> Result<Option<Step>> {
        let start = Instant::now();
        let scene = self.engine.step(&window, &self.cameras);
        self.take_in(window, scene, start.elapsed().as_secs_f64() * 1e3)
    }

    /// Runs windows that follow each other, the network on all of them in one forward pass, the rest one by one. In
    /// order, one result each.
    pub fn run_all(&mut self, windows: Vec<Window<Frame>>) -> Result<Vec<StepResult>> {
        let start = Instant::now();
        let scenes = self.engine.steps(&windows.iter().collect::<Vec<_>>(), &self.cameras)?;
        let network_ms = start.elapsed().as_secs_f64() * 1e3 / windows.len().max(1) as f64;
        let all = windows.into_iter().zip(scenes);
        all.map(|(window, scene)| {
            let step = self.take_in(window, scene, network_ms)?;
            Ok(StepResult { step, tracks: self.ended_tracks(), objects: self.ended_objects() })
        })
        .collect()
    }

    /// Moving objects that have ended since the last call.
    pub fn ended_objects(&mut self) -> Vec<MovingObject> {
        self.objects.drain()
    }

    /// Trajectories that have ended since the last call.
    pub fn ended_tracks(&mut self) -> Vec<Track> {
        self.tracker.drain()
    }

    /// What follows the network. `network_ms` is this window's share of its time.
    fn take_in(&mut self, window: Window<Frame>, scene: Result<Scene>, network_ms: f64) -> Result<Option<Step>> {
        let start = Instant::now();
        self.timings.add("network", network_ms);
        let mut scene = match scene {
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
        let poses: Vec<Rigid> = window.steps.iter().flat_map(|s| s.frames.iter().map(|f| f.map_from_camera)).collect();
        let stamps_ns: Vec<i64> = window.steps.iter().map(|s| s.stamp_ns).collect();
        let look = OverlapLook {
            stamps_ns: &stamps_ns,
            epoch: window.epoch,
            map_from_anchor: &window.map_from_anchor,
            cameras: &self.cameras,
            poses: &poses,
        };
        let agreement = self.timings.time("overlap", || self.overlap.step(&mut scene, &look));
        let newest = window.steps.len() - 1;
        let views = {
            let targets = views_of(&window.steps[newest], &window.map_from_anchor, &self.cameras);
            let time_sec = newest_time_sec(&window);
            let want = Want { flow: true, motion: true };
            self.timings.time("render", || self.engine.render(&scene, &targets, time_sec, want))?
        };
        let look = SceneLook {
            stamp_ns: window.stamp_ns,
            map_from_anchor: &window.map_from_anchor,
            scene: &scene,
            cameras: &self.cameras,
            poses: &poses,
            rendered: &views,
            confidence: &agreement.geometry,
            first_new: window.steps.len() - window.new_steps.min(window.steps.len()),
        };
        self.timings.time("map", || self.map.fuse_scene(&look));
        let mut points = select::moving_points(&scene, newest, &window.map_from_anchor, &self.config.tracks);
        for p in &mut points {
            let known = self.map.evidence(p.position_map);
            p.may_start = known.is_none_or(|k| f64::from(k.seen_for_sec) < STANDS_SEC);
        }
        self.timings.time("tracks", || self.tracker.step(window.stamp_ns, window.epoch, &points));
        let (_, parts) = select::object_points(&scene, newest, &window.map_from_anchor, &self.config.tracks);
        self.timings.time("objects", || self.objects.step(window.stamp_ns, window.epoch, &parts));
        let total_ms = network_ms + start.elapsed().as_secs_f64() * 1e3;
        self.timings.add("step", total_ms);
        let index = self.steps;
        self.steps += 1;
        Ok(Some(Step { index, window, scene: Arc::new(scene), views, agreement, total_ms }))
    }

    /// Saves the map where its folder is; nothing to do for a map in memory.
    ///
    /// # Errors
    /// A file that cannot be written; the last save stays whole.
    pub fn save_map(&mut self) -> Result<(), MapError> {
        match self.map.folder() {
            Some(_) => self.timings.time("map save", || self.map.save()),
            None => Ok(()),
        }
    }

    /// What is left at the end: the map, all trajectories, the stage times, and windows dropped as not finite.
    pub fn finish(mut self) -> Finished {
        let tracks = self.tracker.finish();
        let objects = self.objects.finish();
        Finished {
            map: self.map,
            tracks,
            track_counts: self.tracker.counts(),
            objects,
            object_counts: self.objects.counts(),
            overlap: self.overlap.counts(),
            timings: self.timings,
            steps: self.steps,
            non_finite_windows: self.non_finite,
            map_saves_failed: 0,
            batch: 1,
        }
    }
}

/// What a run leaves in memory.
pub struct Finished {
    /// The map.
    pub map: StaticMap,
    /// Trajectories that ended last.
    pub tracks: Vec<Track>,
    /// What became of points and trajectories.
    pub track_counts: TrackCounts,
    /// Moving objects that ended last.
    pub objects: Vec<MovingObject>,
    /// What became of groups and objects.
    pub object_counts: ObjectCounts,
    /// What overlapping windows said of each other.
    pub overlap: OverlapCounts,
    /// Stage times.
    pub timings: Timings,
    /// Steps run.
    pub steps: u64,
    /// Windows whose result was not finite and was thrown away.
    pub non_finite_windows: u64,
    /// Times the map could not be saved.
    pub map_saves_failed: u64,
    /// Most windows that went through the network in one forward pass.
    pub batch: usize,
}

/// Time of the newest timestep's reference camera in the window's clock.
pub fn newest_time_sec(window: &Window<Frame>) -> f32 {
    let first = window.steps.first().map_or(window.stamp_ns, |s| s.stamp_ns);
    (window.stamp_ns.saturating_sub(first) as f64 * 1e-9) as f32
}
