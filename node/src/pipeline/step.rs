//! One step: a window through the network, its pictures, and what it adds to the map and the trajectories.

mod ladder;

use std::collections::VecDeque;
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
use crate::gate::contract::Notch;
use crate::gate::predict::PixelFlow;
use crate::gate::skipper::{Computed, Shadow, SkipCounts, Skipper};
use crate::map::{MapError, SceneLook, StaticMap};
use crate::objects::{MovingObject, ObjectCounts, ObjectTracker};
use crate::overlap::{Agreement, Overlap, OverlapCounts, OverlapLook};
use crate::rigid::Rigid;
use crate::source::Frame;
use crate::tracks::{Track, TrackCounts, Tracker};
use crate::window::Window;

use super::demand::Demand;
use super::guard::{MOST_IN_A_ROW, StagePanics, caught};
use super::timing::Timings;

/// A surface the map has seen at one place for this long stands, whatever a network under fast ego motion says of its
/// speed: nothing that moves at a gate of 1 m/s stays in a voxel that long.
const STANDS_SEC: f64 = 1.0;
/// Stamps remembered of sets the map was given: those of a window's length at 100 Hz.
const FUSED_KEPT: usize = 512;

/// A part of a step, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// Deciding whether to compute.
    Gate,
    /// The network.
    Network,
    /// Comparing with earlier windows.
    Overlap,
    /// Drawing.
    Draw,
    /// Adding to the map.
    Map,
    /// Trajectories and objects.
    Follow,
    /// Saving the map.
    Save,
}

impl Part {
    fn name(self) -> &'static str {
        match self {
            Self::Gate => "gate",
            Self::Network => "network",
            Self::Overlap => "overlap",
            Self::Draw => "drawing",
            Self::Map => "map",
            Self::Follow => "tracking",
            Self::Save => "saving",
        }
    }
}

/// Called as each part begins: where tests and `storm soak --faults` wait or panic.
pub type OnPart = Box<dyn FnMut(Part) + Send>;

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
    /// Stamps of sets the map was given at their newest; no more than a window holds.
    fused: VecDeque<i64>,
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
            fused: VecDeque::new(),
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
        self.map = map;
    }

    /// The map.
    pub fn map(&self) -> &StaticMap {
        &self.map
    }

    /// Trajectories alive.
    pub fn tracks(&self) -> &[Track] {
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

    /// Windows lost because a part of the step panicked.
    pub fn panics(&self) -> u64 {
        self.panics
    }

    /// Has `on_part` called as each part of a step begins.
    pub fn set_on_part(&mut self, on_part: OnPart) {
        self.on_part = Some(on_part);
    }

    fn enter(&mut self, part: Part) {
        self.part = part;
        if let Some(on_part) = &mut self.on_part {
            on_part(part);
        }
    }

    /// Runs parts of a step. When one panics, what it may have left half done is made anew and the window is dropped,
    /// counted and said.
    fn guarded<T>(&mut self, stamp_ns: i64, parts: impl FnOnce(&mut Self) -> Result<T>) -> Result<Option<T>> {
        match caught(|| parts(self)) {
            Ok(done) => {
                self.panics_in_a_row = 0;
                done.map(Some)
            }
            Err(what) => {
                self.panics += 1;
                self.panics_in_a_row += 1;
                let (stage, times) = (self.part.name(), self.panics_in_a_row);
                warn!("window at {stamp_ns} ns dropped: the {stage} stage panicked ({what}) and starts anew");
                self.rebuild()?;
                if times >= MOST_IN_A_ROW {
                    return Err(StagePanics { stage, times, what }.into());
                }
                Ok(None)
            }
        }
    }

    /// Makes anew what the present part changes.
    fn rebuild(&mut self) -> Result<()> {
        self.skipper.reset();
        match self.part {
            Part::Gate => {}
            Part::Network | Part::Draw => self.engine.restart()?,
            Part::Overlap => self.overlap.reset(),
            Part::Map | Part::Save => self.map.recover(),
            Part::Follow => {
                self.tracker.end_all();
                self.objects.end_all();
            }
        }
        Ok(())
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

    /// What follows the network; `shadow` belongs to the gate.
    fn take_in(
        &mut self,
        window: Window<Frame>,
        ran: Ran,
        demand: Demand,
        shadow: Option<&Shadow>,
    ) -> Result<Option<Step>> {
        let start = Instant::now();
        let Ran { scene, ms: network_ms, approximate } = ran;
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
        // A network told to may give the newest timestep alone.
        let given = &window.steps[window.steps.len() - scene.shape.timesteps.min(window.steps.len())..];
        let poses: Vec<Rigid> = given.iter().flat_map(|s| s.frames.iter().map(|f| f.map_from_camera)).collect();
        let stamps_ns: Vec<i64> = given.iter().map(|s| s.stamp_ns).collect();
        self.enter(Part::Overlap);
        let look = OverlapLook {
            stamps_ns: &stamps_ns,
            epoch: window.epoch,
            map_from_anchor: &window.map_from_anchor,
            cameras: &self.cameras,
            poses: &poses,
        };
        let agreement = self.timings.time("overlap", || self.overlap.step(&mut scene, &look));
        let newest = window.steps.len() - 1;
        let views = if demand.drawn() || self.skipper.wants_views() {
            self.enter(Part::Draw);
            let targets = views_of(&window.steps[newest], &window.map_from_anchor, &self.cameras);
            let time_sec = newest_time_sec(&window);
            let want = Want { flow: true, motion: demand.motion };
            self.timings.time("render", || self.engine.render(&scene, &targets, time_sec, want))?
        } else {
            Vec::new()
        };
        self.enter(Part::Map);
        if demand.map {
            let first_new = self.first_new(&stamps_ns);
            let look = SceneLook {
                stamp_ns: window.stamp_ns,
                map_from_anchor: &window.map_from_anchor,
                scene: &scene,
                cameras: &self.cameras,
                poses: &poses,
                rendered: &views,
                confidence: &agreement.geometry,
                first_new,
            };
            self.timings.time("map", || self.map.fuse_scene(&look));
        } else {
            // What is published relative to the map's origin needs one all the same.
            self.map.set_origin(window.map_from_anchor.translation);
        }
        let (scene, views, agreement) = (Arc::new(scene), Arc::from(views), Arc::new(agreement));
        self.enter(Part::Gate);
        let computed = Computed { window, scene, views, agreement, demand, approximate };
        self.skipper.computed(&computed, shadow);
        self.follow(&computed.scene, &computed.window, demand);
        let total_ms = network_ms + start.elapsed().as_secs_f64() * 1e3;
        let notch = approximate.then_some(Notch::Approximate);
        Ok(Some(self.step(computed, demand, notch, total_ms)))
    }

    /// The first of the newest timesteps that the map was not given before, windows that were skipped left out; it is given them
    /// now.
    fn first_new(&mut self, stamps_ns: &[i64]) -> usize {
        let new = stamps_ns.iter().rev().take_while(|s| !self.fused.contains(s)).count();
        self.fused.extend(&stamps_ns[stamps_ns.len() - new..]);
        while self.fused.len() > FUSED_KEPT {
            self.fused.pop_front();
        }
        stamps_ns.len() - new
    }

    /// What moves, into the trajectories and the objects.
    fn follow(&mut self, scene: &Scene, window: &Window<Frame>, demand: Demand) {
        self.enter(Part::Follow);
        let newest = scene.shape.timesteps - 1;
        if demand.tracks {
            let mut points = select::moving_points(scene, newest, &window.map_from_anchor, &self.config.tracks);
            for p in &mut points {
                let known = self.map.evidence(p.position_map);
                p.may_start = known.is_none_or(|k| f64::from(k.seen_for_sec) < STANDS_SEC);
            }
            self.timings.time("tracks", || self.tracker.step(window.stamp_ns, window.epoch, &points));
        }
        if demand.objects {
            let (_, parts) = select::object_points(scene, newest, &window.map_from_anchor, &self.config.tracks);
            self.timings.time("objects", || self.objects.step(window.stamp_ns, window.epoch, &parts));
        }
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
mod tests {
    use super::*;
    use crate::engine::ModelSource;
    use crate::engine::evaluate::clip::Clip;

    #[test]
    fn a_batch_that_panics_is_run_one_by_one_and_a_window_that_does_is_lost_alone() {
        let config = Config::default();
        let clips: Vec<Clip> = (3..6).map(|seed| Clip::of_seed(seed, (48, 32)).unwrap()).collect();
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
}
