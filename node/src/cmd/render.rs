//! `storm render`: a saved map, or one step of a replay, from any pose at any time.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use glam::{DQuat, DVec3, EulerRot, Vec3};
use storm_render::raster::{Channels, CpuRasterizer, Loaded, Motion, Picture as RasterPicture, RasterSettings, Splats};
use storm_render::{Intrinsics, Renderer, View};

use super::{Outcome, UsageError};
use crate::engine::select::MOVING_MPS;
use crate::map::StaticMap;
use crate::output::picture::{
    DepthScale, Picture, depth_picture, flow_picture, mask_overlay, with_depth_bar, with_flow_wheel,
};
use crate::output::tum::read_tum;
use crate::rigid::Rigid;
use crate::saved::{self, MapPlace, SavedGaussians, SavedObject};

/// Coverage from which a pixel shows a surface.
const SURFACE_ALPHA: f32 = 0.5;
/// Speed at which the flow picture is fully saturated, m/s.
const FULL_SPEED_MPS: f32 = 15.0;

/// Arguments of `storm render`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// A results folder (its map, or with --step one of its steps), its map/, or a PLY.
    map: PathBuf,
    /// Camera pose in the map frame: X,Y,Z,YAW[,PITCH] (m, degrees; yaw 0 looks along x, pitch up is positive), or X,Y,Z,QW,QX,QY,QZ
    /// of a body with x forward, y left, z up.
    #[arg(long, allow_hyphen_values = true, value_parser = parse_pose, required_unless_present = "trajectory")]
    pose: Option<Rigid>,
    /// Draw from every pose of a TUM file instead (timestamp x y z qx qy qz qw, such as a results folder's trajectory.tum).
    #[arg(long, conflicts_with = "pose")]
    trajectory: Option<PathBuf>,
    /// Height of the camera above the poses of --trajectory, metres.
    #[arg(long, default_value_t = 1.6, allow_hyphen_values = true)]
    height_m: f64,
    /// Picture to write (PNG); with --trajectory a folder for 000000.png, 000001.png, ...
    #[arg(long)]
    out: PathBuf,
    /// Draw this step's Gaussians (from outputs.mcap, numbered from 0) instead of the map.
    #[arg(long)]
    step: Option<usize>,
    /// Seconds after the step's stamp; Gaussians move with their velocities. Negative looks back.
    #[arg(long, default_value_t = 0.0, allow_hyphen_values = true)]
    time: f32,
    /// What to draw.
    #[arg(long, default_value = "color")]
    what: What,
    /// Moving things. Of a results folder's map they are its objects, drawn where they were at the time of each pose of
    /// --trajectory, or at --at; of a step (--step) they are its fast Gaussians. [default: remove for a map, keep for a step]
    #[arg(long)]
    objects: Option<Objects>,
    /// With --objects and --pose: seconds after the recording's first pose (trajectory.tum).
    #[arg(long, requires = "objects", allow_hyphen_values = true)]
    at: Option<f64>,
    /// What draws: cpu, or wgpu (any GPU; a build with --features wgpu).
    #[arg(long, default_value = "cpu", value_parser = ["cpu", "wgpu"])]
    device: String,
    /// Picture width, pixels.
    #[arg(long, default_value_t = 960)]
    width: usize,
    /// Picture height, pixels.
    #[arg(long, default_value_t = 640)]
    height: usize,
    /// Horizontal field of view, degrees.
    #[arg(long, default_value_t = 60.0)]
    fov: f32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum What {
    /// Colours.
    Color,
    /// z-depth with a colour bar.
    Depth,
    /// Velocity with its wheel.
    Flow,
    /// Motion groups over the colours.
    Mask,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Objects {
    /// Everything: what stands, and what moves where it was.
    Keep,
    /// What stands alone.
    Remove,
    /// What moves alone.
    Only,
}

fn parse_pose(text: &str) -> Result<Rigid, String> {
    let wrong = || format!("'{text}' is not X,Y,Z,YAW[,PITCH] or X,Y,Z,QW,QX,QY,QZ with finite numbers");
    let n: Vec<f64> = text.split(',').map(|p| p.trim().parse().unwrap_or(f64::NAN)).collect();
    if !n.iter().all(|x| x.is_finite()) {
        return Err(wrong());
    }
    let rotation = match n.as_slice() {
        [_, _, _, yaw] => DQuat::from_rotation_z(yaw.to_radians()),
        [_, _, _, yaw, pitch] => DQuat::from_euler(EulerRot::ZYX, yaw.to_radians(), -pitch.to_radians(), 0.0),
        [_, _, _, w, x, y, z] => DQuat::from_xyzw(*x, *y, *z, *w),
        _ => return Err(wrong()),
    };
    Rigid::new(rotation, DVec3::new(n[0], n[1], n[2])).normalized().ok_or_else(wrong)
}

/// Draws the picture.
pub fn run(args: &Args) -> Result<Outcome> {
    if !(args.fov > 1.0 && args.fov < 170.0) {
        return Err(UsageError(format!("--fov {}: wants 1 to 170 degrees", args.fov)).into());
    }
    let saved = load(&args.map, args.step)?;
    let scene = Scenery::new(args, saved)?;
    let intrinsics = Intrinsics::from_fov(args.fov, args.width, args.height);
    let mut raster = renderer(&args.device)?;
    tracing::info!("drawing on {}", raster.describe());
    let mut ready = None;
    let mut one = |pose: &Rigid, stamp_ns: Option<i64>, out: &Path| -> Result<bool> {
        let saved = scene.at(stamp_ns);
        // Loaded once, or anew where things move between pictures.
        let (loaded, channels) = match ready.take_if(|_| scene.objects.is_empty()) {
            Some(known) => known,
            None => load_splats(&mut *raster, &saved, args.what)?,
        };
        let local_from_camera = saved.map_from_local.inverse() * *pose * crate::window::camera_from_flu().inverse();
        let view = View::from_pose(local_from_camera.to_f32(), intrinsics);
        let pictures = raster.draw(loaded, args.time, &channels, std::slice::from_ref(&view))?;
        ready = Some((loaded, channels));
        let picture = pictures.into_iter().next().context("the rasteriser gave no picture")?;
        finish(&picture, args.what)?.write_png(out).with_context(|| format!("cannot write {}", out.display()))?;
        Ok(picture.alpha.iter().any(|&a| a > 0.0))
    };
    let mut seen = false;
    if let Some(pose) = &args.pose {
        seen = one(pose, None, &args.out)?;
    }
    if let Some(file) = &args.trajectory {
        std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make {}", args.out.display()))?;
        let up = Rigid::new(DQuat::IDENTITY, DVec3::new(0.0, 0.0, args.height_m));
        for (i, (stamp_ns, pose)) in read_tum(file)?.iter().enumerate() {
            seen |= one(&(*pose * up), Some(*stamp_ns), &args.out.join(format!("{i:06}.png")))?;
        }
    }
    let at = scene.still.map_from_local.translation;
    if !seen {
        tracing::warn!(
            "nothing is in view from there; the map's own position is {:.2} {:.2} {:.2} m",
            at.x,
            at.y,
            at.z
        );
    }
    say!("{}", args.out.display());
    Ok(Outcome::Done)
}

/// What stands and what moves, put together for each picture.
struct Scenery {
    still: SavedGaussians,
    objects: Vec<SavedObject>,
    /// For poses without a time of their own, nanoseconds.
    stamp_ns: i64,
}

impl Scenery {
    fn new(args: &Args, mut saved: SavedGaussians) -> Result<Self> {
        let of_step = !saved.velocities.is_empty();
        let moves = |v: &[f32; 3]| Vec3::from(*v).length() >= MOVING_MPS;
        let moving: Vec<bool> = saved.velocities.iter().map(moves).collect();
        let (mut objects, mut stamp_ns) = (Vec::new(), 0);
        match args.objects {
            Some(Objects::Remove) if of_step => saved.retain(|i| !moving[i]),
            Some(Objects::Only) if of_step => saved.retain(|i| moving[i]),
            Some(Objects::Keep | Objects::Only) if !of_step => {
                if !args.map.is_dir() {
                    let text = format!("--objects needs a results folder, {} is a file", args.map.display());
                    return Err(UsageError(text).into());
                }
                // The objects lie beside the map's folder.
                let folder = if StaticMap::is_saved_in(&args.map) { args.map.join("..") } else { args.map.clone() };
                objects = saved::load_objects(&folder)?;
                if args.pose.is_some() {
                    let at = args.at.ok_or_else(|| UsageError("--objects with --pose needs --at SECONDS".into()))?;
                    let poses = read_tum(&folder.join("trajectory.tum"))?;
                    let (first_ns, _) = poses.first().context("trajectory.tum holds no pose")?;
                    stamp_ns = first_ns.saturating_add(crate::sync::clock::signed_ns(at));
                }
                if args.objects == Some(Objects::Only) {
                    saved.retain(|_| false);
                }
            }
            _ => {}
        }
        Ok(Self { still: saved, objects, stamp_ns })
    }

    /// Everything there is at a time.
    fn at(&self, stamp_ns: Option<i64>) -> Cow<'_, SavedGaussians> {
        let stamp_ns = stamp_ns.unwrap_or(self.stamp_ns);
        let mut here = self.objects.iter().filter_map(|o| Some((o, o.pose_at(stamp_ns)?))).peekable();
        if here.peek().is_none() {
            return Cow::Borrowed(&self.still);
        }
        let mut all = self.still.clone();
        here.for_each(|(object, pose)| all.add(&object.cloud, &pose));
        Cow::Owned(all)
    }
}

fn renderer(device: &str) -> Result<Box<dyn Renderer>> {
    let settings = RasterSettings::default();
    if device == "cpu" {
        return Ok(Box::new(CpuRasterizer::new(settings)?));
    }
    #[cfg(feature = "wgpu")]
    {
        use storm_render::gpu::{GpuOptions, GpuOrCpu, GpuRasterizer};
        let gpu = GpuRasterizer::new(settings, &GpuOptions::default())?;
        Ok(Box::new(GpuOrCpu::new(gpu, Box::new(|e| tracing::warn!("{e}; going on with the CPU")))?))
    }
    #[cfg(not(feature = "wgpu"))]
    Err(UsageError("--device wgpu: this program was built without it; cargo build --release --features wgpu".into())
        .into())
}

fn load(path: &Path, step: Option<usize>) -> Result<SavedGaussians> {
    let is_ply = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply"));
    if path.is_dir() && step.is_none() {
        match saved::find_map(path, false) {
            Some(MapPlace::Ply(ply)) => return saved::load_ply(&ply),
            Some(MapPlace::Folder(folder)) => return saved::load_map(&folder),
            None => {}
        }
    }
    match (path.is_dir(), is_ply, step) {
        (true, _, step) => saved::load_step(&path.join("outputs.mcap"), step),
        (false, true, Some(_)) => bail!(UsageError("--step needs a results folder, not a .ply".into())),
        (false, true, None) => saved::load_ply(path),
        (false, false, step) => saved::load_step(path, step),
    }
}

/// Channels in front of the motion groups': colour 3, velocity 3.
const BASE_CHANNELS: usize = 6;

/// Hands the Gaussians to the renderer, once for all pictures, and says which channels these need: of colour, velocity and
/// one for each motion group.
fn load_splats(raster: &mut dyn Renderer, saved: &SavedGaussians, what: What) -> Result<(Loaded, Channels)> {
    let cloud = &saved.cloud;
    let still = [0.0f32; 3];
    let velocities: Vec<[f32; 3]> = (0..cloud.len()).map(|i| *saved.velocities.get(i).unwrap_or(&still)).collect();
    let groups = saved.motion_ids.iter().max().map_or(0, |&m| usize::from(m) + 1);
    let feature_count = BASE_CHANNELS + groups;
    let mut features = vec![0.0; feature_count * cloud.len()];
    for (i, row) in features.chunks_exact_mut(feature_count).enumerate() {
        row[..3].copy_from_slice(&cloud.colors01[i]);
        row[3..BASE_CHANNELS].copy_from_slice(&velocities[i]);
        if let Some(&group) = saved.motion_ids.get(i) {
            row[BASE_CHANNELS + usize::from(group)] = 1.0;
        }
    }
    let splats = Splats {
        means: &cloud.positions,
        quats: &cloud.quats,
        scales: &cloud.scales,
        opacities: &cloud.opacities,
        features: &features,
        feature_count,
    };
    let time_sec = vec![0.0; cloud.len()];
    let motion =
        Motion { velocity_backward: &velocities, velocity_forward: &velocities, time_sec: time_sec.as_slice() };
    let moves = velocities.iter().flatten().any(|&v| v != 0.0);
    let channels = match what {
        What::Color => 0..3,
        What::Depth => 0..0,
        What::Flow => 3..BASE_CHANNELS,
        What::Mask => 0..feature_count,
    };
    Ok((raster.load(&splats, moves.then_some(&motion))?, Channels(channels)))
}

fn finish(p: &RasterPicture, what: What) -> Result<Picture> {
    let (w, h) = (p.width, p.height);
    let pixels = || p.features.chunks_exact(p.feature_count);
    let channels = |from: usize| pixels().map(move |f| [f[from], f[from + 1], f[from + 2]]);
    Ok(match what {
        What::Color => Picture::from_rgb01(w, h, &channels(0).flatten().collect::<Vec<_>>())?,
        What::Depth => {
            let depth: Vec<f32> =
                p.depth.iter().zip(&p.alpha).map(|(d, a)| if *a >= SURFACE_ALPHA { *d } else { 0.0 }).collect();
            let scale = DepthScale::fit([depth.as_slice()]);
            with_depth_bar(&depth_picture(w, h, &depth, scale)?, scale)
        }
        What::Mask => {
            let group = |f: &[f32]| {
                let moves = Vec3::new(f[3], f[4], f[5]).length() >= MOVING_MPS;
                let first_largest = |best: usize, k: usize| if f[k] > f[best] { k } else { best };
                let best = (BASE_CHANNELS..f.len()).fold(BASE_CHANNELS, first_largest);
                if moves { (best - BASE_CHANNELS + 1) as u16 } else { 0 }
            };
            let ids: Vec<u16> = pixels().map(group).collect();
            mask_overlay(&Picture::from_rgb01(w, h, &channels(0).flatten().collect::<Vec<_>>())?, &ids)?
        }
        What::Flow => {
            let flow: Vec<[f32; 3]> = channels(0).collect();
            with_flow_wheel(&flow_picture(w, h, &flow, None, FULL_SPEED_MPS)?, FULL_SPEED_MPS)
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_in_both_forms() {
        let a = parse_pose("1,2,3,90").unwrap();
        let b = parse_pose("1,2,3,0.7071067811865476,0,0,0.7071067811865476").unwrap();
        assert!(a.rotation.dot(b.rotation).abs() > 1.0 - 1e-12);
        let up = parse_pose("0,0,0,0,30").unwrap();
        assert!((up.rotation * DVec3::X).z > 0.49);
        for bad in ["1,2,3", "1,2,3,x", "1,2,3,NaN", "0,0,0,0,0,0,0"] {
            assert!(parse_pose(bad).is_err(), "{bad}");
        }
    }
}
