use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use glam::{DQuat, DVec3};

use super::*;
use crate::cdr::encode;
use crate::config::Config;
use crate::engine::{Engine, ModelSource, UNTRAINED};
use crate::msg::{CameraInfo, Header, Image, PoseStamped};
use crate::pipeline::demand::Demand;
use crate::pipeline::posed::PoseStore;
use crate::pipeline::step::{OnPart, Part, Step, StepMaker};
use crate::poses::PoseBuffer;
use crate::rigid::Rigid;
use crate::source::Rig;
use crate::source::mount::PoseNames;
use crate::source::rig::CameraDescription;
use crate::source::translate::Role;
use crate::sync::DropReason;
use crate::tf::TfTree;

const WIDTH: usize = 48;
const HEIGHT: usize = 32;
const TICK_NS: i64 = 100_000_000;
const START_NS: i64 = 1_700_000_000_000_000_000;

fn stamp(i: usize) -> i64 {
    START_NS + i as i64 * TICK_NS
}

fn header(i: usize) -> Header {
    Header { stamp_ns: stamp(i), frame_id: "cam".into() }
}

fn picture(i: usize) -> Vec<u8> {
    let data = (0..WIDTH * HEIGHT * 3).map(|p| (p * 7 + i * 13) as u8).collect();
    let (height, width, step) = (HEIGHT as u32, WIDTH as u32, WIDTH as u32 * 3);
    let image = Image { header: header(i), height, width, encoding: "rgb8".into(), is_bigendian: false, step, data };
    encode::encode_image(&image).unwrap()
}

fn pose(i: usize) -> Vec<u8> {
    let pose = Rigid::new(DQuat::IDENTITY, DVec3::new(i as f64 * 0.5, 0.0, 0.0));
    encode::encode_pose_stamped(&PoseStamped { header: header(i), child_frame_id: String::new(), pose }).unwrap()
}

fn config(cameras: usize) -> Config {
    let mut c = Config::default();
    c.model.weights = UNTRAINED.into();
    (c.model.image_width, c.model.image_height) = (WIDTH, HEIGHT);
    (c.window.timesteps, c.window.stride_sec) = (2, 0.1);
    c.input.base_from_camera = vec![[0.0, 0.0, 0.0, 0.5, -0.5, 0.5, -0.5]; cameras];
    c
}

#[derive(Default)]
struct Seen {
    stamps: Vec<i64>,
    views: Vec<usize>,
    active: Vec<Vec<usize>>,
    vehicles: usize,
}

/// Takes steps, slowly if asked.
struct Slow {
    seen: Arc<Mutex<Seen>>,
    delay: Duration,
    demand: Demand,
}

impl Outlet for Slow {
    fn demand(&mut self) -> Demand {
        self.demand
    }

    fn vehicle(&mut self, _: i64, _: Rigid) {
        self.seen.lock().unwrap().vehicles += 1;
    }

    fn step(&mut self, step: &Step, _: &StepMaker, active: &[usize]) -> anyhow::Result<()> {
        std::thread::sleep(self.delay);
        let mut seen = self.seen.lock().unwrap();
        seen.stamps.push(step.window.stamp_ns);
        seen.views.push(step.views.len());
        seen.active.push(active.to_vec());
        Ok(())
    }

    fn idle(&mut self, _: &StepMaker) -> anyhow::Result<()> {
        Ok(())
    }

    fn configure(&mut self, _: &Config) {}

    fn times(&mut self, _: &[(&'static str, f64)]) {}
}

struct Running {
    live: Live,
    seen: Arc<Mutex<Seen>>,
}

/// Cameras that look ahead, of the pictures' size.
pub(crate) fn rig(cameras: usize) -> Arc<Rig> {
    let config = config(cameras);
    let intrinsics = storm_render::Intrinsics {
        fx: 40.0,
        fy: 40.0,
        cx: WIDTH as f32 / 2.0,
        cy: HEIGHT as f32 / 2.0,
        width: WIDTH,
        height: HEIGHT,
    };
    let described = (0..cameras)
        .map(|i| CameraDescription {
            topic: format!("/camera{i}/image_rect"),
            info_topic: format!("/camera{i}/camera_info"),
            frame_id: Some("cam".into()),
            info: Some(CameraInfo::pinhole(&intrinsics, header(0))),
            black_frame: None,
        })
        .collect();
    let tree = TfTree::new(&config.sync);
    Arc::new(Rig::build(described, &tree, &PoseNames::default(), &config.input, (WIDTH, HEIGHT)).unwrap())
}

fn start(cameras: usize, config: &Config, delay: Duration, demand: Demand) -> anyhow::Result<Running> {
    start_with(cameras, config, delay, demand, None)
}

fn start_with(
    cameras: usize,
    config: &Config,
    delay: Duration,
    demand: Demand,
    on_part: Option<OnPart>,
) -> anyhow::Result<Running> {
    let rig = rig(cameras);
    let model = ModelSource::open(&config.model)?;
    let engine = Engine::new(model, &config.model, cameras, config.window.timespan_sec)?;
    let image =
        |camera| LiveInput { topic: format!("/camera{camera}"), role: Role::Image { camera, compressed: false } };
    let mut inputs: Vec<LiveInput> = (0..cameras).map(image).collect();
    let type_name = "geometry_msgs/msg/PoseStamped".into();
    inputs.push(LiveInput { topic: "/pose".into(), role: Role::Pose { type_name } });
    let seen = Arc::new(Mutex::new(Seen::default()));
    let outlet = Box::new(Slow { seen: seen.clone(), delay, demand });
    let options = LiveOptions {
        config: config.clone(),
        rig,
        messages: inbox(&inputs, config),
        inputs,
        store: PoseStore::Buffer(PoseBuffer::new(&config.sync)),
        clock: Box::new(|| START_NS),
        on_part,
    };
    Ok(Running { live: Live::start(options, engine, outlet)?, seen })
}

impl Running {
    fn push(&self, input: usize, data: Vec<u8>) {
        self.live.push(input, Message { input, data, received_ns: 0 });
    }

    /// Waits until `done`; false when it takes too long.
    fn until(&self, done: impl Fn(&Status) -> bool) -> bool {
        let start = Instant::now();
        while start.elapsed() < Duration::from_secs(60) {
            if done(&self.live.status()) {
                return true;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        false
    }
}

#[test]
fn fed_slowly_every_set_gives_a_step_and_nothing_is_lost() {
    let run = start(1, &config(1), Duration::ZERO, Demand::ALL).unwrap();
    for i in 0..6 {
        run.push(1, pose(i));
        run.push(0, picture(i));
        assert!(run.until(|s| s.sets == i as u64 + 1 && s.steps == i as u64), "{:?}", run.live.status());
    }
    let seen = run.seen.clone();
    let status = run.live.stop().unwrap();
    assert_eq!((status.steps, status.sets, status.superseded, status.drops.total()), (5, 6, 0, 0));
    assert_eq!((status.images_in, status.windows.filling), (6, 1));
    assert!((status.hop_sec - 0.1).abs() < 1e-6);
    let seen = seen.lock().unwrap();
    assert_eq!(seen.stamps, (1..6).map(stamp).collect::<Vec<_>>());
    assert_eq!((seen.vehicles, seen.views[0]), (6, 1));
}

#[test]
fn a_burst_ends_at_the_newest_window_with_every_image_accounted_for() {
    let mut c = config(1);
    c.live.queue = 8;
    let run = start(1, &c, Duration::from_millis(60), Demand::ALL).unwrap();
    for i in 0..100 {
        run.push(1, pose(i));
        run.push(0, picture(i));
    }
    assert!(run.until(|s| s.stamp_ns == Some(stamp(99))), "{:?}", run.live.status());
    let status = run.live.stop().unwrap();
    assert_eq!(status.images_in, 100);
    assert!(status.drops.get(DropReason::Overflow) > 50, "{:?}", status.drops);
    assert_eq!(status.sets + status.drops.total(), 100, "{status:?}");
    assert_eq!(status.sets, status.steps + status.superseded + status.windows.filling + status.windows.gap);
    assert!(status.steps < 20, "a step for each of {} is what this is to avoid", status.steps);
}

#[test]
fn a_step_that_takes_longer_than_the_period_makes_the_hop_grow_and_not_the_wait() {
    let run = start(1, &config(1), Duration::from_millis(100), Demand::ALL).unwrap();
    // Images of 10 Hz come every 20 ms: five times what a step can do.
    for i in 0..60 {
        run.push(1, pose(i));
        run.push(0, picture(i));
        std::thread::sleep(Duration::from_millis(20));
        let behind = run.live.status().stamp_ns.map_or(0, |s| (stamp(i) - s) / TICK_NS);
        assert!(i < 10 || behind < 40, "{behind} images behind at image {i}");
    }
    assert!(run.until(|s| s.stamp_ns == Some(stamp(59))));
    let status = run.live.stop().unwrap();
    assert!(status.superseded > 20 && status.hop_sec > 0.2, "{status:?}");
}

#[test]
fn a_camera_that_stops_is_left_out_and_comes_back() {
    let run = start(2, &config(2), Duration::ZERO, Demand::ALL).unwrap();
    let both = |i: usize| {
        run.push(2, pose(i));
        run.push(0, picture(i));
        run.push(1, picture(i));
    };
    (0..2).for_each(both);
    assert!(run.until(|s| s.steps == 1), "{:?}", run.live.status());
    run.live.command(Command::Cameras(vec![1]));
    assert!(run.until(|s| s.active == [1]));
    run.push(2, pose(2));
    run.push(1, picture(2));
    assert!(run.until(|s| s.steps == 2), "the history goes on: {:?}", run.live.status());
    run.live.command(Command::Cameras(vec![0, 1]));
    assert!(run.until(|s| s.active == [0, 1]));
    (3..5).for_each(both);
    assert!(run.until(|s| s.steps == 3), "{:?}", run.live.status());
    let seen = run.seen.clone();
    run.live.stop().unwrap();
    let seen = seen.lock().unwrap();
    assert_eq!(seen.active, [vec![0, 1], vec![1], vec![0, 1]]);
    assert_eq!(seen.views, [2, 1, 2]);
}

#[test]
fn a_clock_that_jumps_back_starts_anew_although_poses_come_after_their_images() {
    let run = start(1, &config(1), Duration::ZERO, Demand::ALL).unwrap();
    let late_pose = |i: usize| {
        run.push(0, picture(i));
        run.push(1, pose(i));
    };
    (1000..1004).for_each(late_pose);
    assert!(run.until(|s| s.stamp_ns == Some(stamp(1003))), "{:?}", run.live.status());
    (10..16).for_each(late_pose);
    assert!(run.until(|s| s.stamp_ns == Some(stamp(15))), "{:?}", run.live.status());
    let status = run.live.stop().unwrap();
    assert_eq!(status.epochs, 1);
}

#[test]
fn what_nobody_wants_is_not_drawn_and_commands_answer() {
    let nothing = Demand { motion: false, tracks: false, objects: false, map: false, pictures: false };
    let run = start(1, &config(1), Duration::ZERO, nothing).unwrap();
    let asked = |make: &dyn Fn(Reply) -> Command| {
        let (tx, rx) = std::sync::mpsc::channel();
        run.live.command(make(Box::new(move |r| tx.send(r).unwrap())));
        rx.recv_timeout(Duration::from_secs(60)).unwrap()
    };
    for i in 0..3 {
        run.push(1, pose(i));
        run.push(0, picture(i));
    }
    assert!(run.until(|s| s.stamp_ns == Some(stamp(2))));
    assert!(asked(&Command::SaveMap).unwrap_err().contains("live.map_dir"));
    assert!(asked(&Command::LoadMap).unwrap_err().contains("map.load"));
    assert!(asked(&|r| Command::Pause(true, r)).unwrap().contains("paused"));
    run.push(1, pose(3));
    run.push(0, picture(3));
    assert!(run.until(|s| s.paused_images == 1));
    assert!(asked(&|r| Command::Pause(false, r)).is_ok());
    assert!(asked(&Command::Reset).is_ok());
    let seen = run.seen.clone();
    let status = run.live.stop().unwrap();
    assert_eq!((status.map_gaussians, status.epochs), (0, 1));
    assert!(seen.lock().unwrap().views.iter().all(|v| *v == 0));
}

#[test]
fn a_saved_map_is_never_emptied_by_a_start() {
    let dir = tempfile::tempdir().unwrap();
    let mut c = config(1);
    c.live.map_dir = dir.path().join("map").to_str().unwrap().into();
    let run = start(1, &c, Duration::ZERO, Demand::ALL).unwrap();
    for i in 0..4 {
        run.push(1, pose(i));
        run.push(0, picture(i));
    }
    assert!(run.until(|s| s.stamp_ns == Some(stamp(3))));
    let kept = run.live.stop().unwrap().map_gaussians;
    let e = start(1, &c, Duration::ZERO, Demand::ALL).err().unwrap().to_string();
    assert!(e.contains("map.load"), "{e}");
    c.map.load = c.live.map_dir.clone();
    let run = start(1, &c, Duration::ZERO, Demand::ALL).unwrap();
    assert!(run.until(|s| s.map_gaussians == kept), "{:?} against {kept}", run.live.status().map_gaussians);
    run.live.stop().unwrap();
}

/// Panics at the numbered entries into a part.
fn panics_at(part: Part, times: &'static [u32]) -> OnPart {
    let mut seen = 0;
    Box::new(move |now| {
        seen += u32::from(now == part);
        assert!(now != part || !times.contains(&seen), "injected into {part:?}");
    })
}

#[test]
fn a_part_that_panics_loses_one_window_and_the_node_goes_on() {
    for part in [Part::Gate, Part::Network, Part::Overlap, Part::Draw, Part::Map, Part::Follow] {
        let mut c = config(1);
        // Random weights say that everything moves.
        (c.map.min_opacity, c.map.static_speed_mps) = (0.0, 1e6);
        let run = start_with(1, &c, Duration::ZERO, Demand::ALL, Some(panics_at(part, &[3, 4]))).unwrap();
        for i in 0..9 {
            run.push(1, pose(i));
            run.push(0, picture(i));
            assert!(run.until(|s| s.steps + s.panicked_steps == i as u64), "{part:?}: {:?}", run.live.status());
        }
        assert!(!run.live.broken());
        let status = run.live.stop().unwrap();
        // A computed step passes the gate twice.
        let lost = status.panicked_steps;
        assert!(lost == 2 || (part == Part::Gate && lost == 1), "{part:?}: {status:?}");
        assert_eq!((status.steps, status.sets, status.failed_steps), (8 - lost, 9, 0), "{part:?}");
        assert!(status.map_gaussians > 0, "the map outlives a panic: {status:?}");
    }
}

#[test]
fn a_part_that_panics_every_time_ends_the_run_with_its_name() {
    let on_part: OnPart = Box::new(|part| assert_ne!(part, Part::Overlap));
    let run = start_with(1, &config(1), Duration::ZERO, Demand::ALL, Some(on_part)).unwrap();
    let mut i = 0;
    while !run.live.broken() && i < 200 {
        run.push(1, pose(i));
        run.push(0, picture(i));
        std::thread::sleep(Duration::from_millis(10));
        i += 1;
    }
    let e = format!("{:#}", run.live.stop().unwrap_err());
    assert!(e.contains("overlap stage panicked 5 times in a row"), "{e}");
}

/// Panics in its own way at every other step.
struct Clumsy(u32);

impl Outlet for Clumsy {
    fn demand(&mut self) -> Demand {
        Demand::ALL
    }
    fn vehicle(&mut self, _: i64, _: Rigid) {
        panic!("no vehicle");
    }
    fn step(&mut self, _: &Step, _: &StepMaker, _: &[usize]) -> anyhow::Result<()> {
        self.0 += 1;
        assert!(self.0.is_multiple_of(2), "every other");
        Ok(())
    }
    fn idle(&mut self, _: &StepMaker) -> anyhow::Result<()> {
        Ok(())
    }
    fn configure(&mut self, _: &Config) {}
    fn times(&mut self, _: &[(&'static str, f64)]) {}
}

#[test]
fn outputs_and_decoders_that_panic_are_counted_and_the_rest_goes_on() {
    let c = config(1);
    let engine = || Engine::new(ModelSource::open(&c.model).unwrap(), &c.model, 1, c.window.timespan_sec).unwrap();
    let image = |camera| LiveInput { topic: format!("/c{camera}"), role: Role::Image { camera, compressed: false } };
    let pose_input =
        LiveInput { topic: "/p".into(), role: Role::Pose { type_name: "geometry_msgs/msg/PoseStamped".into() } };
    // No such camera: where its picture is rectified an index is out of range.
    let inputs = vec![image(0), pose_input, image(7)];
    let options = LiveOptions {
        rig: rig(1),
        messages: inbox(&inputs, &c),
        inputs,
        store: PoseStore::Buffer(PoseBuffer::new(&c.sync)),
        clock: Box::new(|| START_NS),
        on_part: None,
        config: c.clone(),
    };
    let live = Live::start(options, engine(), Box::new(Clumsy(0))).unwrap();
    let run = Running { live, seen: Arc::default() };
    for i in 0..5 {
        run.push(1, pose(i));
        run.push(0, picture(i));
        run.push(2, picture(i));
        assert!(run.until(|s| s.steps == i as u64 && s.images_in == 2 * (i as u64 + 1)), "{:?}", run.live.status());
    }
    let status = run.live.stop().unwrap();
    assert_eq!((status.steps, status.sets, status.drops.get(DropReason::Panic)), (4, 5, 5), "{status:?}");
    // Five vehicles and two of four steps.
    assert_eq!((status.panics, status.failed_outputs), (7, 7));
}
