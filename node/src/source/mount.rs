//! Where a camera sits on the vehicle: configured, from the transform tree, in `P` (stereo), or where the pose itself is.

use glam::DVec3;

use crate::msg::CameraInfo;
use crate::rigid::Rigid;
use crate::tf::{Link, TfLookup, TfTree};

/// Cameras nearer to each other than this, and turned by less than [`SAME_TURN_RAD`], are at one place, metres.
const SAME_PLACE_M: f64 = 1e-3;
/// See [`SAME_PLACE_M`].
const SAME_TURN_RAD: f64 = 1e-3;

/// What a source knows of the frames of the vehicle's poses.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct PoseNames {
    /// The fixed frame they are given in; empty when the messages name none.
    pub frame: String,
    /// The frame they are of; empty when the messages name none.
    pub child: String,
}

/// Who says where a camera is mounted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MountOrigin {
    /// `input.base_from_camera`.
    Configured,
    /// Transforms that hold at all times.
    Static,
    /// Transforms that change: looked up at every picture's stamp.
    Moving,
    /// The pose is of the camera's own frame.
    PoseIsCameras,
    /// Nobody names a frame and there is no transform: the only camera's own pose is taken to be given.
    Assumed,
}

/// A camera's mounting.
#[derive(Debug, Clone, PartialEq)]
pub struct Mount {
    /// The camera's frame in the vehicle frame, metres; of a joint one of its positions.
    pub base_from_frame: Rigid,
    /// The picture's optical frame in the camera's frame: the rectifying rotation undone, and the baseline of `P`, metres.
    pub frame_from_view: Rigid,
    /// The frame to look up at every picture's stamp; `None` when it does not move.
    pub joint: Option<String>,
    /// Who says so.
    pub origin: MountOrigin,
    /// Where `P` puts the optical centre in the rectified frame, metres; `None` when it is not used.
    pub baseline: Option<DVec3>,
}

impl Mount {
    /// The picture's optical frame in the vehicle frame; of a joint at one of its positions.
    pub fn base_from_camera(&self) -> Rigid {
        self.base_from_frame * self.frame_from_view
    }

    /// One line for people.
    pub fn line(&self) -> String {
        let t = self.base_from_camera().translation;
        let place = format!("at {:.3} {:.3} {:.3} m", t.x, t.y, t.z);
        let from = match self.origin {
            MountOrigin::Configured => "from input.base_from_camera",
            MountOrigin::Static => "from /tf_static",
            MountOrigin::Moving => "from /tf, looked up at every picture's stamp",
            MountOrigin::PoseIsCameras => "the pose is this camera's own",
            MountOrigin::Assumed => "the pose is taken as this camera's own: no transform and no frame says otherwise",
        };
        match self.baseline {
            Some(b) => format!("{place}, {from}, with the stereo baseline in P ({:.4} {:.4} m)", b.x, b.y),
            None => format!("{place}, {from}"),
        }
    }
}

/// Looks a camera's `frame` up on the vehicle frame `base`. `alone`: it is the only camera, so a pose that names no frame can
/// only be its own.
///
/// # Errors
/// What the tree lacks.
pub fn find(tree: &TfTree, base: &str, frame: &str, pose_names_child: bool, alone: bool) -> Result<Mount, String> {
    let mount = |base_from_frame, joint, origin| Mount {
        base_from_frame,
        frame_from_view: Rigid::IDENTITY,
        joint,
        origin,
        baseline: None,
    };
    if frame.trim_start_matches('/') == base {
        return Ok(mount(Rigid::IDENTITY, None, MountOrigin::PoseIsCameras));
    }
    match tree.link(base, frame) {
        Some((Link::Static, at)) => Ok(mount(at, None, MountOrigin::Static)),
        Some((Link::Moving, at)) => Ok(mount(at, Some(frame.to_owned()), MountOrigin::Moving)),
        None if alone && !pose_names_child && tree.frames().next().is_none() => {
            Ok(mount(Rigid::IDENTITY, None, MountOrigin::Assumed))
        }
        None => Err(match tree.lookup(base, frame, 0) {
            TfLookup::Wait(problem) | TfLookup::Never(problem) => problem.to_string(),
            TfLookup::At(_) => "its transform has no sample".into(),
        }),
    }
}

/// Where `P` puts the optical centre, in the rectified frame of the pair's first camera, metres: CameraInfo has
/// `P[3] = -fx * x` and `P[7] = -fy * y`. Zero without `P`.
pub fn offset_in_p(info: &CameraInfo) -> DVec3 {
    let along = |t: f64, f: f64| {
        let offset = -t / f;
        // -0.0 is no offset either.
        if offset.is_finite() && offset != 0.0 { offset } else { 0.0 }
    };
    DVec3::new(along(info.p[3], info.p[0]), along(info.p[7], info.p[5]), 0.0)
}

fn at_one_place(a: &Rigid, b: &Rigid) -> bool {
    (a.translation - b.translation).length() < SAME_PLACE_M && a.rotation.angle_between(b.rotation) < SAME_TURN_RAD
}

/// Takes the baseline from `P` for cameras that stand in one place otherwise, as CameraInfo means it: both cameras of a
/// pair name the first one's frame. Cameras that have places of their own keep them. `offsets` is [`offset_in_p`] of each.
pub fn use_baselines(mounts: &mut [Mount], offsets: &[DVec3]) {
    let found = mounts.to_vec();
    for (i, mount) in mounts.iter_mut().enumerate() {
        let group: Vec<usize> = (0..found.len().min(offsets.len()))
            .filter(|&j| found[j].origin != MountOrigin::Configured && found[j].joint == found[i].joint)
            .filter(|&j| at_one_place(&found[j].base_from_frame, &found[i].base_from_frame))
            .collect();
        if !group.contains(&i) || group.iter().all(|&j| (offsets[j] - offsets[i]).length() < SAME_PLACE_M) {
            continue;
        }
        // Rectified frames of a pair are parallel; the frame both name is the first camera's, so its rotation holds.
        let first = group.iter().copied().min_by(|&a, &b| offsets[a].length().total_cmp(&offsets[b].length()));
        let rotation = first.map_or(mount.frame_from_view.rotation, |f| found[f].frame_from_view.rotation);
        mount.frame_from_view = Rigid::new(rotation, rotation * offsets[i]);
        mount.baseline = Some(offsets[i]);
    }
}

/// Pairs of cameras that are at one place and look one way, which no two cameras are.
pub fn coinciding(mounts: &[Mount]) -> Vec<(usize, usize)> {
    let places: Vec<Rigid> = mounts.iter().map(Mount::base_from_camera).collect();
    let pairs = (0..places.len()).flat_map(|b| (0..b).map(move |a| (a, b)));
    pairs.filter(|&(a, b)| at_one_place(&places[a], &places[b])).collect()
}

#[cfg(test)]
mod tests {
    use glam::DQuat;
    use proptest::prelude::*;

    use super::*;
    use crate::config::SyncConfig;
    use crate::msg::{Header, TransformStamped};

    fn static_mount(base_from_frame: Rigid, frame_from_view: DQuat) -> Mount {
        let frame_from_view = Rigid::new(frame_from_view, DVec3::ZERO);
        Mount { base_from_frame, frame_from_view, joint: None, origin: MountOrigin::Static, baseline: None }
    }

    fn info(fx: f64, fy: f64, offset: DVec3) -> CameraInfo {
        let p = [fx, 0.0, 300.0, -fx * offset.x, 0.0, fy, 200.0, -fy * offset.y, 0.0, 0.0, 1.0, 0.0];
        CameraInfo { p, ..CameraInfo::default() }
    }

    proptest! {
        /// The definition in CameraInfo: `P * (X Y Z 1)` with a point of the first camera's rectified frame gives the second
        /// one's pixel; the second one's mounting and intrinsics must give the same.
        #[test]
        fn points_land_where_p_puts_them(
            fx in 50.0..2000.0f64, fy in 50.0..2000.0f64, bx in -2.0..2.0f64, by in -2.0..2.0f64,
            turn in prop::array::uniform3(-0.3..0.3f64), place in prop::array::uniform3(-5.0..5.0f64),
            point in (-3.0..3.0f64, -3.0..3.0f64, 2.0..50.0f64),
        ) {
            let offset = DVec3::new(bx, by, 0.0);
            prop_assume!(offset.length() > 2e-3);
            let base_from_frame = Rigid::new(DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5), place.into());
            let first_r = DQuat::from_euler(glam::EulerRot::XYZ, turn[0], turn[1], turn[2]);
            // The second camera's own rotation is of another frame than the shared one and must not count.
            let mut mounts = [static_mount(base_from_frame, first_r), static_mount(base_from_frame, first_r * first_r)];
            let second = info(fx, fy, offset);
            use_baselines(&mut mounts, &[DVec3::ZERO, offset_in_p(&second)]);
            let x = DVec3::new(point.0, point.1, point.2);
            let p = second.p;
            let w = x.z;
            let want = ((p[0] * x.x + p[2] * x.z + p[3]) / w, (p[5] * x.y + p[6] * x.z + p[7]) / w);
            let in_second = mounts[1].base_from_camera().inverse().apply(mounts[0].base_from_camera().apply(x));
            let got = (fx * in_second.x / in_second.z + p[2], fy * in_second.y / in_second.z + p[6]);
            prop_assert!((got.0 - want.0).abs() < 1e-6 && (got.1 - want.1).abs() < 1e-6, "{got:?} {want:?}");
        }
    }

    #[test]
    fn cameras_with_places_of_their_own_keep_them() {
        let place = |y| Rigid::new(DQuat::IDENTITY, DVec3::new(0.0, y, 0.0));
        let offsets = [DVec3::ZERO, DVec3::new(0.54, 0.0, 0.0)];
        let mut mounts = [static_mount(place(0.0), DQuat::IDENTITY), static_mount(place(-0.54), DQuat::IDENTITY)];
        let before = mounts.clone();
        use_baselines(&mut mounts, &offsets);
        assert_eq!(mounts, before);
        let configured =
            |m: &Mount| Mount { origin: MountOrigin::Configured, base_from_frame: place(0.0), ..m.clone() };
        let mut mounts = before.each_ref().map(configured);
        use_baselines(&mut mounts, &offsets);
        assert_eq!((mounts[1].baseline, coinciding(&mounts)), (None, vec![(0, 1)]));
        let mut mounts = [static_mount(place(0.0), DQuat::IDENTITY), static_mount(place(0.0), DQuat::IDENTITY)];
        use_baselines(&mut mounts, &[DVec3::ZERO, DVec3::ZERO]);
        assert_eq!(coinciding(&mounts), [(0, 1)]);
        use_baselines(&mut mounts, &offsets);
        assert!(coinciding(&mounts).is_empty());
        assert_eq!(mounts[1].base_from_camera().translation, DVec3::new(0.54, 0.0, 0.0));
    }

    #[test]
    fn offsets_that_are_none() {
        let mut second = info(400.0, 400.0, DVec3::ZERO);
        assert_eq!(offset_in_p(&second), DVec3::ZERO);
        (second.p[3], second.p[7]) = (f64::NAN, f64::INFINITY);
        assert_eq!(offset_in_p(&second), DVec3::ZERO);
        assert_eq!(offset_in_p(&CameraInfo::default()), DVec3::ZERO);
    }

    #[test]
    fn mountings_are_found_static_moving_or_where_the_pose_is() {
        let sync = SyncConfig::default();
        let mut tree = TfTree::new(&sync);
        let empty = TfTree::new(&sync);
        let origin = |found: Result<Mount, String>| found.map(|m| (m.origin, m.joint));
        assert_eq!(origin(find(&empty, "cam", "/cam", true, false)), Ok((MountOrigin::PoseIsCameras, None)));
        assert_eq!(origin(find(&empty, "base_link", "cam", false, true)), Ok((MountOrigin::Assumed, None)));
        // A pose that names a frame, or a second camera: then identity would be a guess.
        assert!(find(&empty, "base_link", "cam", true, true).unwrap_err().contains("unknown"));
        assert!(find(&empty, "base_link", "cam", false, false).is_err());
        let mut insert = |parent: &str, child: &str, x: f64, is_static: bool| {
            let header = Header { stamp_ns: 7_000_000_000, frame_id: parent.into() };
            let transform = Rigid::new(DQuat::IDENTITY, DVec3::new(x, 0.0, 0.0));
            tree.insert(&TransformStamped { header, child_frame_id: child.into(), transform }, is_static).unwrap();
        };
        insert("base_link", "head", 1.0, false);
        insert("head", "cam", 0.25, true);
        insert("base_link", "rear", -1.0, true);
        insert("elsewhere", "lost", 0.0, true);
        let cam = find(&tree, "base_link", "cam", true, true).unwrap();
        assert_eq!((cam.origin, cam.joint.as_deref()), (MountOrigin::Moving, Some("cam")));
        assert_eq!(cam.base_from_frame.translation.x, 1.25);
        let rear = find(&tree, "base_link", "rear", false, true).unwrap();
        assert_eq!((rear.origin, rear.base_from_frame.translation.x), (MountOrigin::Static, -1.0));
        assert!(find(&tree, "base_link", "lost", false, true).unwrap_err().contains("not connected"));
    }
}
