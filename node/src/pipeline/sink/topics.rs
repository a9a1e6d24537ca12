//! What is published: one step's clouds, pictures and transforms as messages on their topics.

use std::path::Path;

use anyhow::Result;
use glam::{DVec3, Vec3};
use storm_model::scene::{Affine, RenderedView};

use crate::cdr::encode;
use crate::cdr::schema::MessageType;
use crate::config::Config;
use crate::engine::select;
use crate::map::color01;
use crate::msg::{CameraInfo, Header, Image, PointCloud2, PoseStamped, TransformStamped};
use crate::output::bag_writer::{BagWriter, TopicId};
use crate::output::cloud::{
    FlowCloud, GaussianCloud, MapCloud, NO_TRACK, flow_cloud, gaussian_cloud, map_cloud, non_finite_values,
};
use crate::output::picture::{Picture, mask_overlay};
use crate::output::ply::PlyCloud;
use crate::output::qos::Qos;
use crate::pipeline::step::{Step, newest_time_sec};
use crate::rigid::Rigid;
use crate::source::Rig;

/// Frame of the per-step clouds.
pub const ANCHOR_FRAME: &str = "storm_anchor";
/// Frame of the map cloud and of `map.ply`.
pub const ORIGIN_FRAME: &str = "storm_origin";
/// Prefix of all topics: what `~/` resolves to for a node called storm.
pub const PREFIX: &str = "/storm/output";

struct CameraTopics {
    rendered: TopicId,
    depth: TopicId,
    mask: TopicId,
    mask_color: TopicId,
    info: TopicId,
}

/// Writes the published topics into a bag.
pub struct Publisher {
    bag: BagWriter,
    gaussians: TopicId,
    flow: TopicId,
    map: TopicId,
    path: TopicId,
    tf: TopicId,
    tf_static: TopicId,
    cameras: Vec<CameraTopics>,
    truncated: u64,
    withheld: u64,
    non_finite: u64,
}

/// What became of the values on their way out.
#[derive(Debug, Clone, Copy, Default)]
pub struct Published {
    /// Gaussians the size limit left out.
    pub truncated: u64,
    /// Points that were not finite and were therefore not published.
    pub withheld: u64,
    /// Non-finite values in what was published all the same.
    pub non_finite: u64,
}

impl Publisher {
    /// Starts the bag and declares its topics for `cameras` cameras.
    pub fn create(path: &Path, cameras: usize) -> Result<Self> {
        let mut bag = BagWriter::create(path)?;
        let mut topic = |name: &str, kind: MessageType, qos: Qos| bag.topic(&format!("{PREFIX}/{name}"), kind, qos);
        let gaussians = topic("gaussians", MessageType::PointCloud2, Qos::Reliable)?;
        let flow = topic("flow", MessageType::PointCloud2, Qos::Reliable)?;
        let map = topic("map", MessageType::PointCloud2, Qos::Latched)?;
        let path_topic = topic("trajectory", MessageType::Path, Qos::Reliable)?;
        let mut per_camera = Vec::with_capacity(cameras);
        for i in 0..cameras {
            let mut of = |name: &str, kind| topic(&format!("camera{i}/{name}"), kind, Qos::Reliable);
            per_camera.push(CameraTopics {
                rendered: of("rendered", MessageType::Image)?,
                depth: of("depth", MessageType::Image)?,
                mask: of("motion_mask", MessageType::Image)?,
                mask_color: of("mask_color", MessageType::Image)?,
                info: of("camera_info", MessageType::CameraInfo)?,
            });
        }
        let tf = bag.topic("/tf", MessageType::TfMessage, Qos::Reliable)?;
        let tf_static = bag.topic("/tf_static", MessageType::TfMessage, Qos::Latched)?;
        Ok(Self {
            bag,
            gaussians,
            flow,
            map,
            path: path_topic,
            tf,
            tf_static,
            cameras: per_camera,
            truncated: 0,
            withheld: 0,
            non_finite: 0,
        })
    }

    /// Writes one step.
    pub fn step(&mut self, step: &Step, rig: &Rig, config: &Config) -> Result<()> {
        let stamp_ns = step.window.stamp_ns;
        let header = Header { stamp_ns, frame_id: ANCHOR_FRAME.into() };
        let tf = transform(&config.input.map_frame, ANCHOR_FRAME, stamp_ns, step.window.map_from_anchor);
        self.bag.write(self.tf, stamp_ns, &encode::encode_tf_message(&[tf])?)?;
        let cloud = self.gaussian_message(step, header.clone(), config)?;
        self.bag.write(self.gaussians, stamp_ns, &encode::encode_point_cloud2(&cloud)?)?;
        let cloud = self.flow_message(step, header)?;
        self.bag.write(self.flow, stamp_ns, &encode::encode_point_cloud2(&cloud)?)?;
        for camera in 0..self.cameras.len().min(step.views.len()) {
            self.pictures(step, camera, rig)?;
        }
        Ok(())
    }

    fn gaussian_message(&mut self, step: &Step, header: Header, config: &Config) -> Result<PointCloud2> {
        let (scene, g) = (&step.scene, &step.scene.gaussians);
        let limit = config.output.max_gaussians;
        let (picked, left_out) = select::opaque_enough(g, config.output.min_opacity, limit);
        self.truncated += left_out as u64;
        let time_sec = newest_time_sec(&step.window);
        let exposure = Affine::mean(&scene.affine);
        let pick3 = |from: &[[f32; 3]]| -> Vec<[f32; 3]> { picked.iter().map(|&i| from[i]).collect() };
        let built = gaussian_cloud(
            header,
            &GaussianCloud {
                positions: &picked.iter().map(|&i| g.mean_at(i, time_sec)).collect::<Vec<_>>(),
                colors01: &picked.iter().map(|&i| color01(&exposure.apply(g.colors[i]))).collect::<Vec<_>>(),
                velocities: &pick3(&g.velocity_forward),
                opacities: &picked.iter().map(|&i| g.opacities[i]).collect::<Vec<_>>(),
                scales: &pick3(&g.scales),
                quats: &picked.iter().map(|&i| select::unit_quat(g.quats[i])).collect::<Vec<_>>(),
                motion_ids: &picked.iter().map(|&i| g.motion_id(i)).collect::<Vec<_>>(),
                track_ids: &vec![NO_TRACK; picked.len()],
            },
        )?;
        self.withheld += built.non_finite as u64;
        self.non_finite += non_finite_values(&built.cloud) as u64;
        Ok(built.cloud)
    }

    /// One point per pixel of the newest pictures, cameras stacked: where the surface is and how it moves.
    fn flow_message(&mut self, step: &Step, header: Header) -> Result<PointCloud2> {
        let (shape, g) = (&step.scene.shape, &step.scene.gaussians);
        let range = select::from_step(&step.scene, shape.timesteps - 1);
        let positions = &g.means[range.clone()];
        let velocities = &g.velocity_forward[range.clone()];
        // A pixel that its own Gaussian hardly covers shows the sky.
        let valid: Vec<bool> = g.opacities[range].iter().map(|&o| o >= select::SURFACE_OPACITY).collect();
        let cloud = FlowCloud {
            width: shape.width,
            height: shape.cameras * shape.height,
            positions,
            velocities,
            valid: &valid,
        };
        let built = flow_cloud(header, &cloud)?;
        self.withheld += built.non_finite as u64;
        self.non_finite += non_finite_values(&built.cloud) as u64;
        Ok(built.cloud)
    }

    fn pictures(&mut self, step: &Step, camera: usize, rig: &Rig) -> Result<()> {
        let view = &step.views[camera];
        let newest = &step.window.steps[step.window.steps.len() - 1];
        // The pictures carry their source image's stamp and frame.
        let stamp_ns = newest.frames[camera].stamp_ns;
        let header = Header { stamp_ns, frame_id: rig.cameras[camera].frame_id.clone() };
        let rgb = view.rgb8();
        let mask = motion_mask(view);
        let ids: Vec<u16> = mask.iter().map(|&m| u16::from(m)).collect();
        let over = mask_overlay(&Picture::from_rgb8(view.width, view.height, &rgb)?, &ids)?.as_bytes().to_vec();
        let image = |encoding: &str, bytes_per_pixel: usize, data: Vec<u8>| Image {
            header: header.clone(),
            height: view.height as u32,
            width: view.width as u32,
            encoding: encoding.into(),
            is_bigendian: false,
            step: (view.width * bytes_per_pixel) as u32,
            data,
        };
        let depth = surface_depth(view);
        self.non_finite += depth.iter().filter(|d| !d.is_finite()).count() as u64;
        let depth: Vec<u8> = depth.iter().flat_map(|d| d.to_le_bytes()).collect();
        let topics = &self.cameras[camera];
        let messages = [
            (topics.rendered, encode::encode_image(&image("rgb8", 3, rgb))?),
            (topics.depth, encode::encode_image(&image("32FC1", 4, depth))?),
            (topics.mask, encode::encode_image(&image("mono8", 1, mask))?),
            (topics.mask_color, encode::encode_image(&image("rgb8", 3, over))?),
            (
                topics.info,
                encode::encode_camera_info(&CameraInfo::pinhole(&rig.cameras[camera].intrinsics, header.clone()))?,
            ),
        ];
        for (topic, cdr) in messages {
            self.bag.write(topic, step.window.stamp_ns, &cdr)?;
        }
        Ok(())
    }

    /// Writes the map, its frame, and the trajectory, then the bag's index.
    pub fn finish(
        mut self,
        map: &PlyCloud,
        origin: DVec3,
        poses: &[(i64, Rigid)],
        config: &Config,
    ) -> Result<Published> {
        let stamp_ns = poses.last().map_or(0, |(stamp, _)| *stamp);
        let map_frame = &config.input.map_frame;
        let still = transform(map_frame, ORIGIN_FRAME, stamp_ns, Rigid::new(glam::DQuat::IDENTITY, origin));
        self.bag.write(self.tf_static, stamp_ns, &encode::encode_tf_message(&[still])?)?;
        let built = map_cloud(
            Header { stamp_ns, frame_id: ORIGIN_FRAME.into() },
            &MapCloud {
                positions: &map.positions,
                colors01: &map.colors01,
                opacities: &map.opacities,
                scales: &map.scales,
                quats: &map.quats,
            },
        )?;
        self.withheld += built.non_finite as u64;
        self.non_finite += non_finite_values(&built.cloud) as u64;
        self.bag.write(self.map, stamp_ns, &encode::encode_point_cloud2(&built.cloud)?)?;
        let header = |stamp_ns: i64| Header { stamp_ns, frame_id: map_frame.clone() };
        let pose = |(stamp, pose): &(i64, Rigid)| PoseStamped {
            header: header(*stamp),
            child_frame_id: String::new(),
            pose: *pose,
        };
        let path = crate::msg::Path { header: header(stamp_ns), poses: poses.iter().map(pose).collect() };
        self.bag.write(self.path, stamp_ns, &encode::encode_path(&path)?)?;
        self.bag.finish()?;
        Ok(Published { truncated: self.truncated, withheld: self.withheld, non_finite: self.non_finite })
    }
}

fn transform(parent: &str, child: &str, stamp_ns: i64, parent_from_child: Rigid) -> TransformStamped {
    TransformStamped {
        header: Header { stamp_ns, frame_id: parent.into() },
        child_frame_id: child.into(),
        transform: parent_from_child,
    }
}

/// Rendered z-depth where a surface covers most of the pixel, else 0.
pub fn surface_depth(view: &RenderedView) -> Vec<f32> {
    let covered = |(d, a): (&f32, &f32)| if *a >= select::SURFACE_OPACITY { *d } else { 0.0 };
    view.depth.iter().zip(&view.alpha).map(covered).collect()
}

/// 0 where nothing moves, 1 + motion group (at most 255) where the rendered flow is not gated to zero.
pub fn motion_mask(view: &RenderedView) -> Vec<u8> {
    let pixels = view.width * view.height;
    let moves = |p: usize| view.flow.as_ref().is_some_and(|f| Vec3::from(f[p]).length() >= select::MOVING_MPS);
    let group = |p: usize| view.motion_id.as_ref().map_or(0, |m| m[p]);
    (0..pixels).map(|p| if moves(p) { (group(p) + 1).min(255) as u8 } else { 0 }).collect()
}
