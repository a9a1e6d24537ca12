//! Until the node runs: topics are looked for, cameras described, the pipeline started.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Result;
use tracing::{info, warn};

use super::super::describe::Describer;
use super::super::diagnostics::InputReport;
use super::super::outputs::Outputs;
use super::super::services;
use super::super::streams::{Stream, streams};
use super::super::topics::LivePlan;
use super::{Running, Started, now_ns};
use crate::bag;
use crate::engine::{Engine, ModelSource, UNTRAINED};
use crate::pipeline::live::{Live, LiveOptions, inbox};
use crate::source::Rig;
use crate::source::cameras::is_video;

/// Topics found by type count once they have been the same for so long.
const SETTLED: Duration = Duration::from_secs(2);
/// How often topics are looked for.
const LOOK: Duration = Duration::from_millis(250);
/// How often what is waited for is said on the log.
const SAY: Duration = Duration::from_secs(5);

impl Running {
    /// While there is no pipeline yet: services refuse, and what is waited for is said.
    fn wait(&mut self, waiting: &str) {
        for command in self.requests.take() {
            services::refuse(command, &format!("not running yet: {waiting}"));
        }
        if let Some(config) = self.new_config() {
            self.config = config;
        }
        self.report(waiting, None);
        if !waiting.is_empty() && self.said.is_none_or(|at| at.elapsed() >= SAY) {
            warn!("waiting: {waiting}");
            self.said = Some(Instant::now());
        }
    }

    /// Topics that somebody publishes.
    fn graph(&self) -> Vec<bag::Topic> {
        let Ok(topics) = self.node.get_topic_names_and_types() else { return Vec::new() };
        let mut graph: Vec<bag::Topic> = topics
            .into_iter()
            .filter_map(|(name, types)| {
                let type_name = types.into_iter().next()?;
                let relevant = ["sensor_msgs/", "nav_msgs/", "geometry_msgs/", "tf2_msgs/"];
                if !relevant.iter().any(|package| type_name.starts_with(package)) && !is_video(&type_name) {
                    return None;
                }
                let publishers = self.node.get_publishers_info_by_topic(&name, false).map_or(0, |p| p.len());
                (publishers > 0).then_some(bag::Topic {
                    name,
                    type_name,
                    serialization: "cdr".into(),
                    count: publishers as u64,
                })
            })
            .collect();
        graph.sort_by(|a, b| a.name.cmp(&b.name));
        graph
    }

    /// Looks for the topics until they are there; none when the node is to stop.
    pub(super) fn find(&mut self, stop: &AtomicBool) -> Result<Option<LivePlan>> {
        let (mut looked, mut waiting) = (None::<Instant>, String::from("topics"));
        let mut found: Option<(LivePlan, Instant)> = None;
        while !stop.load(Ordering::Relaxed) {
            self.spin();
            if looked.is_none_or(|at| at.elapsed() >= LOOK) {
                looked = Some(Instant::now());
                match LivePlan::resolve(&self.graph(), &self.names, &self.config) {
                    Ok((plan, true)) => return Ok(Some(plan)),
                    Ok((plan, false)) => match &found {
                        Some((before, since)) if *before == plan => {
                            if since.elapsed() >= SETTLED {
                                return Ok(Some(plan));
                            }
                        }
                        _ => {
                            waiting = "for the topics to stay the same".into();
                            found = Some((plan, Instant::now()));
                        }
                    },
                    Err(why) => (waiting, found) = (why, None),
                }
            }
            let say = if found.is_some() { "" } else { waiting.as_str() }.to_string();
            self.wait(&say);
        }
        Ok(None)
    }

    /// Subscribes, waits until the cameras are described, starts the pipeline; none when the node is to stop.
    pub(super) fn describe(
        &mut self,
        plan: LivePlan,
        model: ModelSource,
        size: (usize, usize),
        stop: &AtomicBool,
    ) -> Result<Option<(Started, Arc<Rig>)>> {
        for (i, c) in plan.cameras.iter().enumerate() {
            info!("camera {i}: {} with {}", c.image, c.info);
        }
        plan.left_out.iter().for_each(|l| info!("no camera: {l}"));
        info!("pose: {}", plan.pose);
        self.streams = streams(&plan, &self.config.live);
        for (number, stream) in self.streams.iter().enumerate() {
            stream.subscribe(&mut self.node, &self.pool.spawner(), number, &self.arrivals)?;
            let (topic, vital) = (stream.topic.clone(), stream.vital());
            self.reports.push(InputReport { topic, vital, ..InputReport::default() });
        }
        let inputs: Vec<_> = self.streams.iter().map(Stream::input).collect();
        let messages = inbox(&inputs, &self.config);
        let mut describer = Describer::new(plan);
        while !stop.load(Ordering::Relaxed) {
            self.take(&messages, &mut describer);
            if let Some((rig, store)) = describer.build(&self.config, size) {
                let engine =
                    Engine::new(model, &self.config.model, rig.cameras.len(), self.config.window.timespan_sec)?
                        .with_skips(&self.config.skip);
                let weights = engine.weights();
                if weights == UNTRAINED {
                    warn!("weights: untrained. Seeded random weights stand in; the results show the plumbing alone");
                }
                self.device = format!("{}, {weights}", self.config.model.device);
                let outputs = Outputs::new(&mut self.node, rig.clone(), &self.config)?;
                self.outputs = outputs.topics();
                let clock = self.clock.clone();
                let options = LiveOptions {
                    config: self.config.clone(),
                    rig: rig.clone(),
                    inputs,
                    messages: messages.clone(),
                    store,
                    clock: Box::new(move || now_ns(&clock)),
                    on_part: None,
                };
                let live = Live::start(options, engine, Box::new(outputs))?;
                info!("running: {} cameras, {} by {} pixels each", rig.cameras.len(), size.0, size.1);
                return Ok(Some((Started { live, messages, describer }, rig)));
            }
            let missing = describer.missing().to_string();
            self.wait(&missing);
        }
        Ok(None)
    }
}
