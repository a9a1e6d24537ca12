//! The cameras of a vehicle: where they sit and how their pictures become the network's.

use storm_render::Intrinsics;
use thiserror::Error;
use tracing::{info, warn};

use crate::config::InputConfig;
use crate::decode::{BlackFrame, DecodeError, Rectifier, Validity};
use crate::extrinsics;
use crate::msg;
use crate::rigid::Rigid;
use crate::tf::{TfLookup, TfTree};

use super::masks::{MaskError, Masks};
use super::mount::{self, Mount, MountOrigin, PoseNames};
use super::rectified::Rectified;

/// Vehicle frame assumed when neither the configuration nor the pose message names one (REP 105).
pub const DEFAULT_BASE_FRAME: &str = "base_link";
/// Fixed frame assumed when neither the configuration nor the pose message names one (REP 105).
pub const DEFAULT_MAP_FRAME: &str = "map";

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
    /// The configured fixed frame is not the poses'.
    #[error(
        "input.map_frame is `{wanted}`, but poses are given in `{given}` and no transform connects the two ({detail}); leave input.map_frame empty to use `{given}`"
    )]
    MapFrame {
        /// Frame of the configuration.
        wanted: String,
        /// Frame of the poses.
        given: String,
        /// What the tree said.
        detail: String,
    },
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
    /// Mounting, optical frame in the vehicle frame (of the rectified camera); of a joint at one of its positions.
    pub base_from_camera: Rigid,
    /// The mounting with where it is from.
    pub mount: Mount,
    /// What was decided about rectification.
    pub rectified: Rectified,
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

impl CameraDescription {
    /// The optical frame: the pictures' own, else the CameraInfo's; empty when neither names one.
    pub fn frame(&self) -> String {
        let own = self.frame_id.clone().filter(|frame| !frame.is_empty());
        own.or_else(|| self.info.as_ref().map(|info| info.header.frame_id.clone())).unwrap_or_default()
    }
}

/// All cameras, in the network's order.
pub struct Rig {
    /// The cameras.
    pub cameras: Vec<RigCamera>,
    /// The one windows are anchored at.
    pub reference: usize,
    /// Vehicle frame.
    pub base_frame: String,
    /// Fixed frame of all outputs.
    pub map_frame: String,
    /// The frame poses are given in, when it is another one that the tree leads to [`Self::map_frame`] from.
    pub pose_frame: Option<String>,
    /// Messages go by the times of recording (live: of arrival) instead of their headers' stamps.
    pub stamps_recorded: bool,
}

impl Rig {
    /// Intrinsics of the network's pictures, per camera.
    pub fn intrinsics(&self) -> Vec<Intrinsics> {
        self.cameras.iter().map(|c| c.intrinsics).collect()
    }

    /// True when the tree must be kept although poses have a topic of their own: for joints, or for the poses' frame.
    pub fn needs_tree(&self) -> bool {
        self.pose_frame.is_some() || self.cameras.iter().any(|c| c.mount.joint.is_some())
    }

    /// The vehicle frame: configured, named by the pose, or the usual one.
    pub fn vehicle_frame(config: &InputConfig, pose: &PoseNames) -> String {
        first_named([config.base_frame.as_str(), &pose.child, DEFAULT_BASE_FRAME])
    }

    /// Brings together what the recording (or the live topics) said and what the configuration says. `tree` holds all
    /// transforms heard so far; `width` and `height` are the network's.
    ///
    /// # Errors
    /// A camera that is not described or whose numbers cannot be used, a mounting nobody gives, frames that do not fit.
    pub fn build(
        described: Vec<CameraDescription>,
        tree: &TfTree,
        pose: &PoseNames,
        config: &InputConfig,
        (width, height): (usize, usize),
    ) -> Result<Self, RigError> {
        let n = described.len();
        let for_all = if config.rectified.values() == 1 { 0 } else { config.rectified.values() };
        for (key, given) in [
            ("input.base_from_camera", config.base_from_camera.len()),
            ("input.image_time_offset_sec", config.image_time_offset_sec.len()),
            ("input.rectified", for_all),
        ] {
            if given != 0 && given != n {
                return Err(RigError::Count { key, given, cameras: n });
            }
        }
        let base_frame = Self::vehicle_frame(config, pose);
        let (map_frame, pose_frame) = fixed_frame(tree, pose, config)?;
        let names_base = !(pose.child.is_empty() && config.base_frame.is_empty());
        let topics: Vec<&str> = described.iter().map(|d| d.topic.as_str()).collect();
        let masks = Masks::read(&config.masks, &topics)?;
        let (mut cameras, mut mounts, mut offsets) = (Vec::with_capacity(n), Vec::new(), Vec::new());
        for (camera, d) in described.into_iter().enumerate() {
            let frame = d.frame();
            let CameraDescription { topic, info_topic, frame_id, info, black_frame } = d;
            let Some(info) = info else { return Err(RigError::NoInfo { camera, topic, info_topic }) };
            let Some(frame_id) = frame_id else { return Err(RigError::NoImage { camera, topic }) };
            let rectified = Rectified::decide(&info, &topic, config.rectified.of(camera));
            let rectifier = Rectifier::new(&info, rectified.already, width, height)
                .map_err(|source| RigError::Info { camera, topic: topic.clone(), source })?;
            let no_mount = |frame: &str, detail| RigError::NoMount {
                camera,
                base: base_frame.clone(),
                frame: frame.into(),
                detail,
            };
            let mut mount = match config.base_from_camera.get(camera) {
                Some(m) => Mount {
                    base_from_frame: extrinsics::base_from_camera(m).map_err(|e| no_mount("", e.to_string()))?,
                    frame_from_view: Rigid::IDENTITY,
                    joint: None,
                    origin: MountOrigin::Configured,
                    baseline: None,
                },
                None => mount::find(tree, &base_frame, &frame, names_base, n == 1)
                    .map_err(|detail| no_mount(&frame, detail))?,
            };
            // On raw images the rectifier turns the camera; the mounting follows it.
            if let Some(rectified_from_camera) = rectifier.rectification() {
                mount.frame_from_view = Rigid::new(rectified_from_camera, glam::DVec3::ZERO).inverse();
            }
            let (base_from_camera, intrinsics) = (mount.base_from_camera(), rectifier.intrinsics());
            let black_frame = black_frame.filter(|_| config.find_black_frame);
            let validity = masks.validity(camera, &topic, &rectifier, black_frame.as_ref())?;
            let black_frame = black_frame.map_or_else(String::new, |frame| frame.describe());
            mounts.push(mount.clone());
            offsets.push(mount::offset_in_p(&info));
            cameras.push(RigCamera {
                topic,
                frame_id,
                base_from_camera,
                mount,
                rectified,
                rectifier,
                intrinsics,
                validity,
                black_frame,
            });
        }
        mount::use_baselines(&mut mounts, &offsets);
        for (camera, mount) in cameras.iter_mut().zip(mounts) {
            camera.base_from_camera = mount.base_from_camera();
            camera.mount = mount;
        }
        let mounts: Vec<Rigid> = cameras.iter().map(|c| c.base_from_camera).collect();
        let configured = usize::try_from(config.reference_camera).ok().filter(|&i| i < n);
        let reference = configured.or_else(|| extrinsics::reference_camera(&mounts)).unwrap_or(0);
        // A pose taken as the camera's own is of the camera's frame.
        let base_frame = match cameras.first() {
            Some(c) if c.mount.origin == MountOrigin::Assumed => first_named([c.frame_id.as_str(), &base_frame]),
            _ => base_frame,
        };
        let stamps_recorded = config.stamps == "recorded";
        Ok(Self { cameras, reference, base_frame, map_frame, pose_frame, stamps_recorded })
    }

    /// Says once for each camera what was decided, and what is doubtful. `size` is width and height of the network's pictures.
    pub fn log(&self, size: (usize, usize)) {
        self.lines(size).iter().for_each(|line| info!("{line}"));
        self.warnings().iter().for_each(|line| warn!("{line}"));
    }

    /// What is doubtful about the cameras, one sentence each with what to set.
    pub fn warnings(&self) -> Vec<String> {
        let mounts: Vec<Mount> = self.cameras.iter().map(|c| c.mount.clone()).collect();
        let mut warnings: Vec<String> = mount::coinciding(&mounts)
            .into_iter()
            .map(|(a, b)| {
                format!(
                    "cameras {a} ({}) and {b} ({}) are at one place and look one way: their baseline is missing in P, the \
                     transforms or input.base_from_camera",
                    self.cameras[a].topic, self.cameras[b].topic
                )
            })
            .collect();
        for (i, camera) in self.cameras.iter().enumerate().filter(|(_, c)| c.mount.origin == MountOrigin::Assumed) {
            warnings.push(format!(
                "camera {i} ({}): no transform says where it is mounted and the poses name no frame, so they are taken as \
                 the camera's own (x right, y down, z ahead); if they are the vehicle's, set input.base_from_camera",
                camera.topic
            ));
        }
        warnings
    }

    /// The cameras for people; `size` is width and height of the network's pictures.
    pub fn lines(&self, (width, height): (usize, usize)) -> Vec<String> {
        let mut lines = Vec::new();
        for (i, c) in self.cameras.iter().enumerate() {
            let (w, h) = c.rectifier.source_size();
            let mark = if i == self.reference { ", the anchor's" } else { "" };
            let (rectified, mount) = (c.rectified.line(), c.mount.line());
            lines.push(format!(
                "camera {i}: {} ({w}x{h} to {width}x{height}{mark}); {rectified}; frame {} {mount}",
                c.topic, c.frame_id
            ));
            if c.validity.is_some() && !c.black_frame.is_empty() {
                lines.push(format!(
                    "camera {i} ({}): {} are black in every image and are left out",
                    c.topic, c.black_frame
                ));
            }
            if c.validity.is_some() {
                let percent = 100.0 * c.masked_share();
                lines.push(format!(
                    "camera {i} ({}): {percent:.1} % of the pixels show nothing and take no part",
                    c.topic
                ));
            }
        }
        lines
    }
}

/// The first name that is not empty, without a leading slash.
fn first_named<const N: usize>(names: [&str; N]) -> String {
    names.into_iter().map(|n| n.trim_start_matches('/')).find(|n| !n.is_empty()).unwrap_or_default().to_owned()
}

/// The fixed frame, and the frame poses are given in where the tree must lead from it to the fixed one.
fn fixed_frame(tree: &TfTree, pose: &PoseNames, config: &InputConfig) -> Result<(String, Option<String>), RigError> {
    let given = first_named([&pose.frame]);
    let fixed = first_named([&config.map_frame, &given, DEFAULT_MAP_FRAME]);
    if given.is_empty() || given == fixed {
        return Ok((fixed, None));
    }
    if tree.link(&fixed, &given).is_some() {
        return Ok((fixed, Some(given)));
    }
    let detail = match tree.lookup(&fixed, &given, 0) {
        TfLookup::Wait(problem) | TfLookup::Never(problem) => problem.to_string(),
        TfLookup::At(_) => "its transform has no sample".into(),
    };
    Err(RigError::MapFrame { wanted: fixed, given, detail })
}
