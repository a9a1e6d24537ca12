//! The live pipeline's two threads.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, bail};
use crossbeam::channel::{Receiver, Sender, unbounded};
use tracing::{info, warn};

use super::inbox::{Inbox, Taken};
use super::skew::SkewGate;
use super::status::Status;
use crate::config::{Config, MapConfig};
use crate::engine::Engine;
use crate::map::StaticMap;
use crate::pipeline::front::{Front, FrontOutput};
use crate::pipeline::posed::PoseStore;
use crate::pipeline::saver::Saver;
use crate::pipeline::step::{Demand, Step, StepMaker};
use crate::pipeline::timing::Timings;
use crate::rigid::Rigid;
use crate::source::translate::{Role, translate};
use crate::source::{Event, Rig};
use crate::sync::DropReason;

/// Poses and transforms that may wait; several seconds at 200 Hz.
const MESSAGES_AHEAD: usize = 2048;
/// The threads look for commands this often when nothing comes in.
const PATIENCE: Duration = Duration::from_millis(20);
/// Losses and failures that are written to the log one by one; the rest is only counted.
const LOGGED: u64 = 5;
/// Share of the newest value in a smoothed one.
const SMOOTHING: f64 = 0.2;

/// One input, in the order of [`LiveOptions::inputs`].
#[derive(Debug, Clone)]
pub struct LiveInput {
    /// Its topic.
    pub topic: String,
    /// What its messages are.
    pub role: Role,
}

/// What to run.
pub struct LiveOptions {
    /// The configuration.
    pub config: Config,
    /// The cameras.
    pub rig: Arc<Rig>,
    /// Inputs; messages are pushed by their number.
    pub inputs: Vec<LiveInput>,
    /// Made by [`inbox`] for these inputs; may hold messages already.
    pub messages: Arc<Inbox<Message>>,
    /// Where poses are looked up.
    pub store: PoseStore,
    /// The time that stamps are of, nanoseconds: latencies are measured with it.
    pub clock: Box<dyn Fn() -> i64 + Send>,
}

/// Answers a command, from the step thread.
pub type Reply = Box<dyn FnOnce(std::result::Result<String, String>) + Send>;

/// Something to do between two steps.
pub enum Command {
    /// Start anew: windows, poses, trajectories. The map stays.
    Reset(Reply),
    /// Hold steps back, or go on.
    Pause(bool, Reply),
    /// Save the map in its folder.
    SaveMap(Reply),
    /// Take the map `map.load` names in the place of the present one.
    LoadMap(Reply),
    /// Go on with these cameras of the rig alone.
    Cameras(Vec<usize>),
    /// Another configuration; only what may change at run time differs.
    Configure(Box<Config>),
}

/// Takes the results. Called from the step thread.
pub trait Outlet: Send {
    /// What somebody listens to at present.
    fn demand(&mut self) -> Demand;
    /// The vehicle's pose at a synchronized set.
    fn vehicle(&mut self, stamp_ns: i64, map_from_base: Rigid);
    /// A step. `active`: which cameras of the rig its views are of. An error is counted and said; the run goes on.
    ///
    /// # Errors
    /// What could not be made or sent.
    fn step(&mut self, step: &Step, maker: &StepMaker, active: &[usize]) -> Result<()>;
    /// Called often, whether or not there are steps: what goes on without them.
    ///
    /// # Errors
    /// What could not be made or sent.
    fn idle(&mut self, maker: &StepMaker) -> Result<()>;
    /// Another configuration.
    fn configure(&mut self, config: &Config);
    /// Times of all stages, after each step.
    fn times(&mut self, stages_ms: &[(&'static str, f64)]);
}

/// One message as it came in.
#[derive(Debug)]
pub struct Message {
    /// Of which input.
    pub input: usize,
    /// CDR.
    pub data: Vec<u8>,
    /// When it came, nanoseconds.
    pub received_ns: i64,
}

/// Where messages of `inputs` wait; made before the pipeline, so that none is lost while the cameras are not described.
pub fn inbox(inputs: &[LiveInput], config: &Config) -> Arc<Inbox<Message>> {
    let capacity =
        |i: &LiveInput| if matches!(i.role, Role::Image { .. }) { config.live.queue } else { MESSAGES_AHEAD };
    Arc::new(Inbox::new(&inputs.iter().map(capacity).collect::<Vec<_>>()))
}

/// The running pipeline.
pub struct Live {
    messages: Arc<Inbox<Message>>,
    commands: Sender<Command>,
    status: Arc<Mutex<Status>>,
    decoder: Option<JoinHandle<()>>,
    stepper: Option<JoinHandle<Result<()>>>,
}

fn lock(status: &Mutex<Status>) -> MutexGuard<'_, Status> {
    status.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Live {
    /// Starts the threads.
    ///
    /// # Errors
    /// A map that cannot be read or made, threads that cannot be started.
    pub fn start(options: LiveOptions, engine: Engine, outlet: Box<dyn Outlet>) -> Result<Self> {
        let LiveOptions { config, rig, inputs, messages, store, clock } = options;
        // Events by camera, and one stream for everything else.
        let mut capacities = vec![config.live.queue; rig.cameras.len()];
        capacities.push(MESSAGES_AHEAD);
        let events = Arc::new(Inbox::new(&capacities));
        let mut maker = StepMaker::new(engine, rig.intrinsics(), &config, None)?;
        maker.set_map(open_map(&config)?);
        let status = Arc::new(Mutex::new(Status::default()));
        let (commands, to_do) = unbounded();
        let is_image: Vec<bool> = inputs.iter().map(|i| matches!(i.role, Role::Image { .. })).collect();
        let decode_ms = Arc::new(Mutex::new(0.0));
        let decoder = {
            let decoder = Decoder {
                messages: messages.clone(),
                events: events.clone(),
                rig: rig.clone(),
                inputs,
                ms: decode_ms.clone(),
            };
            std::thread::Builder::new().name("decode".into()).spawn(move || decoder.run())?
        };
        let stepper = Stepper {
            front: Front::on_demand(&config, &rig, store),
            skew: SkewGate::new(rig.cameras.len(), &config.sync),
            saver: Saver::new(config.map.save_every_sec),
            maker,
            config,
            rig,
            messages: messages.clone(),
            is_image,
            events,
            to_do,
            status: status.clone(),
            decode_ms,
            outlet,
            clock,
            publish: Timings::default(),
            own: Own::default(),
        };
        let stepper = std::thread::Builder::new().name("step".into()).spawn(move || stepper.run())?;
        Ok(Self { messages, commands, status, decoder: Some(decoder), stepper: Some(stepper) })
    }

    /// A message of input number `input`. Never waits.
    pub fn push(&self, input: usize, message: Message) {
        self.messages.push(input, message);
    }

    /// Has something done between two steps.
    pub fn command(&self, command: Command) {
        // Fails only when the step thread has ended; then a reply is dropped, which its receiver notices.
        let _ = self.commands.send(command);
    }

    /// How it goes.
    pub fn status(&self) -> Status {
        lock(&self.status).clone()
    }

    /// True when a thread ended by itself, which none should.
    pub fn broken(&self) -> bool {
        let ended = |t: Option<bool>| t.unwrap_or(true);
        ended(self.decoder.as_ref().map(JoinHandle::is_finished))
            || ended(self.stepper.as_ref().map(JoinHandle::is_finished))
    }

    /// Lets the step that runs come to its end, saves the map where it has a folder, ends the threads. What waits is
    /// given up: nobody wants results of a vehicle that is being stopped.
    ///
    /// # Errors
    /// A thread that failed, or a map that could not be saved.
    pub fn stop(mut self) -> Result<Status> {
        self.messages.clear();
        self.messages.close();
        if let Some(decoder) = self.decoder.take() {
            decoder.join().map_err(|_| anyhow!("the decode thread panicked"))?;
        }
        if let Some(stepper) = self.stepper.take() {
            stepper.join().map_err(|_| anyhow!("the step thread panicked"))??;
        }
        Ok(self.status())
    }
}

impl Drop for Live {
    fn drop(&mut self) {
        self.messages.close();
    }
}

/// The map a live run starts with. A folder that holds a map already is never emptied.
fn open_map(config: &Config) -> Result<StaticMap> {
    let (dir, load) = (Path::new(&config.live.map_dir), Path::new(&config.map.load));
    let wanted = &config.map;
    if dir.as_os_str().is_empty() {
        if load.as_os_str().is_empty() {
            return Ok(StaticMap::new(wanted));
        }
        bail!("map.load = {}: a live map to go on from needs live.map_dir, a folder to keep it in", load.display());
    }
    if load == dir {
        return Ok(StaticMap::load(wanted, dir, false)?.0);
    }
    if StaticMap::open(dir, true).is_ok() {
        let dir = dir.display();
        bail!("live.map_dir = {dir} holds a saved map; set map.load={dir} to go on from it, or name another folder");
    }
    let (parent, made) = (dir.display(), || format!("live.map_dir = {}", dir.display()));
    std::fs::create_dir_all(dir).with_context(|| format!("live.map_dir = {parent} cannot be made"))?;
    if load.as_os_str().is_empty() {
        return StaticMap::in_folder(wanted, dir).with_context(made);
    }
    StaticMap::copied(wanted, load, dir).with_context(made)
}

/// The map `map.load` names, read while the present one goes on; it replaces the files in `live.map_dir`.
fn reload_map(wanted: &MapConfig, dir: &Path) -> Result<StaticMap> {
    let load = PathBuf::from(&wanted.load);
    if dir.as_os_str().is_empty() || load.as_os_str().is_empty() {
        bail!("set map.load to the folder of a saved map, and live.map_dir to a folder to keep it in");
    }
    // Read once before anything is replaced.
    let (map, _) = StaticMap::load(wanted, &load, false)?;
    if load == dir {
        return Ok(map);
    }
    drop(map);
    Ok(StaticMap::copied(wanted, &load, dir)?)
}

struct Decoder {
    messages: Arc<Inbox<Message>>,
    events: Arc<Inbox<Event>>,
    rig: Arc<Rig>,
    inputs: Vec<LiveInput>,
    ms: Arc<Mutex<f64>>,
}

impl Decoder {
    fn run(self) {
        let others = self.rig.cameras.len();
        let mut losses = vec![0u64; self.inputs.len()];
        loop {
            let messages = match self.messages.take(1, PATIENCE) {
                Taken::Some(messages) => messages,
                Taken::Nothing => continue,
                Taken::Closed => break,
            };
            for Message { input, data, received_ns } in messages {
                let Some(LiveInput { topic, role }) = self.inputs.get(input) else { continue };
                let start = Instant::now();
                translate(&self.rig, role, topic, &data, received_ns, &mut |event| {
                    let stream = match &event {
                        Event::Image { camera, .. } => *camera,
                        _ => others,
                    };
                    if let Event::Lost { detail, .. } = &event {
                        losses[input] += 1;
                        if losses[input] <= LOGGED {
                            warn!("{detail}");
                        }
                    }
                    self.events.push(stream, event);
                });
                if matches!(role, Role::Image { .. }) {
                    let ms = start.elapsed().as_secs_f64() * 1e3;
                    *self.ms.lock().unwrap_or_else(PoisonError::into_inner) = ms;
                }
            }
        }
        self.events.close();
    }
}

/// Counts of the step thread itself.
#[derive(Default)]
struct Own {
    sets: u64,
    steps: u64,
    failed_steps: u64,
    failed_outputs: u64,
    paused_images: u64,
    paused: bool,
    hop_sec: f64,
    last: Option<(u32, i64)>,
    gaussians: u64,
}

struct Stepper {
    front: Front,
    maker: StepMaker,
    saver: Saver,
    config: Config,
    rig: Arc<Rig>,
    messages: Arc<Inbox<Message>>,
    is_image: Vec<bool>,
    events: Arc<Inbox<Event>>,
    to_do: Receiver<Command>,
    status: Arc<Mutex<Status>>,
    decode_ms: Arc<Mutex<f64>>,
    outlet: Box<dyn Outlet>,
    clock: Box<dyn Fn() -> i64 + Send>,
    publish: Timings,
    skew: SkewGate,
    own: Own,
}

impl Stepper {
    fn run(mut self) -> Result<()> {
        let mut ready = VecDeque::new();
        self.report(None);
        loop {
            let events = match self.events.take(usize::MAX, PATIENCE) {
                Taken::Some(events) => events,
                Taken::Nothing => Vec::new(),
                Taken::Closed => break,
            };
            let commands: Vec<Command> = self.to_do.try_iter().collect();
            let idle = events.is_empty() && commands.is_empty();
            commands.into_iter().for_each(|c| self.obey(c));
            for event in events {
                self.take(event, &mut ready);
            }
            let latency_ms = if self.own.paused { None } else { self.step_newest() };
            if let Err(e) = self.outlet.idle(&self.maker) {
                self.output_failed(&format!("{e:#}"));
            }
            self.saver.offer(&mut self.maker);
            if !idle {
                self.report(latency_ms);
            }
        }
        self.front.finish(&mut ready);
        self.maker.save_map().context("the map could not be saved")?;
        self.report(None);
        Ok(())
    }

    fn take(&mut self, event: Event, ready: &mut VecDeque<FrontOutput>) {
        if self.own.paused && matches!(event, Event::Image { .. }) {
            self.own.paused_images += 1;
            return;
        }
        let event = match event {
            Event::Image { camera, stamp_ns, .. } if !self.skew.admits(camera, stamp_ns) => {
                let detail = format!("camera {camera} at {stamp_ns} ns: far behind the other cameras");
                Event::Lost { camera: Some(camera), reason: DropReason::Late, detail }
            }
            event => event,
        };
        self.front.take(event, ready);
        for output in ready.drain(..) {
            if let FrontOutput::Set(set) = output {
                self.own.sets += 1;
                if let Some(first) = set.frames.first() {
                    self.outlet.vehicle(first.stamp_ns, self.front.base_pose(0, &first.map_from_camera));
                }
            }
        }
    }

    /// Runs the newest window, if there is one; gives how old its newest image was when everything was sent.
    fn step_newest(&mut self) -> Option<f64> {
        let window = self.front.newest_window()?;
        let demand = Demand { map: self.config.live.map, ..self.outlet.demand() };
        let (epoch, stamp_ns) = (window.epoch, window.stamp_ns);
        let newest_ns = window.steps.last().and_then(|s| s.frames.iter().map(|f| f.stamp_ns).max()).unwrap_or(stamp_ns);
        if let Some((_, last_ns)) = self.own.last.filter(|(e, _)| *e == epoch) {
            let hop_sec = (stamp_ns - last_ns) as f64 * 1e-9;
            let share = if self.own.hop_sec > 0.0 { SMOOTHING } else { 1.0 };
            self.own.hop_sec += share * (hop_sec - self.own.hop_sec);
        }
        self.own.last = Some((epoch, stamp_ns));
        let step = match self.maker.run_for(window, demand) {
            Ok(step) => step?,
            Err(e) => {
                self.own.failed_steps += 1;
                if self.own.failed_steps <= LOGGED {
                    warn!("step at {stamp_ns} ns failed: {e:#}");
                }
                return None;
            }
        };
        self.own.steps += 1;
        self.own.gaussians = step.scene.gaussians.len() as u64;
        let start = Instant::now();
        if let Err(e) = self.outlet.step(&step, &self.maker, self.front.active()) {
            self.output_failed(&format!("step at {stamp_ns} ns: {e:#}"));
        }
        self.publish.add("publish", start.elapsed().as_secs_f64() * 1e3);
        // What has ended is of no use to anybody here; it would only fill memory.
        drop((self.maker.ended_tracks(), self.maker.ended_objects()));
        Some(((self.clock)() - newest_ns) as f64 * 1e-6)
    }

    fn output_failed(&mut self, why: &str) {
        self.own.failed_outputs += 1;
        if self.own.failed_outputs <= LOGGED {
            warn!("not everything could be published: {why}");
        }
    }

    fn obey(&mut self, command: Command) {
        match command {
            Command::Reset(reply) => {
                self.front.reset();
                self.own.last = None;
                reply(Ok("windows, poses and trajectories start anew; the map stays".into()));
            }
            Command::Pause(paused, reply) => {
                self.own.paused = paused;
                reply(Ok(if paused { "paused" } else { "running" }.into()));
            }
            Command::SaveMap(reply) => reply(match self.maker.map().folder().map(Path::to_path_buf) {
                None => Err("the map has no folder; set live.map_dir".into()),
                Some(dir) => match self.maker.save_map() {
                    Ok(()) => Ok(format!("{} Gaussians in {}", self.maker.map().len(), dir.display())),
                    Err(e) => Err(e.to_string()),
                },
            }),
            Command::LoadMap(reply) => {
                reply(match reload_map(&self.config.map, Path::new(&self.config.live.map_dir)) {
                    Ok(map) => {
                        let said = format!("{} Gaussians from {}", map.len(), self.config.map.load);
                        self.maker.set_map(map);
                        Ok(said)
                    }
                    Err(e) => Err(format!("{e:#}")),
                })
            }
            Command::Cameras(active) => self.use_cameras(&active),
            Command::Configure(config) => {
                self.outlet.configure(&config);
                self.front.set_hop(config.window.hop_sec);
                self.config = *config;
            }
        }
    }

    fn use_cameras(&mut self, active: &[usize]) {
        if active == self.front.active() || active.is_empty() {
            return;
        }
        let store = PoseStore::nothing(&self.config.sync);
        let front = std::mem::replace(&mut self.front, Front::on_demand(&self.config, &self.rig, store));
        self.front = front.with_cameras(&self.config, &self.rig, active);
        let all = self.rig.intrinsics();
        self.maker.set_cameras(active.iter().filter_map(|&c| all.get(c).copied()).collect());
        info!("going on with cameras {active:?}");
    }

    fn report(&mut self, latency_ms: Option<f64>) {
        let mut drops = self.front.drops();
        let (mut ring, mut messages_dropped) = (0, 0);
        for (is_image, n) in self.is_image.iter().zip(self.messages.dropped()) {
            *(if *is_image { &mut ring } else { &mut messages_dropped }) += n;
        }
        for (i, n) in self.events.dropped().into_iter().enumerate() {
            *(if i < self.rig.cameras.len() { &mut ring } else { &mut messages_dropped }) += n;
        }
        drops.add(DropReason::Overflow, ring);
        let mut stages_ms: Vec<(&'static str, f64)> = self.maker.timings().last().chain(self.publish.last()).collect();
        stages_ms.push(("decode", *self.decode_ms.lock().unwrap_or_else(PoisonError::into_inner)));
        if let Some(ms) = latency_ms {
            stages_ms.push(("latency", ms));
            self.outlet.times(&stages_ms);
        }
        let (own, map) = (&self.own, self.maker.map());
        let mut status = lock(&self.status);
        let mut latencies_ms = std::mem::take(&mut status.latencies_ms);
        if status.paused != own.paused {
            latencies_ms.clear();
        }
        *status = Status {
            images_in: self.front.images_in() + ring + own.paused_images,
            drops,
            messages_dropped,
            messages_lost: self.front.messages_lost(),
            poses_rejected: self.front.poses_rejected(),
            paused_images: own.paused_images,
            sets: own.sets,
            steps: own.steps,
            superseded: self.front.superseded(),
            windows: self.front.window_counts(),
            non_finite_windows: self.maker.non_finite(),
            skips: self.maker.skips(),
            skip_level: self.maker.skip_level(),
            failed_steps: own.failed_steps,
            failed_outputs: own.failed_outputs,
            hop_sec: own.hop_sec,
            stamp_ns: own.last.map(|(_, stamp_ns)| stamp_ns),
            stages_ms,
            latencies_ms,
            gaussians: own.gaussians,
            map_gaussians: map.len() as u64,
            map_mb: map.bytes() as f64 / f64::from(1 << 20),
            map_evicted: map.counts().evicted,
            tracks: self.maker.tracks().len() as u64,
            objects: self.maker.objects().count() as u64,
            epochs: self.front.epoch(),
            active: self.front.active().to_vec(),
            paused: own.paused,
        };
        if let Some(ms) = latency_ms {
            status.latency(ms);
        }
    }
}
