//! A recorded bag as a stream of events.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result};
use tracing::{info, warn};

use crate::bag::Bag;
use crate::cdr::decode as cdr;
use crate::config::{Config, InputConfig, SyncConfig};
use crate::msg::{CameraInfo, PoseStamped, TransformStamped};
use crate::sync::DropReason;
use crate::sync::clock::seconds_between;
use crate::tf::TfTree;

use super::event::Event;
use super::first::FirstPictures;
use super::first_images::black_frames;
use super::frames::{Frames, MAP_FRAME_AHEAD_SEC};
use super::mount::PoseNames;
use super::rig::{CameraDescription, Rig};
use super::topics::{COMPRESSED, PoseTopic, TopicError, TopicPlan};
use super::translate::{Role, translate};

/// Losses of one topic that are written to the log one by one; the rest is only counted.
const LOGGED_LOSSES_PER_TOPIC: usize = 5;

/// An opened bag with its topics and cameras resolved.
pub struct BagSource {
    bag: Bag,
    plan: TopicPlan,
    rig: Arc<Rig>,
    sync: SyncConfig,
    static_transforms: Vec<TransformStamped>,
    roles: Vec<Role>,
}

impl BagSource {
    /// Opens a bag, finds its topics and reads ahead for what describes the cameras (CameraInfo, /tf_static and each
    /// camera's first image). `network_size` is width and height of the pictures the network takes.
    pub fn open(path: &Path, config: &Config, network_size: (usize, usize)) -> Result<Self> {
        let bag = Bag::open(path).with_context(|| format!("cannot read bag {}", path.display()))?;
        if bag.message_count() == 0 {
            anyhow::bail!("bag {} holds no messages", path.display());
        }
        let place = || format!("bag {}", path.display());
        let plan = plan_of(&bag, &config.input).with_context(place)?;
        for left_out in &plan.left_out {
            info!("no camera: {left_out}");
        }
        let Described { mut cameras, pose, statics: static_transforms } = describe(&bag, &plan).with_context(place)?;
        if config.input.find_black_frame {
            let frames = black_frames(&bag, &plan).with_context(place)?;
            cameras.iter_mut().zip(frames).for_each(|(camera, frame)| camera.black_frame = frame);
        }
        let mut tree = static_tree(&config.sync, &static_transforms);
        let frames = Frames::new(&config.input, plan.pose == PoseTopic::Tf, &cameras, pose);
        let pose = read_moving(&bag, &plan, &frames, &mut tree).with_context(place)?;
        let rig = Rig::build(cameras, &tree, &pose, &config.input, network_size).with_context(place)?;
        let mut roles = vec![Role::None; bag.topics().len()];
        for (camera, c) in plan.cameras.iter().enumerate() {
            roles[c.image] = Role::Image { camera, compressed: c.compressed };
        }
        for &(camera, kind, topic) in &plan.truth {
            let compressed = bag.topics()[topic].type_name == COMPRESSED;
            roles[topic] = Role::Truth { camera, kind, compressed };
        }
        match plan.pose {
            PoseTopic::Message(topic) => {
                roles[topic] = Role::Pose { type_name: bag.topics()[topic].type_name.clone() };
            }
            PoseTopic::Tf => {}
        }
        if plan.pose == PoseTopic::Tf || rig.needs_tree() {
            plan.tf.iter().for_each(|&t| roles[t] = Role::Transform);
        }
        Ok(Self { bag, plan, rig: Arc::new(rig), sync: config.sync.clone(), static_transforms, roles })
    }

    /// The cameras.
    pub fn rig(&self) -> Arc<Rig> {
        self.rig.clone()
    }

    /// The topics by part.
    pub fn plan(&self) -> &TopicPlan {
        &self.plan
    }

    /// The static transforms, for a pose that comes from TF.
    pub fn statics(&self) -> TfTree {
        static_tree(&self.sync, &self.static_transforms)
    }

    /// Where the pose comes from and between which frames, for people.
    pub fn pose_line(&self) -> String {
        let topics = match self.plan.pose {
            PoseTopic::Message(t) => self.topic_name(t).to_string(),
            PoseTopic::Tf => self.plan.tf.iter().map(|&t| self.topic_name(t)).collect::<Vec<_>>().join(", "),
        };
        let (base, map) = (&self.rig.base_frame, &self.rig.map_frame);
        match &self.rig.pose_frame {
            Some(given) => format!("pose: {topics}, `{base}` in `{given}`, brought into `{map}` by /tf"),
            None => format!("pose: {topics}, `{base}` in `{map}`"),
        }
    }

    /// Name of topic number `topic` of the plan.
    pub fn topic_name(&self, topic: usize) -> &str {
        self.bag.topics().get(topic).map_or("?", |t| t.name.as_str())
    }

    /// Messages on the camera topics (what a progress bar counts).
    pub fn image_count(&self) -> u64 {
        self.plan.cameras.iter().map(|c| self.bag.topics()[c.image].count).sum()
    }

    /// What could not be read without stopping the run; complete once all events were taken.
    pub fn problems(&self) -> Vec<String> {
        self.bag.problems()
    }

    /// Runs through the bag once, in log-time order. `each` returns false to stop early.
    pub fn events(&self, mut each: impl FnMut(Event) -> bool) -> Result<()> {
        let wanted: Vec<usize> = (0..self.roles.len()).filter(|&i| !matches!(self.roles[i], Role::None)).collect();
        let mut losses = vec![0usize; self.roles.len()];
        for message in self.bag.messages(&wanted)? {
            let message = match message {
                Ok(m) => m,
                Err(e) => {
                    warn!("{e}");
                    if !each(Event::Lost { camera: None, reason: DropReason::Decode, detail: e.to_string() }) {
                        return Ok(());
                    }
                    continue;
                }
            };
            let role = self.roles.get(message.topic).unwrap_or(&Role::None);
            let topic = self.topic_name(message.topic);
            let mut go_on = true;
            translate(&self.rig, role, topic, &message.data, message.log_time_ns, &mut |event| {
                if let Event::Lost { detail, .. } = &event {
                    losses[message.topic] += 1;
                    if losses[message.topic] <= LOGGED_LOSSES_PER_TOPIC {
                        warn!("{detail}");
                    }
                }
                go_on = go_on && each(event);
            });
            if !go_on {
                return Ok(());
            }
        }
        Ok(())
    }
}

/// The topics of `bag` by part; image topics are looked at, since an encoding may say that one shows no colour.
///
/// # Errors
/// A part that no topic plays, or several could.
pub fn plan_of(bag: &Bag, config: &InputConfig) -> Result<TopicPlan, TopicError> {
    let first = |topic: usize| {
        let message = bag.messages(&[topic]).ok()?.find_map(Result::ok)?;
        match bag.topics()[topic].type_name.as_str() {
            COMPRESSED => cdr::compressed_image(&message.data).ok().map(|m| m.format),
            _ => cdr::image(&message.data).ok().map(|m| m.encoding),
        }
    };
    TopicPlan::resolve(bag.topics(), config, &first)
}

/// A transform tree that holds what /tf_static said; transforms that cannot be used are named in the log.
pub fn static_tree(sync: &SyncConfig, transforms: &[TransformStamped]) -> TfTree {
    let mut tree = TfTree::new(sync);
    for t in transforms {
        if let Err(e) = tree.insert(t, true) {
            warn!("/tf_static: {e}");
        }
    }
    tree
}

/// What was read ahead.
struct Described {
    cameras: Vec<CameraDescription>,
    pose: PoseNames,
    statics: Vec<TransformStamped>,
}

/// Reads ahead until every camera is described: CameraInfo, first image's frame, a picture that can be decoded, /tf_static,
/// the pose's frames.
fn describe(bag: &Bag, plan: &TopicPlan) -> Result<Described> {
    let mut statics = Vec::new();
    let n = plan.cameras.len();
    let mut infos: Vec<Option<CameraInfo>> = vec![None; n];
    let mut frames: Vec<Option<String>> = vec![None; n];
    let mut pictures = FirstPictures::new(n);
    let mut pose: Option<PoseNames> = None;
    let pose_topic = match plan.pose {
        PoseTopic::Message(t) => Some(t),
        PoseTopic::Tf => None,
    };
    let mut wanted: Vec<usize> = plan.tf_static.clone();
    wanted.extend(pose_topic);
    wanted.extend(plan.cameras.iter().flat_map(|c| [c.image, c.info]));
    wanted.sort_unstable();
    wanted.dedup();
    let mut statics_left: u64 = plan.tf_static.iter().map(|&t| bag.topics()[t].count).sum();
    for message in bag.messages(&wanted)? {
        let Ok(m) = message else { continue };
        if plan.tf_static.contains(&m.topic) {
            statics_left = statics_left.saturating_sub(1);
            match cdr::tf_message(&m.data) {
                Ok(list) => statics.extend(list),
                Err(e) => warn!("/tf_static: {e}"),
            }
        }
        if pose_topic == Some(m.topic) && pose.is_none() {
            let names = |p: PoseStamped| PoseNames { frame: p.header.frame_id, child: p.child_frame_id };
            pose = cdr::pose(&bag.topics()[m.topic].type_name, &m.data).ok().map(names);
        }
        for (i, c) in plan.cameras.iter().enumerate() {
            if c.info == m.topic && infos[i].is_none() {
                match cdr::camera_info(&m.data) {
                    Ok(info) => infos[i] = Some(info),
                    Err(e) => warn!("{}: {e}", bag.topics()[m.topic].name),
                }
            }
            if c.image == m.topic && frames[i].is_none() {
                frames[i] = cdr::header(&m.data).ok().map(|h| h.frame_id);
            }
            if c.image == m.topic {
                pictures.take(i, c, &m.data)?;
            }
        }
        let described = infos.iter().all(Option::is_some) && frames.iter().all(Option::is_some) && pictures.done();
        if described && statics_left == 0 && (pose_topic.is_none() || pose.is_some()) {
            break;
        }
    }
    pictures.finish(&plan.cameras)?;
    let cameras = plan
        .cameras
        .iter()
        .zip(infos)
        .zip(frames)
        .map(|((c, info), frame_id)| CameraDescription {
            topic: c.name.clone(),
            info_topic: bag.topics()[c.info].name.clone(),
            frame_id,
            info,
            black_frame: None,
        })
        .collect();
    Ok(Described { cameras, pose: pose.unwrap_or_default(), statics })
}

/// Reads /tf ahead into `tree`, as far as the frames need it: to where the pose comes from (with a tree), to the cameras that
/// no fixed transform leads to, to the configured map frame. Gives the frames of the pose.
fn read_moving(bag: &Bag, plan: &TopicPlan, frames: &Frames, tree: &mut TfTree) -> Result<PoseNames> {
    let mut first_ns: Option<i64> = None;
    if !frames.complete(tree, false) && !plan.tf.is_empty() {
        for message in bag.messages(&plan.tf)? {
            let Ok(m) = message else { continue };
            // What cannot be read or used is said when the events are read.
            let Ok(list) = cdr::tf_message(&m.data) else { continue };
            for t in &list {
                let _ = tree.insert(t, false);
            }
            let ahead_sec = seconds_between(*first_ns.get_or_insert(m.log_time_ns), m.log_time_ns);
            if frames.complete(tree, ahead_sec > MAP_FRAME_AHEAD_SEC) {
                break;
            }
        }
    }
    frames.pose(tree).map_err(anyhow::Error::msg)
}
