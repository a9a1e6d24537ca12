//! Which topics of a recording play which part: by configuration, or found by type.

mod pose;

use serde::Serialize;
use thiserror::Error;

use crate::bag::Topic;
use crate::config::InputConfig;

use super::cameras::{self, FirstEncoding, LeftOut, picture_name};

/// Most cameras the network takes.
pub const MAX_CAMERAS: usize = 6;

pub(super) const IMAGE: &str = "sensor_msgs/msg/Image";
pub(super) const COMPRESSED: &str = "sensor_msgs/msg/CompressedImage";
pub(super) const CAMERA_INFO: &str = "sensor_msgs/msg/CameraInfo";
const TF: &str = "tf2_msgs/msg/TFMessage";
/// Message types a vehicle pose comes in.
pub const POSE_TYPES: [&str; 4] = [
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
];
/// Why the topics of a recording cannot be matched to their parts. The message lists what was found and names the fix.
#[derive(Debug, Error)]
pub enum TopicError {
    /// A topic named by the configuration is not in the recording.
    #[error("{key} names topic {topic}, which is not there; there are: {found}")]
    Missing {
        /// The configuration key.
        key: &'static str,
        /// The name.
        topic: String,
        /// Topics of a fitting type.
        found: String,
    },
    /// A topic named by the configuration has another type.
    #[error("{key} names topic {topic} of type {found}; wanted {wanted}")]
    Type {
        /// The configuration key.
        key: &'static str,
        /// The name.
        topic: String,
        /// Its type.
        found: String,
        /// What would fit.
        wanted: String,
    },
    /// No topic plays this part.
    #[error("no {part}; there are: {found}")]
    None {
        /// What was looked for.
        part: &'static str,
        /// All topics with their types.
        found: String,
    },
    /// No topic shows camera pictures.
    #[error(
        "no camera image topic{}; there are: {found}",
        if left_out.is_empty() { String::new() } else { format!("; left out: {left_out}; if one is a camera all the same, name it in input.images") }
    )]
    NoCamera {
        /// Image topics that are no cameras, with the reason.
        left_out: String,
        /// All topics with their types.
        found: String,
    },
    /// More than one topic could play this part.
    #[error("{part} is ambiguous, name it with {key}; candidates: {candidates}")]
    Ambiguous {
        /// What was looked for.
        part: String,
        /// The configuration key that settles it.
        key: &'static str,
        /// The candidates.
        candidates: String,
    },
}

/// One camera's topics, as indices into the recording's topic list.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CameraTopics {
    /// Image topic.
    pub image: usize,
    /// Its name.
    pub name: String,
    /// True for CompressedImage.
    pub compressed: bool,
    /// CameraInfo topic.
    pub info: usize,
}

/// Where the vehicle pose comes from.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub enum PoseTopic {
    /// A topic of one of the pose types.
    Message(usize),
    /// The transform tree.
    Tf,
}

/// What a ground-truth topic holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub enum TruthKind {
    /// z-depth, metres, 0 for sky.
    Depth,
    /// Scene flow, m/s in map axes.
    Flow,
    /// Not 0 where the surface moves.
    Moving,
    /// Not 0 where the ray meets the sky.
    Sky,
    /// Object number, 0 for the static scene.
    Instance,
}

impl TruthKind {
    /// Every kind.
    pub const ALL: [Self; 5] = [Self::Depth, Self::Flow, Self::Moving, Self::Sky, Self::Instance];
}

/// The recording's topics by part.
#[derive(Debug, Clone, PartialEq)]
pub struct TopicPlan {
    /// Cameras, in the network's order.
    pub cameras: Vec<CameraTopics>,
    /// The vehicle pose.
    pub pose: PoseTopic,
    /// `/tf` topics.
    pub tf: Vec<usize>,
    /// `/tf_static` topics.
    pub tf_static: Vec<usize>,
    /// Ground truth: camera, kind, topic.
    pub truth: Vec<(usize, TruthKind, usize)>,
    /// Image topics that are no cameras.
    pub left_out: Vec<LeftOut>,
}

impl TopicPlan {
    /// The topics the vehicle's pose comes from.
    pub fn pose_topics(&self) -> Vec<usize> {
        match self.pose {
            PoseTopic::Message(topic) => vec![topic],
            PoseTopic::Tf => self.tf.clone(),
        }
    }

    /// Matches `topics` to their parts; `first` tells encodings where the messages can be looked at.
    ///
    /// # Errors
    /// A part that no topic plays, or several could.
    pub fn resolve(topics: &[Topic], config: &InputConfig, first: FirstEncoding) -> Result<Self, TopicError> {
        let (images, left_out) = if config.images.is_empty() {
            cameras::find(topics, config, first)?
        } else {
            let by_name = |name: &String| named(topics, "input.images", name, &[IMAGE, COMPRESSED]);
            (config.images.iter().map(by_name).collect::<Result<_, _>>()?, Vec::new())
        };
        let mut cameras = Vec::new();
        for (i, &image) in images.iter().enumerate() {
            let name = topics[image].name.clone();
            let info = match config.camera_infos.get(i) {
                Some(info) => named(topics, "input.camera_infos", info, &[CAMERA_INFO])?,
                None => find_info(topics, &name)?,
            };
            cameras.push(CameraTopics { image, compressed: topics[image].type_name == COMPRESSED, name, info });
        }
        let pose = pose::find_pose(topics, config)?;
        let pose::Tree { moving: tf, fixed: tf_static } = pose::Tree::choose(topics, config, &pose, &cameras)?;
        let truth = find_truth(topics, config, &cameras);
        Ok(Self { cameras, pose, tf, tf_static, truth, left_out })
    }
}

/// True for topics that hold ground truth.
pub(super) fn is_truth(topic: &Topic, config: &InputConfig) -> bool {
    !config.truth_prefix.is_empty() && topic.name.starts_with(&config.truth_prefix)
}

/// Names and types, as errors list them.
pub(super) fn list<'a>(topics: impl Iterator<Item = &'a Topic>) -> String {
    let names: Vec<String> = topics.map(|t| format!("{} ({})", t.name, t.type_name)).collect();
    if names.is_empty() { "none".into() } else { names.join(", ") }
}

fn named(topics: &[Topic], key: &'static str, name: &str, types: &[&str]) -> Result<usize, TopicError> {
    let Some(i) = topics.iter().position(|t| t.name == name) else {
        let found = list(topics.iter().filter(|t| types.contains(&t.type_name.as_str())));
        return Err(TopicError::Missing { key, topic: name.into(), found });
    };
    if types.contains(&topics[i].type_name.as_str()) {
        return Ok(i);
    }
    Err(TopicError::Type { key, topic: name.into(), found: topics[i].type_name.clone(), wanted: types.join(" or ") })
}

/// The name without its last part.
pub(super) fn parent(name: &str) -> &str {
    name.rsplit_once('/').map_or("", |(p, _)| p)
}

fn find_info(topics: &[Topic], image: &str) -> Result<usize, TopicError> {
    let infos: Vec<usize> = (0..topics.len()).filter(|&i| topics[i].type_name == CAMERA_INFO).collect();
    let base = picture_name(image);
    // image_transport's rule first (beside the image), then below the image (`<image>/camera_info`).
    for wanted in [format!("{}/camera_info", parent(base)), format!("{base}/camera_info")] {
        if let Some(&i) = infos.iter().find(|&&i| topics[i].name == wanted) {
            return Ok(i);
        }
    }
    if infos.is_empty() {
        return Err(TopicError::None { part: "camera_info topic", found: list(topics.iter()) });
    }
    Err(TopicError::Ambiguous {
        part: format!("the camera_info of {image}"),
        key: "input.camera_infos",
        candidates: list(infos.iter().map(|&i| &topics[i])),
    })
}

/// Ground truth of camera i is below `<prefix>/<the camera's own namespace>/{depth,flow,moving,sky,instance}`;
/// depth may be packed (`depth/compressedDepth`).
fn find_truth(topics: &[Topic], config: &InputConfig, cameras: &[CameraTopics]) -> Vec<(usize, TruthKind, usize)> {
    let mut truth = Vec::new();
    for (camera, c) in cameras.iter().enumerate() {
        let dir = parent(picture_name(&c.name));
        let kinds = [
            (TruthKind::Depth, "depth"),
            (TruthKind::Flow, "flow"),
            (TruthKind::Moving, "moving"),
            (TruthKind::Sky, "sky"),
            (TruthKind::Instance, "instance"),
        ];
        for (kind, last) in kinds {
            let name = format!("{}{dir}/{last}", config.truth_prefix);
            let raw = topics.iter().position(|t| t.name == name && t.type_name == IMAGE);
            let packed = || {
                let name = format!("{name}/compressedDepth");
                topics.iter().position(|t| t.name == name && t.type_name == COMPRESSED)
            };
            let found = if kind == TruthKind::Depth { raw.or_else(packed) } else { raw };
            truth.extend(found.map(|topic| (camera, kind, topic)));
        }
    }
    truth
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topic(name: &str, type_name: &str) -> Topic {
        Topic { name: name.into(), type_name: type_name.into(), serialization: "cdr".into(), count: 5 }
    }

    fn stereo() -> Vec<Topic> {
        vec![
            topic("/camera/right/image_rect/compressed", COMPRESSED),
            topic("/camera/left/image_rect/compressed", COMPRESSED),
            topic("/camera/left/camera_info", CAMERA_INFO),
            topic("/camera/right/camera_info", CAMERA_INFO),
            topic("/odometry", POSE_TYPES[0]),
            topic("/tf_static", TF),
        ]
    }

    #[test]
    fn a_stereo_bag_needs_no_configuration() {
        let plan = TopicPlan::resolve(&stereo(), &InputConfig::default(), &|_| None).unwrap();
        assert_eq!((plan.cameras[0].image, plan.cameras[0].info), (1, 2));
        assert_eq!((plan.cameras[1].image, plan.cameras[1].info), (0, 3));
        assert_eq!(plan.pose, PoseTopic::Message(4));
        assert_eq!(plan.tf_static, vec![5]);
    }

    #[test]
    fn raw_wins_over_its_compressed_twin_and_truth_is_never_input() {
        let mut topics = stereo();
        topics.push(topic("/camera/left/image_rect", IMAGE));
        topics.push(topic("/ground_truth/camera/left/depth", IMAGE));
        topics.push(topic("/ground_truth/odom", POSE_TYPES[0]));
        let plan = TopicPlan::resolve(&topics, &InputConfig::default(), &|_| None).unwrap();
        assert_eq!(plan.cameras.len(), 2);
        assert_eq!(plan.cameras[0].image, 6);
        assert_eq!(plan.truth, vec![(0, TruthKind::Depth, 7)]);
    }

    #[test]
    fn ambiguity_lists_the_candidates() {
        let mut topics = stereo();
        topics.push(topic("/other_pose", POSE_TYPES[1]));
        let e = TopicPlan::resolve(&topics, &InputConfig::default(), &|_| None).unwrap_err().to_string();
        assert!(e.contains("/other_pose") && e.contains("/odometry") && e.contains("input.pose"), "{e}");
        let config = InputConfig { pose: "/other_pose".into(), ..Default::default() };
        assert_eq!(TopicPlan::resolve(&topics, &config, &|_| None).unwrap().pose, PoseTopic::Message(6));
        let mut topics = stereo();
        topics.push(topic("/camera/left/image_raw", IMAGE));
        let e = TopicPlan::resolve(&topics, &InputConfig::default(), &|_| None).unwrap_err().to_string();
        assert!(e.contains("two pictures of one camera"), "{e}");
    }

    #[test]
    fn what_is_missing_is_said() {
        let e = TopicPlan::resolve(&stereo()[2..], &InputConfig::default(), &|_| None).unwrap_err().to_string();
        assert!(e.contains("no camera image topic") && e.contains("/odometry"), "{e}");
        let e = TopicPlan::resolve(&stereo()[..4], &InputConfig::default(), &|_| None).unwrap_err().to_string();
        assert!(e.contains("no vehicle pose"), "{e}");
        let config = InputConfig { pose: "/odom".into(), ..Default::default() };
        let e = TopicPlan::resolve(&stereo(), &config, &|_| None).unwrap_err().to_string();
        assert!(e.contains("/odom,") && e.contains("/odometry"), "{e}");
    }
}
