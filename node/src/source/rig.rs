//! The cameras of a vehicle: where they sit and how their pictures become the network's.

use storm_render::Intrinsics;
use thiserror::Error;
use tracing::info;

use crate::config::InputConfig;
use crate::decode::{BlackFrame, DecodeError, Rectifier, Validity};
use crate::extrinsics;
use crate::msg;
use crate::rigid::Rigid;
use crate::tf::{TfLookup, TfTree};

use super::masks::{MaskError, Masks};

/// Vehicle frame assumed when neither the configuration nor the pose message names one (REP 105).
pub const DEFAULT_BASE_FRAME: &str = "base_link";

/// What is wrong with a camera's description.
#[derive(Debug, Error)]
pub enum RigError {
    /// A camera gave no CameraInfo.
    #[error(
        "camera {camera} ({topic}): no message on its camera_info topic {info_topic}; without intrinsics it cannot be used"
    )]
    NoInfo {
        /// Camera index.
        camera: usize,
        /// Image topic.
        topic: String,
        /// CameraInfo topic.
        info_topic: String,
    },
    /// A camera gave no image.
    #[error("camera {camera} ({topic}): no readable image")]
    NoImage {
        /// Camera index.
        camera: usize,
        /// Image topic.
        topic: String,
    },
    /// A camera's intrinsics cannot be used.
    #[error("camera {camera} ({topic}): {source}")]
    Info {
        /// Camera index.
        camera: usize,
        /// Image topic.
        topic: String,
        /// Why.
        source: DecodeError,
    },
    /// Nobody says where a camera is mounted.
    #[error(
        "camera {camera}: nothing says where its frame '{frame}' sits on {base} ({detail}); set input.base_from_camera, or input.base_frame if the vehicle frame has another name"
    )]
    NoMount {
        /// Camera index.
        camera: usize,
        /// Vehicle frame.
        base: String,
        /// Camera's optical frame.
        frame: String,
        /// What the tree said.
        detail: String,
    },
    /// A mask of `input.masks` cannot be used.
    #[error(transparent)]
    Mask(#[from] MaskError),
    /// The configuration has more or fewer mountings than there are cameras.
    #[error("{key} has {given} entries for {cameras} cameras")]
    Count {
        /// The configuration key.
        key: &'static str,
        /// Entries given.
        given: usize,
        /// Cameras found.
        cameras: usize,
    },
}

/// One camera.
pub struct RigCamera {
    /// Name used in output topics and the report: its image topic.
    pub topic: String,
    /// Optical frame.
    pub frame_id: String,
    /// Mounting, optical frame in the vehicle frame (of the rectified camera).
    pub base_from_camera: Rigid,
    /// Turns its pictures into the network's.
    pub rectifier: Rectifier,
    /// Intrinsics of the network's picture.
    pub intrinsics: Intrinsics,
    /// Pixels of the network's picture that show something; none: all do.
    pub validity: Option<Validity>,
    /// The black frame of its images, for people; empty: there is none.
    pub black_frame: String,
}

impl RigCamera {
    /// Share of the network's picture that shows nothing, 0 to 1.
    pub fn masked_share(&self) -> f64 {
        self.validity.as_ref().map_or(0.0, Validity::masked_share)
    }
}

/// What is known about a camera before its mounting is looked up.
pub struct CameraDescription {
    /// Image topic.
    pub topic: String,
    /// CameraInfo topic.
    pub info_topic: String,
    /// Optical frame of its images; `None` when it gave none.
    pub frame_id: Option<String>,
    /// Its CameraInfo; `None` when there was none.
    pub info: Option<msg::CameraInfo>,
    /// The black frame of its first images, where there is one.
    pub black_frame: Option<BlackFrame>,
}

/// All cameras, in the network's order.
pub struct Rig {
    /// The cameras.
    pub cameras: Vec<RigCamera>,
    /// The one windows are anchored at.
    pub reference: usize,
    /// Vehicle frame.
    pub base_frame: String,
}

impl Rig {
    /// Intrinsics of the network's pictures, per camera.
    pub fn intrinsics(&self) -> Vec<Intrinsics> {
        self.cameras.iter().map(|c| c.intrinsics).collect()
    }

    /// Brings together what the recording (or the live topics) said and what the configuration says.
    /// `pose_child` is the frame the pose message is of, empty when it names none; `width` and `height` are the network's.
    pub fn build(
        described: Vec<CameraDescription>,
        tree: &TfTree,
        pose_child: &str,
        config: &InputConfig,
        (width, height): (usize, usize),
    ) -> Result<Self, RigError> {
        let n = described.len();
        for (key, given) in [
            ("input.base_from_camera", config.base_from_camera.len()),
            ("input.image_time_offset_sec", config.image_time_offset_sec.len()),
        ] {
            if given != 0 && given != n {
                return Err(RigError::Count { key, given, cameras: n });
            }
        }
        let base_frame = [config.base_frame.as_str(), pose_child, DEFAULT_BASE_FRAME]
            .into_iter()
            .find(|f| !f.is_empty())
            .unwrap_or(DEFAULT_BASE_FRAME)
            .trim_start_matches('/')
            .to_string();
        let topics: Vec<&str> = described.iter().map(|d| d.topic.as_str()).collect();
        let masks = Masks::read(&config.masks, &topics)?;
        let mut cameras = Vec::with_capacity(n);
        for (camera, d) in described.into_iter().enumerate() {
            let CameraDescription { topic, info_topic, frame_id, info, black_frame } = d;
            let Some(info) = info else { return Err(RigError::NoInfo { camera, topic, info_topic }) };
            let Some(frame_id) = frame_id else { return Err(RigError::NoImage { camera, topic }) };
            let rectified = is_rectified(&topic, &config.rectified);
            let rectifier = Rectifier::new(&info, rectified, width, height).map_err(|source| RigError::Info {
                camera,
                topic: topic.clone(),
                source,
            })?;
            let mount = match config.base_from_camera.get(camera) {
                Some(m) => {
                    extrinsics::base_from_camera(m).map_err(|e| no_mount(camera, &base_frame, "", e.to_string()))?
                }
                None => {
                    let frame = if frame_id.is_empty() { info.header.frame_id.clone() } else { frame_id.clone() };
                    mount_from_tree(tree, camera, &base_frame, &frame)?
                }
            };
            // On raw images the rectifier turns the camera; the mounting follows it.
            let base_from_camera = match rectifier.rectification() {
                Some(rectified_from_camera) => mount * Rigid::new(rectified_from_camera, glam::DVec3::ZERO).inverse(),
                None => mount,
            };
            let intrinsics = rectifier.intrinsics();
            let black_frame = black_frame.filter(|_| config.find_black_frame);
            let validity = masks.validity(camera, &topic, &rectifier, black_frame.as_ref())?;
            let black_frame = black_frame.map_or_else(String::new, |frame| frame.describe());
            cameras.push(RigCamera { topic, frame_id, base_from_camera, rectifier, intrinsics, validity, black_frame });
        }
        let mounts: Vec<Rigid> = cameras.iter().map(|c| c.base_from_camera).collect();
        let configured = usize::try_from(config.reference_camera).ok().filter(|&i| i < n);
        let reference = configured.or_else(|| extrinsics::reference_camera(&mounts)).unwrap_or(0);
        let rig = Self { cameras, reference, base_frame };
        rig.say_masked();
        Ok(rig)
    }

    /// Says which pixels are left out.
    fn say_masked(&self) {
        for (i, camera) in self.cameras.iter().enumerate().filter(|(_, c)| c.validity.is_some()) {
            if !camera.black_frame.is_empty() {
                info!(
                    "camera {i} ({}): {} are black in every image and are left out",
                    camera.topic, camera.black_frame
                );
            }
            let percent = 100.0 * camera.masked_share();
            info!("camera {i} ({}): {percent:.1} % of the pixels show nothing and take no part", camera.topic);
        }
    }
}

fn is_rectified(topic: &str, setting: &str) -> bool {
    match setting {
        "yes" => true,
        "no" => false,
        _ => topic.contains("rect"),
    }
}

fn no_mount(camera: usize, base: &str, frame: &str, detail: String) -> RigError {
    RigError::NoMount { camera, base: base.into(), frame: frame.into(), detail }
}

fn mount_from_tree(tree: &TfTree, camera: usize, base: &str, frame: &str) -> Result<Rigid, RigError> {
    let failed = |detail: String| no_mount(camera, base, frame, detail);
    // Static transforms hold at all times, so any stamp will do.
    match tree.lookup(base, frame, 0) {
        TfLookup::At(t) => Ok(t),
        TfLookup::Wait(problem) | TfLookup::Never(problem) => Err(failed(problem.to_string())),
    }
}
