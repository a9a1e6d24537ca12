//! Subscriptions: raw CDR, collected after every spin; and whether a publisher's QoS keeps its messages from us.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::rc::Rc;

use anyhow::{Context, Result};
use futures::executor::LocalSpawner;
use futures::stream::StreamExt;
use futures::task::LocalSpawnExt;
use r2r::{Node, QosProfile};
use tracing::error;

use super::qos;
use super::topics::{IMAGE, LivePlan, LivePose};
use crate::config::LiveConfig;
use crate::pipeline::live::LiveInput;
use crate::source::translate::Role;

/// What a stream is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Use {
    /// Pictures of a camera.
    Image(usize),
    /// CameraInfo of a camera.
    Info(usize),
    /// Vehicle poses.
    Pose,
    /// Moving transforms, which have the vehicle's pose.
    Tf,
    /// Moving transforms beside a pose topic: joints, and frames above the poses' own.
    Joints,
    /// Transforms that hold at all times.
    Statics,
}

/// One subscription.
pub struct Stream {
    /// Its topic, by its final name.
    pub topic: String,
    /// What it is for.
    pub purpose: Use,
    /// What it is to the pipeline; [`Role::None`] for CameraInfo.
    pub role: Role,
    type_name: String,
    asked: QosProfile,
    /// Publishers told about already.
    named: BTreeSet<String>,
}

/// Messages as they came in: stream number and CDR.
pub type Arrivals = Rc<RefCell<Vec<(usize, Vec<u8>)>>>;

/// The streams of a plan, cameras first.
pub fn streams(plan: &LivePlan, config: &LiveConfig) -> Vec<Stream> {
    let tf = "tf2_msgs/msg/TFMessage";
    let mut all = Vec::new();
    let mut add = |topic: &str, purpose, role, type_name: &str, asked| {
        all.push(Stream {
            topic: topic.into(),
            purpose,
            role,
            type_name: type_name.into(),
            asked,
            named: BTreeSet::new(),
        });
    };
    for (camera, c) in plan.cameras.iter().enumerate() {
        let kind = if c.compressed { "sensor_msgs/msg/CompressedImage" } else { IMAGE };
        let role = Role::Image { camera, compressed: c.compressed };
        add(&c.image, Use::Image(camera), role, kind, qos::pictures(config));
    }
    match &plan.pose {
        LivePose::Message { topic, type_name } => {
            let role = Role::Pose { type_name: type_name.clone() };
            add(topic, Use::Pose, role, type_name, qos::poses(config));
        }
        LivePose::Tf => plan.tf.iter().for_each(|t| add(t, Use::Tf, Role::Transform, tf, qos::poses(config))),
    }
    for topic in &plan.tf_static {
        add(topic, Use::Statics, Role::StaticTransform, tf, qos::statics());
    }
    if plan.pose != LivePose::Tf {
        // Joints that carry cameras, and what leads from the poses' frame to the configured one.
        plan.tf.iter().for_each(|t| add(t, Use::Joints, Role::Transform, tf, qos::poses(config)));
    }
    for (camera, c) in plan.cameras.iter().enumerate() {
        add(&c.info, Use::Info(camera), Role::None, "sensor_msgs/msg/CameraInfo", qos::infos());
    }
    all
}

impl Stream {
    /// The stream as an input of the pipeline.
    pub fn input(&self) -> LiveInput {
        LiveInput { topic: self.topic.clone(), role: self.role.clone() }
    }

    /// True for pictures and poses: without them nothing goes on.
    pub fn vital(&self) -> bool {
        matches!(self.purpose, Use::Image(_) | Use::Pose | Use::Tf)
    }

    /// Subscribes; messages appear in `arrivals` under `number`.
    ///
    /// # Errors
    /// A type that was not sourced when the program was built, or a name ROS refuses.
    pub fn subscribe(&self, node: &mut Node, spawner: &LocalSpawner, number: usize, arrivals: &Arrivals) -> Result<()> {
        let Self { topic, type_name, .. } = self;
        let stream = node
            .subscribe_raw(topic, type_name, self.asked.clone())
            .with_context(|| format!("cannot subscribe to {topic} ({type_name})"))?;
        let arrivals = arrivals.clone();
        spawner.spawn_local(stream.for_each(move |data| {
            arrivals.borrow_mut().push((number, data));
            futures::future::ready(())
        }))?;
        Ok(())
    }

    /// Why messages of a publisher of this topic do not arrive, if there is such a publisher; said once for each.
    pub fn mismatch(&mut self, node: &Node) -> Option<String> {
        let publishers = node.get_publishers_info_by_topic(&self.topic, false).ok()?;
        let mut first = None;
        for p in publishers {
            if let Some(why) = qos::mismatch(&self.asked, &p.qos_profile) {
                let name = format!("{}/{}", p.node_namespace.trim_end_matches('/'), p.node_name);
                let why = format!("publisher {name} {why}");
                if self.named.insert(name) {
                    error!("QoS mismatch on {}: {why}", self.topic);
                }
                first.get_or_insert(why);
            }
        }
        first
    }
}
