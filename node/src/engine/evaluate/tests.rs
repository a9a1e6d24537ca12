//! Whole evaluations at a small size.

use std::sync::Arc;

use storm_render::world::{Drive, DriveOptions};

use super::bag::{BagClips, Part};
use super::*;
use crate::config::{Config, ModelConfigSection};
use crate::engine::{Engine, ModelSource, UNTRAINED};
use crate::synth::{SynthOptions, write_drive};

const SIZE: (usize, usize) = (48, 32);
/// A drive with road users that move in the pictures of its first two seconds.
const SEED: u64 = 10_001;

fn engine(cameras: usize) -> Engine {
    // What these tests show does not depend on weights.
    let section = ModelConfigSection { weights: UNTRAINED.into(), ..ModelConfigSection::default() };
    Engine::new(ModelSource::open(&section).unwrap(), &section, cameras, 2.0).unwrap()
}

fn evaluate(clips: &[Clip], methods: &[Method]) -> Vec<(Method, Figures)> {
    let effort = Effort { gs3d_iterations: 6, nsfp_iterations: 6 };
    let mut evaluation = Evaluation::new(engine(clips[0].cameras.len()), None, methods, effort);
    clips.iter().for_each(|clip| evaluation.add(clip, &mut |_, _| {}).unwrap());
    evaluation.figures()
}

/// Without run times, which are never the same.
fn timeless(figures: Vec<(Method, Figures)>) -> Vec<(Method, Figures)> {
    figures.into_iter().map(|(m, f)| (m, Figures { ms: None, ..f })).collect()
}

fn of(all: &[(Method, Figures)], method: Method) -> &Figures {
    &all.iter().find(|(m, _)| *m == method).unwrap().1
}

#[test]
fn every_method_gives_the_same_figures_twice_whatever_the_threads() {
    let clip = Clip::of_seed(SEED, SIZE, 0.0).unwrap();
    let pool = |n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
    let clips = [clip];
    let one = pool(1).install(|| evaluate(&clips, &Method::ALL));
    let three = pool(3).install(|| evaluate(&clips, &Method::ALL));
    for (method, figures) in &one {
        let timed = !matches!(method, Method::ConstantVelocity | Method::OracleGeometry | Method::NearestContext);
        assert_eq!(figures.ms.is_some(), timed, "{}", method.name());
        assert_eq!(figures.psnr.is_some(), *method != Method::Nsfp, "{}", method.name());
        assert_eq!(figures.epe3d.is_some(), *method != Method::NearestContext, "{}", method.name());
        assert_eq!(figures.apd3d.is_some(), *method != Method::NearestContext, "{}", method.name());
    }
    assert_eq!(timeless(one), timeless(three));
}

#[test]
fn ceilings_lie_above_what_knows_no_motion() {
    let clip = Clip::of_seed(SEED, SIZE, 0.0).unwrap();
    let methods = [Method::Static, Method::ConstantVelocity, Method::OracleGeometry];
    let all = evaluate(&[clip], &methods);
    let still = of(&all, Method::Static);
    assert_eq!(still.epe3d_background_static, Some(0.0));
    assert_eq!((still.moving_iou, still.fg_ari), (Some(0.0), Some(0.0)));
    for method in &methods[1..] {
        let ceiling = of(&all, *method);
        assert!(ceiling.epe3d_foreground_dynamic < still.epe3d_foreground_dynamic, "{ceiling:?}");
        assert!(ceiling.psnr > still.psnr && ceiling.depth_rmse < still.depth_rmse, "{ceiling:?}");
        assert!(ceiling.apd3d > Some(0.5) && ceiling.apd3d > still.apd3d, "{ceiling:?}");
        assert!(ceiling.moving_iou > Some(0.3) && ceiling.fg_ari > Some(0.2), "{ceiling:?}");
    }
}

#[test]
fn no_method_is_scored_on_images_that_the_network_saw_as_prior_ones() {
    let clip = Clip::of_seed(SEED, SIZE, 0.1).unwrap();
    let held_out = clip.frames.iter().filter(|f| f.held_out()).count();
    // One before each of the four timesteps but the first, which the drive begins with.
    assert_eq!(held_out, CLIP_FRAMES - 4 - 3);
    for method in [Method::Storm, Method::NearestContext] {
        let mut evaluation = Evaluation::new(engine(3), None, &[method], Effort::default());
        evaluation.add(&clip, &mut |_, _| {}).unwrap();
        assert_eq!(evaluation.images(), 3 * held_out, "{}", method.name());
    }
}

#[test]
fn a_frame_that_equals_its_context_is_answered_perfectly_by_it() {
    let mut clip = Clip::of_seed(SEED, SIZE, 0.0).unwrap();
    // Frame 1 becomes a copy of frame 0 but for one grey level in one value.
    let mut copy = (*clip.frames[0].set).clone();
    let mut rgb = (*copy.frames[0].item.rgb).clone();
    rgb.data[0] ^= 1;
    copy.frames[0].item.rgb = Arc::new(rgb);
    copy.frames.truncate(1);
    copy.stamp_ns += 1_000_000;
    clip.frames.truncate(2);
    clip.frames[1].set = Arc::new(copy);
    clip.frames[1].truth.truncate(1);
    clip.frames[1].truth[0].sky = None;
    let all = evaluate(&[clip], &[Method::NearestContext]);
    let values = (SIZE.0 * SIZE.1 * 3) as f64;
    let expected = 10.0 * (255.0f64 * 255.0 * values).log10();
    let psnr = of(&all, Method::NearestContext).psnr.unwrap();
    // f32 pictures.
    assert!((psnr - expected).abs() < 1e-3, "{psnr} {expected}");
}

#[test]
fn a_bag_with_ground_truth_is_scored_like_the_drive_it_holds() {
    let folder = tempfile::tempdir().unwrap();
    let open = |seconds: f64, part: &Part| {
        let (width, height) = SIZE;
        let options = DriveOptions { seed: SEED, seconds, width, height, cameras: 3, ..DriveOptions::default() };
        let path = folder.path().join(format!("drive{seconds}"));
        if !path.exists() {
            write_drive(&Drive::new(&options).unwrap(), &path, &SynthOptions::default(), &mut |_, _| {}).unwrap();
        }
        BagClips::open(&path, &Config::default(), SIZE, 0.0, part)
    };
    let all = Part { from_sec: 0.0, to_sec: f64::INFINITY, clips: 4 };
    let cut = |seconds: f64, part: &Part| {
        let bag = open(seconds, part).unwrap();
        let mut clips = Vec::new();
        bag.each(|clip| {
            clips.push(clip);
            Ok(())
        })
        .unwrap();
        assert_eq!(clips.len(), bag.count());
        clips
    };
    // Two seconds hold the suite's clip and no other one that is complete.
    let clips = cut(2.0, &all);
    assert_eq!(clips.len(), 1);
    let context: Vec<usize> = clips[0].frames.iter().enumerate().filter_map(|(i, f)| f.context.map(|_| i)).collect();
    assert_eq!((clips[0].frames.len(), context), (20, vec![0, 5, 10, 15]));
    let methods = [Method::OracleGeometry, Method::NearestContext];
    let from_bag = timeless(evaluate(&clips, &methods));
    let mut drive = Clip::of_seed(SEED, SIZE, 0.0).unwrap();
    drive.tracks.clear();
    let from_drive = timeless(evaluate(&[drive], &methods));
    // The bag's poses are stored rounded to quaternions; everything else is the same.
    for ((_, a), (_, b)) in from_bag.iter().zip(&from_drive) {
        for ((name, _, a), (_, _, b)) in a.rows().into_iter().zip(b.rows()) {
            assert_eq!(a.is_some(), b.is_some(), "{name}");
            assert!((a.unwrap_or(0.0) - b.unwrap_or(0.0)).abs() < 0.02, "{name}: {a:?} {b:?}");
        }
    }
    let later = cut(3.0, &Part { from_sec: 0.5, clips: 3, ..all });
    assert_eq!(later.len(), 3);
    let zero_ns = clips[0].window.steps[0].stamp_ns;
    assert!(later.iter().all(|c| c.window.steps[0].stamp_ns >= zero_ns + 500_000_000 && c.frames.len() == 20));
    assert!(open(3.0, &Part { from_sec: 2.0, ..all }).is_err());
}
