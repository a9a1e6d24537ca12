use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use storm_model::scene::Scene;
use storm_render::Intrinsics;
use storm_render::world::{Drive, DriveOptions};

use crate::config::{ModelConfigSection, SkipConfig, WindowConfig};
use crate::engine::evaluate::{CLIP_FRAMES, Clip, Placed, Prediction, Tally};
use crate::engine::truth::TruthAt;
use crate::engine::{Engine, ModelSource};
use crate::rigid::Rigid;
use crate::source::Frame;
use crate::source::world::posed_set;
use crate::window::{PosedSet, Window, WindowBuilder};

/// Frames between windows of one phase: half a second at 10 Hz.
const STRIDE: usize = 5;
/// A drive whose vehicle moves from the start.
const MOVING: u64 = 1;

fn engine(reuse: usize) -> Engine {
    let weights = std::env::var("STORM_WEIGHTS").unwrap_or_default();
    let section = ModelConfigSection { weights, ..ModelConfigSection::default() };
    let source = ModelSource::open(&section).unwrap();
    Engine::new(source, &section, 3, 2.0).unwrap().with_skips(&SkipConfig { reuse, ..SkipConfig::default() })
}

/// What a drive at 10 Hz shows, and its cameras.
struct Seen {
    frames: Vec<(Arc<PosedSet<Frame>>, Vec<TruthAt>)>,
    windows: Vec<Window<Frame>>,
    cameras: Vec<Intrinsics>,
}

fn seen(seed: u64, frames: usize, (width, height): (usize, usize)) -> Seen {
    let options = DriveOptions {
        seed,
        seconds: frames as f64 / 10.0,
        cameras: 3,
        width,
        height,
        rate_hz: 10.0,
        ..DriveOptions::default()
    };
    let drive = Drive::new(&options).unwrap();
    let mut builder = WindowBuilder::new(&WindowConfig { stride_tolerance: 0.01, ..WindowConfig::default() }, 1);
    let mut windows = Vec::new();
    let frames = (0..frames).map(|i| {
        let (set, truth) = posed_set(&drive, i);
        windows.extend(builder.push(set.clone()));
        (Arc::new(set), truth.into_iter().map(TruthAt::of_frame).collect())
    });
    let frames = frames.collect();
    Seen { frames, windows, cameras: drive.cameras().iter().map(|c| c.intrinsics).collect() }
}

/// Where Gaussian `i` is in the map.
fn place(anchor: &Rigid, scene: &Scene, i: usize) -> glam::DVec3 {
    anchor.apply(glam::Vec3::from(scene.gaussians.means[i]).as_dvec3())
}

#[test]
fn windows_go_on_from_the_one_a_stride_before_until_one_is_full_again() {
    let Seen { windows, cameras, .. } = seen(MOVING, 38, (48, 32));
    let (mut engine, mut full) = (engine(2), engine(0));
    let mut before: Vec<(Rigid, Scene)> = Vec::new();
    for (i, window) in windows.iter().enumerate() {
        // Five phases: five full windows, ten that go on, and again.
        let goes_on = !(i / STRIDE).is_multiple_of(3);
        assert_eq!(engine.approximates(window, &cameras), goes_on, "window {i}");
        let (anchor, scene) = engine.shortest_step(window, &cameras).unwrap();
        assert_eq!(scene.shape.timesteps, 4);
        let times = window.time_sec.iter().flatten().map(|&t| t as f32);
        let pixels = scene.shape.height * scene.shape.width;
        for (own, now) in times.zip(scene.gaussians.time_sec.chunks(pixels)) {
            assert!((own - now[0]).abs() < 1e-4, "the clock is the window's own: {own} s, {} s", now[0]);
        }
        let exact = full.exact_step(window, &cameras).unwrap();
        if goes_on {
            let (old_anchor, old) = &before[i - STRIDE];
            assert!(anchor.translation.distance(window.map_from_anchor.translation) > 0.5, "window {i}");
            assert_eq!(&anchor, old_anchor);
            // What was said of older timesteps stays said; the newest is new, and near what a full step says of it.
            let newest = scene.gaussians.len() / 4 * 3;
            let each = scene.gaussians.len() / 4;
            assert!((0..newest).step_by(97).all(|i| place(&anchor, &scene, i) == place(old_anchor, old, i + each)));
            let far = |i: usize| {
                let truth = place(&window.map_from_anchor, &exact, i);
                (place(&anchor, &scene, i) - truth).length() / truth.distance(window.map_from_anchor.translation)
            };
            let mut apart: Vec<f64> = (newest..scene.gaussians.len()).step_by(7).map(far).collect();
            apart.sort_by(f64::total_cmp);
            let median = apart[apart.len() / 2];
            assert!(median > 0.0 && median < 0.2, "window {i}: {median}");
        } else {
            assert_eq!(anchor, window.map_from_anchor);
            assert_eq!(scene.gaussians.means, exact.gaussians.means, "window {i}");
        }
        before.push((anchor, scene));
    }
    assert!(windows.len() > 3 * STRIDE + 2);
}

#[test]
fn what_was_left_is_gone_on_from_only_where_it_fits() {
    let Seen { windows, cameras, .. } = seen(MOVING, 24, (48, 32));
    let next = &windows[STRIDE];
    let mut engine = engine(3);
    engine.exact_step(&windows[0], &cameras).unwrap();
    assert!(engine.approximates(next, &cameras));
    assert!(!engine.approximates(&windows[STRIDE - 1], &cameras), "another phase");
    assert!(!engine.approximates(&windows[0], &cameras), "the same window");
    let mut other = cameras.clone();
    other[1].fx *= 1.01;
    assert!(!engine.approximates(next, &other), "other cameras");
    let mut later = next.clone();
    later.epoch += 1;
    assert!(!engine.approximates(&later, &cameras), "another epoch");
    let mut seen_anew = next.clone();
    seen_anew.steps[0] = Arc::new((*seen_anew.steps[0]).clone());
    assert!(!engine.approximates(&seen_anew, &cameras), "not the very same set");
    engine.restart().unwrap();
    assert!(!engine.approximates(next, &cameras), "forgotten");
    // Nothing piles up: what no window can go on from goes.
    for window in &windows {
        engine.shortest_step(window, &cameras).unwrap();
        assert!(engine.reuse.left.len() <= 3 * STRIDE + 1, "{}", engine.reuse.left.len());
    }
}

/// A measurement, not a check: `cargo test --release -p storm-node --lib reuse::tests::cost -- --ignored --nocapture`, with other
/// weights in `STORM_WEIGHTS`. Windows one to four strides after a full one, each as it goes on and in full, by the protocol of
/// `storm eval` on 20 drives.
#[test]
#[ignore = "timing"]
fn cost() {
    const MOST: usize = 4;
    let (mut engine, mut full) = (engine(MOST), engine(0));
    let mut tallies: BTreeMap<(usize, &str), Tally> = BTreeMap::new();
    for seed in 30_000..30_020 {
        let Seen { frames, windows, cameras } = seen(seed, CLIP_FRAMES + MOST * STRIDE, (96, 64));
        engine.restart().unwrap();
        for (strides, window) in windows.iter().step_by(STRIDE).take(MOST + 1).enumerate() {
            let cut = frames[strides * STRIDE..][..CLIP_FRAMES].to_vec();
            let clip = Clip::new(String::new(), seed, window.clone(), 1, cut, cameras.clone(), Vec::new());
            let mut add = |name, anchor, scene, since: Instant| {
                let ms = since.elapsed().as_secs_f64() * 1e3;
                let placed = Placed { stamp_ns: window.stamp_ns, map_from_anchor: anchor, scene, pixel_aligned: true };
                let tally = tallies.entry((strides, name)).or_default();
                tally.add(&clip, &Prediction::Scenes(vec![placed]), Some(ms)).unwrap();
            };
            let start = Instant::now();
            let scene = full.exact_step(window, &cameras).unwrap();
            add("in full", window.map_from_anchor, scene, start);
            let start = Instant::now();
            let (anchor, scene) = engine.shortest_step(window, &cameras).unwrap();
            add("going on", anchor, scene, start);
        }
    }
    for ((strides, name), tally) in &tallies {
        let f = tally.figures();
        let figure = |x: Option<f64>| x.unwrap_or(f64::NAN);
        println!(
            "{strides} strides, {name:8}: {:.1} ms, PSNR {:.2} dB (moving {:.2}), depth {:.2} m, EPE3D {:.3} m/s, of moving \
             users {:.2}, of the background {:.3}, moving IoU {:.3}, foreground ARI {:.3}",
            figure(f.ms),
            figure(f.psnr),
            figure(f.psnr_dynamic),
            figure(f.depth_rmse),
            figure(f.epe3d),
            figure(f.epe3d_foreground_dynamic),
            figure(f.epe3d_background_static),
            figure(f.moving_iou),
            figure(f.fg_ari),
        );
    }
}
