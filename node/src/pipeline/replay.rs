//! A recorded bag from end to end. The one file with threads and channels: reader (decode) -> step -> writer, joined by
//! bounded channels that block, so nothing is dropped and the order of results is the order of the recording.

use std::collections::VecDeque;
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Instant;

use anyhow::{Context, Result, anyhow};
use crossbeam::channel::{Receiver, Sender, bounded};
use tracing::{info, warn};

use crate::config::Config;
use crate::engine::{Engine, ModelSource, UNTRAINED};
use crate::source::bag::BagSource;
use crate::source::{Event, Rig};

use super::front::{Front, FrontOutput};
use super::map_updates::MapUpdates;
use super::metrics::{Counts, Metrics};
use super::posed::PoseStore;
use super::saver::Saver;
use super::sink::{Sink, SinkInput};
use super::step::{Finished, StepMaker};

/// Decoded events that may wait for the network; small, since each may hold a picture.
const EVENTS_AHEAD: usize = 64;
/// Steps that may wait to be written.
const STEPS_AHEAD: usize = 4;

/// Folder of the map's own files in the results folder.
pub const MAP_FOLDER: &str = "map";

/// What to replay, and where the results go.
pub struct ReplayOptions {
    /// The bag.
    pub bag: PathBuf,
    /// The results folder; made when missing.
    pub out: PathBuf,
    /// The configuration.
    pub config: Config,
    /// Windows that go through the network in one forward pass; at least 1. The results are those of one by one.
    pub batch: usize,
    /// Raised by whoever wants the run to end early; what was read until then is finished and written.
    pub stop: Arc<AtomicBool>,
}

/// Called with images read so far and images in all.
pub type Progress<'a> = &'a (dyn Fn(u64, u64) + Sync);

/// Replays the bag into the results folder.
pub fn run(options: &ReplayOptions, progress: Progress) -> Result<Metrics> {
    let start = Instant::now();
    let config = &options.config;
    let model = ModelSource::open(&config.model)?;
    let size = model.picture_size(&config.model)?;
    let source = BagSource::open(&options.bag, config, size)?;
    source.check().with_context(|| format!("bag {}", options.bag.display()))?;
    let rig = source.rig();
    let engine =
        Engine::new(model, &config.model, rig.cameras.len(), config.window.timespan_sec)?.with_skips(&config.skip);
    if engine.weights() == UNTRAINED {
        warn!(
            "weights: untrained. Seeded random weights stand in; the results show the plumbing, not a reconstruction"
        );
    }
    describe(&source, &rig, &engine, size);
    std::fs::create_dir_all(&options.out)
        .with_context(|| format!("cannot make results folder {}", options.out.display()))?;
    let title = recording_name(&options.bag);
    remove_earlier(&options.out)?;
    let sink = Sink::create(&title, &options.out, &rig, &engine, config)?;
    let weights = engine.weights().to_string();
    let preset = engine.model_config().describe();

    let ran = run_stages(&source, engine, sink, options, progress)?;
    let Ran { front, finished, sink } = ran;
    let mut problems = source.problems();
    if options.stop.load(Ordering::Relaxed) {
        problems.push("stopped by the user before the end of the bag".into());
    }
    problems.iter().for_each(|p| warn!("{p}"));
    let counts = Counts::new(&front, &finished, problems);
    let metrics = sink.finish(finished, counts, weights, preset, start.elapsed())?;
    info!("{} steps in {:.1} s", metrics.steps, metrics.wall_sec);
    Ok(metrics)
}

fn describe(source: &BagSource, rig: &Rig, engine: &Engine, size: (usize, usize)) {
    rig.log(size);
    info!("{}; network: {}", source.pose_line(), engine.model_config().describe());
}

struct Ran {
    front: Front,
    finished: Finished,
    sink: Sink,
}

fn run_stages(
    source: &BagSource,
    engine: Engine,
    sink: Sink,
    options: &ReplayOptions,
    progress: Progress,
) -> Result<Ran> {
    let rig = source.rig();
    let (to_step, events) = bounded(EVENTS_AHEAD);
    let (to_sink, inputs) = bounded(STEPS_AHEAD);
    thread::scope(|scope| {
        let total = source.image_count();
        let stop = &options.stop;
        let reader = scope.spawn(move || read(source, &to_step, total, stop, progress));
        let writer = scope.spawn(move || write(sink, &inputs));
        let stepped = step_all(source, &rig, engine, options, &events, &to_sink);
        // Closing the channels ends the other stages, also when this one failed.
        drop(events);
        drop(to_sink);
        let written = writer.join().map_err(|_| anyhow!("the writer stage panicked"))?;
        let read = reader.join().map_err(|_| anyhow!("the reader stage panicked"))?;
        // The writer's error first: when it stops, the others only see a closed channel.
        let sink = written?;
        let (front, finished) = stepped?;
        read?;
        Ok(Ran { front, finished, sink })
    })
}

fn read(source: &BagSource, to_step: &Sender<Event>, total: u64, stop: &AtomicBool, progress: Progress) -> Result<()> {
    let mut images = 0;
    source.events(|event| {
        let is_image = matches!(event, Event::Image { .. } | Event::Lost { camera: Some(_), .. });
        images += u64::from(is_image);
        if is_image {
            progress(images, total.max(images));
        }
        !stop.load(Ordering::Relaxed) && to_step.send(event).is_ok()
    })
}

fn step_all(
    source: &BagSource,
    rig: &Arc<Rig>,
    engine: Engine,
    options: &ReplayOptions,
    events: &Receiver<Event>,
    to_sink: &Sender<SinkInput>,
) -> Result<(Front, Finished)> {
    let config = &options.config;
    let store = PoseStore::of_bag(source, rig, config);
    let mut front = Front::new(config, rig, store);
    let mut maker = StepMaker::new(engine, rig.intrinsics(), config, Some(&options.out.join(MAP_FOLDER)))?;
    let mut saver = Saver::new(config.map.save_every_sec);
    let every_sec = if config.output.bag { config.output.map_every_sec } else { 0.0 };
    let mut updates = MapUpdates::new(every_sec, config.output.map_max_mb);
    let batch = options.batch.max(1);
    let mut ready = VecDeque::new();
    for event in events {
        front.take(event, &mut ready);
        let windows = ready.iter().filter(|o| matches!(o, FrontOutput::Window(_))).count();
        // What came after a window that waits for others waits with it, so that the order of results stays the same.
        if (windows == 0 || windows >= batch) && !hand_on(&mut ready, &front, &mut maker, &mut updates, to_sink)? {
            break;
        }
        saver.offer(&mut maker);
    }
    front.finish(&mut ready);
    hand_on(&mut ready, &front, &mut maker, &mut updates, to_sink)?;
    while let Some(update) = updates.rest(maker.map())? {
        if to_sink.send(SinkInput::Map(update)).is_err() {
            break;
        }
    }
    saver.save(&mut maker);
    Ok((front, Finished { map_saves_failed: saver.failed(), batch, ..maker.finish() }))
}

/// Runs windows (all of them in one forward pass), passes the rest through; false when the writer has gone.
fn hand_on(
    ready: &mut VecDeque<FrontOutput>,
    front: &Front,
    maker: &mut StepMaker,
    updates: &mut MapUpdates,
    to_sink: &Sender<SinkInput>,
) -> Result<bool> {
    let (mut windows, mut rest) = (Vec::new(), Vec::with_capacity(ready.len()));
    for output in ready.drain(..) {
        match output {
            FrontOutput::Window(window) => {
                windows.push(window);
                rest.push(None);
            }
            other => rest.push(Some(other)),
        }
    }
    let newest_ns = windows.last().map(|w| w.stamp_ns);
    let mut results = maker.run_all(windows)?.into_iter();
    let send = |input: SinkInput| to_sink.send(input).is_ok();
    for output in rest {
        let sent = match output {
            Some(FrontOutput::Set(set)) => {
                let vehicle =
                    set.frames.first().map(|f| (f.stamp_ns, front.base_pose(0, f.stamp_ns, &f.map_from_camera)));
                send(SinkInput::Set { set, vehicle })
            }
            Some(FrontOutput::Truth { camera, stamp_ns, kind, image }) => {
                send(SinkInput::Truth { camera, stamp_ns, kind, image })
            }
            Some(FrontOutput::Window(_)) | None => results.next().is_none_or(|r| {
                (r.tracks.is_empty() || send(SinkInput::Tracks(r.tracks)))
                    && (r.objects.is_empty() || send(SinkInput::Objects(r.objects)))
                    && r.step.is_none_or(|step| send(SinkInput::Step(Arc::new(step))))
            }),
        };
        if !sent {
            return Ok(false);
        }
    }
    if let Some(stamp_ns) = newest_ns
        && let Some(update) = updates.offer(maker.map(), stamp_ns)?
    {
        return Ok(send(SinkInput::Map(update)));
    }
    Ok(true)
}

fn write(mut sink: Sink, inputs: &Receiver<SinkInput>) -> Result<Sink> {
    for input in inputs {
        sink.take(input)?;
    }
    Ok(sink)
}

/// What results call a recording: its file or folder, and the folder that is in (many bags are called `bag`).
pub fn recording_name(bag: &Path) -> String {
    let names = bag.components().rev().filter(|c| matches!(c, Component::Normal(_)));
    let mut parts: Vec<_> = names.take(2).map(|c| c.as_os_str().to_string_lossy()).collect();
    parts.reverse();
    parts.join("/")
}

/// Removes what says what a run came to, so that nothing of an earlier one is taken for this one's. The other files are
/// replaced as they are written.
fn remove_earlier(out: &Path) -> Result<()> {
    for name in ["metrics.json", "report.html"] {
        match std::fs::remove_file(out.join(name)) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => {
                return Err(e).with_context(|| format!("cannot replace {}", out.join(name).display()));
            }
            _ => {}
        }
    }
    Ok(())
}

/// Where results go when nobody says: `storm_out/<name of the bag>`.
pub fn default_out(bag: &Path) -> PathBuf {
    let stem = bag.file_stem().map_or_else(|| "bag".into(), |s| s.to_string_lossy().into_owned());
    Path::new("storm_out").join(stem)
}
