//! A procedural drive written as a bag, ground truth included.
//!
//! | topic | type | what |
//! |---|---|---|
//! | `/camera{i}/image` | Image rgb8 (or `/camera{i}/image/compressed`) | the picture |
//! | `/camera{i}/camera_info` | CameraInfo | pinhole intrinsics, no distortion |
//! | `/odometry` | Odometry | `map_from_base`, at every image stamp and at least 50 times a second |
//! | `/tf_static` | TFMessage | `base_link_from_camera{i}_optical`, latched |
//! | `/ground_truth/camera{i}/depth` | Image 32FC1 | z-depth, metres; 0 is sky |
//! | `/ground_truth/camera{i}/flow` | Image 32FC3 | velocity of the surface in each pixel, m/s, along the map's axes |
//! | `/ground_truth/camera{i}/instance` | Image mono16 | object number, 0 is the static scene |
//! | `/ground_truth/camera{i}/sky`, `/moving` | Image mono8 | 255 where true |
//!
//! Messages lie in order of their stamps, and the same drive and options give the same bytes.

mod schedule;
mod truth;

use std::path::Path;

use glam::{DAffine3, DQuat};
use storm_render::Intrinsics;
use storm_render::world::{Drive, WorldFrame};
use thiserror::Error;

use crate::cdr::encode::{
    encode_camera_info, encode_compressed_image, encode_image, encode_odometry, encode_tf_message,
};
use crate::cdr::schema::MessageType;
use crate::cdr::write::EncodeError;
use crate::msg::{CameraInfo, CompressedImage, Header, Image, PoseStamped, TransformStamped};
use crate::output::OutputError;
use crate::output::bag_metadata::BagSummary;
use crate::output::bag_writer::{BagWriter, TopicId};
use crate::output::qos::Qos;
use crate::rigid::Rigid;
use schedule::{Event, schedule};
pub use truth::TRUTH_PREFIX;
use truth::TruthTopics;

/// Frame the poses are given in.
pub const MAP_FRAME: &str = "map";
/// The vehicle's frame.
pub const BASE_FRAME: &str = "base_link";
/// Least rate of `/odometry`, Hz.
pub const ODOMETRY_HZ: f64 = 50.0;

/// How pictures are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ImageCoding {
    /// `sensor_msgs/Image`, rgb8.
    #[default]
    Raw,
    /// `sensor_msgs/CompressedImage`, PNG (no loss).
    Png,
    /// `sensor_msgs/CompressedImage`, JPEG.
    Jpeg {
        /// 1 (small) to 100 (good).
        quality: u8,
    },
}

/// How a drive is written.
#[derive(Debug, Clone, PartialEq)]
pub struct SynthOptions {
    /// Stamp of the drive's time 0, nanoseconds.
    pub start_stamp_ns: i64,
    /// How pictures are stored.
    pub images: ImageCoding,
    /// Whether the ground-truth topics are written.
    pub ground_truth: bool,
}

impl Default for SynthOptions {
    fn default() -> Self {
        Self { start_stamp_ns: 1_700_000_000_000_000_000, images: ImageCoding::Raw, ground_truth: true }
    }
}

/// Why a drive could not be written.
#[derive(Debug, Error)]
pub enum SynthError {
    /// The bag could not be written.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// A stamp lies outside what a bag can hold.
    #[error("time {time_sec} s after start stamp {start_stamp_ns} ns does not fit a stamp; choose another start stamp")]
    Stamp {
        /// Time of the drive, seconds.
        time_sec: f64,
        /// Stamp of its time 0, nanoseconds.
        start_stamp_ns: i64,
    },
}

impl From<EncodeError> for SynthError {
    fn from(error: EncodeError) -> Self {
        Self::Output(OutputError::Encode(error))
    }
}

/// The optical frame of camera `i`.
pub fn camera_frame(i: usize) -> String {
    format!("camera{i}_optical")
}

/// A rigid glam transform as ours.
fn rigid(t: &DAffine3) -> Rigid {
    Rigid::new(DQuat::from_mat3(&t.matrix3).normalize(), t.translation)
}

/// Intrinsics as ROS states them.
///
/// ROS follows OpenCV, where the centre of the first pixel is 0.0; ours puts it at 0.5, so the principal point moves by
/// half a pixel.
pub fn camera_info(intrinsics: &Intrinsics, header: Header) -> CameraInfo {
    let (fx, fy) = (f64::from(intrinsics.fx), f64::from(intrinsics.fy));
    let (cx, cy) = (f64::from(intrinsics.cx) - 0.5, f64::from(intrinsics.cy) - 0.5);
    CameraInfo {
        header,
        height: intrinsics.height as u32,
        width: intrinsics.width as u32,
        distortion_model: "plumb_bob".into(),
        d: vec![0.0; 5],
        k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        ..CameraInfo::default()
    }
}

/// One picture as the message the options ask for.
fn encode_picture(
    coding: ImageCoding,
    header: Header,
    (width, height): (u32, u32),
    rgb: Vec<u8>,
) -> Result<Vec<u8>, SynthError> {
    use image::ImageEncoder as _;
    use image::codecs::{jpeg::JpegEncoder, png::PngEncoder};
    let color = image::ExtendedColorType::Rgb8;
    let mut file = Vec::new();
    let format = match coding {
        ImageCoding::Raw => {
            let encoding = "rgb8".into();
            let image = Image { header, height, width, encoding, is_bigendian: false, step: 3 * width, data: rgb };
            return Ok(encode_image(&image)?);
        }
        ImageCoding::Png => {
            PngEncoder::new(&mut file).write_image(&rgb, width, height, color).map_err(OutputError::from)?;
            "png"
        }
        ImageCoding::Jpeg { quality } => {
            let encoder = JpegEncoder::new_with_quality(&mut file, quality.clamp(1, 100));
            encoder.write_image(&rgb, width, height, color).map_err(OutputError::from)?;
            "jpeg"
        }
    };
    Ok(encode_compressed_image(&CompressedImage { header, format: format.into(), data: file })?)
}

/// The topics of one camera.
struct CameraTopics {
    image: TopicId,
    info: TopicId,
    truth: Option<TruthTopics>,
}

fn camera_topics(bag: &mut BagWriter, i: usize, options: &SynthOptions) -> Result<CameraTopics, OutputError> {
    let image = match options.images {
        ImageCoding::Raw => bag.topic(&format!("/camera{i}/image"), MessageType::Image, Qos::SensorData)?,
        _ => bag.topic(&format!("/camera{i}/image/compressed"), MessageType::CompressedImage, Qos::SensorData)?,
    };
    let info = bag.topic(&format!("/camera{i}/camera_info"), MessageType::CameraInfo, Qos::SensorData)?;
    let truth = if options.ground_truth { Some(TruthTopics::new(bag, i)?) } else { None };
    Ok(CameraTopics { image, info, truth })
}

fn static_transforms(drive: &Drive, stamp_ns: i64) -> Vec<TransformStamped> {
    let cameras = drive.cameras().iter().enumerate();
    cameras
        .map(|(i, camera)| TransformStamped {
            header: Header { stamp_ns, frame_id: BASE_FRAME.into() },
            child_frame_id: camera_frame(i),
            transform: rigid(&camera.base_from_camera),
        })
        .collect()
}

/// Writes what belongs to one picture.
fn write_picture(
    bag: &mut BagWriter,
    topics: &CameraTopics,
    intrinsics: &Intrinsics,
    header: Header,
    frame: WorldFrame,
    coding: ImageCoding,
) -> Result<(), SynthError> {
    let stamp_ns = header.stamp_ns;
    bag.write(topics.info, stamp_ns, &encode_camera_info(&camera_info(intrinsics, header.clone()))?)?;
    if let Some(truth) = &topics.truth {
        truth.write(bag, &header, &frame)?;
    }
    let size = (frame.width as u32, frame.height as u32);
    bag.write(topics.image, stamp_ns, &encode_picture(coding, header, size, frame.rgb)?).map_err(SynthError::from)
}

/// Writes `drive` as the bag folder `out`; `progress(done, total)` is called after every picture.
///
/// # Errors
/// A stamp that does not fit (found before anything is written), or a bag that cannot be written.
pub fn write_drive(
    drive: &Drive,
    out: &Path,
    options: &SynthOptions,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<BagSummary, SynthError> {
    let images = schedule::image_times(drive, options.start_stamp_ns)?;
    let events = schedule(&images, options.start_stamp_ns)?;
    let mut bag = BagWriter::create_folder(out)?;
    let tf_static = bag.topic("/tf_static", MessageType::TfMessage, Qos::Latched)?;
    let odometry = bag.topic("/odometry", MessageType::Odometry, Qos::Reliable)?;
    let cameras =
        (0..drive.cameras().len()).map(|i| camera_topics(&mut bag, i, options)).collect::<Result<Vec<_>, _>>()?;
    if let Some(first) = events.first() {
        let transforms = static_transforms(drive, first.stamp_ns());
        bag.write(tf_static, first.stamp_ns(), &encode_tf_message(&transforms)?)?;
    }
    let mut upcoming = events.iter().filter_map(|e| match *e {
        Event::Picture { time_sec, camera, .. } => Some((time_sec, camera)),
        Event::Pose { .. } => None,
    });
    // The next picture is rendered while this one is compressed and written.
    let mut render_next = || upcoming.next().map(|(time_sec, camera)| drive.render(camera, time_sec));
    let (mut rendered, mut done) = (render_next(), 0);
    for event in &events {
        match *event {
            Event::Pose { stamp_ns, time_sec } => {
                let header = Header { stamp_ns, frame_id: MAP_FRAME.into() };
                let pose = rigid(&drive.map_from_base(time_sec));
                let message = PoseStamped { header, child_frame_id: BASE_FRAME.into(), pose };
                bag.write(odometry, stamp_ns, &encode_odometry(&message)?)?;
            }
            Event::Picture { stamp_ns, camera, .. } => {
                let header = Header { stamp_ns, frame_id: camera_frame(camera) };
                // Both are there: the schedule was made from this drive's cameras and pictures.
                let (Some(frame), Some(topics)) = (rendered.take(), cameras.get(camera)) else { continue };
                let intrinsics = &drive.cameras()[camera].intrinsics;
                let write = || write_picture(&mut bag, topics, intrinsics, header, frame, options.images);
                let (written, next) = rayon::join(write, &mut render_next);
                written?;
                rendered = next;
                done += 1;
                progress(done, images.len() as u64);
            }
        }
    }
    Ok(bag.finish()?)
}

#[cfg(test)]
mod tests;
