//! `storm render`: a saved map, or one step of a replay, from any pose at any time.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use glam::{DQuat, DVec3, EulerRot};
use storm_render::raster::{CpuRasterizer, Picture as RasterPicture, RasterSettings, Splats};
use storm_render::{Intrinsics, View};

use super::{Outcome, UsageError};
use crate::output::picture::{DepthScale, Picture, depth_picture, flow_picture, with_depth_bar, with_flow_wheel};
use crate::rigid::Rigid;
use crate::saved::{self, SavedGaussians};

/// Coverage from which a pixel shows a surface.
const SURFACE_ALPHA: f32 = 0.5;
/// Speed at which the flow picture is fully saturated, m/s.
const FULL_SPEED_MPS: f32 = 15.0;

/// Arguments of `storm render`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// A map (map.ply), or a results folder: its map, or with --step one of its steps.
    map: PathBuf,
    /// Camera pose in the map frame: X,Y,Z,YAW[,PITCH] (m, degrees; yaw 0 looks along x, pitch up is positive), or X,Y,Z,QW,QX,QY,QZ
    /// of a body with x forward, y left, z up.
    #[arg(long, allow_hyphen_values = true, value_parser = parse_pose)]
    pose: Rigid,
    /// Picture to write (PNG).
    #[arg(long)]
    out: PathBuf,
    /// Draw this step's Gaussians (from outputs.mcap, numbered from 0) instead of the map.
    #[arg(long)]
    step: Option<usize>,
    /// Seconds after the step's stamp; Gaussians move with their velocities. Negative looks back.
    #[arg(long, default_value_t = 0.0, allow_hyphen_values = true)]
    time: f32,
    /// What to draw: color, depth or flow.
    #[arg(long, default_value = "color")]
    what: What,
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
    Color,
    Depth,
    Flow,
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
    let body_from_camera = crate::window::camera_from_flu().inverse();
    let local_from_camera = saved.map_from_local.inverse() * args.pose * body_from_camera;
    let intrinsics = Intrinsics::from_fov(args.fov, args.width, args.height);
    let view = View::from_pose(local_from_camera.to_f32(), intrinsics);
    let picture = draw(&saved, &view, args.time)?;
    if !picture.alpha.iter().any(|&a| a > 0.0) {
        tracing::warn!(
            "nothing is in view from there; the map's own position is {:?}",
            saved.map_from_local.translation
        );
    }
    finish(&picture, args.what)?
        .write_png(&args.out)
        .with_context(|| format!("cannot write {}", args.out.display()))?;
    println!("{}", args.out.display());
    Ok(Outcome::Done)
}

fn load(path: &Path, step: Option<usize>) -> Result<SavedGaussians> {
    let is_ply = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply"));
    match (path.is_dir(), is_ply, step) {
        (true, _, None) if path.join("map.ply").exists() => saved::load_ply(&path.join("map.ply")),
        (true, _, step) => saved::load_step(&path.join("outputs.mcap"), step),
        (false, true, Some(_)) => bail!(UsageError("--step needs a results folder, not a .ply".into())),
        (false, true, None) => saved::load_ply(path),
        (false, false, step) => saved::load_step(path, step),
    }
}

/// Colour and velocity channels, depth and coverage.
fn draw(saved: &SavedGaussians, view: &View, time_sec: f32) -> Result<RasterPicture> {
    let cloud = &saved.cloud;
    let still = [0.0f32; 3];
    let velocity = |i: usize| saved.velocities.get(i).unwrap_or(&still);
    let move_by =
        |(i, p): (usize, &[f32; 3])| -> [f32; 3] { std::array::from_fn(|k| p[k] + time_sec * velocity(i)[k]) };
    let means: Vec<[f32; 3]> = cloud.positions.iter().enumerate().map(move_by).collect();
    let features: Vec<f32> = cloud
        .colors01
        .iter()
        .enumerate()
        .flat_map(|(i, c)| c.iter().chain(velocity(i)).copied().collect::<Vec<_>>())
        .collect();
    let splats = Splats {
        means: &means,
        quats: &cloud.quats,
        scales: &cloud.scales,
        opacities: &cloud.opacities,
        features: &features,
        feature_count: 6,
    };
    let mut raster = CpuRasterizer::new(RasterSettings::default())?;
    raster.render(&splats, std::slice::from_ref(view))?.pop().context("the rasteriser gave no picture")
}

fn finish(p: &RasterPicture, what: What) -> Result<Picture> {
    let (w, h) = (p.width, p.height);
    let channels = |from: usize| p.features.chunks_exact(6).map(move |f| [f[from], f[from + 1], f[from + 2]]);
    Ok(match what {
        What::Color => Picture::from_rgb01(w, h, &channels(0).flatten().collect::<Vec<_>>())?,
        What::Depth => {
            let depth: Vec<f32> =
                p.depth.iter().zip(&p.alpha).map(|(d, a)| if *a >= SURFACE_ALPHA { *d } else { 0.0 }).collect();
            let scale = DepthScale::fit([depth.as_slice()]);
            with_depth_bar(&depth_picture(w, h, &depth, scale)?, scale)
        }
        What::Flow => {
            let flow: Vec<[f32; 3]> = channels(3).collect();
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
