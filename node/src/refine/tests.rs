use glam::{Affine3A, Quat, Vec3};
use storm_render::Intrinsics;

use super::*;

const W: usize = 32;
const H: usize = 20;

/// A wall of coloured Gaussians, and a map of it that is off in colour and place.
fn wall() -> (Params, Params) {
    let mut truth = Params::default();
    for i in 0..400 {
        let (x, y) = ((i % 25) as f32 - 12.0, (i / 25) as f32 - 7.5);
        truth.means.push([0.4 * x, 0.4 * y, 8.0]);
        truth.colors.push([(x * 0.7).sin(), (y * 0.9).cos(), 0.5 * (x + y).sin()]);
    }
    truth.log_scales = vec![[-1.5; 3]; 400];
    truth.quats = vec![[1.0, 0.0, 0.0, 0.0]; 400];
    truth.logits = vec![3.0; 400];
    let mut map = truth.clone();
    for (i, (m, c)) in map.means.iter_mut().zip(&mut map.colors).enumerate() {
        let off = |k: usize| 0.1 * ((i * 37 + k * 11) as f32).sin();
        *m = [m[0] + off(0), m[1] + off(1), m[2]];
        *c = [0, 1, 2].map(|k| 0.6 * c[k] + off(k));
    }
    (truth, map)
}

fn shots_of(truth: &Params) -> Vec<Shot> {
    let mut raster = CpuRasterizer::new(RasterSettings::default()).unwrap();
    (0..8)
        .map(|i| {
            let x = 0.25 * i as f32 - 1.0;
            let pose = Affine3A::from_rotation_translation(Quat::from_rotation_y(0.03 * x), Vec3::new(x, 0.0, 0.0));
            let view = View::from_pose(pose, Intrinsics::from_fov(50.0, W, H));
            let (rgb01, _) = draw(&mut raster, truth, view).unwrap();
            Shot { view, rgb01, moves: vec![false; W * H], held_out: i == 4 }
        })
        .collect()
}

#[test]
fn held_out_pictures_get_better_and_stopping_keeps_what_is_done() {
    let (truth, map) = wall();
    let shots = shots_of(&truth);
    let options = RefineOptions { iterations: 200, minutes: f64::INFINITY, score_every: 50, seed: 1 };
    let mut refined = map.clone();
    let mut heard = Vec::new();
    let report = refine(&mut refined, &shots, RasterSettings::default(), &options, &mut |n, score| {
        heard.extend(score.map(|s| (n, s.iteration)));
        true
    })
    .unwrap();
    assert_eq!((report.gaussians, report.fitted, report.held_out), (400, 7, 1));
    assert_eq!(heard, [(0, 0), (50, 50), (100, 100), (150, 150), (200, 200)]);
    let held_out = |s: &Score| s.psnr_held_out.unwrap();
    let (before, after) = (held_out(&report.scores[0]), held_out(&report.scores[4]));
    assert!(after > before + 2.0, "{before} to {after} dB");
    assert!(report.scores.windows(2).all(|s| s[0].seconds <= s[1].seconds));
    // Enough after ten.
    let mut stopped = map.clone();
    let report = refine(&mut stopped, &shots, RasterSettings::default(), &options, &mut |n, _| n < 10).unwrap();
    assert_eq!(report.scores.last().unwrap().iteration, 10);
    assert!(stopped != map && stopped != refined);
    let hurried = RefineOptions { minutes: 0.0, ..options };
    let report = refine(&mut stopped, &shots, RasterSettings::default(), &hurried, &mut |_, _| true).unwrap();
    assert_eq!(report.scores.last().unwrap().iteration, 1);
}

#[test]
fn what_moves_is_neither_learned_nor_scored() {
    let (truth, map) = wall();
    let mut shots = shots_of(&truth);
    // A bright thing passes before the wall.
    for (n, shot) in shots.iter_mut().enumerate() {
        for r in 4..14 {
            for c in 3 * n..3 * n + 8 {
                shot.rgb01[3 * (r * W + c)..][..3].copy_from_slice(&[1.0, 1.0, 1.0]);
                shot.moves[r * W + c] = true;
            }
        }
    }
    let options = RefineOptions { iterations: 150, minutes: f64::INFINITY, score_every: 1000, seed: 1 };
    let mut refined = map.clone();
    let report = refine(&mut refined, &shots, RasterSettings::default(), &options, &mut |_, _| true).unwrap();
    let held_out = |s: &Score| s.psnr_held_out.unwrap();
    let (before, after) = (held_out(&report.scores[0]), held_out(report.scores.last().unwrap()));
    assert!(after > before + 1.5, "{before} to {after} dB");
    let nothing: Vec<Shot> = Vec::new();
    assert!(refine(&mut refined, &nothing, RasterSettings::default(), &options, &mut |_, _| true).is_err());
}
