//! The long drive itself: set by set into the map and the trackers, timed, with memory watched.

use std::collections::HashSet;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result};
use serde::Serialize;
use storm_model::scene::{Affine, Scene};
use storm_render::raster::CpuRasterizer;
use storm_render::world::{Drive, DriveOptions};

use crate::config::Config;
use crate::engine::select;
use crate::map::{MapCounts, SceneLook, StaticMap};
use crate::objects::{ObjectCounts, ObjectTracker};
use crate::overlap::{Overlap, OverlapCounts, OverlapLook};
use crate::pipeline::timing::{cpu_ms, rss_mb};
use crate::tracks::{TrackCounts, Tracker};

use super::map_quality::{MapFigures, MapJudge, ever_moving};
use super::memory::{Memory, allocator_mb};
use super::motion_quality::{MotionFigures, MotionJudge};
use super::object_quality::{ObjectFigures, ObjectJudge};
use super::oracle::{OracleErrors, OracleSet, OracleStep, OracleWindow};
use super::track_quality::{TrackFigures, TrackJudge};

/// What to drive and what to measure.
#[derive(Debug, Clone)]
pub struct SoakOptions {
    /// The drive: seed, length, picture size, rate.
    pub drive: DriveOptions,
    /// Errors put on the truth.
    pub errors: OracleErrors,
    /// Judge pictures, surfaces and ghosts; needs a second map in memory, for tags, and every picture drawn twice.
    pub quality: bool,
    /// Folder for the map's tiles; none: the map lives in memory alone.
    pub map_dir: Option<PathBuf>,
    /// The configuration.
    pub config: Config,
}

/// Percentiles (nearest rank) of a stage's times, milliseconds.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Spread {
    /// Median wall time.
    pub p50: f64,
    /// 99th percentile of wall time.
    pub p99: f64,
    /// Median of the time all threads ran, without what other programs took.
    pub cpu_p50: f64,
    /// 99th percentile of that.
    pub cpu_p99: f64,
}

/// A quarter of the drive.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Quarter {
    /// Fusing.
    pub fuse_ms: Spread,
    /// Trajectories.
    pub track_ms: Spread,
    /// Comparing overlapping windows.
    pub overlap_ms: Spread,
    /// All three together.
    pub step_ms: Spread,
    /// Mean and largest resident memory, MB.
    pub rss_mb: [f64; 2],
    /// Map Gaussians in memory, and those on disk alone, at its end.
    pub map_gaussians: [usize; 2],
    /// Mean of what the map's tiles hold, MB: it comes and goes between the cap and what a spill leaves.
    pub tiles_mb: f64,
    /// Mean of what was asked of the allocator and not given back, MB.
    pub allocated_mb: f64,
    /// Where memory is at its end.
    pub memory_mb: Memory,
}

/// What the last quarter has more than the second, as a part: 0.02 is 2 %.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Growth {
    /// Of mean resident memory.
    pub resident: f64,
    /// Of a step's 99th percentile, wall time.
    pub step_p99: f64,
    /// Of a step's 99th percentile, processor time.
    pub step_cpu_p99: f64,
}

impl Growth {
    fn of(quarters: &[Quarter]) -> Self {
        let more = |of: &dyn Fn(&Quarter) -> f64| match quarters {
            [_, second, _, last] if of(second) > 0.0 => of(last) / of(second) - 1.0,
            _ => 0.0,
        };
        Self {
            resident: more(&|q| q.rss_mb[0]),
            step_p99: more(&|q| q.step_ms.p99),
            step_cpu_p99: more(&|q| q.step_ms.cpu_p99),
        }
    }
}

/// What a soak found.
#[derive(Debug, Clone, Serialize)]
pub struct SoakReport {
    /// Seed of the drive.
    pub seed: u64,
    /// Seconds driven.
    pub seconds: f64,
    /// Metres driven.
    pub metres: f64,
    /// Sets taken.
    pub sets: usize,
    /// Windows fused.
    pub steps: usize,
    /// Gaussians of a window.
    pub gaussians: usize,
    /// Threads.
    pub threads: usize,
    /// Fusing, over all.
    pub fuse_ms: Spread,
    /// Trajectories, over all.
    pub track_ms: Spread,
    /// Comparing overlapping windows, over all.
    pub overlap_ms: Spread,
    /// What overlapping windows said of each other.
    pub overlap: OverlapCounts,
    /// Last quarter against the second: mean resident memory, and 99th percentile of a step's processor time.
    pub growth: Growth,
    /// The four quarters.
    pub quarters: Vec<Quarter>,
    /// What became of the Gaussians.
    pub map: MapCounts,
    /// Map Gaussians, those on disk included.
    pub map_gaussians: usize,
    /// Memory of the map, MB.
    pub map_mb: f64,
    /// Its files, MB.
    pub map_disk_mb: f64,
    /// Most trajectories alive at once.
    pub live_tracks: usize,
    /// What became of the trajectories.
    pub tracks: TrackCounts,
    /// Grouping and following moving objects, over all.
    pub object_ms: Spread,
    /// What became of the objects.
    pub objects: ObjectCounts,
    /// The map against the truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub map_quality: Option<MapFigures>,
    /// What is said to move against the truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub motion_quality: Option<MotionFigures>,
    /// The trajectories against the truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub track_quality: Option<TrackFigures>,
    /// The moving objects against the truth.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub object_quality: Option<ObjectFigures>,
}

/// One step's times.
#[derive(Debug, Clone, Copy, Default)]
struct Times {
    fuse: [f64; 2],
    overlap: [f64; 2],
    track: [f64; 2],
    objects: [f64; 2],
    rss_mb: f64,
    tiles_mb: f64,
    allocated_mb: f64,
    map: [usize; 2],
}

/// Wall and processor time of some work, milliseconds.
fn timed<R>(work: impl FnOnce() -> R) -> (R, [f64; 2]) {
    let (cpu, start) = (cpu_ms(), Instant::now());
    let result = work();
    let wall = start.elapsed().as_secs_f64() * 1e3;
    let cpu = cpu.zip(cpu_ms()).map_or(0.0, |(a, b)| b - a);
    (result, [wall, cpu])
}

fn spread(times: &[Times], of: impl Fn(&Times) -> [f64; 2]) -> Spread {
    let sorted = |k: usize| {
        let mut v: Vec<f64> = times.iter().map(|t| of(t)[k]).collect();
        v.sort_by(f64::total_cmp);
        v
    };
    let at =
        |v: &[f64], q: f64| v.get(((q * v.len() as f64).ceil() as usize).saturating_sub(1)).copied().unwrap_or(0.0);
    let (wall, cpu) = (sorted(0), sorted(1));
    Spread { p50: at(&wall, 0.5), p99: at(&wall, 0.99), cpu_p50: at(&cpu, 0.5), cpu_p99: at(&cpu, 0.99) }
}

fn quarter(times: &[Times], memory_mb: Memory) -> Quarter {
    let n = times.len().max(1) as f64;
    Quarter {
        fuse_ms: spread(times, |t| t.fuse),
        track_ms: spread(times, |t| t.track),
        overlap_ms: spread(times, |t| t.overlap),
        step_ms: spread(times, |t| [0, 1].map(|k| t.fuse[k] + t.overlap[k] + t.track[k])),
        rss_mb: [times.iter().map(|t| t.rss_mb).sum::<f64>() / n, times.iter().map(|t| t.rss_mb).fold(0.0, f64::max)],
        map_gaussians: times.last().map_or([0; 2], |t| t.map),
        tiles_mb: times.iter().map(|t| t.tiles_mb).sum::<f64>() / n,
        allocated_mb: times.iter().map(|t| t.allocated_mb).sum::<f64>() / n,
        memory_mb,
    }
}

/// The second map: the same Gaussians, with what belongs to road users that move at some time in red.
struct Tagged {
    map: StaticMap,
    moving: HashSet<u16>,
}

/// Drives, measures, judges. `progress` is told the sets done.
pub fn run(options: &SoakOptions, progress: &dyn Fn(usize)) -> Result<SoakReport> {
    let drive = Drive::new(&options.drive)?;
    let config = &options.config;
    let stride = ((config.window.stride_sec * options.drive.rate_hz).round() as usize).max(1);
    let reference = if options.drive.cameras >= 3 { 1 } else { 0 };
    let ego_leak = (options.errors.ego_leak, options.drive.seed);
    let mut windows = OracleWindow::new(config.window.timesteps, stride, reference, ego_leak)?;
    let mut map = match &options.map_dir {
        Some(dir) => StaticMap::in_folder(&config.map, dir)?,
        None => StaticMap::new(&config.map),
    };
    let mut tagged = options
        .quality
        .then(|| Tagged { map: StaticMap::new(&config.map), moving: ever_moving(&drive, options.drive.seconds) });
    let mut tracker = Tracker::new(&config.tracks);
    let mut objects = ObjectTracker::new(&config.objects);
    let mut overlap = Overlap::new(&config.overlap);
    let mut motion_judge = options.quality.then(MotionJudge::default);
    let mut object_judge = options.quality.then(ObjectJudge::default);
    let mut map_judge: Option<MapJudge> = None;
    let mut track_judge = options.quality.then(|| TrackJudge::new(&drive));
    let cameras: Vec<_> = drive.cameras().iter().map(|c| c.intrinsics).collect();
    let sets = drive.frame_count();
    let (all_steps, mut memory) = (sets.saturating_sub((config.window.timesteps - 1) * stride), Vec::new());
    // Written to once, so that the measurements do not grow the memory they measure.
    let mut times = vec![Times { rss_mb: 1.0, ..Times::default() }; all_steps];
    times.clear();
    let mut recent = std::collections::VecDeque::new();
    let (mut live_tracks, mut gaussians) = (0, 0);
    // A held-out pose every two seconds: enough of them to judge, few enough to draw.
    let every = ((2.0 * options.drive.rate_hz) as usize).max(1);
    for frame in 0..sets {
        let set = Arc::new(OracleSet::at(&drive, drive.frame_time_sec(frame, 0), &options.errors));
        recent.push_back(set.clone());
        if recent.len() > stride * config.window.timesteps {
            recent.pop_front();
        }
        let Some(mut step) = windows.push(set.clone()) else { continue };
        let newest = config.window.timesteps - 1;
        let as_given = motion_judge.is_some().then(|| step.scene.clone());
        let stamps_ns: Vec<i64> =
            (0..=newest).map(|t| recent[recent.len() - 1 - (newest - t) * stride].stamp_ns()).collect();
        let overlapping = OverlapLook {
            stamps_ns: &stamps_ns,
            epoch: 0,
            map_from_anchor: &step.map_from_anchor,
            cameras: &cameras,
            poses: &step.poses,
        };
        let (agreement, overlap_ms) = timed(|| overlap.step(&mut step.scene, &overlapping));
        if let (Some(judge), Some(as_given)) = (&mut motion_judge, &as_given) {
            judge.step(&set, as_given, &step.scene);
        }
        let look = SceneLook {
            stamp_ns: set.stamp_ns(),
            map_from_anchor: &step.map_from_anchor,
            scene: &step.scene,
            cameras: &cameras,
            poses: &step.poses,
            rendered: &[],
            confidence: &agreement.geometry,
            first_new: if times.is_empty() { 0 } else { config.window.timesteps - 1 },
        };
        let (_, fuse) = timed(|| map.fuse_scene(&look));
        if let Some(tagged) = &mut tagged {
            let scene = tag(&step, &recent, stride, &tagged.moving);
            tagged.map.fuse_scene(&SceneLook { scene: &scene, ..look });
        }
        let points = select::moving_points(&step.scene, newest, &step.map_from_anchor, &config.tracks);
        let (_, track) = timed(|| tracker.step(set.stamp_ns(), 0, &points));
        live_tracks = live_tracks.max(tracker.live().len());
        gaussians = step.scene.gaussians.len();
        if let Some(judge) = &mut track_judge {
            judge.step(&drive, &set, tracker.live());
        }
        drop(tracker.drain());
        let (pixels, parts) = select::object_points(&step.scene, newest, &step.map_from_anchor, &config.tracks);
        let (owners, object_ms) = timed(|| objects.step(set.stamp_ns(), 0, &parts));
        if let Some(judge) = &mut object_judge {
            judge.step(&drive, &set, &pixels, &owners, &objects, &config.objects)?;
        }
        drop(objects.drain());
        let loaded = map.loaded();
        let rss_mb = rss_mb().unwrap_or(0.0);
        times.push(Times {
            fuse,
            overlap: overlap_ms,
            track,
            objects: object_ms,
            rss_mb,
            tiles_mb: map.bytes() as f64 / 1e6,
            allocated_mb: allocator_mb().0,
            map: [loaded, map.len() - loaded],
        });
        if 4 * times.len() >= (memory.len() + 1) * all_steps {
            let mb = |bytes: usize| bytes as f64 / 1e6;
            memory.push(
                Memory {
                    tiles: mb(map.bytes()),
                    map_side: mb(map.side_bytes()),
                    tracks: mb(tracker.bytes()),
                    objects: mb(objects.bytes()),
                    overlap: mb(overlap.bytes()),
                    sets: mb(windows.bytes()),
                    measurements: mb(times.capacity() * size_of::<Times>()),
                    ..Memory::default()
                }
                .of_process(),
            );
        }
        if options.quality && frame.is_multiple_of(every) {
            let judge = match &mut map_judge {
                Some(judge) => judge,
                None => map_judge.insert(MapJudge::new(CpuRasterizer::new(step.scene.raster_settings())?)),
            };
            // Half way between two sets, in the middle of the window.
            let time_sec = set.time_sec - (0.5 * newest as f64 * stride as f64 + 0.5) / options.drive.rate_hz;
            judge.window(&drive, &step.scene, &step.map_from_anchor, step.first_sec, time_sec)?;
        }
        progress(frame + 1);
    }
    let end_sec = drive.frame_time_sec(sets.saturating_sub(1), 0);
    let map_quality = match (map_judge, &tagged) {
        (Some(judge), Some(tagged)) => {
            let clouds = (map.cloud()?, tagged.map.cloud()?);
            Some(judge.finish(&drive, &clouds.0, &clouds.1, end_sec)?)
        }
        _ => None,
    };
    if map.folder().is_some() {
        map.save().context("the map could not be saved")?;
    }
    let n = times.len();
    let memory_at = |q: usize| memory.get(q).copied().unwrap_or_default();
    let quarters: Vec<Quarter> = (0..4).map(|q| quarter(&times[q * n / 4..(q + 1) * n / 4], memory_at(q))).collect();
    let metres = (0..sets)
        .map(|i| drive.map_from_base(drive.frame_time_sec(i, 0)).translation)
        .collect::<Vec<_>>()
        .windows(2)
        .map(|w| w[0].distance(w[1]))
        .sum();
    Ok(SoakReport {
        seed: options.drive.seed,
        seconds: options.drive.seconds,
        metres,
        sets,
        steps: n,
        gaussians,
        threads: rayon::current_num_threads(),
        fuse_ms: spread(&times, |t| t.fuse),
        track_ms: spread(&times, |t| t.track),
        overlap_ms: spread(&times, |t| t.overlap),
        overlap: overlap.counts(),
        growth: Growth::of(&quarters),
        quarters,
        map: map.counts(),
        map_gaussians: map.len(),
        map_mb: map.bytes() as f64 / 1e6,
        map_disk_mb: map.disk_bytes() as f64 / 1e6,
        live_tracks,
        tracks: tracker.counts(),
        map_quality,
        object_ms: spread(&times, |t| t.objects),
        objects: objects.counts(),
        motion_quality: motion_judge.map(MotionJudge::finish),
        object_quality: object_judge.map(ObjectJudge::finish),
        track_quality: track_judge.map(TrackJudge::finish).transpose()?,
    })
}

/// The scene with 1 in red where a pixel shows a road user that moves at some time, else 0.
fn tag(
    step: &OracleStep,
    recent: &std::collections::VecDeque<Arc<OracleSet>>,
    stride: usize,
    moving: &HashSet<u16>,
) -> Scene {
    let mut scene = step.scene.clone();
    scene.affine = vec![Affine::IDENTITY; scene.shape.cameras];
    let span = (scene.shape.timesteps - 1) * stride + 1;
    let first = recent.len().saturating_sub(span);
    for t in 0..scene.shape.timesteps {
        for c in 0..scene.shape.cameras {
            let frame = &recent[first + t * stride].frames[c];
            for (i, p) in scene.shape.picture(t, c).enumerate().map(|(p, i)| (i, p)) {
                let tagged = moving.contains(&frame.instance[p]);
                scene.gaussians.colors[i] = if tagged { [1.0, -1.0, -1.0] } else { [-1.0; 3] };
            }
        }
    }
    scene
}
