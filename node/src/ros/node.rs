//! The node's life: parameters, topics, cameras, running, end.

mod start;

use std::any::Any;
use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::Rc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};
use futures::executor::LocalPool;
use futures::task::LocalSpawnExt;
use r2r::{Clock, Context, Node, ParameterValue};
use tracing::{info, warn};

use super::describe::Describer;
use super::diagnostics::{InputReport, Report};
use super::names::Names;
use super::parameters::{Served, read};
use super::publisher::Topic;
use super::services::{self, Requests};
use super::streams::{Arrivals, Stream, Use};
use crate::cdr::encode_live::encode_diagnostics;
use crate::config::Config;
use crate::engine::ModelSource;
use crate::error_line::error_line;
use crate::output::qos::Qos;
use crate::pipeline::live::{Change, Command, Inbox, Live, Message, Status, Watchdog};
use crate::source::Rig;

/// Longest wait for a message; services and signals are looked at in between.
const SPIN: Duration = Duration::from_millis(20);
/// How often inputs are watched.
const WATCH: Duration = Duration::from_millis(100);
/// How often `/diagnostics` is sent.
const REPORT: Duration = Duration::from_secs(1);

/// Runs the node until `stop` is raised. True when it ended as asked and nothing went wrong in it.
///
/// # Errors
/// Parameters that are not accepted, weights that cannot be read, ROS that cannot be reached, a map that cannot be saved.
pub fn run(stop: &AtomicBool) -> Result<bool> {
    let context = guarded(Context::create).map_err(|why| crate::cmd::UsageError(format!("ROS refuses: {why}")))??;
    let mut node = guarded(|| Node::create(context, "storm", ""))
        .map_err(|why| crate::cmd::UsageError(format!("ROS refuses: {why}")))?
        .context("the node cannot be made; is the middleware (RMW_IMPLEMENTATION) installed?")?;
    let names = Names::new(&node.name()?, &node.namespace()?, std::env::args());
    let (config, sim_time) = {
        let given = node.params.lock().unwrap_or_else(PoisonError::into_inner);
        let sim_time = given.get("use_sim_time").is_some_and(|p| p.value == ParameterValue::Bool(true));
        (read(&given)?, sim_time)
    };
    if config.model.threads > 0 {
        // Fails only when a pool was set up before in this process; then that one is kept.
        let _ = rayon::ThreadPoolBuilder::new().num_threads(config.model.threads).build_global();
    }
    let model = ModelSource::open(&config.model)?;
    let size = model.picture_size(&config.model)?;

    let pool = LocalPool::new();
    let changed = Arc::new(Mutex::new(None));
    let served = Arc::new(Mutex::new(Served::new(config.clone(), sim_time, changed.clone())));
    // The handler takes ROS time into use where use_sim_time says so; the events are in `changed` already.
    let (handler, _events) = node.make_derived_parameter_handler(served)?;
    pool.spawner().spawn_local(handler)?;
    let requests = Requests::default();
    services::offer(&mut node, &pool.spawner(), &requests)?;
    let diagnostics = Topic::new(&mut node, "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", Qos::Reliable)?;
    let clock = node.get_ros_clock();
    let mut this = Running {
        node,
        pool,
        names,
        config,
        clock,
        requests,
        changed,
        diagnostics,
        arrivals: Rc::new(RefCell::new(Vec::new())),
        streams: Vec::new(),
        reports: Vec::new(),
        outputs: Vec::new(),
        reported: Instant::now(),
        said: None,
        status_before: Status::default(),
        device: String::new(),
    };
    info!("{}: looking for cameras and a pose", this.names.node);
    let Some(plan) = this.find(stop)? else { return Ok(true) };
    let Some((live, rig)) = this.describe(plan, model, size, stop)? else { return Ok(true) };
    this.live(live, &rig, stop)
}

/// Runs what panics on bad arguments; gives the panic's text.
fn guarded<R>(work: impl FnOnce() -> R) -> std::result::Result<R, String> {
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(|_| {}));
    let outcome = catch_unwind(AssertUnwindSafe(work));
    std::panic::set_hook(hook);
    outcome.map_err(|panic: Box<dyn Any + Send>| {
        let text = panic.downcast_ref::<String>().cloned();
        text.or_else(|| panic.downcast_ref::<&str>().map(|s| s.to_string())).unwrap_or_default()
    })
}

fn now_ns(clock: &Mutex<Clock>) -> i64 {
    let now = clock.lock().unwrap_or_else(PoisonError::into_inner).get_now().unwrap_or_default();
    i64::try_from(now.as_nanos()).unwrap_or(i64::MAX)
}

struct Running {
    node: Node,
    pool: LocalPool,
    names: Names,
    config: Config,
    clock: Arc<Mutex<Clock>>,
    requests: Requests,
    changed: Arc<Mutex<Option<Config>>>,
    diagnostics: Topic,
    arrivals: Arrivals,
    streams: Vec<Stream>,
    reports: Vec<InputReport>,
    outputs: Vec<Topic>,
    reported: Instant,
    said: Option<Instant>,
    status_before: Status,
    device: String,
}

impl Running {
    /// One turn of ROS: takes what came in, at most one message per topic.
    fn spin(&mut self) -> Vec<(usize, Vec<u8>)> {
        self.node.spin_once(SPIN);
        self.pool.run_until_stalled();
        let arrived = std::mem::take(&mut *self.arrivals.borrow_mut());
        for (stream, _) in &arrived {
            if let Some(report) = self.reports.get_mut(*stream) {
                report.received += 1;
            }
        }
        arrived
    }

    fn new_config(&self) -> Option<Config> {
        self.changed.lock().unwrap_or_else(PoisonError::into_inner).take()
    }

    /// Hands on what came in; gives the streams that sent, and whether a CameraInfo changed.
    fn take(&mut self, messages: &Inbox<Message>, describer: &mut Describer) -> (Vec<usize>, bool) {
        let (mut sent, mut other) = (Vec::new(), false);
        let received_ns = now_ns(&self.clock);
        for (input, data) in self.spin() {
            let Some(stream) = self.streams.get(input) else { continue };
            match stream.purpose {
                Use::Image(camera) => describer.picture(camera, &data),
                Use::Info(camera) => other |= describer.info(camera, &data),
                Use::Pose => describer.pose(&data),
                Use::Statics => describer.statics(&data),
                Use::Tf | Use::Joints => describer.transforms(&data),
            }
            let is_unused = match stream.purpose {
                Use::Info(_) => true,
                Use::Joints => !describer.needs_joints(),
                _ => false,
            };
            if !is_unused {
                messages.push(input, Message { input, data, received_ns });
            }
            sent.push(input);
        }
        (sent, other)
    }

    /// Runs until told to stop.
    fn live(&mut self, started: Started, rig: &Rig, stop: &AtomicBool) -> Result<bool> {
        let Started { live, messages, mut describer } = started;
        let cameras = rig.cameras.len();
        // Inputs 0..cameras are the cameras, the next one is the pose.
        let mut dog = Watchdog::new(cameras + 1, self.config.live.silence_sec);
        let mut watched = Instant::now();
        let mut info_changed = false;
        let (mut in_use, mut wanted): (Vec<usize>, _) = ((0..cameras).collect(), None);
        while !stop.load(Ordering::Relaxed) {
            let (sent, other) = self.take(&messages, &mut describer);
            let now = now_ns(&self.clock);
            sent.into_iter().for_each(|input| dog.heard(input, now));
            if other && !std::mem::replace(&mut info_changed, true) {
                warn!(
                    "a CameraInfo has changed; the node goes on with the one it started with, restart it to take the new one"
                );
            }
            self.requests.take().into_iter().for_each(|command| live.command(command));
            if let Some(config) = self.new_config() {
                dog.set_silence(config.live.silence_sec);
                self.config = config.clone();
                live.command(Command::Configure(Box::new(config)));
            }
            if watched.elapsed() >= WATCH {
                watched = Instant::now();
                self.watch(&mut dog, now);
                let lively = dog.lively(cameras, now).filter(|_| self.config.live.degrade);
                // Twice in a row: cameras that stop or come back together do so within a moment, not at once.
                if let Some(left) = &lively
                    && lively == wanted
                    && *left != in_use
                {
                    in_use.clone_from(left);
                    live.command(Command::Cameras(left.clone()));
                }
                wanted = lively;
            }
            if self.reported.elapsed() >= REPORT {
                let status = live.status();
                self.report("", Some(&status));
                self.status_before = status;
            }
            if live.broken() {
                break;
            }
        }
        let broken = live.broken();
        info!("stopping");
        let stopping = self.requests.take();
        stopping.into_iter().for_each(|command| services::refuse(command, "the node is stopping"));
        let status = live.stop().context("the node could not stop as it should")?;
        if !self.config.live.map_dir.is_empty() {
            info!("map saved in {}", self.config.live.map_dir);
        }
        info!("{} steps from {} images; dropped {}", status.steps, status.images_in, status.drops.total());
        if broken {
            bail!("the pipeline ended by itself");
        }
        Ok(status.failed_steps == 0 && status.non_finite_windows == 0)
    }

    /// Says what stopped and what came back.
    fn watch(&mut self, dog: &mut Watchdog, now_ns: i64) {
        for change in dog.poll(now_ns) {
            let (input, silent) = match change {
                Change::Silent { input, for_sec } => {
                    let topic = self.streams.get(input).map_or("?", |s| s.topic.as_str());
                    warn!("{topic} has sent nothing for {for_sec:.1} s");
                    (input, true)
                }
                Change::Back { input } => {
                    info!("{} is back", self.streams.get(input).map_or("?", |s| s.topic.as_str()));
                    (input, false)
                }
            };
            if let Some(report) = self.reports.get_mut(input) {
                report.silent = silent;
            }
        }
    }

    /// Sends `/diagnostics` when it is time, and looks for publishers whose QoS does not match.
    fn report(&mut self, waiting: &str, status: Option<&Status>) {
        let elapsed = self.reported.elapsed();
        if elapsed < REPORT {
            return;
        }
        self.reported = Instant::now();
        for (stream, report) in self.streams.iter_mut().zip(&mut self.reports) {
            report.mismatch = stream.mismatch(&self.node);
            report.rate_hz = (report.received - report.reported) as f64 / elapsed.as_secs_f64();
            report.reported = report.received;
        }
        let now_ns = now_ns(&self.clock);
        let outputs: Vec<_> = self.outputs.iter().map(|t| (self.names.resolve(t.name()), t.listeners())).collect();
        let report = Report {
            node: &self.names.node,
            waiting,
            inputs: &self.reports,
            outputs: &outputs,
            status: status.map(|now| (now, &self.status_before)),
            device: self.device.clone(),
            now_ns,
            map: self.config.live.map != "never",
        };
        if let Err(e) = self.diagnostics.send(encode_diagnostics(now_ns, &report.statuses())) {
            warn!("diagnostics could not be sent: {}", error_line(&e));
        }
    }
}

struct Started {
    live: Live,
    messages: Arc<Inbox<Message>>,
    describer: Describer,
}
