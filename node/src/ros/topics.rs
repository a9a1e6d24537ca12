//! Which topics of the running system play which part: the rules of a recording, on the graph as it is.

use crate::bag::Topic;
use crate::config::Config;
use crate::source::cameras::LeftOut;
use crate::source::topics::{PoseTopic, TopicPlan};

use super::names::Names;

/// Picture types.
pub const IMAGE: &str = "sensor_msgs/msg/Image";
const COMPRESSED: &str = "sensor_msgs/msg/CompressedImage";

/// One camera's topics, by their final names.
#[derive(Debug, Clone, PartialEq)]
pub struct LiveCamera {
    /// Pictures.
    pub image: String,
    /// True for CompressedImage.
    pub compressed: bool,
    /// CameraInfo.
    pub info: String,
}

/// Where the pose comes from.
#[derive(Debug, Clone, PartialEq)]
pub enum LivePose {
    /// A topic of a pose type.
    Message {
        /// Its name.
        topic: String,
        /// Its type.
        type_name: String,
    },
    /// The transform tree.
    Tf,
}

impl std::fmt::Display for LivePose {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Message { topic, type_name } => write!(f, "{topic} ({type_name})"),
            Self::Tf => f.write_str("/tf"),
        }
    }
}

/// All inputs.
#[derive(Debug, Clone, PartialEq)]
pub struct LivePlan {
    /// In the network's order.
    pub cameras: Vec<LiveCamera>,
    /// The vehicle pose.
    pub pose: LivePose,
    /// Image topics that are no cameras.
    pub left_out: Vec<LeftOut>,
    /// Topics of the transform tree: those that change, those that hold at all times.
    pub tf: Vec<String>,
    /// See `tf`.
    pub tf_static: Vec<String>,
}

impl LivePlan {
    /// From the topics that have a publisher. Second: whether the number of cameras was asked for, so that nothing more is
    /// to be waited for.
    ///
    /// # Errors
    /// What is not there yet, or ambiguous.
    pub fn resolve(graph: &[Topic], names: &Names, config: &Config) -> Result<(Self, bool), String> {
        let own = format!("{}/output/", names.node);
        let transport = config.live.transport.as_str();
        let has = |name: &str, kind: &str| graph.iter().any(|t| t.name == name && t.type_name == kind);
        let graph: Vec<Topic> = graph
            .iter()
            .filter(|t| !t.name.starts_with(&own))
            // Where a camera offers both, the one that is not wanted is not looked at.
            .filter(|t| match (transport, t.type_name.as_str()) {
                ("compressed", IMAGE) => !has(&format!("{}/compressed", t.name), COMPRESSED),
                ("raw", COMPRESSED) => !t.name.strip_suffix("/compressed").is_some_and(|raw| has(raw, IMAGE)),
                _ => true,
            })
            // A recording counts messages; how many publishers there are says nothing of that kind.
            .map(|t| Topic { count: 1, ..t.clone() })
            .collect();
        let there = |name: &str| graph.iter().any(|t| t.name == name);
        let mut input = config.input.clone();
        for list in [&mut input.images, &mut input.camera_infos] {
            list.iter_mut().for_each(|name| *name = names.resolve(name));
        }
        if !input.pose.is_empty() {
            input.pose = names.resolve(&input.pose);
        } else if there(&names.resolve("~/input/pose")) {
            input.pose = names.resolve("~/input/pose");
        }
        let named = !input.images.is_empty();
        if !named {
            for i in 0.. {
                let raw = names.resolve(&format!("~/input/camera{i}/image"));
                let compressed = names.resolve(&format!("~/input/camera{i}/image/compressed"));
                let Some(image) = [raw, compressed].into_iter().find(|name| there(name)) else { break };
                input.images.push(image);
                let info = names.resolve(&format!("~/input/camera{i}/camera_info"));
                if input.camera_infos.len() == i && there(&info) {
                    input.camera_infos.push(info);
                }
            }
            // Some cameras with a CameraInfo of the standard name and some without: those are found beside the pictures.
            if input.camera_infos.len() != input.images.len() {
                input.camera_infos.clear();
            }
        }
        let plan = TopicPlan::resolve(&graph, &input, &|_| None).map_err(|e| e.to_string())?;
        let found = plan.cameras.len();
        if config.live.cameras != 0 && config.live.cameras != found {
            let names: Vec<&str> = plan.cameras.iter().map(|c| c.name.as_str()).collect();
            return Err(format!("live.cameras = {}, but there are {found}: {}", config.live.cameras, names.join(", ")));
        }
        let name = |topic: usize| graph.get(topic).map(|t| t.name.clone()).unwrap_or_default();
        let cameras = plan
            .cameras
            .iter()
            .map(|c| LiveCamera { image: c.name.clone(), compressed: c.compressed, info: name(c.info) })
            .collect();
        let pose = match plan.pose {
            PoseTopic::Tf => LivePose::Tf,
            PoseTopic::Message(t) => LivePose::Message {
                topic: name(t),
                type_name: graph.get(t).map(|t| t.type_name.clone()).unwrap_or_default(),
            },
        };
        let tf = plan.tf.iter().map(|&t| name(t)).collect();
        let mut tf_static: Vec<String> = plan.tf_static.iter().map(|&t| name(t)).collect();
        if tf_static.is_empty() {
            // Nobody publishes it yet: it is listened to all the same.
            tf_static.push("/tf_static".into());
        }
        Ok((Self { cameras, pose, left_out: plan.left_out, tf, tf_static }, named || config.live.cameras != 0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topic(name: &str, type_name: &str) -> Topic {
        Topic { name: name.into(), type_name: type_name.into(), serialization: "cdr".into(), count: 1 }
    }

    fn graph() -> Vec<Topic> {
        vec![
            topic("/front/image_rect", IMAGE),
            topic("/front/image_rect/compressed", COMPRESSED),
            topic("/front/camera_info", "sensor_msgs/msg/CameraInfo"),
            topic("/odom", "nav_msgs/msg/Odometry"),
            topic("/storm/output/camera0/rendered", IMAGE),
            topic("/storm/output/camera0/camera_info", "sensor_msgs/msg/CameraInfo"),
        ]
    }

    fn resolve(graph: &[Topic], args: &str, set: &[&str]) -> Result<(LivePlan, bool), String> {
        let names = Names::new("storm", "/", args.split_whitespace().map(str::to_owned));
        let config = set.iter().fold(Config::default(), |c, s| c.with_override(s).unwrap());
        LivePlan::resolve(graph, &names, &config)
    }

    #[test]
    fn topics_are_found_by_type_and_own_outputs_are_no_inputs() {
        let (plan, settled) = resolve(&graph(), "", &[]).unwrap();
        assert_eq!((plan.cameras.len(), settled), (1, false));
        assert_eq!((plan.cameras[0].image.as_str(), plan.cameras[0].compressed), ("/front/image_rect", false));
        let (plan, settled) = resolve(&graph(), "", &["live.transport=compressed", "live.cameras=1"]).unwrap();
        assert_eq!((plan.cameras[0].image.as_str(), settled), ("/front/image_rect/compressed", true));
        let e = resolve(&graph(), "", &["live.cameras=2"]).unwrap_err();
        assert!(e.contains("live.cameras = 2") && e.contains("/front/image_rect"), "{e}");
    }

    #[test]
    fn one_of_two_robots_trees_is_named() {
        let mut graph = graph();
        graph.retain(|t| t.name != "/odom");
        graph.push(topic("/robot1/tf", "tf2_msgs/msg/TFMessage"));
        graph.push(Topic { count: 3, ..topic("/robot2/tf", "tf2_msgs/msg/TFMessage") });
        let e = resolve(&graph, "", &[]).unwrap_err();
        assert!(e.contains("/robot1/tf") && e.contains("/robot2/tf") && e.contains("input.pose"), "{e}");
        let (plan, _) = resolve(&graph, "", &["input.pose=/robot2/tf"]).unwrap();
        assert_eq!((plan.pose, plan.tf), (LivePose::Tf, vec!["/robot2/tf".to_owned()]));
        assert_eq!(plan.tf_static, ["/tf_static"]);
        // Three publishers beside one make no one-shot of the one.
        graph.push(topic("/odom", "nav_msgs/msg/Odometry"));
        assert!(matches!(
            resolve(&graph, "", &["input.base_from_camera=[[0,0,0,1,0,0,0]]"]).unwrap().0.pose,
            LivePose::Message { .. }
        ));
    }

    #[test]
    fn standard_names_and_their_remaps_win() {
        let remap = "--ros-args -r ~/input/camera0/image:=/front/image_rect -r ~/input/pose:=/odom";
        let mut graph = graph();
        graph.push(topic("/back/image_rect", IMAGE));
        graph.push(topic("/back/camera_info", "sensor_msgs/msg/CameraInfo"));
        graph.push(topic("/other", "nav_msgs/msg/Odometry"));
        let (plan, _) = resolve(&graph, remap, &[]).unwrap();
        assert_eq!(plan.cameras.len(), 1);
        assert_eq!(plan.cameras[0].info, "/front/camera_info");
        let odometry = LivePose::Message { topic: "/odom".into(), type_name: "nav_msgs/msg/Odometry".into() };
        assert_eq!(plan.pose, odometry);
        let e = resolve(&graph, "", &[]).unwrap_err();
        assert!(e.contains("input.pose"), "{e}");
    }

    #[test]
    fn what_is_not_there_is_named() {
        let e = resolve(&graph()[2..], "", &[]).unwrap_err();
        assert!(e.contains("camera image topic") && e.contains("/odom"), "{e}");
        let e = resolve(&graph(), "", &["input.images=[/left]"]).unwrap_err();
        assert!(e.contains("/left") && e.contains("input.images"), "{e}");
    }
}
