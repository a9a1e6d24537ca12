//! The running pipeline from outside: what it takes, what it is told, what it gives.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Result, anyhow};
use crossbeam::channel::{Sender, unbounded};

use super::decoder::Decoder;
use super::inbox::Inbox;
use super::map_folder::open_map;
use super::skew::SkewGate;
use super::status::Status;
use super::stepper::{Own, Stepper};
use crate::config::Config;
use crate::engine::Engine;
use crate::pipeline::demand::Demand;
use crate::pipeline::front::Front;
use crate::pipeline::posed::PoseStore;
use crate::pipeline::saver::Saver;
use crate::pipeline::step::{OnPart, Step, StepMaker};
use crate::pipeline::timing::Timings;
use crate::rigid::Rigid;
use crate::source::Rig;
use crate::source::translate::Role;

/// Poses and transforms that may wait; several seconds at 200 Hz.
const MESSAGES_AHEAD: usize = 2048;
/// The threads look for commands this often when nothing comes in.
pub(super) const PATIENCE: Duration = Duration::from_millis(20);
/// Losses and failures that are written to the log one by one; the rest is only counted.
pub(super) const LOGGED: u64 = 5;

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
    /// See [`StepMaker::set_on_part`].
    pub on_part: Option<OnPart>,
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

pub(super) fn lock(status: &Mutex<Status>) -> MutexGuard<'_, Status> {
    status.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Live {
    /// Starts the threads.
    ///
    /// # Errors
    /// A map that cannot be read or made, threads that cannot be started.
    pub fn start(options: LiveOptions, engine: Engine, outlet: Box<dyn Outlet>) -> Result<Self> {
        let LiveOptions { config, rig, inputs, messages, store, clock, on_part } = options;
        // Events by camera, and one stream for everything else.
        let mut capacities = vec![config.live.queue; rig.cameras.len()];
        capacities.push(MESSAGES_AHEAD);
        let events = Arc::new(Inbox::new(&capacities));
        let mut maker = StepMaker::new(engine, rig.intrinsics(), &config, None)?;
        maker.set_map(open_map(&config)?);
        if let Some(on_part) = on_part {
            maker.set_on_part(on_part);
        }
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
