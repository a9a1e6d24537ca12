//! Waits until the cameras are described: CameraInfo and a first picture of each, mountings, the pose's child frame.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use tracing::warn;

use super::topics::{LivePlan, LivePose};
use crate::cdr::decode as cdr;
use crate::config::Config;
use crate::decode::FrameFinder;
use crate::msg::{CameraInfo, TransformStamped};
use crate::pipeline::posed::PoseStore;
use crate::source::Rig;
use crate::source::bag::static_tree;
use crate::source::frames::{Frames, MAP_FRAME_AHEAD_SEC};
use crate::source::look_at;
use crate::source::mount::PoseNames;
use crate::source::rig::CameraDescription;

/// Static transforms kept; they are sent once each.
const MAX_STATICS: usize = 10_000;
/// Moving transforms kept, by their child: what matters here is which frames they connect.
const MAX_MOVING: usize = 512;

/// What was learnt so far.
pub struct Describer {
    plan: LivePlan,
    infos: Vec<Option<CameraInfo>>,
    frames: Vec<Option<String>>,
    finders: Vec<FrameFinder>,
    statics: Vec<TransformStamped>,
    moving: BTreeMap<String, TransformStamped>,
    /// When the first moving transform came.
    moving_since: Option<Instant>,
    /// True once the map frame was waited for as long as it is.
    any_map: bool,
    pose: Option<PoseNames>,
    built: bool,
    /// True while nothing is built, and afterwards when the cameras or the poses need moving transforms.
    needs_joints: bool,
    changed: bool,
    missing: String,
}

impl Describer {
    /// For the inputs of `plan`.
    pub fn new(plan: LivePlan) -> Self {
        let n = plan.cameras.len();
        let (infos, frames, statics) = (vec![None; n], vec![None; n], Vec::new());
        let finders = vec![FrameFinder::default(); n];
        Self {
            plan,
            infos,
            frames,
            finders,
            statics,
            moving: BTreeMap::new(),
            moving_since: None,
            any_map: false,
            pose: None,
            built: false,
            needs_joints: true,
            changed: true,
            missing: String::new(),
        }
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

    /// A pose: the frames it is of and in matter here.
    pub fn pose(&mut self, data: &[u8]) {
        if let LivePose::Message { type_name, .. } = &self.plan.pose
            && self.pose.is_none()
            && let Ok(pose) = cdr::pose(type_name, data)
        {
            self.pose = Some(PoseNames { frame: pose.header.frame_id, child: pose.child_frame_id });
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

    /// Transforms that change.
    pub fn transforms(&mut self, data: &[u8]) {
        if self.built {
            return;
        }
        let Ok(list) = cdr::tf_message(data) else { return };
        self.moving_since.get_or_insert_with(Instant::now);
        for t in list {
            if self.moving.len() < MAX_MOVING || self.moving.contains_key(&t.child_frame_id) {
                self.changed |= self.moving.insert(t.child_frame_id.clone(), t).is_none();
            }
        }
    }

    /// Whether moving transforms beside a pose topic are wanted.
    pub fn needs_joints(&self) -> bool {
        self.needs_joints
    }

    /// What is still missing, for people.
    pub fn missing(&self) -> &str {
        &self.missing
    }

    /// The cameras and an empty pose store, once everything is known.
    pub fn build(&mut self, config: &Config, network_size: (usize, usize)) -> Option<(Arc<Rig>, PoseStore)> {
        let has_waited = |since: Instant| since.elapsed().as_secs_f64() > MAP_FRAME_AHEAD_SEC;
        if !self.any_map && self.moving_since.is_some_and(has_waited) {
            (self.any_map, self.changed) = (true, true);
        }
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
        if let (LivePose::Message { topic, .. }, None) = (&self.plan.pose, &self.pose) {
            missing.push(format!("no pose on {topic}"));
        }
        if !missing.is_empty() {
            self.missing = missing.join(", ");
            return None;
        }
        let cameras = self.plan.cameras.iter().zip(&self.infos).zip(&self.frames).zip(&self.finders);
        let described: Vec<_> = cameras
            .map(|(((camera, info), frame_id), finder)| CameraDescription {
                topic: camera.image.clone(),
                info_topic: camera.info.clone(),
                frame_id: frame_id.clone(),
                info: info.clone(),
                black_frame: finder.found(),
            })
            .collect();
        let mut tree = static_tree(&config.sync, &self.statics);
        for t in self.moving.values() {
            // What cannot be used is said when the pipeline reads it.
            let _ = tree.insert(t, false);
        }
        let from_tree = self.plan.pose == LivePose::Tf;
        let frames = Frames::new(&config.input, from_tree, &described, self.pose.clone().unwrap_or_default());
        let pose = match frames.pose(&tree) {
            Ok(pose) => pose,
            Err(e) => {
                self.missing = e;
                return None;
            }
        };
        match Rig::build(described, &tree, &pose, &config.input, network_size) {
            Ok(_) if from_tree && !frames.complete(&tree, self.any_map) => {
                self.missing = format!("no transform yet from a frame `map` to `{}`", pose.child);
                None
            }
            Ok(rig) => {
                let statics = || static_tree(&config.sync, &self.statics);
                let store = match self.plan.pose {
                    LivePose::Message { .. } => PoseStore::of_messages(&rig, config, statics),
                    LivePose::Tf => PoseStore::of_tree(&rig, statics()),
                };
                (self.built, self.needs_joints) = (true, from_tree || rig.needs_tree());
                rig.log(network_size);
                Some((Arc::new(rig), store))
            }
            Err(e) => {
                self.missing = e.to_string();
                None
            }
        }
    }
}
