//! Which topic has the vehicle's pose, and which transform tree is the vehicle's.

use super::{CameraTopics, POSE_TYPES, PoseTopic, TF, TopicError, is_truth, list, named, parent};
use crate::bag::Topic;
use crate::config::InputConfig;

/// Topics of one transform tree.
pub struct Tree {
    /// Transforms that change.
    pub moving: Vec<usize>,
    /// Transforms that hold at all times.
    pub fixed: Vec<usize>,
}

impl Tree {
    /// The tree of this vehicle. Two robots' trees (`/robot1/tf`, `/robot2/tf`) use the same frame names, so they are never
    /// poured together: the one `input.pose` names, else the only one, else the one of the cameras' or the pose's namespace.
    pub fn choose(
        topics: &[Topic],
        config: &InputConfig,
        pose: &PoseTopic,
        cameras: &[CameraTopics],
    ) -> Result<Self, TopicError> {
        let is_tf = |t: &Topic| t.type_name == TF;
        let is_static = |t: &Topic| is_tf(t) && t.name.ends_with("tf_static");
        let all = |fits: &dyn Fn(&Topic) -> bool| (0..topics.len()).filter(|&i| fits(&topics[i])).collect::<Vec<_>>();
        let of = |space: &str| {
            let beside = all(&|t| is_static(t) && parent(&t.name) == space);
            // A robot's fixed transforms may be beside its own moving ones or in the one topic all share.
            let fixed = if beside.is_empty() { all(&|t| is_static(t) && parent(&t.name).is_empty()) } else { beside };
            Self { moving: all(&|t| is_tf(t) && !is_static(t) && parent(&t.name) == space), fixed }
        };
        let mut spaces: Vec<&str> =
            topics.iter().filter(|t| is_tf(t) && t.count > 0).map(|t| parent(&t.name)).collect();
        spaces.sort_unstable();
        spaces.dedup();
        if *pose == PoseTopic::Tf {
            let moving = all(&|t| is_tf(t) && !is_static(t) && t.count > 0);
            if let Some(named) = topics.iter().find(|t| is_tf(t) && t.name == config.pose) {
                return Ok(of(parent(&named.name)));
            }
            return match moving.as_slice() {
                [one] => Ok(of(parent(&topics[*one].name))),
                [] => Err(TopicError::None { part: "vehicle pose topic", found: list(topics.iter()) }),
                many => Err(TopicError::Ambiguous {
                    part: "the transform tree with the vehicle's pose".into(),
                    key: "input.pose",
                    candidates: list(many.iter().map(|&i| &topics[i])),
                }),
            };
        }
        if let [one] = spaces.as_slice() {
            return Ok(of(one));
        }
        let pose_name = if let PoseTopic::Message(i) = pose { topics[*i].name.as_str() } else { "" };
        let names = cameras.iter().map(|c| c.name.as_str()).chain([pose_name]);
        let nearest = |name: &str| {
            let holds = |space: &&&str| name.strip_prefix(**space).is_some_and(|rest| rest.starts_with('/'));
            spaces.iter().filter(holds).max_by_key(|space| space.len()).copied()
        };
        let mut found: Vec<&str> = names.filter_map(nearest).collect();
        found.sort_unstable();
        found.dedup();
        match found.as_slice() {
            [one] => Ok(of(one)),
            [] if spaces.is_empty() => Ok(Self { moving: Vec::new(), fixed: Vec::new() }),
            // The cameras are of one namespace, the pose of none: the root's tree is the pose's alone.
            ["", one] => Ok(of(one)),
            _ if !config.base_from_camera.is_empty() => Ok(Self { moving: Vec::new(), fixed: Vec::new() }),
            _ => Err(TopicError::Ambiguous {
                part: "the transform tree with the cameras' mountings (or set input.base_from_camera)".into(),
                key: "input.images",
                candidates: list(topics.iter().filter(|t| is_tf(t))),
            }),
        }
    }
}

/// Last parts of topics whose poses a person or a planner sends once: never where the vehicle is.
const ONE_SHOT: [&str; 9] = [
    "initialpose",
    "initial_pose",
    "set_pose",
    "goal",
    "goal_pose",
    "goal_update",
    "target_pose",
    "waypoint",
    "clicked_pose",
];

/// The topic with the vehicle's pose.
pub fn find_pose(topics: &[Topic], config: &InputConfig) -> Result<PoseTopic, TopicError> {
    if !config.pose.is_empty() {
        let mut types = POSE_TYPES.to_vec();
        types.push(TF);
        let i = named(topics, "input.pose", &config.pose, &types)?;
        return Ok(if topics[i].type_name == TF { PoseTopic::Tf } else { PoseTopic::Message(i) });
    }
    let has_tf = topics.iter().any(|t| t.type_name == TF && t.count > 0 && !t.name.ends_with("tf_static"));
    // One message beside many pictures is a place somebody named, whatever its topic is called. Live topics are not counted:
    // there all of them have 1.
    let counted = topics.iter().any(|t| t.count > 1);
    let one_shot = |t: &Topic| ONE_SHOT.contains(&t.name.rsplit('/').next().unwrap_or("")) || (counted && t.count == 1);
    let fits =
        |t: &Topic| POSE_TYPES.contains(&t.type_name.as_str()) && t.count > 0 && !is_truth(t, config) && !one_shot(t);
    let found: Vec<usize> = (0..topics.len()).filter(|&i| fits(&topics[i])).collect();
    match found.as_slice() {
        [one] => Ok(PoseTopic::Message(*one)),
        [] if has_tf => Ok(PoseTopic::Tf),
        [] => Err(TopicError::None { part: "vehicle pose topic", found: list(topics.iter()) }),
        many => Err(TopicError::Ambiguous {
            part: "the vehicle pose".into(),
            key: "input.pose",
            candidates: list(many.iter().map(|&i| &topics[i])),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::super::{CAMERA_INFO, IMAGE, TopicPlan};
    use super::*;

    fn topic(name: &str, type_name: &str) -> Topic {
        Topic { name: name.into(), type_name: type_name.into(), serialization: "cdr".into(), count: 5 }
    }

    fn one_camera(space: &str) -> Vec<Topic> {
        vec![
            topic(&format!("{space}/camera0/image"), IMAGE),
            topic(&format!("{space}/camera0/camera_info"), CAMERA_INFO),
            topic(&format!("{space}/tf"), TF),
            topic(&format!("{space}/tf_static"), TF),
        ]
    }

    #[test]
    fn two_trees_are_ambiguous_until_one_is_named() {
        let mut topics = one_camera("/robot1");
        topics.extend([topic("/robot2/tf", TF), topic("/robot2/tf_static", TF)]);
        let e = TopicPlan::resolve(&topics, &InputConfig::default(), &|_| None).unwrap_err().to_string();
        assert!(["/robot1/tf ", "/robot2/tf ", "input.pose"].iter().all(|w| e.contains(w)), "{e}");
        for (pose, tf, fixed) in [("/robot1/tf", 2, 3), ("/robot2/tf", 4, 5)] {
            let config = InputConfig { pose: pose.into(), ..Default::default() };
            let plan = TopicPlan::resolve(&topics, &config, &|_| None).unwrap();
            assert_eq!((plan.pose, plan.tf, plan.tf_static), (PoseTopic::Tf, vec![tf], vec![fixed]));
        }
        // A pose of its own leaves no doubt: the cameras' tree is the one of their namespace.
        topics.push(topic("/robot1/odom", POSE_TYPES[0]));
        let plan = TopicPlan::resolve(&topics, &InputConfig::default(), &|_| None).unwrap();
        assert_eq!((plan.tf, plan.tf_static), (vec![2], vec![3]));
        // Fixed transforms in the topic all share.
        let mut shared = one_camera("");
        shared[2] = topic("/robot1/tf", TF);
        let plan = TopicPlan::resolve(&shared, &InputConfig::default(), &|_| None).unwrap();
        assert_eq!((plan.pose, plan.tf, plan.tf_static), (PoseTopic::Tf, vec![2], vec![3]));
    }

    #[test]
    fn poses_that_are_sent_once_are_never_the_vehicles() {
        let mut topics = one_camera("");
        for name in ["/initialpose", "/move_base_simple/goal", "/goal_pose", "/robot/set_pose"] {
            topics.push(topic(name, POSE_TYPES[2]));
        }
        topics.push(Topic { count: 1, ..topic("/somewhere", POSE_TYPES[1]) });
        let plan = TopicPlan::resolve(&topics, &InputConfig::default(), &|_| None).unwrap();
        assert_eq!(plan.pose, PoseTopic::Tf);
        topics.push(topic("/pose", POSE_TYPES[1]));
        let plan = TopicPlan::resolve(&topics, &InputConfig::default(), &|_| None).unwrap();
        assert_eq!(plan.pose, PoseTopic::Message(topics.len() - 1));
        // Whoever names one means it.
        let config = InputConfig { pose: "/initialpose".into(), ..Default::default() };
        assert_eq!(TopicPlan::resolve(&topics, &config, &|_| None).unwrap().pose, PoseTopic::Message(4));
    }
}
