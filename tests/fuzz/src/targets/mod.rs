//! One function per reader: any bytes in, no panic, no endless loop, no memory out of proportion, and what is accepted is
//! sound. They call what the program calls.

mod front;

use std::cell::RefCell;
use std::collections::VecDeque;
use std::path::Path;
use std::sync::{Arc, OnceLock};

use candle_core::Device;
use glam::DVec3;
use storm_model::weights;
use storm_node::bag::Bag;
use storm_node::cdr::decode as cdr_decode;
use storm_node::config::Config;
use storm_node::decode::{
    Codec, Format, Rectifier, RgbPicture, Shows, compressed_to_depth, compressed_to_rgb, image_to_depth,
    image_to_labels, image_to_rgb, image_to_vectors,
};
use storm_node::map::{MapCloud, StaticMap};
use storm_node::msg::{CameraInfo, CompressedImage, Header, Image};
use storm_node::output::objects_csv::read_objects;
use storm_node::output::ply::read_ply;
use storm_node::pipeline::front::Front;
use storm_node::pipeline::posed::PoseStore;
use storm_node::source::bag::BagSource;
use storm_node::source::mount::PoseNames;
use storm_node::source::rig::CameraDescription;
use storm_node::source::translate::{Role, translate};
use storm_node::source::{Event, Rig};
use storm_node::tf::TfTree;
use storm_render::Intrinsics;

pub use front::front;

/// Picture size of the network in these targets.
pub const NETWORK: (usize, usize) = (16, 8);
/// Picture size of the cameras.
pub const CAMERA: (usize, usize) = (32, 16);
/// Encodings the image target draws from.
pub const ENCODINGS: [&str; 24] = [
    "rgb8",
    "bgr8",
    "rgba8",
    "bgra8",
    "rgb16",
    "bgr16",
    "mono8",
    "mono16",
    "8UC4",
    "uyvy",
    "yuyv",
    "bayer_rggb8",
    "bayer_gbrg16",
    "32FC1",
    "16UC1",
    "32FC3",
    "rgba16",
    "16UC3",
    "vyuy",
    "nv12",
    "nv21",
    "nv24",
    "i420",
    "yv12",
];
/// Pictures larger than this are not rectified: that takes time in proportion, which is no finding.
const MOST_PIXELS: usize = 1 << 20;

thread_local! {
    static FOLDER: RefCell<Option<tempfile::TempDir>> = const { RefCell::new(None) };
}

/// Runs `with` in a folder of this thread's own, which it finds as it left it.
fn in_folder<T>(with: impl FnOnce(&Path) -> T) -> T {
    FOLDER.with(|folder| {
        let mut folder = folder.borrow_mut();
        let dir = folder.get_or_insert_with(|| tempfile::tempdir().expect("a temporary folder"));
        with(dir.path())
    })
}

fn write(path: &Path, bytes: &[u8]) {
    std::fs::write(path, bytes).expect("the temporary folder takes a file");
}

/// Takes plain values off the front; zeros when nothing is left.
struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    fn take(&mut self, n: usize) -> &'a [u8] {
        let (head, rest) = self.0.split_at(n.min(self.0.len()));
        self.0 = rest;
        head
    }

    fn array<const N: usize>(&mut self) -> [u8; N] {
        let mut out = [0; N];
        let taken = self.take(N);
        out[..taken.len()].copy_from_slice(taken);
        out
    }

    fn u8(&mut self) -> u8 {
        self.array::<1>()[0]
    }

    fn u16(&mut self) -> u16 {
        u16::from_le_bytes(self.array())
    }

    fn i64(&mut self) -> i64 {
        i64::from_le_bytes(self.array())
    }

    fn f64(&mut self) -> f64 {
        f64::from_le_bytes(self.array())
    }
}

/// A bag file of any storage: what `storm info` and `storm replay` read. Bytes that begin as `metadata.yaml` does are
/// read as that file of a folder with an empty bag.
pub fn bag(data: &[u8]) {
    in_folder(|dir| {
        let folder = dir.join("folder");
        let (path, file) = if data.starts_with(b"rosbag2_bagfile_information") {
            std::fs::create_dir_all(&folder).expect("a folder");
            write(&folder.join("in.mcap"), &empty_mcap());
            (folder.clone(), folder.join("metadata.yaml"))
        } else {
            (dir.join("bag"), dir.join("bag"))
        };
        write(&file, data);
        if let Ok(bag) = Bag::open(&path) {
            let readable: Vec<usize> = (0..bag.topics().len()).filter(|&i| bag.topics()[i].is_readable()).collect();
            let (mut last_ns, mut ordered) = (i64::MIN, true);
            for message in bag.messages(&readable).expect("readable topics can be read").flatten() {
                ordered &= message.log_time_ns >= last_ns;
                assert!(readable.contains(&message.topic));
                last_ns = message.log_time_ns;
            }
            let problems = bag.problems();
            assert!(problems.len() <= 201, "{} problem lines", problems.len());
            let said = problems.iter().any(|line| line.contains("out of order"));
            assert!(ordered || said || problems.len() > 200, "messages come in the order of their times");
        }
        if let Ok(source) = BagSource::open(&path, &Config::default(), NETWORK) {
            let _ = source.events(|_| true);
        }
        let _ = std::fs::remove_dir_all(&folder);
    });
}

fn empty_mcap() -> Vec<u8> {
    let mut writer = mcap::Writer::new(std::io::Cursor::new(Vec::new())).expect("a writer into memory");
    writer.finish().expect("memory takes it");
    writer.into_inner().into_inner()
}

fn header() -> Header {
    Header { stamp_ns: 0, frame_id: "camera".into() }
}

/// Two cameras that look ahead.
fn rig() -> Arc<Rig> {
    static RIG: OnceLock<Arc<Rig>> = OnceLock::new();
    RIG.get_or_init(|| {
        let (width, height) = CAMERA;
        let (cx, cy) = (width as f32 / 2.0, height as f32 / 2.0);
        let intrinsics = Intrinsics { fx: 20.0, fy: 20.0, cx, cy, width, height };
        let described = (0..2).map(|i| CameraDescription {
            topic: format!("/camera{i}/image_rect"),
            info_topic: format!("/camera{i}/camera_info"),
            frame_id: Some("camera".into()),
            info: Some(CameraInfo::pinhole(&intrinsics, header())),
            black_frame: None,
        });
        let mut config = Config::default();
        config.input.base_from_camera = vec![[0.0, 0.0, 0.0, 0.5, -0.5, 0.5, -0.5]; 2];
        let tree = TfTree::new(&config.sync);
        Arc::new(
            Rig::build(described.collect(), &tree, &PoseNames::default(), &config.input, NETWORK).expect("a sound rig"),
        )
    })
    .clone()
}

/// The pose types [`storm_node::cdr::decode::pose`] reads.
pub const POSES: [&str; 4] = [
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/TransformStamped",
];

/// One message through every decoder, and through the translation to events that a bag's and a topic's messages take.
pub fn cdr(data: &[u8]) {
    let _ = cdr_decode::header(data);
    let _ = cdr_decode::point_cloud2(data);
    if let Ok(image) = cdr_decode::image(data) {
        assert!(image.data.len() <= data.len());
    }
    if let Ok(info) = cdr_decode::camera_info(data) {
        rectify(&info);
    }
    let rig = rig();
    let roles = [
        Role::Image { camera: 0, compressed: false },
        Role::Image { camera: 1, compressed: true },
        Role::Transform,
        Role::StaticTransform,
    ];
    let poses = POSES.iter().map(|t| Role::Pose { type_name: (*t).into() });
    let config = Config::default();
    let mut tree = TfTree::new(&config.sync);
    for role in roles.into_iter().chain(poses) {
        let mut front = Front::new(&config, &rig, PoseStore::nothing(&config.sync));
        let mut out = VecDeque::new();
        translate(&rig, &role, "/topic", data, 0, &mut |event| {
            if let Event::Transform(t) | Event::StaticTransform(t) = &event {
                let _ = tree.insert(t, matches!(event, Event::StaticTransform(_)));
                let _ = tree.lookup(&t.header.frame_id, &t.child_frame_id, t.header.stamp_ns);
            }
            front.take(event, &mut out);
        });
        front.finish(&mut out);
    }
}

fn rectify(info: &CameraInfo) {
    for already in [false, true] {
        let Ok(rectifier) = Rectifier::new(info, already, NETWORK.0, NETWORK.1) else { continue };
        let (width, height) = rectifier.source_size();
        let Some(pixels) = width.checked_mul(height).filter(|n| *n <= MOST_PIXELS) else { continue };
        let picture = RgbPicture { width, height, data: vec![9; pixels * 3] };
        let out = rectifier.apply(&picture).expect("a picture of the right size");
        assert_eq!(out.data.len(), NETWORK.0 * NETWORK.1 * 3);
        let k = rectifier.intrinsics();
        assert!([k.fx, k.fy, k.cx, k.cy].iter().all(|x| x.is_finite()), "{k:?}");
    }
}

/// A CompressedImage: the first byte is the length of its `format`, which follows, then its data. TIFF, motion JPEG without
/// tables, compressedDepth and the zstd transport come this way.
pub fn compressed(data: &[u8]) {
    let mut b = Bytes(data);
    let length = usize::from(b.u8());
    let text = String::from_utf8_lossy(b.take(length)).into_owned();
    let format = Format::parse(&text);
    for part in [format.encoding, format.codec_name, format.stored] {
        assert!(text.contains(part), "{part} is not in {text}");
    }
    let message = CompressedImage { header: header(), format: text.clone(), data: b.0.to_vec() };
    if let Ok(p) = compressed_to_rgb(&message) {
        assert_eq!(p.data.len(), p.width * p.height * 3);
        assert!(format.shows() == Shows::Color && format.codec != Codec::Depth, "{text} shows no colour");
    }
    if let Ok(p) = compressed_to_depth(&message) {
        assert_eq!(p.data.len(), p.width * p.height);
        assert!(p.data.iter().all(|z| z.is_nan() || (z.is_finite() && *z > 0.0)));
        assert!(format.shows() == Shows::Depth, "{text} shows no depth");
    }
}

/// A picture: the first byte says whether a file (JPEG, PNG) or raw rows follow.
pub fn image(data: &[u8]) {
    let mut b = Bytes(data);
    let kind = b.u8();
    if kind & 1 == 1 {
        let message = CompressedImage { header: header(), format: "jpeg".into(), data: b.0.to_vec() };
        if let Ok(p) = compressed_to_rgb(&message) {
            assert_eq!(p.data.len(), p.width * p.height * 3);
        }
        return;
    }
    let encoding = ENCODINGS[usize::from(kind >> 1) % ENCODINGS.len()];
    let side = |b: &mut Bytes| match u32::from(b.u16()) {
        // Far sides, which must be refused.
        n if n >= 0xff00 => n << 16,
        n => n,
    };
    let (width, height, step) = (side(&mut b), side(&mut b), side(&mut b));
    let is_bigendian = b.u8() & 1 == 1;
    let encoding = encoding.to_owned();
    let image = Image { header: header(), height, width, encoding, is_bigendian, step, data: b.0.to_vec() };
    let pixels = width as usize * height as usize;
    if let Ok(p) = image_to_rgb(&image) {
        assert_eq!(p.data.len(), pixels * 3);
    }
    if let Ok(p) = image_to_depth(&image) {
        assert_eq!(p.data.len(), pixels);
    }
    if let Ok(p) = image_to_vectors(&image) {
        assert_eq!(p.len(), pixels);
    }
    if let Ok(p) = image_to_labels(&image) {
        assert_eq!(p.len(), pixels);
    }
}

/// Numbers in every storage of a wrapped pickle.
const STORAGE_BYTES: usize = 1024;

/// A weights file: safetensors or a PyTorch checkpoint. A bare pickle is put into a checkpoint first, since no mutation
/// gets a zip's checksums right.
pub fn weights(data: &[u8]) {
    in_folder(|dir| {
        let path = dir.join("weights.pth");
        let pickle = data.first() == Some(&0x80);
        match pickle {
            true => write(&path, &checkpoint(data)),
            false => write(&path, data),
        }
        if let Ok((config, tensors)) = weights::load(&path, None, &Device::Cpu) {
            config.validate().expect("what is loaded is a network");
            assert!(!tensors.is_empty());
        }
    });
}

/// A zip as `torch.save` writes it: stored entries, the pickle first.
pub fn checkpoint(pickle: &[u8]) -> Vec<u8> {
    let zeros = [0u8; STORAGE_BYTES];
    let entries: Vec<(String, &[u8])> = std::iter::once(("a/data.pkl".to_owned(), pickle))
        .chain((0..4).map(|i| (format!("a/data/{i}"), &zeros[..])))
        .collect();
    let (mut out, mut directory) = (Vec::new(), Vec::new());
    for (name, bytes) in &entries {
        let at = out.len() as u32;
        let size = (bytes.len() as u32).to_le_bytes();
        let common = [&[0; 6], &[0; 4][..], &crc32fast::hash(bytes).to_le_bytes(), &size, &size].concat();
        let name_len = (name.len() as u16).to_le_bytes();
        out.extend([b"PK\x03\x04\x14\0".as_slice(), &common[2..], &name_len, &[0; 2], name.as_bytes(), bytes].concat());
        let head = [b"PK\x01\x02\x14\0\x14\0".as_slice(), &common[2..], &name_len, &[0; 12]].concat();
        directory.extend([head.as_slice(), &at.to_le_bytes(), name.as_bytes()].concat());
    }
    let count = (entries.len() as u16).to_le_bytes();
    let (at, len) = ((out.len() as u32).to_le_bytes(), (directory.len() as u32).to_le_bytes());
    out.extend(directory);
    out.extend([b"PK\x05\x06".as_slice(), &[0; 4], &count, &count, &len, &at, &[0; 2]].concat());
    out
}

/// A saved map. `STRMMAPX`: the index alone, as it stands. `ply`: a `map.ply`. `object_id`: an `objects.csv`. Everything
/// else is the payload of an index (its length in two bytes) and of a tile, which get sound heads and checksums first: no
/// mutation finds those.
pub fn map(data: &[u8]) {
    in_folder(|dir| {
        let dir = dir.join("map");
        let _ = std::fs::remove_dir_all(&dir);
        std::fs::create_dir_all(&dir).expect("a folder");
        if data.starts_with(b"ply") || data.starts_with(b"object_id") {
            let path = dir.join("file");
            write(&path, data);
            if let Ok(ply) = read_ply(&path) {
                let c = &ply.cloud;
                assert!(c.positions.iter().flatten().chain(c.scales.iter().flatten()).all(|x| x.is_finite()));
            }
            let _ = read_objects(&path);
            return;
        }
        if data.starts_with(b"STRMMAPX") {
            write(&dir.join("map.index"), data);
        } else {
            let mut b = Bytes(data);
            let len = usize::from(b.u16());
            let (mut index, tile) = (b.take(len).to_vec(), b.0);
            let sealed = seal(b"STRMTILE", tile);
            if let Some(line) = index.get_mut(INDEX_HEAD..INDEX_HEAD + INDEX_LINE) {
                line[24..28].copy_from_slice(&crc32fast::hash(tile).to_le_bytes());
                let word = |at: usize| i32::from_le_bytes([line[at], line[at + 1], line[at + 2], line[at + 3]]);
                let revision = u64::from_le_bytes(std::array::from_fn(|i| line[12 + i]));
                let name = format!("{}_{}_{}.{revision}.tile", word(0), word(4), word(8));
                write(&dir.join(name), &sealed);
            }
            write(&dir.join("map.index"), &seal(b"STRMMAPX", &index));
        }
        for salvage in [false, true] {
            let Ok((map, _)) = StaticMap::open(&dir, salvage) else { continue };
            if let Ok(cloud) = map.cloud_of(1000) {
                sound(&cloud);
            }
            let _ = map.changed_since(0);
            let _ = map.evidence(DVec3::ONE);
        }
    });
}

fn sound(cloud: &MapCloud) {
    let finite = |x: &f32| x.is_finite();
    assert!(cloud.positions.iter().flatten().all(finite), "positions");
    assert!(cloud.scales.iter().flatten().all(finite), "scales");
    assert!(cloud.quats.iter().flatten().all(finite), "quaternions");
    assert!(cloud.opacities.iter().all(finite), "opacities");
    assert!(cloud.colors01.iter().flatten().all(finite), "colours");
}

/// Bytes of an index's payload before its lines, and of a line.
pub const INDEX_HEAD: usize = 56;
const INDEX_LINE: usize = 28;
/// Bytes of a map file's head: magic, version, length, checksum.
pub const MAP_HEAD: usize = 24;

fn seal(magic: &[u8; 8], payload: &[u8]) -> Vec<u8> {
    let (len, crc) = ((payload.len() as u64).to_le_bytes(), crc32fast::hash(payload).to_le_bytes());
    [magic.as_slice(), &1u32.to_le_bytes(), &len, &crc, payload].concat()
}

/// A configuration file; text that begins with `--set ` is an assignment of the command line.
pub fn config(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else { return };
    let config = match text.strip_prefix("--set ") {
        Some(assignment) => Config::default().with_override(assignment),
        None => Config::from_yaml(text),
    };
    if let Ok(config) = config {
        config.validate().expect("what is read was checked");
        let again = Config::from_yaml(&config.to_yaml()).expect("what is written can be read");
        assert_eq!(again, config);
    }
}
