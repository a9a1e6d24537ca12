//! Waits until the cameras are described: CameraInfo and a first picture of each, mountings, the pose's child frame.

use std::sync::Arc;

use tracing::warn;

use super::topics::{LivePlan, LivePose};
use crate::cdr::decode as cdr;
use crate::config::Config;
use crate::decode::FrameFinder;
use crate::msg::{CameraInfo, TransformStamped};
use crate::pipeline::posed::PoseStore;
use crate::poses::PoseBuffer;
use crate::source::Rig;
use crate::source::bag::static_tree;
use crate::source::look_at;
use crate::source::rig::CameraDescription;

/// Static transforms kept; they are sent once each.
const MAX_STATICS: usize = 10_000;

/// What was learnt so far.
pub struct Describer {
    plan: LivePlan,
    infos: Vec<Option<CameraInfo>>,
    frames: Vec<Option<String>>,
    finders: Vec<FrameFinder>,
    statics: Vec<TransformStamped>,
    pose_child: Option<String>,
    changed: bool,
    missing: String,
}

impl Describer {
    /// For the inputs of `plan`.
    pub fn new(plan: LivePlan) -> Self {
        let n = plan.cameras.len();
        let (infos, frames, statics) = (vec![None; n], vec![None; n], Vec::new());
        let finders = vec![FrameFinder::default(); n];
        Self { plan, infos, frames, finders, statics, pose_child: None, changed: true, missing: String::new() }
    }

    /// A CameraInfo; true when it says something else than the one before.
    pub fn info(&mut self, camera: usize, data: &[u8]) -> bool {
        let Some(place) = self.infos.get_mut(camera) else { return false };
        match cdr::camera_info(data) {
            Ok(info) => {
                let other = place.as_ref().is_some_and(|old| {
                    (old.k, old.p, old.r, &old.d, old.width, old.height)
                        != (info.k, info.p, info.r, &info.d, info.width, info.height)
                });
                self.changed |= other || place.is_none();
                *place = Some(info);
                other
            }
            Err(e) => {
                if place.is_none() {
                    warn!("{}: {e}", self.plan.cameras[camera].info);
                }
                false
            }
        }
    }

    /// A picture: its frame is what matters here, and the black around the first ones.
    pub fn picture(&mut self, camera: usize, data: &[u8]) {
        if let (Some(finder), Some(topics)) = (self.finders.get_mut(camera), self.plan.cameras.get(camera))
            && !finder.settled()
        {
            look_at(finder, topics.compressed, data);
            self.changed |= finder.settled();
        }
        if let Some(place @ None) = self.frames.get_mut(camera)
            && let Ok(header) = cdr::header(data)
        {
            *place = Some(header.frame_id);
            self.changed = true;
        }
    }

    /// A pose: the frame it is of matters here.
    pub fn pose(&mut self, data: &[u8]) {
        if let LivePose::Message { type_name, .. } = &self.plan.pose
            && self.pose_child.is_none()
            && let Ok(pose) = cdr::pose(type_name, data)
        {
            self.pose_child = Some(pose.child_frame_id);
            self.changed = true;
        }
    }

    /// Transforms that hold at all times.
    pub fn statics(&mut self, data: &[u8]) {
        match cdr::tf_message(data) {
            Ok(list) if self.statics.len() < MAX_STATICS => {
                self.statics.extend(list);
                self.changed = true;
            }
            Ok(_) => {}
            Err(e) => warn!("/tf_static: {e}"),
        }
    }

    /// What is still missing, for people.
    pub fn missing(&self) -> &str {
        &self.missing
    }

    /// The cameras and an empty pose store, once everything is known.
    pub fn build(&mut self, config: &Config, network_size: (usize, usize)) -> Option<(Arc<Rig>, PoseStore)> {
        if !std::mem::take(&mut self.changed) {
            return None;
        }
        let mut missing = Vec::new();
        for (i, camera) in self.plan.cameras.iter().enumerate() {
            if self.infos[i].is_none() {
                missing.push(format!("no message on {}", camera.info));
            }
            if self.frames[i].is_none() {
                missing.push(format!("no picture on {}", camera.image));
            } else if config.input.find_black_frame && !self.finders[i].settled() {
                missing.push(format!("more pictures on {} to see whether their black border stays", camera.image));
            }
        }
        if let (LivePose::Message { topic, .. }, None) = (&self.plan.pose, &self.pose_child) {
            missing.push(format!("no pose on {topic}"));
        }
        if !missing.is_empty() {
            self.missing = missing.join(", ");
            return None;
        }
        let cameras = self.plan.cameras.iter().zip(&self.infos).zip(&self.frames).zip(&self.finders);
        let described = cameras
            .map(|(((camera, info), frame_id), finder)| CameraDescription {
                topic: camera.image.clone(),
                info_topic: camera.info.clone(),
                frame_id: frame_id.clone(),
                info: info.clone(),
                black_frame: finder.found(),
            })
            .collect();
        let tree = static_tree(&config.sync, &self.statics);
        let child = self.pose_child.clone().unwrap_or_default();
        match Rig::build(described, &tree, &child, &config.input, network_size) {
            Ok(rig) => {
                let store = match self.plan.pose {
                    LivePose::Message { .. } => PoseStore::Buffer(PoseBuffer::new(&config.sync)),
                    LivePose::Tf => {
                        PoseStore::Tree { tree, fixed: config.input.map_frame.clone(), base: rig.base_frame.clone() }
                    }
                };
                Some((Arc::new(rig), store))
            }
            Err(e) => {
                self.missing = e.to_string();
                None
            }
        }
    }
}
