//! All output topics but the diagnostics: what a step gives, sent to whoever listens.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use anyhow::Result;
use glam::DVec3;
use r2r::Node;
use tracing::info;

use super::convert;
use super::map_output::MapOutput;
use super::publisher::Topic;
use crate::cdr::{encode, encode_live};
use crate::config::Config;
use crate::msg::Header;
use crate::output::cloud_live::track_cloud;
use crate::output::qos::Qos;
use crate::pipeline::demand::Demand;
use crate::pipeline::live::Outlet;
use crate::pipeline::messages::{self, ORIGIN_FRAME, Pictures, Published};
use crate::pipeline::step::{Step, StepMaker};
use crate::rigid::Rigid;
use crate::source::Rig;

/// Poses kept for the path: a quarter of an hour at 10 Hz.
const PATH_POSES: usize = 10_000;
/// Least time between two paths, seconds.
const PATH_EVERY_SEC: f64 = 1.0;
/// Stages whose times are published as `~/debug/<stage>_ms`.
const STAGES: [&str; 9] = ["decode", "network", "render", "map", "tracks", "objects", "step", "publish", "latency"];

struct CameraOutputs {
    rendered: Topic,
    depth: Topic,
    mask: Topic,
    mask_color: Topic,
    info: Topic,
}

impl CameraOutputs {
    fn new(node: &mut Node, camera: usize) -> Result<Self> {
        let mut of = |name: &str, kind: &str| {
            Topic::new(
                node,
                &format!("~/output/camera{camera}/{name}"),
                &format!("sensor_msgs/msg/{kind}"),
                Qos::Reliable,
            )
        };
        Ok(Self {
            rendered: of("rendered", "Image")?,
            depth: of("depth", "Image")?,
            mask: of("motion_mask", "Image")?,
            mask_color: of("mask_color", "Image")?,
            info: of("camera_info", "CameraInfo")?,
        })
    }
}

/// The publishers.
pub struct Outputs {
    rig: Arc<Rig>,
    config: Config,
    gaussians: Topic,
    flow: Topic,
    tracks: Topic,
    objects: Topic,
    detections: Option<Topic>,
    path: Topic,
    tf: Topic,
    tf_static: Topic,
    cameras: Vec<CameraOutputs>,
    map: MapOutput,
    debug: Vec<(&'static str, Topic)>,
    poses: VecDeque<(i64, Rigid)>,
    path_sent: Option<Instant>,
    origin: Option<DVec3>,
    /// Of the newest step.
    stamp_ns: Option<i64>,
    counts: Published,
}

impl Outputs {
    /// Declares the topics.
    ///
    /// # Errors
    /// What ROS refuses, or message packages that were not sourced when the program was built.
    pub fn new(node: &mut Node, rig: Arc<Rig>, config: &Config) -> Result<Self> {
        let mut of = |name: &str, kind: &str, qos: Qos| Topic::new(node, name, kind, qos);
        let cloud = "sensor_msgs/msg/PointCloud2";
        let gaussians = of("~/output/gaussians", cloud, Qos::Reliable)?;
        let flow = of("~/output/flow", cloud, Qos::Reliable)?;
        let tracks = of("~/output/tracks", cloud, Qos::Reliable)?;
        let objects = of("~/output/objects", "visualization_msgs/msg/MarkerArray", Qos::Reliable)?;
        let detections = of("~/output/detections", "vision_msgs/msg/Detection3DArray", Qos::Reliable);
        let detections = detections.inspect_err(|_| info!("built without vision_msgs: no ~/output/detections")).ok();
        let path = of("~/output/trajectory", "nav_msgs/msg/Path", Qos::Reliable)?;
        let tf = of("/tf", "tf2_msgs/msg/TFMessage", Qos::Reliable)?;
        let tf_static = of("/tf_static", "tf2_msgs/msg/TFMessage", Qos::Latched)?;
        let mut debug = Vec::new();
        for stage in STAGES {
            debug.push((stage, of(&format!("~/debug/{stage}_ms"), "std_msgs/msg/Float64", Qos::SensorData)?));
        }
        let cameras = (0..rig.cameras.len()).map(|i| CameraOutputs::new(node, i)).collect::<Result<_>>()?;
        Ok(Self {
            map: MapOutput::new(node)?,
            rig,
            config: config.clone(),
            gaussians,
            flow,
            tracks,
            objects,
            detections,
            path,
            tf,
            tf_static,
            cameras,
            debug,
            poses: VecDeque::new(),
            path_sent: None,
            origin: None,
            stamp_ns: None,
            counts: Published::default(),
        })
    }

    /// Handles of the topics that are sent to whoever listens; without the `debug` ones and the latched transform.
    pub fn topics(&self) -> Vec<Topic> {
        let of_camera =
            |c: &'_ CameraOutputs| [&c.rendered, &c.depth, &c.mask, &c.mask_color, &c.info].map(Clone::clone);
        let single = [&self.gaussians, &self.flow, &self.tracks, &self.objects, &self.path, &self.tf];
        let all = single.into_iter().chain(&self.detections).chain(self.map.topics()).cloned();
        all.chain(self.cameras.iter().flat_map(of_camera)).collect()
    }

    fn transforms(&mut self, step: &Step, maker: &StepMaker) -> Result<()> {
        let frame = &self.rig.map_frame;
        let origin = maker.map().origin();
        if self.origin != Some(origin) {
            let still = messages::origin_transform(frame, step.window.stamp_ns, origin);
            self.tf_static.send(encode::encode_tf_message(&[still]))?;
            self.origin = Some(origin);
            self.map.forget();
        }
        if self.tf.wanted() {
            self.tf.send(encode::encode_tf_message(&[messages::anchor_transform(step, frame)]))?;
        }
        Ok(())
    }

    fn pictures(&mut self, step: &Step, active: &[usize]) -> Result<()> {
        for (view, &camera) in active.iter().enumerate() {
            let (Some(topics), Some(described)) = (self.cameras.get(camera), self.rig.cameras.get(camera)) else {
                continue;
            };
            let Some(pictures) = Pictures::new(step, view, described) else { continue };
            if topics.info.wanted() {
                topics.info.send(encode::encode_camera_info(&pictures.camera_info()))?;
            }
            if topics.rendered.wanted() {
                topics.rendered.send(encode::encode_image(&pictures.rendered()))?;
            }
            if topics.depth.wanted() {
                topics.depth.send(encode::encode_image(&pictures.depth(&mut self.counts)))?;
            }
            if step.views.get(view).is_none_or(|v| v.motion_id.is_none()) {
                // Somebody has subscribed since the step began; from the next one on there are masks.
                continue;
            }
            if topics.mask.wanted() {
                topics.mask.send(encode::encode_image(&pictures.motion_mask()))?;
            }
            if topics.mask_color.wanted() {
                topics.mask_color.send(encode::encode_image(&pictures.mask_color()?))?;
            }
        }
        Ok(())
    }

    fn moving(&mut self, step: &Step, maker: &StepMaker) -> Result<()> {
        let stamp_ns = step.window.stamp_ns;
        if self.tracks.wanted() {
            let header = Header { stamp_ns, frame_id: ORIGIN_FRAME.into() };
            let built = track_cloud(header, &convert::track_ends(maker.tracks(), maker.map().origin()))?;
            self.counts.withheld += built.non_finite as u64;
            self.tracks.send(encode::encode_point_cloud2(&built.cloud))?;
        }
        let header = Header { stamp_ns, frame_id: self.rig.map_frame.clone() };
        if self.objects.wanted() {
            self.objects.send(encode_live::encode_markers(&convert::markers(maker.objects(), &header)))?;
        }
        if let Some(topic) = self.detections.as_ref().filter(|t| t.wanted()) {
            let found = convert::detections(maker.objects(), &header);
            topic.send(encode_live::encode_detections(&header, &found))?;
        }
        Ok(())
    }

    fn path(&mut self) -> Result<()> {
        let due = self.path_sent.is_none_or(|at| at.elapsed().as_secs_f64() >= PATH_EVERY_SEC);
        if due && self.path.wanted() {
            let path = messages::path(&self.rig.map_frame, self.poses.make_contiguous());
            self.path.send(encode::encode_path(&path))?;
            self.path_sent = Some(Instant::now());
        }
        Ok(())
    }
}

impl Outlet for Outputs {
    fn demand(&mut self) -> Demand {
        let any = |of: &dyn Fn(&CameraOutputs) -> bool| self.cameras.iter().any(of);
        let motion = any(&|c| c.mask.wanted() || c.mask_color.wanted());
        Demand {
            motion,
            pictures: motion || any(&|c| c.rendered.wanted() || c.depth.wanted() || c.info.wanted()),
            tracks: self.tracks.wanted(),
            objects: self.objects.wanted() || self.detections.as_ref().is_some_and(Topic::wanted),
            map: match self.config.live.map.as_str() {
                "always" => true,
                "never" => false,
                _ => self.map.was_wanted() || !self.config.live.map_dir.is_empty(),
            },
        }
    }

    fn vehicle(&mut self, stamp_ns: i64, map_from_base: Rigid) {
        if self.poses.back().is_some_and(|(last_ns, _)| stamp_ns < *last_ns) {
            self.poses.clear();
        }
        self.poses.push_back((stamp_ns, map_from_base));
        if self.poses.len() > PATH_POSES {
            self.poses.pop_front();
        }
    }

    fn step(&mut self, step: &Step, maker: &StepMaker, active: &[usize]) -> Result<()> {
        self.transforms(step, maker)?;
        // What planners and trackers wait for goes first.
        if self.flow.wanted() {
            self.flow.send(encode::encode_point_cloud2(&messages::flow(step, &mut self.counts)?))?;
        }
        self.moving(step, maker)?;
        if self.gaussians.wanted() {
            let cloud = messages::gaussians(step, &self.config, &mut self.counts)?;
            self.gaussians.send(encode::encode_point_cloud2(&cloud))?;
        }
        self.pictures(step, active)?;
        self.path()?;
        self.stamp_ns = Some(step.window.stamp_ns);
        self.idle(maker)
    }

    fn idle(&mut self, maker: &StepMaker) -> Result<()> {
        match self.stamp_ns {
            Some(stamp_ns) => self.map.offer(maker.map(), stamp_ns, &self.config.live, &mut self.counts),
            None => Ok(()),
        }
    }

    fn configure(&mut self, config: &Config) {
        self.config = config.clone();
    }

    fn times(&mut self, stages_ms: &[(&'static str, f64)]) {
        for (stage, topic) in &self.debug {
            if let Some((_, ms)) = stages_ms.iter().find(|(name, _)| name == stage)
                && topic.wanted()
            {
                // A debug value that cannot be sent is not worth a word.
                let _ = topic.send(encode::encode_float64(*ms));
            }
        }
    }
}
