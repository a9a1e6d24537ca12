//! What is published, as messages: a step's clouds, pictures and transforms, the map, the path. A replay writes them into
//! `outputs.mcap` and a live node sends them, so both are the same by construction.

use glam::{DQuat, DVec3, Vec3};
use storm_model::scene::{Affine, RenderedView};

use crate::config::Config;
use crate::engine::select;
use crate::gate::predict::PixelFlow;
use crate::map::{TileIndex, color01};
use crate::msg::{CameraInfo, Header, Image, Path, PointCloud2, PoseStamped, TransformStamped};
use crate::output::OutputError;
use crate::output::cloud::{
    BuiltCloud, FlowCloud, GaussianCloud, MapCloud, NO_TRACK, flow_cloud, gaussian_cloud, map_cloud, non_finite_values,
};
use crate::output::cloud_live::tile_cloud;
use crate::output::picture::{Picture, mask_overlay};
use crate::rigid::Rigid;
use crate::source::rig::RigCamera;

use super::step::{Step, newest_time_sec};

/// Frame of the per-step clouds.
pub const ANCHOR_FRAME: &str = "storm_anchor";
/// Frame of the map cloud and of `map.ply`.
pub const ORIGIN_FRAME: &str = "storm_origin";

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

impl Published {
    fn counted(&mut self, built: BuiltCloud) -> PointCloud2 {
        self.withheld += built.non_finite as u64;
        self.non_finite += non_finite_values(&built.cloud) as u64;
        built.cloud
    }
}

/// Header of a step's clouds.
pub fn anchor_header(step: &Step) -> Header {
    Header { stamp_ns: step.window.stamp_ns, frame_id: ANCHOR_FRAME.into() }
}

/// Where a step's clouds lie in the map.
pub fn anchor_transform(step: &Step, map_frame: &str) -> TransformStamped {
    transform(map_frame, ANCHOR_FRAME, step.window.stamp_ns, step.window.map_from_anchor)
}

/// Where the map cloud lies in the map frame.
pub fn origin_transform(map_frame: &str, stamp_ns: i64, origin: DVec3) -> TransformStamped {
    transform(map_frame, ORIGIN_FRAME, stamp_ns, Rigid::new(DQuat::IDENTITY, origin))
}

fn transform(parent: &str, child: &str, stamp_ns: i64, parent_from_child: Rigid) -> TransformStamped {
    TransformStamped {
        header: Header { stamp_ns, frame_id: parent.into() },
        child_frame_id: child.into(),
        transform: parent_from_child,
    }
}

/// All Gaussians of a step's window, moved to its newest stamp.
pub fn gaussians(step: &Step, config: &Config, counts: &mut Published) -> Result<PointCloud2, OutputError> {
    let (scene, g) = (&step.scene, &step.scene.gaussians);
    let limit = config.output.max_gaussians;
    let (picked, left_out) = select::opaque_enough(g, config.output.min_opacity, limit);
    counts.truncated += left_out as u64;
    let time_sec = newest_time_sec(&step.window);
    let exposure = Affine::mean(&scene.affine);
    let pick3 = |from: &[[f32; 3]]| -> Vec<[f32; 3]> { picked.iter().map(|&i| from[i]).collect() };
    let cloud = GaussianCloud {
        positions: &picked.iter().map(|&i| g.mean_at(i, time_sec)).collect::<Vec<_>>(),
        colors01: &picked.iter().map(|&i| color01(&exposure.apply(g.colors[i]))).collect::<Vec<_>>(),
        velocities: &pick3(&g.velocity_forward),
        opacities: &picked.iter().map(|&i| g.opacities[i]).collect::<Vec<_>>(),
        scales: &pick3(&g.scales),
        quats: &picked.iter().map(|&i| select::unit_quat(g.quats[i])).collect::<Vec<_>>(),
        motion_ids: &picked.iter().map(|&i| g.motion_id(i)).collect::<Vec<_>>(),
        track_ids: &vec![NO_TRACK; picked.len()],
    };
    Ok(counts.counted(gaussian_cloud(anchor_header(step), &cloud)?))
}

/// One point per pixel of the newest pictures, cameras stacked: where the surface is and how it moves.
pub fn flow(step: &Step, counts: &mut Published) -> Result<PointCloud2, OutputError> {
    let (shape, g) = (&step.scene.shape, &step.scene.gaussians);
    let (width, height) = (shape.width, shape.cameras * shape.height);
    if let Some(PixelFlow { positions, velocities, valid }) = &step.pixels {
        let cloud = FlowCloud { width, height, positions, velocities, valid };
        return Ok(counts.counted(flow_cloud(anchor_header(step), &cloud)?));
    }
    let range = select::from_step(&step.scene, shape.timesteps - 1);
    // A pixel that its own Gaussian hardly covers shows the sky.
    let shows = |i: usize| g.opacities[i] >= select::SURFACE_OPACITY && step.scene.is_valid(i);
    let valid: Vec<bool> = range.clone().map(shows).collect();
    let cloud = FlowCloud {
        width,
        height,
        positions: &g.means[range.clone()],
        velocities: &g.velocity_forward[range],
        valid: &valid,
    };
    Ok(counts.counted(flow_cloud(anchor_header(step), &cloud)?))
}

/// One camera's pictures of a step, made as they are asked for. They carry their source image's stamp and frame.
pub struct Pictures<'a> {
    view: &'a RenderedView,
    header: Header,
    camera: &'a RigCamera,
}

impl<'a> Pictures<'a> {
    /// Of view number `view` of the step, which `camera` took; none when the step has no such view.
    pub fn new(step: &'a Step, view: usize, camera: &'a RigCamera) -> Option<Self> {
        let stamp_ns = step.window.steps.last()?.frames.get(view)?.stamp_ns;
        let header = Header { stamp_ns, frame_id: camera.frame_id.clone() };
        Some(Self { view: step.views.get(view)?, header, camera })
    }

    fn image(&self, encoding: &str, bytes_per_pixel: usize, data: Vec<u8>) -> Image {
        Image {
            header: self.header.clone(),
            height: self.view.height as u32,
            width: self.view.width as u32,
            encoding: encoding.into(),
            is_bigendian: false,
            step: (self.view.width * bytes_per_pixel) as u32,
            data,
        }
    }

    /// The newest picture as the model sees it, rgb8.
    pub fn rendered(&self) -> Image {
        self.image("rgb8", 3, self.view.rgb8())
    }

    /// z-depth, 32FC1, metres; 0: no surface.
    pub fn depth(&self, counts: &mut Published) -> Image {
        let depth = surface_depth(self.view);
        counts.non_finite += depth.iter().filter(|d| !d.is_finite()).count() as u64;
        self.image("32FC1", 4, depth.iter().flat_map(|d| d.to_le_bytes()).collect())
    }

    /// 0 still, 1 + motion group where the surface moves, mono8.
    pub fn motion_mask(&self) -> Image {
        self.image("mono8", 1, motion_mask(self.view))
    }

    /// The mask over the picture, rgb8.
    pub fn mask_color(&self) -> Result<Image, OutputError> {
        let ids: Vec<u16> = motion_mask(self.view).iter().map(|&m| u16::from(m)).collect();
        let under = Picture::from_rgb8(self.view.width, self.view.height, &self.view.rgb8())?;
        Ok(self.image("rgb8", 3, mask_overlay(&under, &ids)?.as_bytes().to_vec()))
    }

    /// CameraInfo of all of them.
    pub fn camera_info(&self) -> CameraInfo {
        CameraInfo::pinhole(&self.camera.intrinsics, self.header.clone())
    }
}

/// Map Gaussians, frame [`ORIGIN_FRAME`].
pub fn map(stamp_ns: i64, cloud: &MapCloud, counts: &mut Published) -> Result<PointCloud2, OutputError> {
    Ok(counts.counted(map_cloud(Header { stamp_ns, frame_id: ORIGIN_FRAME.into() }, cloud)?))
}

/// Changed tiles of the map, frame [`ORIGIN_FRAME`]: each is here whole and replaces what was known of it.
pub fn map_update(
    stamp_ns: i64,
    tile_m: f64,
    tiles: &[(TileIndex, crate::map::MapCloud)],
    counts: &mut Published,
) -> Result<PointCloud2, OutputError> {
    let header = Header { stamp_ns, frame_id: ORIGIN_FRAME.into() };
    let corner = |tile: &TileIndex| tile.map(|i| (f64::from(i) * tile_m) as f32);
    Ok(counts.counted(tile_cloud(header, tiles, corner)?))
}

/// The vehicle's poses so far, stamped with the last one.
pub fn path(map_frame: &str, poses: &[(i64, Rigid)]) -> Path {
    let header = |stamp_ns: i64| Header { stamp_ns, frame_id: map_frame.into() };
    let pose = |(stamp, pose): &(i64, Rigid)| PoseStamped {
        header: header(*stamp),
        child_frame_id: String::new(),
        pose: *pose,
    };
    Path { header: header(poses.last().map_or(0, |(stamp, _)| *stamp)), poses: poses.iter().map(pose).collect() }
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
