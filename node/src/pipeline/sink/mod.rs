//! What a replay leaves behind: takes sets, steps and ground truth in order, writes the results folder.
//!
//! A file that cannot be written (a full disk) is given up at that moment, with what it has, and said; the others go on.

mod gallery;
mod topics;
mod trajectory;

pub use topics::{PREFIX, Publisher};

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result};
use tracing::warn;

use crate::config::{Config, WindowConfig};
use crate::engine::Engine;
use crate::engine::score::Scorer;
use crate::error_line::error_line;
use crate::objects::MovingObject;
use crate::output::OutputError;
use crate::output::objects_csv::ObjectsWriter;
use crate::output::ply::{PlyCloud, write_ply};
use crate::output::tracks_csv::{TrackRow, TracksWriter};
use crate::rigid::Rigid;
use crate::source::rig::RigCamera;
use crate::source::topics::TruthKind;
use crate::source::{Frame, Rig};
use crate::tracks::Track;
use crate::window::PosedSet;

use super::front::TruthImage;
use super::map_updates::MapUpdate;
use super::messages::Published;
use super::metrics::{Counts, Metrics};
use super::posed::seconds;
use super::step::{Finished, Step};
use super::timing::{Timings, peak_rss_mb};
use crate::output::atomic::write_bytes;
use gallery::{Gallery, Run};
use trajectory::Trajectory;

/// Most trajectory rows kept for the report's picture: some 2,000 trajectories of two seconds.
const ROWS_DRAWN: usize = 40_000;

/// One thing to write.
pub enum SinkInput {
    /// A synchronized, posed set.
    Set {
        /// The set.
        set: Arc<PosedSet<Frame>>,
        /// Stamp and vehicle pose at its first camera's image.
        vehicle: Option<(i64, Rigid)>,
    },
    /// Ground truth of a camera at a stamp.
    Truth {
        /// Which camera.
        camera: usize,
        /// Stamp, nanoseconds.
        stamp_ns: i64,
        /// What it holds.
        kind: TruthKind,
        /// The image.
        image: TruthImage,
    },
    /// A step's result.
    Step(Arc<Step>),
    /// Changed tiles of the map.
    Map(MapUpdate),
    /// Trajectories that have ended.
    Tracks(Vec<Track>),
    /// Moving objects that have ended.
    Objects(Vec<MovingObject>),
}

/// The writer's state over a run.
pub struct Sink {
    title: String,
    out: PathBuf,
    rig: Arc<Rig>,
    config: Config,
    publisher: Option<Publisher>,
    scorer: Option<Scorer>,
    gallery: Gallery,
    trajectory: Trajectory,
    sets: u64,
    last_gaussians: u64,
    epochs: u32,
    timings: Timings,
    /// None once it was given up.
    tracks: Option<TracksWriter>,
    /// None once it was given up.
    objects: Option<ObjectsWriter>,
    /// What could not be written.
    problems: Vec<String>,
    /// What outputs.mcap had published when it was given up.
    published: Published,
    /// The first ones, for the report.
    drawn: Vec<TrackRow>,
}

impl Sink {
    /// Starts the results folder `out` (which is there); `title` heads the report.
    pub fn create(title: &str, out: &Path, rig: &Arc<Rig>, engine: &Engine, config: &Config) -> Result<Self> {
        let publisher = match config.output.bag {
            true => Some(Publisher::create(&out.join("outputs.mcap"), rig.cameras.len())?),
            false => None,
        };
        let scorer = match config.output.score_held_out {
            true => Some(Scorer::new(engine.raster_settings(), rig.intrinsics(), config.output.score_frames_per_step)?),
            false => None,
        };
        Ok(Self {
            title: title.to_string(),
            out: out.to_path_buf(),
            rig: rig.clone(),
            config: config.clone(),
            publisher,
            scorer,
            gallery: Gallery::new(config.output.report_steps),
            trajectory: Trajectory::default(),
            sets: 0,
            last_gaussians: 0,
            epochs: 0,
            timings: Timings::default(),
            tracks: Some(TracksWriter::create(&out.join("tracks.csv"))?),
            objects: Some(ObjectsWriter::create(&out.join("objects.csv"))?),
            problems: Vec::new(),
            published: Published::default(),
            drawn: Vec::new(),
        })
    }

    /// Takes the next thing.
    pub fn take(&mut self, input: SinkInput) -> Result<()> {
        match input {
            SinkInput::Set { set, vehicle } => {
                self.sets += 1;
                self.epochs = self.epochs.max(set.epoch);
                if let Some((stamp_ns, map_from_base)) = vehicle {
                    self.trajectory.push(set.epoch, stamp_ns, map_from_base);
                }
                if let Some(scorer) = &mut self.scorer {
                    scorer.set(set);
                }
            }
            SinkInput::Truth { camera, stamp_ns, kind, image } => {
                if let Some(scorer) = &mut self.scorer {
                    scorer.truth(camera, stamp_ns, kind, image);
                }
            }
            SinkInput::Map(update) => {
                if let Some(publisher) = &mut self.publisher {
                    let rig = &self.rig;
                    if let Err(e) = self.timings.time("publish map", || publisher.map_update(&update, rig)) {
                        self.gave_up_bag("outputs.mcap at a map update", &e);
                    }
                }
            }
            SinkInput::Objects(ended) => self.write_objects(&ended),
            SinkInput::Tracks(ended) => self.write_tracks(&ended),
            SinkInput::Step(step) => {
                self.last_gaussians = step.scene.gaussians.len() as u64;
                if let Some(publisher) = &mut self.publisher {
                    let (rig, config) = (&self.rig, &self.config);
                    if let Err(e) = self.timings.time("publish", || publisher.step(&step, rig, config)) {
                        self.gave_up_bag(&format!("outputs.mcap after step {}", step.index), &e);
                    }
                }
                self.gallery.offer(&step);
                if let Some(scorer) = &mut self.scorer {
                    self.timings.time("score", || scorer.step(step))?;
                }
            }
        }
        Ok(())
    }

    fn gave_up(&mut self, what: &str, e: &anyhow::Error) {
        gave_up(&mut self.problems, what, e);
    }

    fn gave_up_bag(&mut self, what: &str, e: &anyhow::Error) {
        if let Some(publisher) = self.publisher.take() {
            self.published = publisher.counts();
        }
        self.gave_up(what, e);
    }

    fn write_objects(&mut self, ended: &[MovingObject]) {
        let Some(objects) = &mut self.objects else { return };
        if let Some(e) = ended.iter().find_map(|object| objects.write(object).err()) {
            self.objects = None;
            self.gave_up("objects.csv (what there is: objects.csv.part)", &e.into());
        }
    }

    /// Rows of trajectories that have ended, handed to the system at once.
    fn write_tracks(&mut self, ended: &[Track]) {
        for track in ended {
            let rows: Vec<TrackRow> = track_rows(track).collect();
            if let Some(e) = self.tracks.as_mut().and_then(|tracks| tracks.write(&rows).err()) {
                self.gave_up_tracks(e);
            }
            if self.drawn.len() + rows.len() <= ROWS_DRAWN {
                self.drawn.extend(rows);
            }
        }
        if let Some(e) = self.tracks.as_mut().and_then(|tracks| tracks.flush().err()) {
            self.gave_up_tracks(e);
        }
    }

    fn gave_up_tracks(&mut self, e: OutputError) {
        self.tracks = None;
        self.gave_up("tracks.csv (what there is: tracks.csv.part)", &e.into());
    }

    /// Writes what is written once, at the end.
    pub fn finish(
        mut self,
        finished: Finished,
        counts: Counts,
        weights: String,
        model: String,
        wall: Duration,
    ) -> Result<Metrics> {
        self.write_tracks(&finished.tracks);
        self.write_objects(&finished.objects);
        let Self { out, rig, config, publisher, scorer, gallery, trajectory, tracks, objects, drawn: rows, .. } = self;
        let poses = trajectory.all();
        let (mut problems, mut published) = (self.problems, self.published);
        let mut written = |what: &str, done: Result<()>| {
            if let Err(e) = done {
                gave_up(&mut problems, what, &e);
            }
        };
        written("tracks.csv", tracks.map_or(Ok(()), |t| Ok(t.finish()?)));
        written("objects.csv", objects.map_or(Ok(()), |o| Ok(o.finish()?)));
        let place = |name: &str| out.join(name);
        let origin = finished.map.origin();
        let map = finished.map.cloud().context("the map cannot be read back")?;
        let cloud = PlyCloud {
            positions: map.positions.clone(),
            colors01: map.colors01.clone(),
            opacities: map.opacities.clone(),
            scales: map.scales.clone(),
            quats: map.quats.clone(),
        };
        let notes = [
            format!("storm {}; weights: {weights}; model: {model}", env!("CARGO_PKG_VERSION")),
            format!(
                "static map without the sky; positions in metres, relative to origin_m in the frame {}",
                rig.map_frame
            ),
        ];
        written("map.ply", write_ply(&place("map.ply"), &cloud, origin.to_array(), &notes).map_err(Into::into));
        let tum = trajectory.write(&out, &rig.map_frame, &rig.base_frame);
        written("trajectory.tum", tum.map_err(Into::into));
        let yaml = config.to_yaml();
        written("config.yaml", write_bytes(&place("config.yaml"), yaml.as_bytes()).map_err(Into::into));
        if let Some(publisher) = publisher {
            published = publisher.counts();
            let done = publisher.finish(&cloud, origin, &trajectory, &rig);
            written("the end of outputs.mcap", done.map(|counts| published = counts));
        }
        let mut timings = finished.timings;
        timings.merge(self.timings);
        let held_out = match scorer {
            Some(scorer) => scorer.finish()?,
            None => None,
        };
        problems.extend(counts.problems);
        let recorded_sec = trajectory.recorded_ns() as f64 * 1e-9;
        let tried = finished.steps + counts.non_finite_windows;
        let no_steps = (tried == 0).then(|| no_steps(&config.window, self.sets, recorded_sec));
        let mut metrics = Metrics {
            recording: self.title.clone(),
            weights,
            model,
            images_in: counts.images_in,
            frames_in: self.sets,
            steps: finished.steps,
            steps_skipped: finished.skips.skipped(),
            skips: finished.skips,
            dropped: counts.dropped,
            masked_share: rig.cameras.iter().map(RigCamera::masked_share).collect(),
            messages_lost: counts.messages_lost,
            poses_rejected: counts.poses_rejected,
            non_finite_windows: counts.non_finite_windows,
            stage_panics: counts.stage_panics,
            nonfinite: published.non_finite,
            withheld: published.withheld,
            problems,
            latency_ms: timings.stats(),
            peak_rss_mb: peak_rss_mb(),
            wall_sec: wall.as_secs_f64(),
            recorded_sec,
            gaussians: self.last_gaussians,
            gaussians_left_out: published.truncated,
            map_gaussians: finished.map.len() as u64,
            map: finished.map.counts(),
            map_mb: finished.map.bytes() as f64 / f64::from(1 << 20),
            map_saves_failed: finished.map_saves_failed,
            map_evicted: finished.map.counts().evicted,
            tracks: finished.track_counts.finished,
            track_counts: finished.track_counts,
            objects: finished.object_counts,
            overlap: finished.overlap,
            batch: finished.batch,
            map_frame: rig.map_frame.clone(),
            base_frame: rig.base_frame.clone(),
            origin_m: origin.to_array(),
            epochs: self.epochs,
            verdict: counts.verdict,
            no_steps,
            held_out,
        };
        let json = serde_json::to_string_pretty(&metrics).context("metrics.json")? + "\n";
        let mut late = Vec::new();
        if let Err(e) = write_bytes(&place("metrics.json"), json.as_bytes()) {
            late.push(format!("metrics.json could not be written: {e}"));
        }
        let title = self.title;
        let run = Run { title: &title, metrics: &metrics, map: &map, tracks: &rows, poses: &poses, config: &config };
        if let Err(e) = gallery.write(&place("report.html"), &rig, &run) {
            late.push(format!("report.html could not be written: {}", error_line(&e)));
        }
        metrics.problems.extend(late);
        Ok(metrics)
    }
}

/// Why there was no window, and what one needs.
fn no_steps(window: &WindowConfig, sets: u64, recorded_sec: f64) -> String {
    format!(
        "no step was run: a window needs {} timesteps {} s apart, {} s in all (window.timesteps, window.stride_sec), and there are \
         {sets} sets of images with poses over {} s",
        window.timesteps,
        window.stride_sec,
        seconds(window.span_sec()),
        seconds(recorded_sec)
    )
}

fn gave_up(problems: &mut Vec<String>, what: &str, e: &anyhow::Error) {
    let line = format!("{what} could not be written: {}", error_line(e));
    warn!("{line}");
    problems.push(line);
}

fn track_rows(track: &Track) -> impl Iterator<Item = TrackRow> + '_ {
    track.points.iter().map(|p| TrackRow {
        track_id: track.id,
        stamp_ns: p.stamp_ns,
        position_m: p.position_map.to_array(),
        velocity_mps: p.velocity_map_mps.as_vec3().to_array(),
        motion_id: p.motion_id,
    })
}
