//! One step: a window through the network, its pictures, and what it adds to the map and the trajectories.

mod given;
mod ladder;
mod parts;
mod take_in;

pub use parts::{OnPart, Part};

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use storm_model::scene::{RenderedView, Scene};
use storm_render::Intrinsics;
use tracing::warn;

use crate::config::Config;
use crate::engine::Engine;
use crate::gate::contract::Notch;
use crate::gate::predict::PixelFlow;
use crate::gate::skipper::{Computed, SkipCounts, Skipper};
use crate::map::{MapError, StaticMap};
use crate::objects::{MovingObject, ObjectCounts, ObjectTracker};
use crate::overlap::{Agreement, Overlap, OverlapCounts};
use crate::source::Frame;
use crate::tracks::{LiveTrack, Track, TrackCounts, Tracker};
use crate::window::Window;

use super::demand::Demand;
use super::guard::caught;
use super::timing::Timings;
use given::Given;

/// What one step gives.
pub struct Step {
    /// Number of the step, from 0.
    pub index: u64,
    /// The window it came from.
    pub window: Window<Frame>,
    /// Gaussians in the anchor frame, sky and exposure.
    pub scene: Arc<Scene>,
    /// The newest timestep's cameras as the scene shows them.
    pub views: Arc<[RenderedView]>,
    /// How far this window and earlier ones agree about its Gaussians.
    pub agreement: Arc<Agreement>,
    /// The notch that took it, where it was not computed in full.
    pub notch: Option<Notch>,
    /// What the newest pictures' pixels show, where the newest timestep's Gaussians are not aligned with them: an extrapolated
    /// step's belong to the pixels of the last computed one.
    pub pixels: Option<PixelFlow>,
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
    skipper: Skipper,
    timings: Timings,
    /// Sets the map was given.
    given: Given,
    steps: u64,
    non_finite: u64,
    part: Part,
    on_part: Option<OnPart>,
    panics: u64,
    panics_in_a_row: u32,
}

/// What the network said of a window, and how long it took.
struct Ran {
    scene: Result<Scene>,
    ms: f64,
    approximate: bool,
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
            skipper: Skipper::new(&config.skip),
            config: config.clone(),
            timings: Timings::default(),
            given: Given::default(),
            steps: 0,
            non_finite: 0,
            part: Part::Gate,
            on_part: None,
            panics: 0,
            panics_in_a_row: 0,
        })
    }

    /// Goes on with other cameras, in the order of the windows' frames.
    pub fn set_cameras(&mut self, cameras: Vec<Intrinsics>) {
        self.skipper.reset();
        self.cameras = cameras;
    }

    /// Takes another map, in the place of the present one, which goes.
    pub fn set_map(&mut self, map: StaticMap) {
        self.skipper.reset();
        self.given = Given::default();
        self.map = map;
    }

    /// The map.
    pub fn map(&self) -> &StaticMap {
        &self.map
    }

    /// Trajectories alive.
    pub fn tracks(&self) -> &[LiveTrack] {
        self.tracker.live()
    }

    /// Objects alive that were seen often enough to be believed.
    pub fn objects(&self) -> impl Iterator<Item = &MovingObject> {
        self.objects.live().iter().filter(|o| o.confirmed(&self.config.objects))
    }

    /// Stage times so far.
    pub fn timings(&self) -> &Timings {
        &self.timings
    }

    /// Windows whose result was not finite and was thrown away.
    pub fn non_finite(&self) -> u64 {
        self.non_finite
    }

    /// Steps that were not computed, and how the checks of them went.
    pub fn skips(&self) -> SkipCounts {
        self.skipper.counts()
    }

    /// The network, for what it says of itself.
    pub fn engine(&self) -> &Engine {
        &self.engine
    }

    /// Runs one window with everything. `None` when the network's result was not finite: the window is dropped, counted and said.
    pub fn run(&mut self, window: Window<Frame>) -> Result<Option<Step>> {
        self.run_for(window, Demand::ALL)
    }

    /// Runs windows that follow each other, the network on all of them in one forward pass, the rest one by one. In
    /// order, one result each. Several windows at once are all computed, exactly.
    pub fn run_all(&mut self, mut windows: Vec<Window<Frame>>) -> Result<Vec<StepResult>> {
        if windows.len() <= 1 {
            let Some(window) = windows.pop() else { return Ok(Vec::new()) };
            let step = self.run(window)?;
            return Ok(vec![self.result(step)]);
        }
        let start = Instant::now();
        let together = caught(|| {
            self.enter(Part::Network);
            self.engine.exact_steps(&windows.iter().collect::<Vec<_>>(), &self.cameras)
        });
        let scenes = match together {
            Ok(scenes) => scenes?,
            Err(what) => {
                warn!("the network panicked over {} windows at once ({what}); they are run one by one", windows.len());
                self.rebuild()?;
                return windows.into_iter().map(|w| self.run(w).map(|step| self.result(step))).collect();
            }
        };
        let ms = start.elapsed().as_secs_f64() * 1e3 / windows.len() as f64;
        let all = windows.into_iter().zip(scenes);
        all.map(|(window, scene)| {
            let stamp_ns = window.stamp_ns;
            let ran = Ran { scene, ms, approximate: false };
            let step = self.guarded(stamp_ns, |s| s.take_in(window, ran, Demand::ALL, None))?;
            Ok(self.result(step.flatten()))
        })
        .collect()
    }

    fn result(&mut self, step: Option<Step>) -> StepResult {
        StepResult { step, tracks: self.ended_tracks(), objects: self.ended_objects() }
    }

    fn step(&mut self, of: Computed, demand: Demand, notch: Option<Notch>, total_ms: f64) -> Step {
        self.timings.add("step", total_ms);
        let index = self.steps;
        self.steps += 1;
        let Computed { window, scene, views, agreement, .. } = of;
        // The gate's own views are nobody else's.
        let views = if demand.drawn() { views } else { Arc::from([]) };
        Step { index, window, scene, views, agreement, notch, pixels: None, total_ms }
    }

    /// Moving objects that have ended since the last call.
    pub fn ended_objects(&mut self) -> Vec<MovingObject> {
        self.objects.drain()
    }

    /// Trajectories that have ended since the last call.
    pub fn ended_tracks(&mut self) -> Vec<Track> {
        self.tracker.drain()
    }

    /// Saves the map where its folder is; nothing to do for a map in memory.
    ///
    /// # Errors
    /// A file that cannot be written; the last save stays whole.
    pub fn save_map(&mut self) -> Result<(), MapError> {
        if self.map.folder().is_none() {
            return Ok(());
        }
        let saved = caught(|| {
            let start = Instant::now();
            self.enter(Part::Save);
            let saved = self.map.save();
            self.timings.add("map save", start.elapsed().as_secs_f64() * 1e3);
            saved
        });
        saved.unwrap_or_else(|what| {
            self.map.recover();
            Err(MapError::Panicked(what))
        })
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
            skips: self.skipper.counts(),
            timings: self.timings,
            steps: self.steps,
            non_finite_windows: self.non_finite,
            panics: self.panics,
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
    /// Steps that were not computed.
    pub skips: SkipCounts,
    /// Stage times.
    pub timings: Timings,
    /// Steps run.
    pub steps: u64,
    /// Windows whose result was not finite and was thrown away.
    pub non_finite_windows: u64,
    /// Windows lost because a stage panicked.
    pub panics: u64,
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

#[cfg(test)]
mod masked_tests;
#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::ModelSource;
    use crate::engine::evaluate::clip::Clip;

    #[test]
    fn a_batch_that_panics_is_run_one_by_one_and_a_window_that_does_is_lost_alone() {
        let config = Config::default();
        let clips: Vec<Clip> = (3..6).map(|seed| Clip::of_seed(seed, (48, 32), 0.0).unwrap()).collect();
        for (times, lost) in [(&[1][..], 0), (&[1, 3][..], 1)] {
            let source = ModelSource::open(&config.model).unwrap();
            let engine = Engine::new(source, &config.model, 3, config.window.timespan_sec).unwrap();
            let mut maker = StepMaker::new(engine, clips[0].cameras.clone(), &config, None).unwrap();
            let mut seen = 0;
            maker.set_on_part(Box::new(move |part| {
                seen += u32::from(part == Part::Network);
                assert!(part != Part::Network || !times.contains(&seen), "injected");
            }));
            let results = maker.run_all(clips.iter().map(|c| c.window.clone()).collect()).unwrap();
            let missing = results.iter().filter(|r| r.step.is_none()).count();
            assert_eq!((results.len(), missing, maker.panics()), (3, lost, lost as u64));
        }
    }

    #[test]
    fn another_map_is_given_what_the_one_before_was() {
        let mut config = Config::default();
        config.skip.check_every = 0;
        let clip = Clip::of_seed(3, (48, 32), 0.0).unwrap();
        let source = ModelSource::open(&config.model).unwrap();
        let engine = Engine::new(source, &config.model, 3, config.window.timespan_sec).unwrap();
        let mut maker = StepMaker::new(engine, clip.cameras.clone(), &config, None).unwrap();
        maker.run(clip.window.clone()).unwrap();
        let whole = maker.map().len();
        let revision = maker.map().revision();
        maker.run(clip.window.clone()).unwrap();
        assert_eq!((maker.map().len(), maker.map().revision()), (whole, revision + 1), "nothing in it is new");
        maker.set_map(StaticMap::new(&config.map));
        maker.run(clip.window.clone()).unwrap();
        assert!(whole > 0 && 10 * maker.map().len() >= 9 * whole, "{} of {whole}", maker.map().len());
    }
}
