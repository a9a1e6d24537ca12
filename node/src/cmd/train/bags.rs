//! Clips cut from recorded bags, for training without labels: the same reading, decoding, rectifying, synchronising and
//! posing that replay does, kept as 8-bit pictures of the network's size.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use storm_model::ModelConfig;
use storm_model::train::{ClipOptions, ClipSource, RecordedPicture, SkyLabel, TrainClip, TrainError, recorded_clip};
use storm_render::Intrinsics;
use tracing::info;

use crate::cmd::UsageError;
use crate::config::Config;
use crate::engine::truth::sample;
use crate::pipeline::front::{Front, FrontOutput, TruthImage};
use crate::pipeline::posed::PoseStore;
use crate::source::bag::BagSource;
use crate::source::event::Truth;
use crate::source::topics::TruthKind;
use crate::source::{Frame, Rig};
use crate::sync::clock::seconds_between;
use crate::window::{PosedSet, camera_from_flu, relative};

use super::cuts::{Cut, cuts};

/// Pictures of one bag kept in memory at most, bytes.
const MEMORY_LIMIT: usize = 4 << 30;

/// Pictures whose darkest and brightest value are no further apart show nothing: a covered lens, a decoder's grey.
const FLAT: u8 = 2;

/// Target moments of a clip that is scored.
const SCORED: usize = 8;

/// Rays this far below the vehicle's horizontal meet the ground (slopes of 10 degrees and more are no roads).
const GROUND_BELOW_DEG: f64 = 10.0;

/// Which part of a bag, and how.
#[derive(Debug, Clone)]
pub struct BagOptions {
    /// Seconds after the first synchronized set.
    pub from_sec: f64,
    /// Seconds after the first synchronized set; infinity: all.
    pub to_sec: f64,
    /// Use only the rig's first cameras.
    pub cameras: Option<usize>,
    /// Sizes and times of clips.
    pub clips: ClipOptions,
}

/// What one camera saw at one moment.
struct Picture {
    frame: crate::window::PosedFrame<Frame>,
    depth: Option<Vec<f32>>,
    sky: Option<Vec<SkyLabel>>,
}

/// A bag's pictures in memory and the clips that can be cut from them.
pub struct BagClips {
    name: String,
    cameras: Vec<Intrinsics>,
    reference: usize,
    /// Per camera, what the ground must be where nobody labelled the sky.
    ground: Vec<Vec<SkyLabel>>,
    sets: Vec<(i64, Vec<Picture>)>,
    inside: Vec<Cut>,
    outside: Vec<Cut>,
    span_sec: f64,
    depth_labels: bool,
}

/// What was found and left out on the way.
#[derive(Debug, Default)]
struct Read {
    sets: Vec<Arc<PosedSet<Frame>>>,
    depth: BTreeMap<(usize, i64), Vec<f32>>,
    sky: BTreeMap<(usize, i64), Vec<u16>>,
    flat: usize,
    dropped: u64,
}

impl BagClips {
    /// Reads a bag. `config` says how its topics are used, `size` is the network's picture.
    pub fn open(path: &Path, config: &Config, size: (usize, usize), options: &BagOptions) -> Result<Self> {
        let name = path.file_name().map_or_else(|| "bag".into(), |n| n.to_string_lossy().into_owned());
        let source = BagSource::open(path, config, size)?;
        let rig = source.rig();
        rig.log(size);
        let cameras = match options.cameras {
            Some(n) if n > rig.cameras.len() => {
                let text = format!("--bag-cameras {n}: bag {name} has {} camera(s)", rig.cameras.len());
                return Err(UsageError(text).into());
            }
            Some(n) => n,
            None => rig.cameras.len(),
        };
        if rig.reference >= cameras {
            let text = format!(
                "--bag-cameras {cameras}: the anchor's camera is number {} of bag {name}; name the cameras in order with input.images in --bag-config",
                rig.reference + 1
            );
            return Err(UsageError(text).into());
        }
        let read = read(&source, &rig, config, cameras, size)?;
        let depth_labels = !read.depth.is_empty();
        let sky_labels = !read.sky.is_empty();
        let stamps: Vec<(i64, u32)> = read.sets.iter().map(|s| (s.stamp_ns, s.epoch)).collect();
        let range = (options.from_sec, options.to_sec);
        let (inside, outside) = cuts(&stamps, range, &options.clips);
        let recorded = match (stamps.first(), stamps.last()) {
            (Some(first), Some(last)) => seconds_between(first.0, last.0),
            _ => 0.0,
        };
        if inside.is_empty() {
            bail!(
                "bag {name}: no clip of {} timesteps {} s apart fits into its {} usable synchronized sets of {recorded:.1} s between {} s and {} s ({} sets flat and left out, {} images dropped by synchronisation and poses)",
                options.clips.timesteps,
                options.clips.stride_sec,
                stamps.len(),
                options.from_sec,
                options.to_sec.min(recorded),
                read.flat,
                read.dropped,
            );
        }
        info!(
            "bag {name}: {} synchronized sets of {cameras} camera(s) in {recorded:.1} s, {} clips to learn from, {} outside the range; {} flat sets left out, {} images dropped; {} depth, {} sky labels",
            stamps.len(),
            inside.len(),
            outside.len(),
            read.flat,
            read.dropped,
            if depth_labels { "with" } else { "no" },
            if sky_labels { "with" } else { "no" }
        );
        let ground = rig.cameras[..cameras]
            .iter()
            .map(|c| ground(&c.intrinsics, &c.base_from_camera.rotation))
            .collect::<Vec<_>>();
        let intrinsics = rig.intrinsics()[..cameras].to_vec();
        let sets = with_labels(read, cameras);
        Ok(Self {
            name,
            cameras: intrinsics,
            reference: rig.reference,
            ground,
            sets,
            inside,
            outside,
            span_sec: options.clips.span_sec,
            depth_labels,
        })
    }

    /// The bag's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Cameras used.
    pub fn cameras(&self) -> usize {
        self.cameras.len()
    }

    /// Whether it has depth to learn from.
    pub fn has_depth(&self) -> bool {
        self.depth_labels
    }

    /// Clips that lie outside the range to learn from, their targets spread over the moments that are not context.
    pub fn outside(&self, config: &ModelConfig) -> Vec<Result<TrainClip, TrainError>> {
        self.outside
            .iter()
            .map(|cut| {
                let held: Vec<usize> = cut.moments.clone().filter(|k| !cut.context.contains(k)).collect();
                let want = SCORED.min(held.len());
                let targets: Vec<usize> = (0..want).map(|i| held[i * held.len() / want]).collect();
                self.cut(cut, &targets, false, config)
            })
            .collect()
    }

    fn cut(
        &self,
        cut: &Cut,
        targets: &[usize],
        one_camera: bool,
        config: &ModelConfig,
    ) -> Result<TrainClip, TrainError> {
        let gone = || TrainError::Source(format!("bag {}: a clip names a set that is not there", self.name));
        let first = cut.context.first().and_then(|&k| self.sets.get(k)).ok_or_else(gone)?;
        let map_from_anchor = first.1[self.reference].frame.map_from_camera * camera_from_flu();
        let used = if one_camera { self.reference..self.reference + 1 } else { 0..self.cameras.len() };
        let row = |k: &usize| -> Result<Vec<RecordedPicture<'_>>, TrainError> {
            let (_, pictures) = self.sets.get(*k).ok_or_else(gone)?;
            let view = |camera: usize| {
                let Picture { frame, depth, sky } = &pictures[camera];
                RecordedPicture {
                    rgb: &frame.item.rgb.data,
                    intrinsics: self.cameras[camera],
                    anchor_from_camera: relative(&map_from_anchor, &frame.map_from_camera).snapped().to_f32(),
                    time_sec: seconds_between(first.0, frame.stamp_ns) as f32,
                    depth: depth.as_deref(),
                    sky: Some(sky.as_deref().unwrap_or(&self.ground[camera])),
                    valid: frame.item.valid.as_deref(),
                }
            };
            Ok(used.clone().map(view).collect())
        };
        let rows = |sets: &[usize]| sets.iter().map(row).collect::<Result<Vec<_>, _>>();
        recorded_clip(&rows(&cut.context)?, &rows(targets)?, self.span_sec, config)
    }
}

impl ClipSource for BagClips {
    fn starts(&self) -> usize {
        self.inside.len()
    }

    fn moments(&self, start: usize) -> usize {
        self.inside.get(start).map_or(1, |cut| cut.moments.len())
    }

    fn clip(
        &self,
        start: usize,
        moments: &[usize],
        one_camera: bool,
        config: &ModelConfig,
    ) -> Result<TrainClip, TrainError> {
        let Some(cut) = self.inside.get(start) else {
            return Err(TrainError::Source(format!("bag {} has no clip {start}", self.name)));
        };
        let targets: Vec<usize> = moments.iter().map(|m| cut.moments.start + m).collect();
        self.cut(cut, &targets, one_camera, config)
    }
}

/// Runs the bag through the stages in front of the network.
fn read(source: &BagSource, rig: &Arc<Rig>, config: &Config, cameras: usize, size: (usize, usize)) -> Result<Read> {
    let store = PoseStore::of_bag(source, rig, config);
    let mut front = Front::new(config, rig, store);
    let (mut read, mut ready) = (Read::default(), VecDeque::new());
    let set_bytes = cameras * size.0 * size.1 * 3;
    let mut full = false;
    source.events(|event| {
        front.take(event, &mut ready);
        ready.drain(..).for_each(|output| read.take(output, cameras, size));
        full = read.sets.len().saturating_mul(set_bytes) > MEMORY_LIMIT;
        !full
    })?;
    if full {
        bail!("its pictures take more than {} GB of memory; cut the bag into shorter ones", MEMORY_LIMIT >> 30);
    }
    front.finish(&mut ready);
    ready.drain(..).for_each(|output| read.take(output, cameras, size));
    source.problems().iter().for_each(|p| tracing::warn!("{p}"));
    read.dropped = front.drops().total();
    Ok(read)
}

impl Read {
    fn take(&mut self, output: FrontOutput, cameras: usize, size: (usize, usize)) {
        match output {
            FrontOutput::Set(set) => {
                let whole = set.frames.len() >= cameras;
                if whole && set.frames[..cameras].iter().all(|f| shows_something(&f.item.rgb.data)) {
                    self.sets.push(set);
                } else {
                    self.flat += 1;
                }
            }
            FrontOutput::Truth { camera, stamp_ns, kind, image } if camera < cameras => {
                self.label(camera, stamp_ns, kind, &image, size);
            }
            FrontOutput::Truth { .. } | FrontOutput::Window(_) => {}
        }
    }

    /// Depth and sky only: moving pixels and flow are what self-supervised training has to find by itself.
    fn label(&mut self, camera: usize, stamp_ns: i64, kind: TruthKind, image: &TruthImage, size: (usize, usize)) {
        match (&*image.data, kind) {
            (Truth::Depth(depth), _) => {
                if let Some(depth) = sample(depth, image, size) {
                    self.depth.insert((camera, stamp_ns), depth);
                }
            }
            (Truth::Mask(mask), TruthKind::Sky) => {
                if let Some(sky) = sample(mask, image, size) {
                    self.sky.insert((camera, stamp_ns), sky);
                }
            }
            _ => {}
        }
    }
}

fn shows_something(rgb: &[u8]) -> bool {
    match (rgb.iter().min(), rgb.iter().max()) {
        (Some(least), Some(most)) => most - least > FLAT,
        _ => false,
    }
}

fn with_labels(read: Read, cameras: usize) -> Vec<(i64, Vec<Picture>)> {
    let Read { sets, mut depth, mut sky, .. } = read;
    let label = |&x: &u16| if x > 0 { SkyLabel::Sky } else { SkyLabel::Surface };
    sets.iter()
        .map(|set| {
            let picture = |camera: usize| {
                let frame = set.frames[camera].clone();
                let key = (camera, frame.stamp_ns);
                let sky = sky.remove(&key).map(|mask| mask.iter().map(label).collect());
                Picture { depth: depth.remove(&key), sky, frame }
            };
            (set.stamp_ns, (0..cameras).map(picture).collect())
        })
        .collect()
}

/// Surface where a pixel's ray points clearly below the vehicle's horizontal, unknown elsewhere.
fn ground(k: &Intrinsics, base_from_camera: &glam::DQuat) -> Vec<SkyLabel> {
    let below = -GROUND_BELOW_DEG.to_radians().sin();
    let pixel = |i: usize| {
        let ray = k.ray((i % k.width) as f32 + 0.5, (i / k.width) as f32 + 0.5);
        let up = (*base_from_camera * ray.as_dvec3().normalize()).z;
        if up < below { SkyLabel::Surface } else { SkyLabel::Unknown }
    };
    (0..k.width * k.height).map(pixel).collect()
}

/// Reads all bags of a run.
pub fn open_all(
    bags: &[String],
    config: Option<&str>,
    size: (usize, usize),
    options: &BagOptions,
) -> Result<Vec<Arc<BagClips>>> {
    let config = match config {
        Some(path) => Config::load(Path::new(path))?,
        None => Config::default(),
    };
    bags.iter()
        .map(|bag| {
            let clips = BagClips::open(Path::new(bag), &config, size, options);
            Ok(Arc::new(clips.with_context(|| format!("cannot learn from bag {bag}"))?))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

    #[test]
    fn the_ground_is_below_the_horizon_and_nothing_is_said_of_the_rest() {
        // Optical frame looking along the vehicle's x axis, 45 degrees up and down.
        let level = DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5);
        let k = Intrinsics { fx: 10.0, fy: 10.0, cx: 5.0, cy: 10.0, width: 10, height: 20 };
        let labels = ground(&k, &level);
        let rows: Vec<bool> = (0..20).map(|r| labels[r * 10 + 5] == SkyLabel::Surface).collect();
        // tan(10 degrees) is 1.8 pixels below the centre row.
        assert!(rows[..11].iter().all(|s| !s) && rows[12..].iter().all(|&s| s), "{rows:?}");
        assert!(labels.iter().all(|&l| l != SkyLabel::Sky));
    }

    #[test]
    fn flat_pictures_show_nothing() {
        assert!(!shows_something(&[]) && !shows_something(&[7; 30]) && !shows_something(&[7, 8, 9]));
        assert!(shows_something(&[7, 8, 10]));
    }
}
