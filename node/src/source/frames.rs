//! Which frames a run is in: the vehicle's, the fixed one, and whether the transforms heard so far lead to all of them.

use crate::config::InputConfig;
use crate::tf::TfTree;

use super::mount::PoseNames;
use super::rig::{CameraDescription, DEFAULT_BASE_FRAME, DEFAULT_MAP_FRAME, Rig};

/// How long /tf is heard for a frame called `map` above the vehicle before another one is taken, seconds: localisation
/// starts after odometry.
pub const MAP_FRAME_AHEAD_SEC: f64 = 10.0;
/// Frames named in the message about a tree without the vehicle's pose.
const FRAMES_NAMED: usize = 12;

/// What a run needs from the transforms.
pub struct Frames<'a> {
    config: &'a InputConfig,
    /// True when the vehicle's pose comes from the tree itself.
    from_tree: bool,
    /// Frames of the cameras whose mounting is not configured.
    cameras: Vec<String>,
    /// Frames the pose messages name.
    pose: PoseNames,
}

impl<'a> Frames<'a> {
    /// For the cameras as far as they are described; `pose` has the frames of the pose messages, if there are any.
    pub fn new(config: &'a InputConfig, from_tree: bool, cameras: &[CameraDescription], pose: PoseNames) -> Self {
        let cameras = match config.base_from_camera.is_empty() {
            true => cameras.iter().map(CameraDescription::frame).collect(),
            false => Vec::new(),
        };
        Self { config, from_tree, cameras, pose }
    }

    /// The vehicle frame. In a tree and unless it is configured: the usual names, else the first camera's own frame, so that
    /// a tree of nothing but a camera's pose is enough.
    fn base(&self, tree: &TfTree) -> String {
        if !(self.from_tree && self.config.base_frame.is_empty()) {
            return Rig::vehicle_frame(self.config, &self.pose);
        }
        let usual = [DEFAULT_BASE_FRAME, "base_footprint", "base"].into_iter().find(|frame| tree.knows(frame));
        let camera = self.cameras.first().map(|frame| frame.trim_start_matches('/')).filter(|frame| tree.knows(frame));
        usual.or(camera).unwrap_or(DEFAULT_BASE_FRAME).to_owned()
    }

    /// Whether the transforms lead to everything. `any_map`: any fixed frame above the vehicle will do where none is
    /// configured.
    pub fn complete(&self, tree: &TfTree, any_map: bool) -> bool {
        let base = self.base(tree);
        let mounted = |frame: &String| frame.trim_start_matches('/') == base || tree.link(&base, frame).is_some();
        self.cameras.iter().all(mounted) && self.placed(tree, &base, any_map)
    }

    fn placed(&self, tree: &TfTree, base: &str, any_map: bool) -> bool {
        let configured = &self.config.map_frame;
        if !self.from_tree {
            let given = &self.pose.frame;
            return configured.is_empty()
                || given.is_empty()
                || configured == given
                || tree.link(configured, given).is_some();
        }
        match configured.is_empty() {
            true => tree.link(DEFAULT_MAP_FRAME, base).is_some() || (any_map && self.fixed(tree, base).is_some()),
            false => tree.link(configured, base).is_some(),
        }
    }

    /// The fixed frame above the vehicle.
    fn fixed<'t>(&'t self, tree: &'t TfTree, base: &str) -> Option<&'t str> {
        let connected = |frame: &&str| *frame != base && tree.link(frame, base).is_some();
        if !self.config.map_frame.is_empty() {
            return Some(self.config.map_frame.as_str()).filter(connected);
        }
        let usual = [DEFAULT_MAP_FRAME, "odom", "world"].into_iter().find(connected);
        usual.or_else(|| tree.root(base).filter(connected))
    }

    /// The frames of the pose: those its messages name, or those found in the tree.
    ///
    /// # Errors
    /// The pose comes from the tree, and the tree has none.
    pub fn pose(&self, tree: &TfTree) -> Result<PoseNames, String> {
        if !self.from_tree {
            return Ok(self.pose.clone());
        }
        let base = self.base(tree);
        if let Some(fixed) = self.fixed(tree, &base) {
            return Ok(PoseNames { frame: fixed.to_owned(), child: base });
        }
        let configured = self.config.map_frame.as_str();
        let wanted = if configured.is_empty() { DEFAULT_MAP_FRAME } else { configured };
        let named: Vec<&str> = tree.frames().take(FRAMES_NAMED).collect();
        let frames = if named.is_empty() { "none".into() } else { named.join(", ") };
        Err(format!(
            "no transform gives the vehicle's pose: /tf does not connect `{wanted}` and `{base}`; set input.map_frame and \
             input.base_frame to two of its frames ({frames}), or input.pose to a pose topic"
        ))
    }
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;
    use crate::config::SyncConfig;
    use crate::msg::{Header, TransformStamped};
    use crate::rigid::Rigid;

    fn tree(edges: &[(&str, &str)]) -> TfTree {
        let mut tree = TfTree::new(&SyncConfig::default());
        for (parent, child) in edges {
            let header = Header { stamp_ns: 0, frame_id: (*parent).into() };
            let transform = Rigid::new(DQuat::IDENTITY, glam::DVec3::X);
            tree.insert(&TransformStamped { header, child_frame_id: (*child).into(), transform }, false).unwrap();
        }
        tree
    }

    fn camera() -> Vec<CameraDescription> {
        let (topic, info_topic) = ("/c/image".into(), "/c/camera_info".into());
        vec![CameraDescription { topic, info_topic, frame_id: Some("cam".into()), info: None, black_frame: None }]
    }

    #[test]
    fn the_fixed_frame_of_a_tree() {
        let config = InputConfig::default();
        let frames = |config: &InputConfig, edges: &[(&str, &str)]| {
            Frames::new(config, true, &camera(), PoseNames::default()).pose(&tree(edges)).map(|p| (p.frame, p.child))
        };
        let is = |frame: &str, child: &str| Ok((frame.to_owned(), child.to_owned()));
        let all = [("odom", "base_link"), ("map", "odom"), ("base_link", "cam")];
        assert_eq!(frames(&config, &all), is("map", "base_link"));
        assert_eq!(frames(&config, &[("odom", "base_footprint"), ("earth", "odom")]), is("odom", "base_footprint"));
        assert_eq!(frames(&config, &[("utm", "base_link")]), is("utm", "base_link"));
        // A tree of a camera's pose alone.
        assert_eq!(frames(&config, &[("map", "cam")]), is("map", "cam"));
        let e = frames(&config, &[("base_link", "cam"), ("map", "odom")]).unwrap_err();
        assert!(
            ["`map`", "`base_link`", "cam, ", "input.map_frame", "input.pose"].iter().all(|w| e.contains(w)),
            "{e}"
        );
        let named = InputConfig { map_frame: "odom".into(), base_frame: "cam".into(), ..InputConfig::default() };
        assert_eq!(frames(&named, &all), is("odom", "cam"));
        let wrong = InputConfig { map_frame: "mapp".into(), ..InputConfig::default() };
        assert!(frames(&wrong, &all).unwrap_err().contains("`mapp`"));
    }

    #[test]
    fn what_is_complete() {
        let config = InputConfig::default();
        let complete = |from_tree, edges: &[(&str, &str)], any_map| {
            let pose = PoseNames { frame: "odom".into(), child: "base_link".into() };
            Frames::new(&config, from_tree, &camera(), pose).complete(&tree(edges), any_map)
        };
        assert!(!complete(false, &[], true));
        assert!(complete(false, &[("base_link", "cam")], false));
        assert!(!complete(true, &[("base_link", "cam")], true));
        assert!(!complete(true, &[("base_link", "cam"), ("odom", "base_link")], false));
        assert!(complete(true, &[("base_link", "cam"), ("odom", "base_link")], true));
        assert!(complete(true, &[("base_link", "cam"), ("map", "base_link")], false));
        let other = InputConfig { map_frame: "map".into(), ..InputConfig::default() };
        let pose = PoseNames { frame: "odom".into(), child: "cam".into() };
        let frames = Frames::new(&other, false, &camera(), pose);
        assert!(!frames.complete(&tree(&[]), true) && frames.complete(&tree(&[("map", "odom")]), false));
    }
}
