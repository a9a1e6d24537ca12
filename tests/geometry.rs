//! From a bag to a window, geometry intact: what one camera saw, lifted by its true depth and moved by the window's own
//! poses, is what another timestep's camera sees. Intrinsics, mountings, pose interpolation, anchor and pixel centres all
//! have to be right for that.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::collections::{BTreeMap, VecDeque};

use glam::Vec3;
use storm_node::config::Config;
use storm_node::pipeline::front::{Front, FrontOutput, TruthImage};
use storm_node::pipeline::posed::PoseStore;
use storm_node::poses::PoseBuffer;
use storm_node::source::Frame;
use storm_node::source::bag::BagSource;
use storm_node::source::event::Truth;
use storm_node::source::topics::TruthKind;
use storm_node::window::Window;
use storm_render::Intrinsics;

const SIZE: (usize, usize) = (120, 80);
/// Depths this close, relatively, are the same surface; pixels at its border may differ more.
const SAME_SURFACE: f32 = 0.03;
/// Share of the pixels that land inside the other picture and must land on their own surface; the rest is hidden there,
/// moving, or at an edge. A pose off by one pixel already puts it near 0.8.
const LANDED: f32 = 0.85;
/// The moved picture must match at least this much better than the unmoved one.
const BETTER: f32 = 3.0;

type Truths = BTreeMap<(usize, i64, TruthKind), TruthImage>;

fn windows(bag: &std::path::Path) -> (Vec<Window<Frame>>, Truths, Vec<Intrinsics>) {
    let config = Config::default();
    let source = BagSource::open(bag, &config, SIZE).unwrap();
    let rig = source.rig();
    let mut front = Front::new(&config, &rig, PoseStore::Buffer(PoseBuffer::new(&config.sync)));
    let (mut windows, mut truths, mut out) = (Vec::new(), Truths::new(), VecDeque::new());
    source
        .events(|event| {
            front.take(event, &mut out);
            for o in out.drain(..) {
                match o {
                    FrontOutput::Window(w) => windows.push(w),
                    FrontOutput::Truth { camera, stamp_ns, kind, image } => {
                        truths.insert((camera, stamp_ns, kind), image);
                    }
                    FrontOutput::Set(_) => {}
                }
            }
            true
        })
        .unwrap();
    (windows, truths, rig.intrinsics())
}

fn depth(truths: &Truths, camera: usize, stamp_ns: i64) -> &[f32] {
    match &*truths[&(camera, stamp_ns, TruthKind::Depth)].data {
        Truth::Depth(d) => d,
        _ => panic!("depth is depth"),
    }
}

fn moving(truths: &Truths, camera: usize, stamp_ns: i64) -> &[u16] {
    match &*truths[&(camera, stamp_ns, TruthKind::Moving)].data {
        Truth::Mask(m) => m,
        _ => panic!("moving is a mask"),
    }
}

#[test]
fn a_picture_moved_by_depth_and_pose_is_the_other_picture() {
    let dir = tempfile::tempdir().unwrap();
    let bag = dir.path().join("bag");
    // Cameras that fire 3 ms apart, so that poses must be interpolated to each camera's own stamp.
    let more = ["--noise", "0", "--same-exposure", "--stagger", "0.003"];
    common::synth(&bag, 17, "2.2", &more);
    let (windows, truths, cameras) = windows(&bag);
    let window = windows.first().expect("a window");
    let (first, second) = (0, 1);
    let (mut landed, mut inside, mut moved_error, mut still_error) = (0usize, 0usize, 0f32, 0f32);
    for camera in 0..cameras.len() {
        let k = &cameras[camera];
        let a = &window.steps[first].frames[camera];
        let b = &window.steps[second].frames[camera];
        let b_from_a =
            (window.anchor_from_camera(second, camera).inverse() * window.anchor_from_camera(first, camera)).to_f32();
        let (depth_a, depth_b) = (depth(&truths, camera, a.stamp_ns), depth(&truths, camera, b.stamp_ns));
        let moving_a = moving(&truths, camera, a.stamp_ns);
        let color =
            |f: &Frame, p: usize| Vec3::from(std::array::from_fn::<f32, 3, _>(|c| f32::from(f.rgb.data[3 * p + c])));
        for p in (0..SIZE.0 * SIZE.1).filter(|&p| depth_a[p] > 0.0 && moving_a[p] == 0) {
            let ray = k.ray((p % SIZE.0) as f32 + 0.5, (p / SIZE.0) as f32 + 0.5);
            let there = b_from_a.transform_point3(ray * depth_a[p]);
            let Some((u, v)) = k.project(there) else { continue };
            if !(u >= 0.0 && v >= 0.0 && u < SIZE.0 as f32 && v < SIZE.1 as f32) {
                continue;
            }
            inside += 1;
            let q = v as usize * SIZE.0 + u as usize;
            if (depth_b[q] - there.z).abs() > SAME_SURFACE * there.z {
                continue;
            }
            landed += 1;
            moved_error += (color(&a.item, p) - color(&b.item, q)).abs().element_sum();
            still_error += (color(&a.item, p) - color(&b.item, p)).abs().element_sum();
        }
    }
    let share = landed as f32 / inside as f32;
    println!("landed {share:.3} of {inside}; moved {moved_error:.0}, unmoved {still_error:.0}");
    assert!(inside > 5_000, "{inside}");
    assert!(share > LANDED, "{share}");
    assert!(moved_error * BETTER < still_error, "{moved_error} {still_error}");
}
