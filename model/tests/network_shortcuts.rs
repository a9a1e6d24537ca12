//! What a forward pass leaves out or rounds: exact when off, close where it should be, and never more than it says.
#![allow(clippy::unwrap_used)]

use candle_core::{Device, Tensor};
use glam::{Affine3A, Vec3};
use storm_model::{ClipBatch, ClipOutput, ModelConfig, PixelLayout, Precision, Shortcuts, Storm, ViewInput};
use storm_render::Intrinsics;

const TIMESTEPS: usize = 3;
const CAMERAS: usize = 2;
const HEIGHT: usize = 24;
const WIDTH: usize = 40;

fn storm() -> Storm {
    let config = ModelConfig { depth: 4, ..ModelConfig::preset("tiny").unwrap() };
    Storm::untrained(&config, 3, &Device::Cpu).unwrap()
}

/// Pictures with a flat left half.
fn clip(seed: usize) -> ClipBatch {
    clip_of(seed, 0..TIMESTEPS)
}

/// The same of other timesteps, in the frame and on the clock of the first.
fn clip_of(seed: usize, timesteps: std::ops::Range<usize>) -> ClipBatch {
    let picture = |t: usize, camera: usize| -> Vec<f32> {
        (0..3 * HEIGHT * WIDTH)
            .map(|i| match i / 3 % WIDTH < WIDTH / 2 {
                true => 0.1,
                false => ((i * 7 + (t * CAMERAS + camera + seed) * 1013) as f32 * 0.011).sin(),
            })
            .collect()
    };
    let pictures: Vec<Vec<Vec<f32>>> =
        timesteps.clone().map(|t| (0..CAMERAS).map(|c| picture(t, c)).collect()).collect();
    let views: Vec<Vec<ViewInput>> = timesteps
        .clone()
        .zip(&pictures)
        .map(|(t, pictures)| {
            let view = |c: usize| ViewInput {
                rgb: &pictures[c],
                intrinsics: Intrinsics { fx: 30.0, fy: 30.0, cx: 20.0, cy: 12.0, width: WIDTH, height: HEIGHT },
                world_from_camera: Affine3A::from_rotation_y(c as f32)
                    * Affine3A::from_translation(Vec3::new(0.0, 0.0, t as f32)),
                time_sec: 0.5 * t as f32,
                valid: None,
            };
            (0..CAMERAS).map(view).collect()
        })
        .collect();
    ClipBatch::from_views(&views, PixelLayout::Hwc, 2.0, &Device::Cpu).unwrap()
}

fn patches() -> usize {
    TIMESTEPS * CAMERAS * (HEIGHT / 8) * (WIDTH / 8)
}

fn parts(output: &ClipOutput) -> Vec<Tensor> {
    let mut parts = vec![
        output.means.clone(),
        output.scales.clone(),
        output.quats.clone(),
        output.opacities.clone(),
        output.colors.clone(),
        output.velocity_backward.clone(),
        output.velocity_forward.clone(),
        output.time_sec.clone(),
    ];
    parts.extend(
        [&output.motion_weights, &output.motion_bases, &output.affine, &output.sky_token]
            .into_iter()
            .flatten()
            .cloned(),
    );
    parts
}

fn values(x: &Tensor) -> Vec<f32> {
    x.flatten_all().unwrap().to_vec1().unwrap()
}

/// Root mean square of the difference over that of the first, the largest of all parts.
fn apart(exact: &ClipOutput, other: &ClipOutput) -> f64 {
    let square = |x: f32| f64::from(x) * f64::from(x);
    let one = |(a, b): (&Tensor, &Tensor)| {
        assert_eq!(a.dims(), b.dims());
        let (a, b) = (values(a), values(b));
        let sum: f64 = a.iter().zip(&b).map(|(x, y)| square(x - y)).sum();
        (sum / a.iter().map(|&x| square(x)).sum::<f64>().max(1e-12)).sqrt()
    };
    parts(exact).iter().zip(&parts(other)).map(one).fold(0.0, f64::max)
}

#[test]
fn nothing_asked_for_is_the_same_bits() {
    let (storm, clip) = (storm(), clip(0));
    let exact = storm.forward(&clip).unwrap();
    let all = Shortcuts { keep: Some(vec![true; patches()]), merge: 0.01, ..Shortcuts::default() };
    for shortcuts in [Shortcuts::default(), all] {
        let output = storm.forward_with(&clip, &shortcuts).unwrap();
        assert_eq!(apart(&exact, &output), 0.0, "{shortcuts:?}");
    }
}

#[test]
fn each_precision_is_as_fine_as_it_says() {
    let (storm, clip) = (storm(), clip(0));
    let exact = storm.forward(&clip).unwrap();
    let error = |precision| {
        apart(&exact, &storm.forward_with(&clip, &Shortcuts { precision, ..Shortcuts::default() }).unwrap())
    };
    let (int16, int8, bf16) = (error(Precision::Int16), error(Precision::Int8), error(Precision::Bf16));
    // The limit for bf16 is 2e-2.
    assert!(int16 > 0.0 && int16 < 2e-3, "{int16:e}");
    assert!(int8 > int16 && int8 < 2e-2, "{int8:e}");
    assert!(bf16 > int16 && bf16 < 2e-2, "{bf16:e}");
}

#[test]
fn the_newest_timestep_alone_is_that_of_all() {
    let (storm, clip) = (storm(), clip(0));
    let all = storm.forward(&clip).unwrap();
    let one = storm.forward_with(&clip, &Shortcuts { newest_only: true, ..Shortcuts::default() }).unwrap();
    assert_eq!(one.means.dims(), [1, 1, CAMERAS, HEIGHT, WIDTH, 3]);
    let scene = one.scene(0).unwrap();
    assert_eq!((scene.shape.timesteps, scene.gaussians.len()), (1, CAMERAS * HEIGHT * WIDTH));
    assert!(scene.gaussians.time_sec.iter().all(|&t| t == 1.0));
    for (a, b) in parts(&all).iter().zip(&parts(&one)) {
        let (a, b) = (values(a), values(b));
        // Per window, or the last part of what is per timestep.
        for (x, y) in a[a.len() - b.len()..].iter().zip(&b) {
            assert!((x - y).abs() <= 1e-4 * x.abs().max(1.0), "{x} {y}");
        }
    }
}

#[test]
fn dropped_patches_are_transparent_and_the_others_still_there() {
    let (storm, clip) = (storm(), clip(0));
    let exact = storm.forward(&clip).unwrap().scene(0).unwrap();
    // The top row of patches of every picture.
    let per_picture = (HEIGHT / 8) * (WIDTH / 8);
    let keep: Vec<bool> = (0..patches()).map(|i| i % per_picture >= WIDTH / 8).collect();
    for newest_only in [false, true] {
        let shortcuts = Shortcuts { keep: Some(keep.clone()), newest_only, ..Shortcuts::default() };
        let scene = storm.forward_with(&clip, &shortcuts).unwrap().scene(0).unwrap();
        let g = &scene.gaussians;
        let mut apart = 0f32;
        let offset = exact.gaussians.len() - g.len();
        for i in 0..g.len() {
            if i / WIDTH % HEIGHT < 8 {
                assert_eq!((g.opacities[i], g.velocity_forward[i]), (0.0, [0.0; 3]));
            } else {
                assert!(g.opacities[i] > 0.0);
                apart = apart.max((scene.depths[i] / exact.depths[i + offset] - 1.0).abs());
            }
        }
        assert!(apart > 0.0 && apart < 0.5, "{apart}");
    }
    let error = storm.forward_with(&clip, &Shortcuts { keep: Some(vec![true; 3]), ..Shortcuts::default() });
    assert!(error.unwrap_err().to_string().contains("3 entries"));
}

#[test]
fn pooling_and_merging_change_little_and_combine() {
    let (storm, clip) = (storm(), clip(0));
    let exact = storm.forward(&clip).unwrap();
    let with = |shortcuts: &Shortcuts| apart(&exact, &storm.forward_with(&clip, shortcuts).unwrap());
    for shortcuts in [
        Shortcuts { kv_pool: 2, ..Shortcuts::default() },
        Shortcuts { merge: 0.25, ..Shortcuts::default() },
        Shortcuts { kv_pool: 2, merge: 0.25, precision: Precision::Int16, ..Shortcuts::default() },
    ] {
        let error = with(&shortcuts);
        assert!(error > 1e-6 && error < 0.5, "{shortcuts:?}: {error}");
    }
    for wrong in [Shortcuts { kv_pool: 9, ..Shortcuts::default() }, Shortcuts { merge: 1.0, ..Shortcuts::default() }] {
        assert!(storm.forward_with(&clip, &wrong).is_err());
    }
}

#[test]
fn a_batch_is_its_windows() {
    let storm = storm();
    let clips = [clip(0), clip(5)];
    for shortcuts in [
        Shortcuts { kv_pool: 2, precision: Precision::Int16, ..Shortcuts::default() },
        Shortcuts { merge: 0.3, ..Shortcuts::default() },
    ] {
        let both = storm.forward_with(&ClipBatch::stack(&clips).unwrap(), &shortcuts).unwrap();
        for (i, clip) in clips.iter().enumerate() {
            let alone = storm.forward_with(clip, &shortcuts).unwrap();
            for (a, b) in parts(&alone).iter().zip(&parts(&both)) {
                let (a, b) = (values(&a.get(0).unwrap()), values(&b.get(i).unwrap()));
                assert!(a.iter().zip(&b).all(|(x, y)| (x - y).abs() <= 1e-4 * x.abs().max(1.0)), "window {i}");
            }
        }
    }
}

#[test]
fn a_pass_that_leaves_something_says_the_same() {
    let (storm, clip) = (storm(), clip(0));
    let (output, kept) = storm.forward_keeping(&clip, Precision::F32).unwrap();
    assert_eq!(apart(&storm.forward(&clip).unwrap(), &output), 0.0);
    assert!(kept.bytes() > 4 * values(&output.means).len());
}

/// Per timestep: its part of `x` `(1, t, ...)`.
fn timestep(x: &Tensor, t: usize) -> Vec<f32> {
    values(&x.narrow(1, t, 1).unwrap())
}

/// Keys and values of the first block are of the input alone: with one block nothing is approximated but that older timesteps
/// are what they were said to be before.
#[test]
fn with_one_block_a_pass_that_goes_on_is_exact() {
    let config = ModelConfig { depth: 1, ..ModelConfig::preset("tiny").unwrap() };
    let storm = Storm::untrained(&config, 3, &Device::Cpu).unwrap();
    let (first, next) = (clip_of(0, 0..3), clip_of(0, 1..4));
    let (before, kept) = storm.forward_keeping(&first, Precision::F32).unwrap();
    let (output, _) = storm.forward_reusing(&next, &kept, Precision::F32).unwrap();
    let full = storm.forward(&next).unwrap();
    for ((now, whole), then) in parts(&output).iter().zip(&parts(&full)).zip(&parts(&before)).take(8) {
        assert_eq!(now.dims(), whole.dims());
        for (a, b) in timestep(now, 2).iter().zip(&timestep(whole, 2)) {
            assert!((a - b).abs() <= 1e-4 * b.abs().max(1.0), "{a} {b}");
        }
        assert_eq!((timestep(now, 0), timestep(now, 1)), (timestep(then, 1), timestep(then, 2)));
    }
}

#[test]
fn passes_go_on_from_each_other_and_stay_near_the_full_ones() {
    let storm = storm();
    let (_, mut kept) = storm.forward_keeping(&clip_of(0, 0..3), Precision::F32).unwrap();
    for first in 1..4 {
        let next = clip_of(0, first..first + 3);
        let (output, left) = storm.forward_reusing(&next, &kept, Precision::F32).unwrap();
        let error = apart(&storm.forward(&next).unwrap(), &output);
        assert!(error > 1e-6 && error < 0.5, "{first}: {error}");
        let (whole, _) = storm.forward_reusing(&next, &kept, Precision::Int16).unwrap();
        assert!(apart(&output, &whole) < 5e-3);
        kept = left;
    }
    // A window that grows by a timestep.
    let (output, _) = storm.forward_reusing(&clip_of(0, 3..7), &kept, Precision::F32).unwrap();
    assert_eq!(output.means.dims()[1], 4);
}

#[test]
fn windows_that_cannot_go_on_are_refused() {
    let storm = storm();
    let (_, kept) = storm.forward_keeping(&clip_of(0, 0..3), Precision::F32).unwrap();
    let two = ClipBatch::stack(&[clip_of(0, 1..4), clip_of(1, 1..4)]).unwrap();
    for wrong in [two, clip_of(0, 0..5), clip_of(0, 0..1)] {
        let error = storm.forward_reusing(&wrong, &kept, Precision::F32).unwrap_err().to_string();
        assert!(error.contains("cannot go on"), "{error}");
    }
}
