use std::sync::Arc;

use candle_core::Tensor;
use glam::Vec3;

use super::clips::{ClipOptions, ClipPlan, HELD_OUT_SEEDS};
use super::loader::{DataOptions, Loader};
use super::looks::LookOptions;
use crate::config::ModelConfig;

fn small() -> ClipOptions {
    ClipOptions { width: 24, height: 16, cameras: 3, targets: 2, ..ClipOptions::default() }
}

fn values(x: &Tensor) -> Vec<f32> {
    x.flatten_all().unwrap().to_vec1().unwrap()
}

/// Where surfaces seen twice may differ at most, metres over depth: half a pixel's footprint at this picture size, on
/// surfaces seen at a slant.
const SAME_SURFACE: f32 = 0.15;

#[test]
fn samples_depend_on_seed_and_index_only_and_leave_the_held_out_drives_alone() {
    let options = small();
    for index in 0..2000 {
        let plan = ClipPlan::training(3, index, &options);
        assert!(!HELD_OUT_SEEDS.contains(&plan.drive_seed));
        assert!(plan.start_sec >= 0.0 && plan.start_sec + options.span_sec <= options.drive_sec);
        assert!(plan.target_sec.iter().all(|&t| (0.0..options.span_sec).contains(&t)));
        assert_eq!(plan, ClipPlan::training(3, index, &options));
        assert_ne!(plan, ClipPlan::training(4, index, &options));
        assert_ne!(plan.drive_seed, ClipPlan::training(3, index + 1, &options).drive_seed);
    }
}

#[test]
fn the_anchor_is_the_front_camera_and_static_points_agree_between_pictures() {
    let options = ClipOptions { width: 48, height: 32, ..small() };
    let clip = ClipPlan::of_drive(10_500, &options).make(&options, &ModelConfig::preset("tiny").unwrap()).unwrap();
    let pose = values(&clip.context.world_from_camera.get(0).unwrap().get(0).unwrap().get(1).unwrap());
    let want = [0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    for (a, b) in pose.iter().zip(want) {
        assert!((a - b).abs() < 1e-6, "{pose:?}");
    }
    assert_eq!(values(&clip.context.time_sec)[9..], [1.5, 1.5, 1.5]);

    // Surface points of the first front picture, seen again by the front camera at the next timestep.
    let (h, w) = (options.height, options.width);
    let picture = |x: &Tensor, t: usize| values(&x.get(0).unwrap().get(t).unwrap().get(1).unwrap());
    let k = picture(&clip.context.intrinsics, 0);
    let m = picture(&clip.context.world_from_camera, 1);
    let truth = &clip.context_truth;
    let (depth, next) = (picture(&truth.depth, 0), picture(&truth.depth, 1));
    let (moving, flow) = (picture(&truth.moving, 0), picture(&truth.flow, 0));
    let (mut same, mut seen) = (0, 0);
    for i in 0..h * w {
        if depth[i] == 0.0 {
            assert_eq!(picture(&truth.sky, 0)[i], 1.0);
            continue;
        }
        if moving[i] == 1.0 {
            assert!(Vec3::from_slice(&flow[3 * i..]).length() > 0.0);
            continue;
        }
        assert_eq!(flow[3 * i..3 * i + 3], [0.0; 3]);
        let (u, v) = ((i % w) as f32 + 0.5, (i / w) as f32 + 0.5);
        let (x, y) = ((u - k[2]) / k[0] * depth[i], (v - k[5]) / k[4] * depth[i]);
        // Anchor axes at the first front camera: forward, left, up.
        let d = Vec3::new(depth[i], -x, -y) - Vec3::new(m[3], m[7], m[11]);
        let column = |c: usize| Vec3::new(m[c], m[4 + c], m[8 + c]);
        let p = Vec3::new(column(0).dot(d), column(1).dot(d), column(2).dot(d));
        let (u, v) = (k[0] * p.x / p.z + k[2], k[4] * p.y / p.z + k[5]);
        if p.z > 0.5 && u >= 0.0 && v >= 0.0 && (u as usize) < w && (v as usize) < h {
            seen += 1;
            same += usize::from((next[v as usize * w + u as usize] - p.z).abs() < SAME_SURFACE * p.z);
        }
    }
    assert!(seen > 200 && same * 10 > seen * 8, "{same} of {seen} points are where they were");
}

#[test]
fn any_number_of_threads_gives_the_same_batches() {
    let config = Arc::new(ModelConfig::preset("tiny").unwrap());
    let options = DataOptions { seed: 9, batch: 2, clips: small(), one_camera_batches: 1, targets_from: 0, reuse: 1 };
    let run = |threads: usize, first: u64| {
        let mut loader = Loader::new(options.clone(), Arc::clone(&config), first, threads);
        (0..3).map(|_| loader.next_batch().unwrap()).collect::<Vec<_>>()
    };
    let (one, two, later) = (run(1, 0), run(2, 0), run(2, 1));
    assert_eq!(one[0].context.image.dims(), [2, 4, 1, 3, 16, 24]);
    assert_eq!(one[1].context.image.dims(), [2, 4, 3, 3, 16, 24]);
    for (a, b) in one.iter().zip(&two).chain(one[1..].iter().zip(&later)) {
        assert_eq!(values(&a.context.image), values(&b.context.image));
        assert_eq!(values(&a.target.as_ref().unwrap().1.depth), values(&b.target.as_ref().unwrap().1.depth));
        assert_eq!(values(&a.sky.directions), values(&b.sky.directions));
    }
    assert_ne!(values(&one[1].context.image), values(&one[2].context.image));
}

#[test]
fn an_early_anchor_moves_frame_and_clock_and_nothing_else() {
    let usual = small();
    let early = ClipOptions { anchor_lead: 2, ..usual };
    let config = ModelConfig::preset("tiny").unwrap();
    let plans = (0..60).map(|k| (ClipPlan::training(1, k, &usual), ClipPlan::training(1, k, &early)));
    let mut leads = std::collections::BTreeMap::new();
    for (a, b) in plans {
        assert_eq!(a, ClipPlan { lead_sec: 0.0, ..b.clone() });
        assert!(b.lead_sec <= b.start_sec);
        let count = leads.entry((2.0 * b.lead_sec) as usize).or_insert(0);
        *count += 1;
        if *count > 1 {
            continue;
        }
        let (one, other) = (a.make(&usual, &config).unwrap(), b.make(&early, &config).unwrap());
        let numbers = |x: &Tensor| x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(numbers(&one.context.image), numbers(&other.context.image));
        let later = numbers(&one.context.time_sec).iter().map(|t| t + b.lead_sec as f32).collect::<Vec<_>>();
        assert_eq!(numbers(&other.context.time_sec), later);
        // The first reference camera is where the vehicle had driven to by then.
        let pose = numbers(&other.context.world_from_camera);
        let far = [3, 7, 11].map(|i| pose[16 * usual.reference() + i]).iter().map(|x| x * x).sum::<f32>().sqrt();
        assert!(b.lead_sec > 0.0 || far < 1e-5, "{far}");
        assert!(far < 40.0 * b.lead_sec as f32 + 1e-5, "{far}");
    }
    assert_eq!(leads.keys().copied().collect::<Vec<_>>(), [0, 1, 2], "{leads:?}");
}

#[test]
fn variety_changes_lenses_and_cameras_and_nothing_else() {
    let usual = ClipOptions::default();
    let varied = ClipOptions { variety: true, ..usual };
    let mut zoomed = 0;
    for k in 0..200 {
        let (a, b) = (ClipPlan::training(1, k, &usual), ClipPlan::training(1, k, &varied));
        assert_eq!(a, ClipPlan { zoom: [1.0; 2], ..b.clone() });
        zoomed += usize::from(b.zoom != [1.0; 2]);
    }
    assert!((60..140).contains(&zoomed), "{zoomed} of 200");
    let data = DataOptions {
        seed: 2,
        batch: 1,
        clips: ClipOptions { variety: true, ..small() },
        one_camera_batches: 0,
        targets_from: 0,
        reuse: 1,
    };
    let config = ModelConfig::preset("tiny").unwrap();
    let cameras = |n: u64| data.batch(32 * n, &config).unwrap().context.dims().unwrap()[2];
    let seen: std::collections::BTreeSet<usize> = (0..12).map(cameras).collect();
    assert!(seen.contains(&3) && seen.len() >= 2, "{seen:?}");
}

#[test]
fn looks_change_colours_of_training_clips_only() {
    let config = ModelConfig::preset("tiny").unwrap();
    let usual = small();
    let varied = ClipOptions { looks: LookOptions { sensor: true, ..LookOptions::default() }, ..usual };
    assert_eq!(ClipPlan::of_drive(10_500, &varied), ClipPlan::of_drive(10_500, &usual), "validation is plain");
    let mut changed = 0;
    for k in 0..8 {
        let (a, b) = (ClipPlan::training(1, k, &usual), ClipPlan::training(1, k, &varied));
        assert_eq!(a, ClipPlan { looks: LookOptions::default(), ..b.clone() });
        let (one, other) = (a.make(&usual, &config).unwrap(), b.make(&varied, &config).unwrap());
        let again = b.make(&varied, &config).unwrap();
        assert_eq!(values(&other.context.image), values(&again.context.image));
        assert!(values(&other.context.image).iter().all(|x| (-1.0..=1.0).contains(x)));
        changed += usize::from(values(&one.context.image) != values(&other.context.image));
        // What the sky terms are taught is what these cameras saw.
        let sky = |clip: &super::clips::TrainClip| (values(&clip.sky.directions), values(&clip.sky.colors));
        let image = values(&other.context.image);
        assert_eq!(sky(&one).0, sky(&other).0);
        let weights = values(&other.sky.weights);
        for (c, _) in sky(&other).1.chunks(3).zip(&weights).filter(|(_, w)| **w == 1.0) {
            assert!(image.contains(&c[0]));
        }
        let truth = |clip: &super::clips::TrainClip| {
            let t = &clip.target.as_ref().unwrap().1;
            (values(&t.depth), values(&t.flow), values(&t.sky), values(&t.moving))
        };
        assert_eq!(truth(&one), truth(&other));
        assert_eq!(values(&one.context.world_from_camera), values(&other.context.world_from_camera));
    }
    assert!(changed >= 6, "{changed} of 8");
}

#[test]
fn pose_errors_are_in_what_is_given_and_not_in_what_is_asked_for() {
    let config = ModelConfig::preset("tiny").unwrap();
    let usual = small();
    let varied = ClipOptions { looks: LookOptions { poses: true, ..LookOptions::default() }, ..usual };
    let mut differ = 0;
    for k in 0..8 {
        let one = ClipPlan::training(1, k, &usual).make(&usual, &config).unwrap();
        let other = ClipPlan::training(1, k, &varied).make(&varied, &config).unwrap();
        assert_eq!(values(&one.context.image), values(&other.context.image));
        let (a, b) = (values(&one.context.world_from_camera), values(&other.context.world_from_camera));
        differ += usize::from(a != b);
        // 25 ms at 22 m/s, and the poses' own errors.
        assert!(a.iter().zip(&b).all(|(x, y)| (x - y).abs() < 0.8), "{k}");
        let target = |clip: &super::clips::TrainClip| values(&clip.target.as_ref().unwrap().0.world_from_camera);
        assert_eq!(target(&one), target(&other));
    }
    assert!(differ >= 3, "{differ} of 8");
}

#[test]
fn every_part_of_the_looks_gives_sound_clips() {
    let config = ModelConfig::preset("tiny").unwrap();
    for cameras in [1, 2, 3] {
        let options = ClipOptions { cameras, looks: LookOptions::varied(), ..small() };
        for k in 0..24 {
            let clip = ClipPlan::training(5, k, &options).make(&options, &config).unwrap();
            let truth = &clip.context_truth;
            let finite = |x: &Tensor| values(x).iter().all(|v| v.is_finite());
            assert!(finite(&truth.depth) && finite(&truth.flow) && finite(&clip.context.world_from_camera));
            assert!(values(&truth.depth).iter().zip(values(&truth.sky)).all(|(&d, s)| (d == 0.0) == (s == 1.0)));
            assert!(values(&clip.context.image).iter().all(|x| (-1.0..=1.0).contains(x)));
        }
    }
}
