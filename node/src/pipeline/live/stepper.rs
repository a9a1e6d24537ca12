//! The step thread: events to sets, the newest window to a step, the step to whoever takes it.

use std::collections::VecDeque;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use anyhow::{Context, Result};
use crossbeam::channel::Receiver;
use tracing::{info, warn};

use super::inbox::{Inbox, Taken};
use super::map_folder::reload_map;
use super::skew::SkewGate;
use super::status::Status;
use super::worker::{Command, LOGGED, Message, Outlet, PATIENCE, lock};
use crate::config::Config;
use crate::error_line::error_line;
use crate::pipeline::front::{Front, FrontOutput};
use crate::pipeline::guard::{StagePanics, caught};
use crate::pipeline::posed::PoseStore;
use crate::pipeline::saver::Saver;
use crate::pipeline::step::StepMaker;
use crate::pipeline::timing::Timings;
use crate::source::{Event, Rig};
use crate::sync::DropReason;

/// Share of the newest value in a smoothed one.
const SMOOTHING: f64 = 0.2;

/// Counts of the step thread itself.
#[derive(Default)]
pub(super) struct Own {
    sets: u64,
    steps: u64,
    failed_steps: u64,
    failed_outputs: u64,
    outlet_panics: u64,
    paused_images: u64,
    paused: bool,
    hop_sec: f64,
    last: Option<(u32, i64)>,
    gaussians: u64,
}

/// What the thread owns.
pub(super) struct Stepper {
    pub front: Front,
    pub maker: StepMaker,
    pub saver: Saver,
    pub config: Config,
    pub rig: Arc<Rig>,
    pub messages: Arc<Inbox<Message>>,
    pub is_image: Vec<bool>,
    pub events: Arc<Inbox<Event>>,
    pub to_do: Receiver<Command>,
    pub status: Arc<Mutex<Status>>,
    pub decode_ms: Arc<Mutex<f64>>,
    pub outlet: Box<dyn Outlet>,
    pub clock: Box<dyn Fn() -> i64 + Send>,
    pub publish: Timings,
    pub skew: SkewGate,
    pub own: Own,
}

impl Stepper {
    /// Runs until the events end; then saves the map where it has a folder.
    pub fn run(mut self) -> Result<()> {
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
            let latency_ms = if self.own.paused { None } else { self.step_newest()? };
            self.output("idle", |s| s.outlet.idle(&s.maker));
            self.saver.offer(&mut self.maker);
            if !idle {
                self.report(latency_ms);
            }
        }
        self.front.finish(&mut ready);
        self.count_sets(&mut ready);
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
        self.count_sets(ready);
    }

    fn count_sets(&mut self, ready: &mut VecDeque<FrontOutput>) {
        for output in ready.drain(..) {
            if let FrontOutput::Set(set) = output {
                self.own.sets += 1;
                if let Some(first) = set.frames.first() {
                    let map_from_base = self.front.base_pose(0, first.stamp_ns, &first.map_from_camera);
                    self.output("vehicle pose", |s| {
                        s.outlet.vehicle(first.stamp_ns, map_from_base);
                        Ok(())
                    });
                }
            }
        }
    }

    /// Runs the newest window, if there is one; gives how old its newest image was when everything was sent.
    ///
    /// # Errors
    /// A stage that panics every time.
    fn step_newest(&mut self) -> Result<Option<f64>> {
        let Some(window) = self.front.newest_window() else { return Ok(None) };
        let demand = self.outlet.demand();
        let (epoch, stamp_ns) = (window.epoch, window.stamp_ns);
        let newest_ns = window.steps.last().and_then(|s| s.frames.iter().map(|f| f.stamp_ns).max()).unwrap_or(stamp_ns);
        if let Some((_, last_ns)) = self.own.last.filter(|(e, _)| *e == epoch) {
            let hop_sec = stamp_ns.saturating_sub(last_ns) as f64 * 1e-9;
            let share = if self.own.hop_sec > 0.0 { SMOOTHING } else { 1.0 };
            self.own.hop_sec += share * (hop_sec - self.own.hop_sec);
        }
        self.own.last = Some((epoch, stamp_ns));
        let step = match self.maker.run_for(window, demand) {
            Ok(Some(step)) => step,
            Ok(None) => return Ok(None),
            Err(e) if e.is::<StagePanics>() => return Err(e),
            Err(e) => {
                self.own.failed_steps += 1;
                if self.own.failed_steps <= LOGGED {
                    warn!("step at {stamp_ns} ns failed: {}", error_line(&e));
                }
                return Ok(None);
            }
        };
        self.own.steps += 1;
        self.own.gaussians = step.scene.gaussians.len() as u64;
        let start = Instant::now();
        self.output("step", |s| s.outlet.step(&step, &s.maker, s.front.active()));
        self.publish.add("publish", start.elapsed().as_secs_f64() * 1e3);
        // What has ended is of no use to anybody here; it would only fill memory.
        drop(self.maker.ended_tracks());
        drop(self.maker.ended_objects());
        Ok(Some((self.clock)().saturating_sub(newest_ns) as f64 * 1e-6))
    }

    /// Has something sent. What fails or panics there is counted and said, and the run goes on: the next step is sent anew.
    fn output(&mut self, what: &str, send: impl FnOnce(&mut Self) -> Result<()>) {
        match caught(|| send(self)) {
            Ok(Ok(())) => {}
            Ok(Err(e)) => self.output_failed(&format!("{what}: {}", error_line(&e))),
            Err(said) => {
                self.own.outlet_panics += 1;
                self.output_failed(&format!("{what}: panicked: {said}"));
            }
        }
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
                    Err(e) => Err(error_line(&e)),
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
            images_used: self.front.images_used(),
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
            panicked_steps: self.maker.panics(),
            panics: self.front.panics() + own.outlet_panics,
            failed_saves: self.saver.failed(),
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
