use std::sync::Arc;

use glam::{DQuat, DVec3};
use storm_model::config::ModelConfig;
use storm_model::scene::{SceneShape, Want};
use storm_render::Gaussians;
use storm_render::raster::CpuRasterizer;

use super::*;
use crate::decode::RgbPicture;
use crate::dice::Dice;
use crate::overlap::Agreement;
use crate::pipeline::demand::Demand;
use crate::rigid::Rigid;
use crate::window::PosedFrame;

const HOP_NS: i64 = 100_000_000;
const CAMERA: Intrinsics = Intrinsics { fx: 40.0, fy: 40.0, cx: 24.0, cy: 16.0, width: 48, height: 32 };

/// A wall 12 m ahead and a car before it; `texture` is how strongly the wall is painted, `far_mps` what the car drives.
fn street(texture: f32, car_m: f32, car_mps: f32) -> Scene {
    let mut g = Gaussians::default();
    let mut add = |mean: [f32; 3], color: [f32; 3], velocity: [f32; 3]| {
        g.means.push(mean);
        g.quats.push([1.0, 0.0, 0.0, 0.0]);
        g.scales.push([0.15; 3]);
        g.opacities.push(0.99);
        g.colors.push(color);
        g.velocity_backward.push(velocity);
        g.velocity_forward.push(velocity);
        g.time_sec.push(0.0);
    };
    for row in -40..=40 {
        for col in -60..=60 {
            let (x, y) = (0.2 * col as f32, 0.2 * row as f32);
            let paint = texture * (2.0 * x).sin() * (1.7 * y).cos();
            add([x, y, 12.0], [paint, 0.5 * paint, 0.1], [0.0; 3]);
        }
    }
    for row in 0..6 {
        for col in 0..12 {
            let place = [car_m + 0.2 * col as f32, 0.5 + 0.2 * row as f32, 10.0];
            add(place, [0.8, -0.6, -0.6], [car_mps, 0.0, 0.0]);
        }
    }
    let n = g.means.len();
    Scene {
        shape: SceneShape { timesteps: 1, cameras: 1, height: 1, width: n },
        depths: vec![10.0; n],
        gaussians: g,
        valid: Vec::new(),
        sky: None,
        affine: Vec::new(),
        motion_bases: Vec::new(),
        config: Arc::new(ModelConfig::preset("tiny").unwrap()),
    }
}

/// Where the vehicle is at hop `k`: driving along the street and a little towards the wall.
fn pose(k: i64) -> Rigid {
    Rigid::new(DQuat::IDENTITY, DVec3::new(0.1 * k as f64, 0.0, 0.05 * k as f64))
}

fn draw(scene: &Scene, k: i64) -> Vec<RenderedView> {
    let mut raster = CpuRasterizer::new(scene.raster_settings()).unwrap();
    let view = View::from_pose(pose(k).to_f32(), CAMERA);
    let want = Want { flow: true, motion: false };
    scene.render(&mut raster, &[(view, None)], 0.1 * k as f32, want).unwrap()
}

/// A picture of the true scene with noise, changed by `paint`.
fn picture(scene: &Scene, k: i64, paint: &dyn Fn(&mut RgbPicture)) -> RgbPicture {
    let mut dice = Dice::new(31 * k as u64 + 1);
    let mut noise = || (0..12).map(|_| dice.unit()).sum::<f32>() - 6.0;
    let data = draw(scene, k)[0].rgb8().iter().map(|&x| (f32::from(x) + noise()).round() as u8).collect();
    let mut rgb = RgbPicture { width: CAMERA.width, height: CAMERA.height, data };
    paint(&mut rgb);
    rgb
}

fn window(k: i64, rgb: RgbPicture) -> Window<Frame> {
    let stamp_ns = k * HOP_NS;
    let frame = PosedFrame { stamp_ns, map_from_camera: pose(k), item: Frame::whole(rgb) };
    Window {
        epoch: 0,
        stamp_ns,
        map_from_anchor: Rigid::IDENTITY,
        steps: vec![Arc::new(PosedSet { stamp_ns, epoch: 0, frames: vec![frame] })],
        prior: Vec::new(),
        time_sec: vec![vec![0.0]],
    }
}

fn nothing(_: &mut RgbPicture) {}

/// The network saw `believed` at hop 0; whether that explains the picture of `truth` at hop `k`. The clock begins at hop 0.
fn asked(
    believed: &Scene,
    at_first: &Scene,
    truth: &Scene,
    k: i64,
    paint: &dyn Fn(&mut RgbPicture),
) -> Result<(), Unexplained> {
    let computed = Computed {
        window: window(0, picture(at_first, 0, &nothing)),
        scene: Arc::new(believed.clone()),
        views: draw(believed, 0).into(),
        agreement: Arc::new(Agreement::default()),
        demand: Demand::ALL,
        approximate: false,
    };
    explains(&SkipConfig::default(), &computed, &window(k, picture(truth, k, paint)), &draw(believed, k), &[CAMERA])
}

fn block(p: &mut RgbPicture, side: usize, levels: i16) {
    for y in 8..8 + side {
        for x in 30..30 + side {
            for v in &mut p.data[3 * (y * 48 + x)..][..3] {
                *v = (i16::from(*v) + levels).clamp(0, 255) as u8;
            }
        }
    }
}

#[test]
fn a_street_and_a_steady_car_are_explained_while_cruising() {
    for speed in [0.0, 3.0, -8.0] {
        let scene = street(0.4, -1.0, speed);
        for k in 1..=5 {
            assert_eq!(asked(&scene, &scene, &scene, k, &nothing), Ok(()), "{speed} m/s, hop {k}");
        }
    }
}

#[test]
fn a_network_that_draws_the_wall_grey_still_explains_it() {
    let (truth, blurred) = (street(0.4, -1.0, 3.0), street(0.0, -1.0, 3.0));
    let gap = |k| (draw(&truth, k)[0].rgb8(), draw(&blurred, k)[0].rgb8());
    let (a, b) = gap(0);
    assert!(a.iter().zip(&b).any(|(a, b)| a.abs_diff(*b) > 40), "it is wrong by a lot");
    for k in 1..=3 {
        assert_eq!(asked(&blurred, &truth, &truth, k, &nothing), Ok(()), "hop {k}");
    }
}

#[test]
fn somebody_who_steps_out_and_a_small_far_mover_are_not_explained() {
    let scene = street(0.4, -1.0, 3.0);
    for (side, levels) in [(4, 30), (3, 50), (2, 90), (2, -90)] {
        for k in 1..=5 {
            let found = asked(&scene, &scene, &scene, k, &|p| block(p, side, levels));
            let Err(Unexplained::Picture { camera: 0, change }) = found else {
                panic!("{side} pixels by {levels} at hop {k}: {found:?}")
            };
            assert!(change.at[0].abs_diff(30) <= 8 && change.at[1].abs_diff(8) <= 8, "{change:?}");
        }
    }
}

#[test]
fn light_that_changes_is_not_explained() {
    let scene = street(0.4, -1.0, 0.0);
    for levels in [-4, 4, 20] {
        let found = asked(&scene, &scene, &scene, 1, &|p| {
            p.data.iter_mut().for_each(|x| *x = (i16::from(*x) + levels).clamp(0, 255) as u8);
        });
        assert!(matches!(found, Err(Unexplained::Exposure { .. })), "{levels}: {found:?}");
    }
}

#[test]
fn a_parked_car_that_starts_and_one_that_stops_are_not_explained() {
    let parked = street(0.4, -1.0, 0.0);
    // It has gone 0.7 m: three pixels.
    assert!(asked(&parked, &parked, &street(0.4, -0.3, 0.0), 4, &nothing).is_err());
    let (driving, stopped) = (street(0.4, -1.0, 4.0), street(0.4, -1.0, 0.0));
    assert!(asked(&driving, &driving, &stopped, 3, &nothing).is_err());
    // And one that turns up where the wall was.
    assert!(asked(&street(0.4, -60.0, 0.0), &street(0.4, -60.0, 0.0), &parked, 2, &nothing).is_err());
}

#[test]
fn how_far_ahead_is_limited() {
    let config = SkipConfig { predict_sec: 0.35, predict_m: 1.0, ..SkipConfig::default() };
    let rgb = RgbPicture { width: 48, height: 32, data: vec![0; 48 * 32 * 3] };
    let at = |k| window(k, rgb.clone());
    assert!(in_reach(&config, &at(0), &at(3)) && !in_reach(&config, &at(0), &at(4)), "time");
    assert!(!in_reach(&config, &at(3), &at(3)) && !in_reach(&config, &at(3), &at(2)), "not back");
    let near = SkipConfig { predict_m: 0.2, ..config.clone() };
    assert!(in_reach(&near, &at(0), &at(1)) && !in_reach(&near, &at(0), &at(3)), "distance");
    let mut other = at(1);
    other.epoch = 1;
    assert!(!in_reach(&config, &at(0), &other), "epoch");
    let mut broken = at(1);
    Arc::make_mut(&mut broken.steps[0]).frames[0].map_from_camera.translation.x = f64::NAN;
    assert!(!in_reach(&config, &at(0), &broken), "a pose that is no number");
}

#[test]
fn a_moved_scene_is_where_and_when_it_is_now_and_draws_the_same() {
    let scene = street(0.4, -1.0, 3.0);
    let rgb = RgbPicture { width: 48, height: 32, data: vec![0; 48 * 32 * 3] };
    let moved = moved_on(&scene, &window(0, rgb.clone()), &window(3, rgb));
    // One timestep: the new window's clock begins at it.
    assert!(moved.gaussians.time_sec.iter().all(|t| *t == 0.0));
    let last = scene.gaussians.len() - 1;
    assert!((moved.gaussians.means[last][0] - scene.gaussians.means[last][0] - 0.9).abs() < 1e-5);
    let mut raster = CpuRasterizer::new(scene.raster_settings()).unwrap();
    let view = View::from_pose(pose(3).to_f32(), CAMERA);
    let now = moved.render(&mut raster, &[(view, None)], 0.0, Want { flow: true, motion: false }).unwrap();
    let worst = now[0].depth.iter().zip(&draw(&scene, 3)[0].depth).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst < 1e-3, "{worst} m");
    // Its pixels say where surfaces are: the wall lies 12 m ahead of where the drive began.
    let at = |k| window(k, RgbPicture { width: 48, height: 32, data: vec![0; 48 * 32 * 3] });
    let pixels = pixel_flow(&at(0), &at(3), &now, &[CAMERA]);
    assert!(pixels.valid[0] && (pixels.positions[0][2] - 12.0).abs() < 0.2, "{:?}", pixels.positions[0]);
    let fastest = pixels.velocities.iter().map(|v| v[0]).fold(0.0, f32::max);
    assert!((fastest - 3.0).abs() < 0.1, "{fastest} m/s");
}
