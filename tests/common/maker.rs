//! Small hand-made bags whose messages a test can spoil one by one.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::path::Path;

use glam::{DQuat, DVec3};
use storm_node::cdr::encode;
use storm_node::cdr::schema::MessageType;
use storm_node::msg::{CameraInfo, Header, Image, PoseStamped, TransformStamped};
use storm_node::output::bag_writer::BagWriter;
use storm_node::output::qos::Qos;
use storm_node::rigid::Rigid;
use storm_render::Intrinsics;

/// Frames in a bag, 0.1 s apart.
pub const FRAMES: usize = 20;
/// Stamp of frame 0.
pub const START_NS: i64 = 1_700_000_000_000_000_000;
const SIZE: (u32, u32) = (64, 48);

/// Stamp of frame `i`.
pub fn stamp(i: usize) -> i64 {
    START_NS + i as i64 * 100_000_000
}

/// A spoiler: changes message `i` or, by returning false, leaves it out.
type Edit<M> = Box<dyn Fn(usize, &mut M) -> bool>;

/// A forward drive seen by two cameras, each kind of message open to spoiling.
pub struct Maker {
    /// Images of camera 0 (index: frame) and of camera 1 (index: frame + 1000).
    pub image: Edit<Image>,
    /// The images' bytes as written.
    pub bytes: Box<dyn Fn(usize, Vec<u8>) -> Vec<u8>>,
    /// What the cameras' topics begin with.
    pub prefix: String,
    /// Poses come as /tf instead of /odometry.
    pub tf: bool,
    /// Vehicle poses.
    pub pose: Edit<PoseStamped>,
    /// CameraInfo, index: camera.
    pub info: Edit<CameraInfo>,
    /// Static transforms, index: camera.
    pub mount: Edit<TransformStamped>,
}

impl Default for Maker {
    fn default() -> Self {
        Self {
            image: Box::new(|_, _| true),
            bytes: Box::new(|_, b| b),
            prefix: String::new(),
            tf: false,
            pose: Box::new(|_, _| true),
            info: Box::new(|_, _| true),
            mount: Box::new(|_, _| true),
        }
    }
}

impl Maker {
    /// Writes the bag as one MCAP file.
    pub fn write(&self, path: &Path) {
        let mut bag = BagWriter::create(path).unwrap();
        let tf = bag.topic("/tf_static", MessageType::TfMessage, Qos::Latched).unwrap();
        let poses = match self.tf {
            true => bag.topic("/tf", MessageType::TfMessage, Qos::Reliable).unwrap(),
            false => bag.topic("/odometry", MessageType::Odometry, Qos::Reliable).unwrap(),
        };
        for camera in 0..2 {
            let mut t = mount(camera);
            if (self.mount)(camera, &mut t) {
                bag.write(tf, stamp(0), &encode::encode_tf_message(&[t]).unwrap()).unwrap();
            }
        }
        for frame in 0..FRAMES {
            let mut p = pose(frame);
            if (self.pose)(frame, &mut p) {
                let PoseStamped { header, child_frame_id, pose: transform } = p.clone();
                let cdr = match self.tf {
                    true => encode::encode_tf_message(&[TransformStamped { header, child_frame_id, transform }]),
                    false => encode::encode_odometry(&p),
                };
                bag.write(poses, stamp(frame), &cdr.unwrap()).unwrap();
            }
            for camera in 0..2 {
                let name = |what: &str| format!("{}/camera{camera}/{what}", self.prefix);
                let info_topic = bag.topic(&name("camera_info"), MessageType::CameraInfo, Qos::Reliable).unwrap();
                let image_topic = bag.topic(&name("image"), MessageType::Image, Qos::Reliable).unwrap();
                let mut k = info(camera, frame);
                if frame == 0 && (self.info)(camera, &mut k) {
                    bag.write(info_topic, stamp(frame), &encode::encode_camera_info(&k).unwrap()).unwrap();
                }
                let mut m = image(camera, frame);
                let index = frame + 1000 * camera;
                if (self.image)(index, &mut m) {
                    let bytes = (self.bytes)(index, encode::encode_image(&m).unwrap());
                    bag.write(image_topic, stamp(frame), &bytes).unwrap();
                }
            }
        }
        bag.finish().unwrap();
    }
}

fn header(frame_id: &str, frame: usize) -> Header {
    Header { stamp_ns: stamp(frame), frame_id: frame_id.into() }
}

fn pose(frame: usize) -> PoseStamped {
    let pose = Rigid::new(DQuat::IDENTITY, DVec3::new(0.5 * frame as f64, 0.0, 0.0));
    PoseStamped { header: header("map", frame), child_frame_id: "base_link".into(), pose }
}

/// Optical frame looking along the vehicle's x axis, the second camera half a metre to the right.
fn mount(camera: usize) -> TransformStamped {
    let rotation = DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5);
    TransformStamped {
        header: header("base_link", 0),
        child_frame_id: format!("camera{camera}_optical"),
        transform: Rigid::new(rotation, DVec3::new(1.0, -0.5 * camera as f64, 1.5)),
    }
}

fn info(camera: usize, frame: usize) -> CameraInfo {
    let (width, height) = (SIZE.0 as usize, SIZE.1 as usize);
    let intrinsics = Intrinsics { fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0, width, height };
    CameraInfo::pinhole(&intrinsics, header(&format!("camera{camera}_optical"), frame))
}

fn image(camera: usize, frame: usize) -> Image {
    let (width, height) = SIZE;
    let pixel = |k: u32| {
        let (col, row) = (k % width, k / width);
        [(col * 4) as u8, (row * 5) as u8, ((col + row + 7 * frame as u32) * 3) as u8]
    };
    Image {
        header: header(&format!("camera{camera}_optical"), frame),
        height,
        width,
        encoding: "rgb8".into(),
        is_bigendian: false,
        step: 3 * width,
        data: (0..width * height).flat_map(pixel).collect(),
    }
}
