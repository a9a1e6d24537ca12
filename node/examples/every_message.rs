//! Writes one message of every type the program publishes: `OUT/every_message.mcap`, the same as a bag folder
//! `OUT/every_message`, and `OUT/every_message.json` with the values a reader must find.
//!
//! `tests/python/read_outputs.py` reads the result with two independent libraries.

use std::path::Path;

use anyhow::Context as _;
use glam::{DQuat, DVec3};
use serde_json::json;
use storm_node::cdr::encode;
use storm_node::cdr::schema::MessageType;
use storm_node::msg::{CameraInfo, CompressedImage, Header, Image, Path as PathMessage, PoseStamped, TransformStamped};
use storm_node::output::bag_writer::BagWriter;
use storm_node::output::cloud::{FlowCloud, GaussianCloud, MapCloud, flow_cloud, gaussian_cloud, map_cloud};
use storm_node::output::picture::Picture;
use storm_node::output::qos::Qos;
use storm_node::rigid::Rigid;

const STAMP_NS: i64 = 1_700_000_000_123_456_789;

fn header(frame_id: &str) -> Header {
    Header { stamp_ns: STAMP_NS, frame_id: frame_id.into() }
}

/// Topic, type, profile, message, and `field path -> value` of what a reader must find in it.
type Entry = (&'static str, MessageType, Qos, Vec<u8>, serde_json::Value);

fn pictures() -> anyhow::Result<Vec<Entry>> {
    let image = Image {
        header: header("camera0_optical"),
        height: 2,
        width: 3,
        encoding: "rgb8".into(),
        is_bigendian: false,
        step: 9,
        data: (0..18).collect(),
    };
    let png = Picture::filled(4, 2, [10, 20, 30]).png()?;
    let png_len = png.len();
    let compressed = CompressedImage { header: header("camera0_optical"), format: "png".into(), data: png };
    let info = CameraInfo {
        header: header("camera0_optical"),
        height: 240,
        width: 320,
        distortion_model: "plumb_bob".into(),
        d: vec![0.1, -0.2, 0.0, 0.0, 0.3],
        k: [300.0, 0.0, 159.5, 0.0, 301.0, 119.5, 0.0, 0.0, 1.0],
        r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: [300.0, 0.0, 159.5, -36.0, 0.0, 301.0, 119.5, 0.0, 0.0, 0.0, 1.0, 0.0],
        binning_x: 1,
        binning_y: 2,
        roi: [4, 6, 200, 300],
    };
    Ok(vec![
        (
            "/image",
            MessageType::Image,
            Qos::SensorData,
            encode::encode_image(&image)?,
            json!({"header.stamp.sec": 1_700_000_000, "header.stamp.nanosec": 123_456_789,
                   "header.frame_id": "camera0_optical", "height": 2, "width": 3, "encoding": "rgb8", "step": 9,
                   "data.17": 17}),
        ),
        (
            "/image/compressed",
            MessageType::CompressedImage,
            Qos::SensorData,
            encode::encode_compressed_image(&compressed)?,
            json!({"format": "png", "data.#": png_len, "data.1": 80}),
        ),
        (
            "/camera_info",
            MessageType::CameraInfo,
            Qos::SensorData,
            encode::encode_camera_info(&info)?,
            json!({"distortion_model": "plumb_bob", "d.#": 5, "d.4": 0.3, "k.2": 159.5, "k.4": 301.0, "r.8": 1.0,
                   "p.3": -36.0, "binning_y": 2, "roi.x_offset": 4, "roi.y_offset": 6, "roi.height": 200,
                   "roi.width": 300, "roi.do_rectify": false}),
        ),
    ])
}

fn poses() -> anyhow::Result<Vec<Entry>> {
    let pose = PoseStamped {
        header: header("map"),
        child_frame_id: "base_link".into(),
        pose: Rigid::new(DQuat::from_xyzw(0.1, 0.2, 0.3, 0.9), DVec3::new(691_234.125, 5_334_000.5, -7.25)),
    };
    let transform = TransformStamped {
        header: header("base_link"),
        child_frame_id: "camera0_optical".into(),
        transform: Rigid::new(DQuat::from_xyzw(0.5, -0.5, 0.5, -0.5), DVec3::new(1.5, 0.0, 1.25)),
    };
    let path = PathMessage { header: header("map"), poses: vec![pose.clone(); 3] };
    let odd = TransformStamped { child_frame_id: "c".into(), ..transform.clone() };
    Ok(vec![
        (
            "/pose",
            MessageType::PoseStamped,
            Qos::Reliable,
            encode::encode_pose_stamped(&pose)?,
            json!({"header.frame_id": "map", "pose.position.y": 5_334_000.5, "pose.orientation.w": 0.9}),
        ),
        (
            "/odometry",
            MessageType::Odometry,
            Qos::Reliable,
            encode::encode_odometry(&pose)?,
            json!({"child_frame_id": "base_link", "pose.pose.position.x": 691_234.125, "pose.pose.orientation.z": 0.3,
                   "pose.covariance.#": 36, "twist.twist.linear.x": 0.0, "twist.covariance.35": 0.0}),
        ),
        (
            "/tf_static",
            MessageType::TfMessage,
            Qos::Latched,
            encode::encode_tf_message(&[transform.clone(), odd, transform])?,
            json!({"transforms.#": 3, "transforms.1.child_frame_id": "c", "transforms.2.header.frame_id": "base_link",
                   "transforms.2.transform.translation.z": 1.25, "transforms.2.transform.rotation.y": -0.5}),
        ),
        (
            "/path",
            MessageType::Path,
            Qos::Reliable,
            encode::encode_path(&path)?,
            json!({"poses.#": 3, "poses.2.header.stamp.nanosec": 123_456_789, "poses.2.pose.position.z": -7.25}),
        ),
        ("/debug/step_ms", MessageType::Float64, Qos::Reliable, encode::encode_float64(12.5)?, json!({"data": 12.5})),
    ])
}

fn clouds() -> anyhow::Result<Vec<Entry>> {
    let positions = [[1.0, 2.0, 3.0], [-4.0, 5.5, 6.0]];
    let (colors01, scales) = ([[1.0, 0.5, 0.0], [0.0, 0.0, 1.0]], [[0.1, 0.2, 0.3]; 2]);
    let (opacities, quats) = ([0.5, 0.25], [[1.0, 0.0, 0.0, 0.0]; 2]);
    let gaussians = GaussianCloud {
        positions: &positions,
        colors01: &colors01,
        velocities: &[[0.0, 0.0, 0.0], [10.0, -1.0, 0.0]],
        opacities: &opacities,
        scales: &scales,
        quats: &quats,
        motion_ids: &[0, 7],
        track_ids: &[1, 4_000_000_000],
    };
    let map =
        MapCloud { positions: &positions, colors01: &colors01, opacities: &opacities, scales: &scales, quats: &quats };
    let flow = FlowCloud {
        width: 1,
        height: 2,
        positions: &positions,
        velocities: &[[3.0, 0.0, 0.0]; 2],
        valid: &[true, false],
    };
    let cloud = |topic, qos, built: storm_node::output::cloud::BuiltCloud, expected| -> anyhow::Result<Entry> {
        Ok((topic, MessageType::PointCloud2, qos, encode::encode_point_cloud2(&built.cloud)?, expected))
    };
    Ok(vec![
        cloud(
            "/gaussians",
            Qos::Reliable,
            gaussian_cloud(header("map"), &gaussians)?,
            json!({"width": 2, "point_step": 68, "is_dense": true, "points.1.x": -4.0, "points.1.vy": -1.0,
                   "points.1.motion_id": 7, "points.1.track_id": 4_000_000_000u32, "points.0.scale_2": 0.3f32}),
        )?,
        cloud(
            "/flow",
            Qos::Reliable,
            flow_cloud(header("map"), &flow)?,
            json!({"width": 1, "height": 2, "row_step": 28, "is_dense": false, "points.0.valid": 1,
                   "points.1.valid": 0, "points.0.vx": 3.0, "points.1.vx": 0.0}),
        )?,
        cloud(
            "/map",
            Qos::Latched,
            map_cloud(header("map"), &map)?,
            json!({"width": 2, "point_step": 48, "fields.#": 12, "points.1.y": 5.5, "points.1.opacity": 0.25}),
        )?,
    ])
}

fn main() -> anyhow::Result<()> {
    let out = std::env::args().nth(1).context("usage: every_message OUT")?;
    let out = Path::new(&out);
    std::fs::create_dir_all(out)?;
    let entries: Vec<Entry> = [pictures()?, poses()?, clouds()?].concat();
    for mut bag in
        [BagWriter::create(&out.join("every_message.mcap"))?, BagWriter::create_folder(&out.join("every_message"))?]
    {
        for (topic, message_type, qos, cdr, _) in &entries {
            let id = bag.topic(topic, *message_type, *qos)?;
            bag.write(id, STAMP_NS, cdr)?;
        }
        bag.finish()?;
    }
    let expected: serde_json::Map<_, _> = entries.into_iter().map(|e| (e.0.to_owned(), e.4)).collect();
    std::fs::write(out.join("every_message.json"), serde_json::to_string_pretty(&expected)?)?;
    Ok(())
}
