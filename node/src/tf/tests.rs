use glam::{DQuat, DVec3, EulerRot};
use proptest::prelude::*;

use super::*;
use crate::msg::Header;
use crate::poses::PoseReject;

const MS: i64 = 1_000_000;

fn message(stamp_ns: i64, parent: &str, child: &str, transform: Rigid) -> TransformStamped {
    TransformStamped { header: Header { stamp_ns, frame_id: parent.into() }, child_frame_id: child.into(), transform }
}

fn shift(x: f64) -> Rigid {
    Rigid::new(DQuat::IDENTITY, DVec3::new(x, 0.0, 0.0))
}

fn tree() -> TfTree {
    TfTree::new(&SyncConfig::default())
}

#[test]
fn chains_are_followed_up_and_down() {
    let mut t = tree();
    t.insert(&message(0, "/base_link", "camera", shift(2.0)), true).unwrap();
    t.insert(&message(0, "base_link", "/lidar", shift(-1.0)), true).unwrap();
    for i in 0..3 {
        t.insert(&message(i * 100 * MS, "odom", "base_link", shift(10.0 * i as f64)), false).unwrap();
    }
    t.insert(&message(0, "map", "odom", shift(1000.0)), true).unwrap();
    let at = |target, source, ms: i64| match t.lookup(target, source, ms * MS) {
        TfLookup::At(x) => x.translation.x,
        other => panic!("{other:?}"),
    };
    assert_eq!((at("map", "camera", 150), at("camera", "map", 150)), (1017.0, -1017.0));
    // Frames that hang on the vehicle need no pose of the vehicle, however late or early.
    assert_eq!((at("lidar", "camera", 99_999), at("camera", "camera", -5)), (3.0, 0.0));
    assert!(t.knows("/map") && !t.knows("world"));
}

#[test]
fn outcomes_name_the_frames() {
    let mut t = tree();
    assert!(
        matches!(t.lookup("map", "base", 0), TfLookup::Wait(TfProblem::UnknownFrame { frame, .. }) if frame == "map")
    );
    for ms in [1000, 1100, 2000] {
        t.insert(&message(ms * MS, "map", "base", shift(0.0)), false).unwrap();
    }
    t.insert(&message(0, "rig", "camera", shift(0.0)), true).unwrap();
    let text = |target, source, ms: i64| match t.lookup(target, source, ms * MS) {
        TfLookup::Wait(p) => format!("wait: {p}"),
        TfLookup::Never(p) => format!("never: {p}"),
        TfLookup::At(_) => "at".into(),
    };
    assert_eq!(text("map", "base", 1050), "at");
    assert_eq!(text("map", "base", 2500), "wait: transform from `base` to `map` ends 0.500 s before the stamp");
    assert_eq!(text("base", "map", 500), "never: transform from `base` to `map` begins 0.500 s after the stamp");
    assert!(text("map", "base", 1500).starts_with("never: transform from `base` to `map` has a gap of 0.900 s"));
    let apart = text("map", "camera", 1050);
    assert!(apart.contains("`map` and `camera` are not connected") && apart.contains("`rig`"), "{apart}");
    assert_eq!(text("map", "wheel", 0), "wait: frame `wheel` is unknown; known: base, camera, map, rig");
    assert_eq!(
        t.lookup("map", "base", 500 * MS).to_pose(),
        PoseLookup::Never(PoseMissing::BeforeFirst { first_ns: 1000 * MS })
    );
    assert_eq!(t.lookup("map", "wheel", 0).to_pose(), PoseLookup::Wait);
}

#[test]
fn loops_and_nonsense_are_refused() {
    let mut t = tree();
    t.insert(&message(0, "a", "b", shift(1.0)), true).unwrap();
    t.insert(&message(0, "b", "c", shift(1.0)), true).unwrap();
    let e = t.insert(&message(0, "c", "a", shift(1.0)), true).unwrap_err().to_string();
    assert!(e.contains("a -> c -> b -> a"), "{e}");
    assert_eq!(t.insert(&message(0, "/a", "a", shift(1.0)), false), Err(TfError::OwnParent { frame: "a".into() }));
    assert!(matches!(t.insert(&message(0, "/", "a", shift(1.0)), false), Err(TfError::EmptyName { .. })));
    let bad = Rigid::new(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), DVec3::ZERO);
    let e = t.insert(&message(0, "a", "d", bad), false).unwrap_err();
    assert_eq!(
        e,
        TfError::Numbers { parent: "a".into(), child: "d".into(), reason: PoseReject::NotUnit { length: 0.0 } }
    );
    assert!(!t.knows("d"));
    // The tree still works, and a frame may change its parent.
    t.insert(&message(0, "a", "c", shift(7.0)), true).unwrap();
    assert_eq!(t.lookup("b", "c", 0), TfLookup::At(shift(6.0)));
    for i in 0..2000 {
        let _ = t.insert(&message(0, "a", &format!("x{i}"), shift(0.0)), false);
    }
    assert_eq!(t.frames().count(), MAX_FRAMES);
}

#[test]
fn a_clock_jump_forgets_what_moves_and_keeps_what_does_not() {
    let mut t = tree();
    t.insert(&message(0, "base", "camera", shift(1.0)), true).unwrap();
    for i in 0..3 {
        t.insert(&message((100_000 + i * 100) * MS, "map", "base", shift(0.0)), false).unwrap();
    }
    t.follow_clock(100_150 * MS);
    assert!(matches!(t.lookup("map", "camera", 100_150 * MS), TfLookup::At(_)));
    t.follow_clock(0);
    assert!(matches!(t.lookup("map", "camera", 100_150 * MS), TfLookup::Wait(_)));
    assert_eq!(t.lookup("base", "camera", 0), TfLookup::At(shift(1.0)));
}

proptest! {
    /// Any tree gives the product along the path, both ways, to f64 precision at UTM-sized places.
    #[test]
    fn lookups_agree_with_plain_products(
        links in proptest::collection::vec(
            (0usize..100, -3.0f64..3.0, -3.0f64..3.0, -1e6f64..1e6, -50.0f64..50.0), 1..12,
        ),
        a in 0usize..12, b in 0usize..12,
    ) {
        let mut t = tree();
        let mut root_from = vec![Rigid::IDENTITY];
        for (i, (parent, yaw, pitch, x, y)) in links.iter().enumerate() {
            let parent = parent % (i + 1);
            let link = Rigid::new(DQuat::from_euler(EulerRot::ZYX, *yaw, *pitch, 0.3), DVec3::new(*x, *y, 1.0));
            t.insert(&message(0, &format!("f{parent}"), &format!("f{}", i + 1), link), true).unwrap();
            root_from.push(root_from[parent] * link);
        }
        let (a, b) = (a % root_from.len(), b % root_from.len());
        let TfLookup::At(a_from_b) = t.lookup(&format!("f{a}"), &format!("f{b}"), 0) else { panic!() };
        let expected = root_from[a].inverse() * root_from[b];
        // Up to a dozen products of positions of 1e6 m, each rounded at 1e-10 m and turned by rotations rounded at
        // 1e-16.
        prop_assert!((a_from_b.translation - expected.translation).length() < 1e-7);
        prop_assert!(a_from_b.rotation.dot(expected.rotation).abs() > 1.0 - 1e-12);
        let TfLookup::At(b_from_a) = t.lookup(&format!("f{b}"), &format!("f{a}"), 0) else { panic!() };
        prop_assert!((a_from_b * b_from_a).translation.length() < 1e-7);
    }
}
