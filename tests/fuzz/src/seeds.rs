//! Sound input for every target, small, made by the program's own writers: nothing recorded is kept.

use std::io::Cursor;
use std::path::Path;

use glam::{DQuat, DVec3};
use image::{DynamicImage, ImageFormat, RgbImage};
use storm_node::cdr::encode;
use storm_node::cdr::schema::MessageType;
use storm_node::config::{Config, MapConfig};
use storm_node::map::{MapCloud, StaticMap};
use storm_node::msg::{CameraInfo, CompressedImage, Header, Image, PointCloud2, PoseStamped, TransformStamped};
use storm_node::output::ply::{PlyCloud, write_ply};
use storm_node::rigid::Rigid;
use storm_render::Intrinsics;

use super::targets::{CAMERA, ENCODINGS, MAP_HEAD};

fn header(stamp_ns: i64) -> Header {
    Header { stamp_ns, frame_id: "camera".into() }
}

fn picture() -> RgbImage {
    RgbImage::from_fn(CAMERA.0 as u32, CAMERA.1 as u32, |x, y| image::Rgb([x as u8 * 8, y as u8 * 16, 70]))
}

fn compressed_file(format: ImageFormat) -> Vec<u8> {
    let mut data = Vec::new();
    picture().write_to(&mut Cursor::new(&mut data), format).expect("memory takes it");
    data
}

fn raw(stamp_ns: i64) -> Image {
    let (width, height) = (CAMERA.0 as u32, CAMERA.1 as u32);
    let data = picture().into_raw();
    let encoding = "rgb8".into();
    Image { header: header(stamp_ns), height, width, encoding, is_bigendian: false, step: 3 * width, data }
}

fn info(model: &str) -> CameraInfo {
    let (width, height) = CAMERA;
    let intrinsics = Intrinsics { fx: 20.0, fy: 20.0, cx: 16.0, cy: 8.0, width, height };
    let mut info = CameraInfo::pinhole(&intrinsics, header(1));
    info.distortion_model = model.into();
    info.d = match model {
        "equidistant" => vec![0.1, -0.02, 0.003, -0.001],
        "rational_polynomial" => vec![0.2, -0.1, 0.001, 0.002, 0.01, 0.1, 0.05, 0.02],
        _ => vec![-0.2, 0.05, 0.001, -0.001, 0.0],
    };
    info
}

fn pose(stamp_ns: i64) -> PoseStamped {
    let pose = Rigid::new(DQuat::IDENTITY, DVec3::new(1.0, 2.0, 3.0));
    PoseStamped { header: Header { stamp_ns, frame_id: "map".into() }, child_frame_id: "base_link".into(), pose }
}

fn transforms() -> Vec<TransformStamped> {
    let transform = Rigid::new(DQuat::from_xyzw(-0.5, 0.5, -0.5, 0.5), DVec3::ZERO);
    let header = Header { stamp_ns: 0, frame_id: "base_link".into() };
    vec![TransformStamped { header, child_frame_id: "camera".into(), transform }; 2]
}

/// Every message type there is, as CDR.
pub fn cdr() -> Vec<Vec<u8>> {
    let cloud = PointCloud2 { width: 2, height: 1, point_step: 4, row_step: 8, data: vec![0; 8], ..Default::default() };
    let jpeg = CompressedImage { header: header(1), format: "jpeg".into(), data: compressed_file(ImageFormat::Jpeg) };
    [
        encode::encode_image(&raw(1)),
        encode::encode_compressed_image(&jpeg),
        encode::encode_camera_info(&info("plumb_bob")),
        encode::encode_camera_info(&info("rational_polynomial")),
        encode::encode_camera_info(&info("equidistant")),
        encode::encode_pose_stamped(&pose(1)),
        encode::encode_odometry(&pose(1)),
        encode::encode_tf_message(&transforms()),
        encode::encode_point_cloud2(&cloud),
    ]
    .into_iter()
    .map(|m| m.expect("a sound message"))
    .collect()
}

/// The messages of a small recording: topic, type, stamp, CDR.
fn recording() -> Vec<(&'static str, MessageType, i64, Vec<u8>)> {
    let mut all = vec![
        ("/tf_static", MessageType::TfMessage, 0, encode::encode_tf_message(&transforms())),
        ("/cam/camera_info", MessageType::CameraInfo, 1, encode::encode_camera_info(&info("plumb_bob"))),
    ];
    for i in 0..3i64 {
        all.push(("/odometry", MessageType::Odometry, 10 + i, encode::encode_odometry(&pose(10 + i))));
        all.push(("/cam/image_raw", MessageType::Image, 10 + i, encode::encode_image(&raw(10 + i))));
    }
    all.into_iter().map(|(topic, kind, at, m)| (topic, kind, at, m.expect("a sound message"))).collect()
}

/// A bag; without checksums, so that what is mutated is still looked at.
fn mcap_bag(chunks: bool, compression: Option<mcap::Compression>, crc: bool) -> Vec<u8> {
    let mut writer = mcap::WriteOptions::new()
        .profile("ros2")
        .library("")
        .use_chunks(chunks)
        .chunk_size(Some(4000))
        .compression(compression)
        .compression_threads(0)
        .calculate_chunk_crcs(crc)
        .calculate_data_section_crc(crc)
        .calculate_summary_section_crc(crc)
        .create(Cursor::new(Vec::new()))
        .expect("a writer into memory");
    for (topic, kind, at, data) in recording() {
        let schema = writer.add_schema(&kind.name(), "ros2msg", b"").expect("memory takes it");
        let channel_id = writer.add_channel(schema, topic, "cdr", &Default::default()).expect("memory takes it");
        let head =
            mcap::records::MessageHeader { channel_id, sequence: 0, log_time: at as u64, publish_time: at as u64 };
        writer.write_to_known_channel(&head, &data).expect("memory takes it");
    }
    writer.finish().expect("memory takes it");
    writer.into_inner().into_inner()
}

fn sqlite_bag(compress: bool) -> Vec<u8> {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let path = dir.path().join("bag.db3");
    let db = rusqlite::Connection::open(&path).expect("a database");
    db.execute_batch(
        "PRAGMA page_size=512; PRAGMA journal_mode=OFF;
         CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL);
         CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL, data BLOB NOT NULL);",
    )
    .expect("tables");
    for (topic, kind, at, data) in recording() {
        let row: Option<i64> = db.query_row("SELECT id FROM topics WHERE name = ?1", [topic], |r| r.get(0)).ok();
        let id = row.unwrap_or_else(|| {
            db.execute(
                "INSERT INTO topics(name, type, serialization_format) VALUES (?1, ?2, 'cdr')",
                (topic, kind.name()),
            )
            .expect("a row");
            db.last_insert_rowid()
        });
        let data = if compress { zstd::encode_all(&data[..], 1).expect("memory takes it") } else { data };
        db.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?1, ?2, ?3)", (id, at, data))
            .expect("a row");
    }
    db.close().expect("written");
    std::fs::read(&path).expect("the database")
}

/// Bags of every storage and compression, and the text beside them.
pub fn bag() -> Vec<Vec<u8>> {
    let metadata = "rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n  relative_file_paths:\n    - in.mcap\n  message_count: 0\n  compression_format: zstd\n  compression_mode: FILE\n  topics_with_message_count:\n    - topic_metadata: {name: /a, type: b/msg/C, serialization_format: cdr, offered_qos_profiles: \"\"}\n      message_count: 0\n";
    let whole = mcap_bag(true, None, true);
    // A recorder that died: no summary, no footer.
    let cut = mcap_bag(true, None, false);
    let cut = cut[..cut.len() * 2 / 3].to_vec();
    vec![
        mcap_bag(false, None, false),
        mcap_bag(true, None, false),
        mcap_bag(true, Some(mcap::Compression::Zstd), false),
        mcap_bag(true, Some(mcap::Compression::Lz4), false),
        cut,
        sqlite_bag(false),
        sqlite_bag(true),
        zstd::encode_all(&whole[..], 1).expect("memory takes it"),
        metadata.as_bytes().to_vec(),
    ]
}

/// Files of both kinds, and rows of every encoding.
pub fn image() -> Vec<Vec<u8>> {
    let file = |format| [vec![1], compressed_file(format)].concat();
    // Found by fuzzing: sums of brightness that overflow in the JPEG decoder, and 801 bytes that claim 314 megapixels.
    let overflow = include_bytes!("../found/image_dc_overflow").to_vec();
    let large = include_bytes!("../found/image_many_pixels").to_vec();
    let mut all = vec![file(ImageFormat::Jpeg), file(ImageFormat::Png), overflow, large];
    for i in 0..ENCODINGS.len() {
        // 4 x 3 pixels of up to 12 bytes, no padding.
        let head = [(i as u8) << 1, 4, 0, 3, 0, 0, 0, 0];
        all.push([&head[..], &(0..144).map(|b| b as u8).collect::<Vec<_>>()].concat());
    }
    all
}

/// CompressedImages as image_transport's plugins and USB cameras send them.
pub fn compressed() -> Vec<Vec<u8>> {
    let message = |format: &str, data: &[u8]| [&[format.len() as u8], format.as_bytes(), data].concat();
    let file = |picture: DynamicImage, kind| {
        let mut data = Vec::new();
        picture.write_to(&mut Cursor::new(&mut data), kind).expect("memory takes it");
        data
    };
    let (colour, grey) = (DynamicImage::from(picture()), DynamicImage::from(picture()).into_luma8());
    let deep = DynamicImage::from(grey.clone()).into_luma16();
    let depth_png =
        [&[0; 4][..], &10100f32.to_le_bytes(), &(-1009f32).to_le_bytes(), &file(deep.clone().into(), ImageFormat::Png)]
            .concat();
    let raw = raw(1);
    let mut packed = [raw.height.to_le_bytes(), raw.width.to_le_bytes()].concat();
    packed.push(0);
    packed.extend([raw.step.to_le_bytes(), 4u32.to_le_bytes()].concat());
    packed.extend(b"rgb8");
    packed.extend(zstd::encode_all(&raw.data[..], 1).expect("memory takes it"));
    let whole = encode::encode_image(&raw).expect("a sound message");
    vec![
        message("tiff", &file(colour.clone(), ImageFormat::Tiff)),
        message("16UC1; tiff compressed ", &file(deep.into(), ImageFormat::Tiff)),
        message("rgb16; tiff compressed bgr16", &file(colour.clone().into_rgb16().into(), ImageFormat::Tiff)),
        message("mjpeg", &without_tables(&file(colour, ImageFormat::Jpeg))),
        message("bayer_rggb8; jpeg compressed ", &file(grey.clone().into(), ImageFormat::Jpeg)),
        message("bayer_gbrg8; png compressed ", &file(grey.into(), ImageFormat::Png)),
        message("32FC1; compressedDepth png", &depth_png),
        message("16UC1; compressedDepth", &depth_png),
        message("zstd", &packed),
        message("zstd", &zstd::encode_all(&whole[..], 1).expect("memory takes it")),
        message("bgr8; jpeg compressed bgr8", &compressed_file(ImageFormat::Jpeg)),
    ]
}

/// A JPEG without its DHT segments.
fn without_tables(file: &[u8]) -> Vec<u8> {
    let (mut out, mut at) = (file[..2].to_vec(), 2);
    while file[at + 1] != 0xda {
        let end = at + 2 + usize::from(u16::from_be_bytes([file[at + 2], file[at + 3]]));
        if file[at + 1] != 0xc4 {
            out.extend(&file[at..end]);
        }
        at = end;
    }
    out.extend(&file[at..]);
    out
}

/// A state dict of one tensor of 4 x 8 numbers as `torch.save` pickles it, and the smallest safetensors files.
pub fn weights() -> Vec<Vec<u8>> {
    let mut pickle = b"\x80\x02}q\x00".to_vec();
    pickle.extend(b"X\x0b\x00\x00\x00norm.weightctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\nFloatStorage\n");
    pickle.extend(b"X\x01\x00\x00\x000X\x03\x00\x00\x00cpuM\x00\x01tQK\x00K\x04K\x08\x86K\x08K\x01\x86\x89ccollections\nOrderedDict\n)RtRs.");
    let wrapped = {
        let mut p = b"\x80\x02}q\x00X\x05\x00\x00\x00model".to_vec();
        p.extend(&pickle[2..pickle.len() - 1]);
        p.extend(b"s.");
        p
    };
    let header = br#"{"__metadata__":{"storm_config":"{\"embed_dim\":16,\"depth\":1}"},"norm.weight":{"dtype":"F16","shape":[2,2],"data_offsets":[0,8]},"norm.bias":{"dtype":"F32","shape":[1],"data_offsets":[8,12]}}"#;
    let safetensors = [&(header.len() as u64).to_le_bytes()[..], header, &[0; 12]].concat();
    let plain = br#"{"norm.weight":{"dtype":"BF16","shape":[4],"data_offsets":[0,8]}}"#;
    let plain = [&(plain.len() as u64).to_le_bytes()[..], plain, &[0; 8]].concat();
    let zip = super::targets::checkpoint(&pickle);
    vec![pickle, wrapped, safetensors, plain, zip]
}

/// A map of a few Gaussians in one tile (index and tile), the index as a file, and what lies beside it.
pub fn map() -> Vec<Vec<u8>> {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let n = 6;
    let cloud = MapCloud {
        origin: DVec3::ZERO,
        positions: (0..n).map(|i| [1.0 + i as f32, 2.0, 3.0]).collect(),
        colors01: vec![[0.5; 3]; n],
        opacities: vec![0.9; n],
        scales: vec![[0.1, 0.05, 0.02]; n],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        confidences: vec![1.0; n],
    };
    let map_dir = dir.path().join("map");
    let mut map = StaticMap::of_cloud(&MapConfig::default(), &map_dir, &cloud).expect("a map");
    map.save().expect("a saved map");
    let find = |ending: &str| {
        let mut files = std::fs::read_dir(&map_dir).expect("the folder").map(|e| e.expect("an entry").path());
        let path = files.find(|p: &std::path::PathBuf| p.extension().is_some_and(|e| e == ending));
        std::fs::read(path.expect("a file of the map")).expect("it can be read")
    };
    let (index, tile) = (find("index"), find("tile"));
    let (index_payload, tile_payload) = (&index[MAP_HEAD..], &tile[MAP_HEAD..]);
    let both = [&(index_payload.len() as u16).to_le_bytes()[..], index_payload, tile_payload].concat();
    let ply_path = dir.path().join("map.ply");
    let ply = PlyCloud {
        positions: cloud.positions,
        colors01: cloud.colors01,
        opacities: cloud.opacities,
        scales: cloud.scales,
        quats: cloud.quats,
    };
    write_ply(&ply_path, &ply, [1.0, 2.0, 3.0], &["a note".to_owned()]).expect("a file");
    let csv = b"object_id,stamp_ns,x_m,y_m,z_m,yaw_rad,length_m,width_m,height_m\n1,5,0,1,2,0.5,4,2,1.5\n".to_vec();
    vec![both, index, read(&ply_path), csv]
}

fn read(path: &Path) -> Vec<u8> {
    std::fs::read(path).expect("it was just written")
}

/// The default configuration, pieces of it, and assignments.
pub fn config() -> Vec<Vec<u8>> {
    [
        Config::default().to_yaml().as_str(),
        "window: {stride_sec: 0.25, timesteps: 2}\nmap:\n  spill: no\n",
        "/**:\n  ros__parameters:\n    window:\n      stride_sec: 0.25\n",
        "input: {images: [/a, \"/b\"], base_from_camera: [[0, 0, 0, 1, 0, 0, 0]]}",
        "input: {images: &a [/x], camera_infos: *a}",
        "--set window.stride_sec=0.4",
        "--set input.images=[/a, /b]",
        "--set map.max_mb=18446744073709551615",
    ]
    .iter()
    .map(|t| t.as_bytes().to_vec())
    .collect()
}

/// Two cameras and a pose source at 10 Hz, by both kinds of poses and both ways to ask for windows.
pub fn front() -> Vec<Vec<u8>> {
    (0..4u8)
        .map(|options| {
            let mut b = vec![options];
            for _ in 0..24 {
                // Times: 0x40 and up take a step of milliseconds in two bytes; 0x20 holds the clock.
                b.extend([0x40 | if options & 1 == 0 { 3 } else { 4 }, 100, 0, 1, 9]);
                b.extend([0x60, 0, 0, 0x79, 1, 0]);
            }
            b
        })
        .collect()
}
