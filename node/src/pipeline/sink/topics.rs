//! The published topics of a replay, written into a bag.

use std::path::Path;

use anyhow::Result;
use glam::DVec3;

use crate::cdr::encode;
use crate::cdr::schema::MessageType;
use crate::config::Config;
use crate::output::bag_writer::{BagWriter, TopicId};
use crate::output::cloud::MapCloud;
use crate::output::ply::PlyCloud;
use crate::output::qos::Qos;
use crate::pipeline::map_updates::MapUpdate;
use crate::pipeline::messages::{self, Pictures, Published};
use crate::pipeline::step::Step;
use crate::source::Rig;

use super::trajectory::Trajectory;

/// Prefix of all topics: what `~/` resolves to for a node called storm.
pub const PREFIX: &str = "/storm/output";

struct CameraTopics {
    rendered: TopicId,
    depth: TopicId,
    mask: TopicId,
    mask_color: TopicId,
    info: TopicId,
}

/// Writes the published topics into a bag.
pub struct Publisher {
    bag: BagWriter,
    gaussians: TopicId,
    flow: TopicId,
    map: TopicId,
    map_update: TopicId,
    path: TopicId,
    tf: TopicId,
    tf_static: TopicId,
    cameras: Vec<CameraTopics>,
    /// The map's origin, as `/tf_static` has it.
    origin_told: Option<DVec3>,
    counts: Published,
}

impl Publisher {
    /// Starts the bag and declares its topics for `cameras` cameras.
    pub fn create(path: &Path, cameras: usize) -> Result<Self> {
        let mut bag = BagWriter::create(path)?;
        let mut topic = |name: &str, kind: MessageType, qos: Qos| bag.topic(&format!("{PREFIX}/{name}"), kind, qos);
        let gaussians = topic("gaussians", MessageType::PointCloud2, Qos::Reliable)?;
        let flow = topic("flow", MessageType::PointCloud2, Qos::Reliable)?;
        let map = topic("map", MessageType::PointCloud2, Qos::Latched)?;
        let map_update = topic("map_update", MessageType::PointCloud2, Qos::Reliable)?;
        let path_topic = topic("trajectory", MessageType::Path, Qos::Reliable)?;
        let mut per_camera = Vec::with_capacity(cameras);
        for i in 0..cameras {
            let mut of = |name: &str, kind| topic(&format!("camera{i}/{name}"), kind, Qos::Reliable);
            per_camera.push(CameraTopics {
                rendered: of("rendered", MessageType::Image)?,
                depth: of("depth", MessageType::Image)?,
                mask: of("motion_mask", MessageType::Image)?,
                mask_color: of("mask_color", MessageType::Image)?,
                info: of("camera_info", MessageType::CameraInfo)?,
            });
        }
        let tf = bag.topic("/tf", MessageType::TfMessage, Qos::Reliable)?;
        let tf_static = bag.topic("/tf_static", MessageType::TfMessage, Qos::Latched)?;
        Ok(Self {
            bag,
            gaussians,
            flow,
            map,
            map_update,
            path: path_topic,
            tf,
            tf_static,
            cameras: per_camera,
            origin_told: None,
            counts: Published::default(),
        })
    }

    /// Writes one step.
    pub fn step(&mut self, step: &Step, rig: &Rig, config: &Config) -> Result<()> {
        let stamp_ns = step.window.stamp_ns;
        let tf = messages::anchor_transform(step, &rig.map_frame);
        self.bag.write(self.tf, stamp_ns, &encode::encode_tf_message(&[tf])?)?;
        let cloud = messages::gaussians(step, config, &mut self.counts)?;
        self.bag.write(self.gaussians, stamp_ns, &encode::encode_point_cloud2(&cloud)?)?;
        let cloud = messages::flow(step, &mut self.counts)?;
        self.bag.write(self.flow, stamp_ns, &encode::encode_point_cloud2(&cloud)?)?;
        for (camera, topics) in self.cameras.iter().enumerate() {
            let Some(pictures) = Pictures::new(step, camera, &rig.cameras[camera]) else { continue };
            let written = [
                (topics.rendered, encode::encode_image(&pictures.rendered())?),
                (topics.depth, encode::encode_image(&pictures.depth(&mut self.counts))?),
                (topics.mask, encode::encode_image(&pictures.motion_mask())?),
                (topics.mask_color, encode::encode_image(&pictures.mask_color()?)?),
                (topics.info, encode::encode_camera_info(&pictures.camera_info())?),
            ];
            for (topic, cdr) in written {
                self.bag.write(topic, stamp_ns, &cdr)?;
            }
        }
        Ok(())
    }

    /// Writes changed tiles of the map.
    pub fn map_update(&mut self, update: &MapUpdate, rig: &Rig) -> Result<()> {
        self.tell_origin(update.stamp_ns, update.origin, rig)?;
        let cloud = messages::map_update(update.stamp_ns, update.tile_m, &update.tiles, &mut self.counts)?;
        self.bag.write(self.map_update, update.stamp_ns, &encode::encode_point_cloud2(&cloud)?)?;
        Ok(())
    }

    /// Says where the map's frame is, once.
    fn tell_origin(&mut self, stamp_ns: i64, origin: DVec3, rig: &Rig) -> Result<()> {
        if self.origin_told != Some(origin) {
            let still = messages::origin_transform(&rig.map_frame, stamp_ns, origin);
            self.bag.write(self.tf_static, stamp_ns, &encode::encode_tf_message(&[still])?)?;
            self.origin_told = Some(origin);
        }
        Ok(())
    }

    /// What became of the values so far.
    pub fn counts(&self) -> Published {
        self.counts
    }

    /// Writes the map, its frame, and the trajectory (one message for each stretch of rising time), then the bag's index.
    pub fn finish(mut self, map: &PlyCloud, origin: DVec3, trajectory: &Trajectory, rig: &Rig) -> Result<Published> {
        let stamp_ns = trajectory.last_ns().unwrap_or(0);
        self.tell_origin(stamp_ns, origin, rig)?;
        let cloud = MapCloud {
            positions: &map.positions,
            colors01: &map.colors01,
            opacities: &map.opacities,
            scales: &map.scales,
            quats: &map.quats,
        };
        let cloud = messages::map(stamp_ns, &cloud, &mut self.counts)?;
        self.bag.write(self.map, stamp_ns, &encode::encode_point_cloud2(&cloud)?)?;
        for (_, poses) in trajectory.epochs() {
            let path = messages::path(&rig.map_frame, poses);
            self.bag.write(self.path, path.header.stamp_ns, &encode::encode_path(&path)?)?;
        }
        self.bag.finish()?;
        Ok(self.counts)
    }
}
