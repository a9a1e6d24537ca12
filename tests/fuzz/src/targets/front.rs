//! Events through synchronisation, poses and windows.

use std::collections::VecDeque;

use glam::{DQuat, DVec3};
use storm_node::config::Config;
use storm_node::decode::RgbPicture;
use storm_node::msg::{Header, TransformStamped};
use storm_node::pipeline::front::{Front, FrontOutput};
use storm_node::pipeline::posed::PoseStore;
use storm_node::poses::PoseBuffer;
use storm_node::rigid::Rigid;
use storm_node::source::{Event, Frame};
use storm_node::sync::DropReason;
use storm_node::tf::TfTree;

use super::{Bytes, rig};

/// A row of events with any stamps and poses through synchronisation, poses and windows. What came in is what came out or
/// was dropped; nothing that is not finite comes out.
pub fn front(data: &[u8]) {
    let mut b = Bytes(data);
    let rig = rig();
    let config = Config::default();
    let options = b.u8();
    let store = match options & 5 {
        0 => PoseStore::Buffer(PoseBuffer::new(&config.sync)),
        4 => PoseStore::Both {
            poses: PoseBuffer::new(&config.sync),
            tree: TfTree::new(&config.sync),
            fixed_and_given: Some(("map".into(), "odom".into())),
            base: "base".into(),
        },
        _ => PoseStore::Tree { tree: TfTree::new(&config.sync), fixed: "map".into(), base: "base".into() },
    };
    let on_demand = options & 2 == 2;
    let mut front = match on_demand {
        true => Front::on_demand(&config, &rig, store),
        false => Front::new(&config, &rig, store),
    };
    let frame = Frame::whole(RgbPicture { width: 1, height: 1, data: vec![0; 3] });
    let mut out = VecDeque::new();
    let (mut now_ns, mut images, mut used) = (0i64, 0u64, 0u64);
    while !b.0.is_empty() {
        let what = b.u8();
        // Mostly small steps of time, sometimes any stamp at all.
        let stamp_ns = match what >> 6 {
            0 => b.i64(),
            _ => now_ns.wrapping_add(i64::from(b.u16() as i16) * 1_000_000),
        };
        now_ns = if what & 0x20 == 0 { stamp_ns } else { now_ns };
        let event = match what & 7 {
            0..=2 => {
                images += 1;
                Event::Image { camera: usize::from(what & 1), stamp_ns, frame: frame.clone() }
            }
            3 => Event::Pose { stamp_ns, map_from_base: pose(&mut b) },
            4 | 5 => {
                let transform = pose(&mut b);
                let parent = Header { stamp_ns, frame_id: ["map", "base", "odom"][usize::from(what >> 3) % 3].into() };
                let child = ["base", "odom", "map"][usize::from(b.u8()) % 3];
                let t = Box::new(TransformStamped { header: parent, child_frame_id: child.into(), transform });
                if what & 1 == 0 { Event::Transform(t) } else { Event::StaticTransform(t) }
            }
            6 => {
                images += 1;
                Event::Lost { camera: Some(0), reason: DropReason::Decode, detail: String::new() }
            }
            _ => {
                let _ = front.newest_window();
                continue;
            }
        };
        front.take(event, &mut out);
        used += taken(&mut out);
        if on_demand && what & 0x18 == 0x18 {
            let _ = front.newest_window();
        }
    }
    front.finish(&mut out);
    used += taken(&mut out);
    let (came, dropped) = (front.images_in(), front.drops().total());
    assert_eq!(came, images, "images in");
    assert_eq!(came, 2 * used + dropped, "{} dropped of {came}, {used} sets", front.drops());
}

/// Sets among the outputs, which are checked.
fn taken(out: &mut VecDeque<FrontOutput>) -> u64 {
    let mut sets = 0;
    for output in out.drain(..) {
        match output {
            FrontOutput::Set(set) => {
                sets += 1;
                assert!(set.frames.iter().all(|f| f.map_from_camera.is_finite()));
            }
            FrontOutput::Window(window) => {
                assert!(window.map_from_anchor.is_finite());
                assert!(window.time_sec.iter().flatten().all(|t| t.is_finite()));
            }
            FrontOutput::Truth { .. } => {}
        }
    }
    sets
}

/// Any rigid transform, mostly a sound one.
fn pose(b: &mut Bytes) -> Rigid {
    match b.u8() {
        0 => {
            let q = DQuat::from_xyzw(b.f64(), b.f64(), b.f64(), b.f64());
            Rigid::new(q, DVec3::new(b.f64(), b.f64(), b.f64()))
        }
        n => Rigid::new(DQuat::from_rotation_z(f64::from(n) * 0.05), DVec3::new(f64::from(b.u8()), 0.0, 0.0)),
    }
}
