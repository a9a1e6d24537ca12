//! The map against the truth: pictures and surfaces at poses no window had, and what of moving things stayed in it.

use std::collections::HashSet;

use anyhow::Result;
use glam::{DVec3, Vec3};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use serde::Serialize;
use storm_model::metrics::Mean;
use storm_model::metrics::image::{Image, psnr};
use storm_model::scene::Scene;
use storm_render::View;
use storm_render::raster::{CpuRasterizer, Picture, Splats};
use storm_render::world::{Drive, DriveOptions, WorldFrame};

use crate::engine::select::SURFACE_OPACITY;
use crate::map::MapCloud;
use crate::rigid::Rigid;

/// A surface is right within this, metres.
const RIGHT_M: f32 = 0.2;
/// Surfaces up to this depth are judged, metres.
const JUDGED_M: f32 = 20.0;
/// The true surface is sampled so many times as finely as the pictures: on the road 20 m ahead, rows are then less than
/// 0.3 m apart.
const FINER: usize = 8;
/// A Gaussian this far behind the surface in front of it is hidden there and not judged, metres.
const HIDDEN_M: f32 = 0.5;

/// Room around a road user's box that still counts as its own, metres.
const BOX_ROOM_M: f64 = 0.3;

/// A pose between frames, its truth, and how well the window of its time draws it.
pub struct HeldOut {
    time_sec: f64,
    camera: usize,
    window_psnr: Option<f64>,
}

/// How good the map is.
#[derive(Debug, Clone, Default, Serialize)]
pub struct MapFigures {
    /// Pictures judged.
    pub pictures: usize,
    /// Mean PSNR of static pixels at held-out poses: the windows' own scenes, dB.
    pub window_psnr: Option<f64>,
    /// The same of the map, dB.
    pub map_psnr: Option<f64>,
    /// Share of static surface pixels the map covers.
    pub covered: Option<f64>,
    /// Share of the map's Gaussians that are in sight within 20 m whose centre is within 0.2 m of a true surface.
    pub accuracy: Option<f64>,
    /// Share of the true static surface points within 20 m (one per pixel) that have a map Gaussian within 0.2 m.
    pub completeness: Option<f64>,
    /// Mean distance of those Gaussians from the true surface, metres.
    pub error_m: Option<f64>,
    /// Share of the map's mass (opacity times confidence) that was left by road users which have moved on.
    pub ghost_share: Option<f64>,
    /// Share of map Gaussians that are mostly such.
    pub ghost_gaussians: Option<f64>,
}

/// Draws Gaussians at rest from a camera; colours -1 to 1.
fn draw(raster: &mut CpuRasterizer, splats: &Splats, view: View) -> Result<Picture> {
    let mut pictures = raster.render(splats, &[view])?;
    Ok(pictures.remove(0))
}

/// Pixels that show static surroundings, and no moving thing beside them.
fn static_pixels(frame: &WorldFrame) -> Vec<bool> {
    let (w, h) = (frame.width, frame.height);
    let moves = |r: usize, c: usize| frame.moving[r * w + c] > 0;
    (0..w * h)
        .map(|i| {
            let (r, c) = (i / w, i % w);
            let beside = (r.saturating_sub(1)..(r + 2).min(h))
                .any(|r| (c.saturating_sub(1)..(c + 2).min(w)).any(|c| moves(r, c)));
            frame.sky[i] == 0 && !beside
        })
        .collect()
}

fn static_psnr(picture: &Picture, frame: &WorldFrame, mask: &[bool]) -> Result<Option<f64>> {
    let unit = |x: f32| (0.5 * x + 0.5).clamp(0.0, 1.0);
    let drawn: Vec<f32> = (0..picture.width * picture.height)
        .flat_map(|i| [0, 1, 2].map(|c| picture.features[i * picture.feature_count + c]))
        .map(unit)
        .collect();
    let truth: Vec<f32> = frame.rgb.iter().map(|&x| f32::from(x) / 255.0).collect();
    let image = |values| Image { width: frame.width, height: frame.height, channels: 3, values };
    Ok(psnr(&image(&drawn), &image(&truth), Some(mask))?)
}

/// Collects held-out poses while driving, judges the map in the end.
pub struct MapJudge {
    raster: CpuRasterizer,
    held_out: Vec<HeldOut>,
}

impl MapJudge {
    /// Nothing yet.
    pub fn new(raster: CpuRasterizer) -> Self {
        Self { raster, held_out: Vec::new() }
    }

    /// Draws a window's scene at a time of the drive no picture was taken at.
    pub fn window(
        &mut self,
        drive: &Drive,
        scene: &Scene,
        map_from_anchor: &Rigid,
        first_sec: f64,
        time_sec: f64,
    ) -> Result<()> {
        for camera in 0..drive.cameras().len() {
            let (frame, view) = view_at(drive, camera, time_sec, map_from_anchor);
            let means = scene.means_at((time_sec - first_sec) as f32);
            let g = &scene.gaussians;
            let splats = Splats {
                means: &means,
                quats: &g.quats,
                scales: &g.scales,
                opacities: &g.opacities,
                features: g.colors.as_flattened(),
                feature_count: 3,
            };
            let picture = draw(&mut self.raster, &splats, view)?;
            let window_psnr = static_psnr(&picture, &frame, &static_pixels(&frame))?;
            self.held_out.push(HeldOut { time_sec, camera, window_psnr });
        }
        Ok(())
    }

    /// Judges a map. `tags` is the same map with the share of moving road users' content in the red channel.
    pub fn finish(mut self, drive: &Drive, map: &MapCloud, tags: &MapCloud, end_sec: f64) -> Result<MapFigures> {
        let o = drive.options();
        let finer = DriveOptions { width: o.width * FINER, height: o.height * FINER, smooth_edges: false, ..o.clone() };
        let fine = &Drive::new(&finer)?;
        let colors: Vec<f32> = map.colors01.as_flattened().iter().map(|c| 2.0 * c - 1.0).collect();
        let splats = Splats {
            means: &map.positions,
            quats: &map.quats,
            scales: &map.scales,
            opacities: &map.opacities,
            features: &colors,
            feature_count: 3,
        };
        let map_frame = Rigid::new(glam::DQuat::IDENTITY, map.origin);
        let (mut window, mut own, mut covered) = (Mean::default(), Mean::default(), Mean::default());
        let mut surfaces = Surfaces { centers: Cloud::new(&map.positions), ..Surfaces::default() };
        for (n, held) in self.held_out.iter().enumerate() {
            let (frame, view) = view_at(drive, held.camera, held.time_sec, &map_frame);
            let picture = draw(&mut self.raster, &splats, view)?;
            let mask = static_pixels(&frame);
            window.add(held.window_psnr);
            own.add(static_psnr(&picture, &frame, &mask)?);
            for i in (0..mask.len()).filter(|&i| mask[i]) {
                covered.add(Some(f64::from(u8::from(picture.alpha[i] >= SURFACE_OPACITY))));
            }
            // Every camera in turn: the fine truth takes its time.
            let cameras = drive.cameras().len();
            if n % cameras == (n / cameras) % cameras {
                surfaces.judge(fine, held, &frame, &mask, &view, &map.positions);
            }
        }
        let (ghost_share, ghost_gaussians) = ghosts(drive, tags, end_sec);
        Ok(MapFigures {
            pictures: self.held_out.len(),
            window_psnr: window.value(),
            map_psnr: own.value(),
            covered: covered.value(),
            accuracy: surfaces.accuracy.value(),
            completeness: surfaces.completeness.value(),
            error_m: surfaces.error_m.value(),
            ghost_share,
            ghost_gaussians,
        })
    }
}

/// Places that can be asked for the nearest.
#[derive(Default)]
struct Cloud(Option<ImmutableKdTree<f32, 3>>);

impl Cloud {
    fn new(points: &[[f32; 3]]) -> Self {
        Self(match points.is_empty() {
            true => None,
            false => ImmutableKdTree::builder().with_serial_construction().build_from_slice(points).ok(),
        })
    }

    /// Distance of the nearest, metres; infinite of none.
    fn distance_m(&self, p: &[f32; 3]) -> f32 {
        let nearest =
            |t: &ImmutableKdTree<f32, 3>| t.query(p).nearest_one::<SquaredEuclidean<f32>>().execute().distance;
        self.0.as_ref().map_or(f32::INFINITY, |t| nearest(t).sqrt())
    }
}

/// Accuracy and completeness of surfaces.
#[derive(Default)]
struct Surfaces {
    centers: Cloud,
    accuracy: Mean,
    completeness: Mean,
    error_m: Mean,
}

impl Surfaces {
    /// One held-out view. `positions` are the map's centres in the frame `view` starts from.
    fn judge(
        &mut self,
        fine: &Drive,
        held: &HeldOut,
        frame: &WorldFrame,
        mask: &[bool],
        view: &View,
        positions: &[[f32; 3]],
    ) {
        let share = |x: bool| Some(f64::from(u8::from(x)));
        let local_from_camera = view.world_from_camera();
        let k = view.intrinsics;
        for i in (0..mask.len()).filter(|&i| mask[i] && frame.depth[i] <= JUDGED_M) {
            let p = k.ray((i % k.width) as f32 + 0.5, (i / k.width) as f32 + 0.5) * frame.depth[i];
            let near = self.centers.distance_m(&local_from_camera.transform_point3(p).to_array());
            self.completeness.add(share(near <= RIGHT_M));
        }
        let truth = fine.render(held.camera, held.time_sec);
        let kf = fine.cameras()[held.camera].intrinsics;
        let at = |i: usize| kf.ray((i % kf.width) as f32 + 0.5, (i / kf.width) as f32 + 0.5) * truth.depth[i];
        // A little beyond what is judged, so that nothing at the limit misses its surface.
        let seen = |i: &usize| truth.depth[*i] > 0.0 && truth.depth[*i] < 1.2 * JUDGED_M && truth.moving[*i] == 0;
        let points: Vec<[f32; 3]> = (0..truth.depth.len()).filter(seen).map(|i| at(i).to_array()).collect();
        let surface = Cloud::new(&points);
        for p in positions {
            let p: Vec3 = view.camera_from_world.transform_point3((*p).into());
            let Some((u, v)) = kf.project(p).filter(|_| p.z <= JUDGED_M && p.z > 1.0) else { continue };
            let margin = 2.0 * FINER as f32;
            let inside = u >= margin && v >= margin && u < kf.width as f32 - margin && v < kf.height as f32 - margin;
            if inside {
                let front = truth.depth[v as usize * kf.width + u as usize];
                if !(front > 0.0 && p.z > front + HIDDEN_M) {
                    let off = surface.distance_m(&p.to_array());
                    self.accuracy.add(share(off <= RIGHT_M));
                    self.error_m.add(Some(f64::from(off.min(JUDGED_M))));
                }
            }
        }
    }
}

/// The truth at a time, and the camera's view in a local frame.
fn view_at(drive: &Drive, camera: usize, time_sec: f64, map_from_local: &Rigid) -> (WorldFrame, View) {
    let mount = &drive.cameras()[camera];
    let pose = Rigid::from(&(drive.map_from_base(time_sec) * mount.base_from_camera));
    let local = crate::window::relative(map_from_local, &pose);
    (drive.render(camera, time_sec), View::from_pose(local.to_f32(), mount.intrinsics))
}

/// Instance numbers of road users that move at some time of a drive, sampled twice a second.
pub fn ever_moving(drive: &Drive, seconds: f64) -> HashSet<u16> {
    (0..(2.0 * seconds) as usize + 1)
        .flat_map(|i| drive.movers(0.5 * i as f64))
        .filter(|m| m.moving)
        .map(|m| m.instance)
        .collect()
}

/// Share of mass and of Gaussians left by road users that are not there at the end.
fn ghosts(drive: &Drive, tags: &MapCloud, end_sec: f64) -> (Option<f64>, Option<f64>) {
    let boxes: Vec<_> =
        drive.movers(end_sec).into_iter().map(|m| (m.map_from_object.inverse(), 0.5 * m.size + BOX_ROOM_M)).collect();
    let still_there = |p: DVec3| boxes.iter().any(|(to, half)| to.transform_point3(p).abs().cmple(*half).all());
    let (mut ghost, mut all, mut count) = (0f64, 0f64, 0usize);
    for i in 0..tags.len() {
        let mass = f64::from(tags.opacities[i] * tags.confidences[i]);
        let tag = f64::from(tags.colors01[i][0]);
        all += mass;
        if tag > 0.0 && !still_there(tags.origin + Vec3::from(tags.positions[i]).as_dvec3()) {
            ghost += mass * tag;
            count += usize::from(tag > 0.5);
        }
    }
    ((all > 0.0).then(|| ghost / all), (!tags.is_empty()).then(|| count as f64 / tags.len() as f64))
}
