//! A recorded bag as a stream of events.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use tracing::{info, warn};

use crate::bag::{Bag, BagError, RawMessage};
use crate::cdr::decode as cdr;
use crate::config::{Config, InputConfig, SyncConfig};
use crate::decode::RgbPicture;
use crate::msg::{CameraInfo, PoseStamped, TransformStamped};
use crate::pipeline::posed::PoseStore;
use crate::sync::DropReason;
use crate::sync::clock::{seconds_between, signed_ns};
use crate::tf::TfTree;

use super::ahead::PoseAhead;
use super::event::{Event, Frame};
use super::first::FirstPictures;
use super::first_images::black_frames;
use super::frames::{Frames, MAP_FRAME_AHEAD_SEC};
use super::mount::PoseNames;
use super::rig::{CameraDescription, Rig};
use super::survey::Survey;
use super::topics::{COMPRESSED, PoseTopic, TopicError, TopicPlan};
use super::translate::{Role, translate};

/// Images of a camera that may be unreadable before it is given up.
const IMAGES_TRIED: usize = 5;

/// Losses of one topic that are written to the log one by one; the rest is only counted.
const LOGGED_LOSSES_PER_TOPIC: usize = 5;

/// An opened bag with its topics and cameras resolved.
pub struct BagSource {
    bag: Bag,
    plan: TopicPlan,
    rig: Arc<Rig>,
    config: Config,
    survey: Survey,
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
        let survey = Survey::beginning(&bag, &plan).with_context(|| format!("bag {}", path.display()))?;
        let (rig, config) = (Arc::new(rig), config.clone());
        Ok(Self { bag, plan, rig, config, survey, static_transforms, roles })
    }

    /// Refuses a recording no step can come of: stamps of two clocks, images none of which can be read. The error says why and what
    /// to set.
    pub fn check(&self) -> Result<()> {
        let recorded_sec = match (self.bag.start_ns(), self.bag.end_ns()) {
            (Some(start_ns), Some(end_ns)) => seconds_between(start_ns, end_ns),
            _ => 0.0,
        };
        self.survey.check(&self.plan, &self.config.input, recorded_sec)?;
        self.check_images()
    }

    /// Reads the first images of every camera, as a replay does, until one fits its CameraInfo.
    fn check_images(&self) -> Result<()> {
        for (camera, c) in self.plan.cameras.iter().enumerate() {
            let mut first_error = None;
            for message in self.bag.messages(&[c.image])?.flatten().take(IMAGES_TRIED) {
                let mut why = None;
                self.translate(&message, &mut |event| {
                    if let Event::Lost { detail, .. } = event {
                        why = Some(detail);
                    }
                });
                match why {
                    Some(why) => first_error = first_error.or(Some(why)),
                    None => {
                        first_error = None;
                        break;
                    }
                }
            }
            if let Some(why) = first_error {
                bail!("camera {camera}: none of its first images can be read; {why}");
            }
        }
        Ok(())
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
        static_tree(&self.config.sync, &self.static_transforms)
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

    /// Runs through the bag once: images and ground truth in log-time order, every image behind the poses it needs, wherever
    /// these are recorded. `each` returns false to stop early.
    pub fn events(&self, each: impl FnMut(Event) -> bool) -> Result<()> {
        self.run(true, each)
    }

    /// The same without pixels: images are empty, and there is no ground truth. For what stamps alone say.
    pub fn events_without_pixels(&self, each: impl FnMut(Event) -> bool) -> Result<()> {
        self.run(false, each)
    }

    fn run(&self, pixels: bool, mut each: impl FnMut(Event) -> bool) -> Result<()> {
        let mut poses = self.plan.pose_topics();
        if self.rig.needs_tree() {
            // Joints of cameras, and the frame that poses are given in, are needed as early as the poses.
            poses.extend(self.plan.tf.iter().copied());
            poses.sort_unstable();
            poses.dedup();
        }
        let wanted = |role: &Role| match role {
            Role::None => false,
            Role::Truth { .. } => pixels,
            _ => true,
        };
        let others = (0..self.roles.len()).filter(|i| wanted(&self.roles[*i]) && !poses.contains(i));
        let others: Vec<usize> = others.collect();
        let mut losses = vec![0usize; self.roles.len()];
        let mut hand_on = |topic: Option<usize>, event: Event| {
            if let (Event::Lost { detail, .. }, Some(topic)) = (&event, topic) {
                losses[topic] += 1;
                if losses[topic] <= LOGGED_LOSSES_PER_TOPIC {
                    warn!("{detail}");
                }
            }
            each(event)
        };
        let translated = |message: &RawMessage| {
            let mut events = Vec::new();
            self.translate(message, &mut |event| events.push(event));
            events
        };
        let store = PoseStore::of_bag(self, &self.rig, &self.config);
        let dated_ahead_ns = if self.rig.stamps_recorded { BTreeMap::new() } else { self.survey.dated_ahead() };
        let mut ahead =
            PoseAhead::new(self.bag.messages(&poses)?, translated, store, dated_ahead_ns, &self.config.sync);
        for message in self.bag.messages(&others)? {
            let message = match message {
                Ok(m) => m,
                Err(e) => {
                    if !unreadable(&e, &mut hand_on) {
                        return Ok(());
                    }
                    continue;
                }
            };
            if let Some(Role::Image { camera, .. }) = self.roles.get(message.topic) {
                let stamp_ns = self.image_stamp_ns(*camera, &message);
                if !ahead.before_image(stamp_ns, message.log_time_ns, &mut hand_on) {
                    return Ok(());
                }
            }
            let mut go_on = true;
            let mut take = |event| go_on = go_on && hand_on(Some(message.topic), event);
            match self.roles.get(message.topic) {
                Some(Role::Image { camera, .. }) if !pixels => take(self.without_pixels(*camera, &message)),
                _ => self.translate(&message, &mut take),
            }
            for e in ahead.errors() {
                go_on = go_on && unreadable(&e, &mut hand_on);
            }
            if !go_on {
                return Ok(());
            }
        }
        if ahead.rest(&mut hand_on) {
            for e in ahead.errors() {
                unreadable(&e, &mut hand_on);
            }
        }
        Ok(())
    }

    fn translate(&self, message: &RawMessage, each: &mut dyn FnMut(Event)) {
        let role = self.roles.get(message.topic).unwrap_or(&Role::None);
        translate(&self.rig, role, self.topic_name(message.topic), &message.data, message.log_time_ns, each);
    }

    fn without_pixels(&self, camera: usize, message: &RawMessage) -> Event {
        let frame = Frame::whole(RgbPicture { width: 0, height: 0, data: Vec::new() });
        match cdr::header(&message.data) {
            Ok(header) => {
                let stamp_ns = if self.rig.stamps_recorded { message.log_time_ns } else { header.stamp_ns };
                Event::Image { camera, stamp_ns, frame }
            }
            Err(e) => {
                let detail = format!("{} at {} ns: {e}", self.topic_name(message.topic), message.log_time_ns);
                Event::Lost { camera: Some(camera), reason: DropReason::Decode, detail }
            }
        }
    }

    /// The stamp an image's pose is looked up at.
    fn image_stamp_ns(&self, camera: usize, message: &RawMessage) -> i64 {
        let header_ns = cdr::header(&message.data).map_or(message.log_time_ns, |h| h.stamp_ns);
        let stamp_ns = if self.rig.stamps_recorded { message.log_time_ns } else { header_ns };
        let offset_sec = self.config.input.image_time_offset_sec.get(camera).copied().unwrap_or(0.0);
        stamp_ns.saturating_add(signed_ns(offset_sec))
    }
}

/// Says and counts a message that could not be read at all.
fn unreadable(e: &BagError, each: &mut impl FnMut(Option<usize>, Event) -> bool) -> bool {
    warn!("{e}");
    each(None, Event::Lost { camera: None, reason: DropReason::Decode, detail: e.to_string() })
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
