//! Skipped steps through the real network: what is skipped, what is not, and what the contract does about a gate that lets too much
//! through.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::sync::Arc;

use storm_node::config::Config;
use storm_node::decode::RgbPicture;
use storm_node::dice::Dice;
use storm_node::engine::{Engine, ModelSource};
use storm_node::gate::contract::Notch;
use storm_node::pipeline::demand::Demand;
use storm_node::pipeline::step::{Step, StepMaker};
use storm_node::source::Frame;
use storm_node::source::world::posed_set;
use storm_node::window::{PosedSet, WindowBuilder};
use storm_render::world::{Drive, DriveOptions};

const HOP_NS: i64 = 100_000_000;
const SEED: u64 = 77;

/// A vehicle at rest: one moment of a drive again and again, with noise of a level or two, changed by `paint`.
struct Standing {
    first: PosedSet<Frame>,
    cameras: Vec<storm_render::Intrinsics>,
}

impl Standing {
    fn new() -> Self {
        let options = DriveOptions {
            seed: SEED,
            seconds: 1.0,
            cameras: 1,
            width: 48,
            height: 32,
            noise: 0.0,
            ..DriveOptions::default()
        };
        let drive = Drive::new(&options).unwrap();
        let cameras = drive.cameras().iter().map(|c| c.intrinsics).collect();
        Self { first: posed_set(&drive, 0).0, cameras }
    }

    fn set(&self, k: i64, paint: &dyn Fn(i64, &mut RgbPicture)) -> PosedSet<Frame> {
        let mut set = self.first.clone();
        set.stamp_ns = k * HOP_NS;
        for frame in &mut set.frames {
            frame.stamp_ns = set.stamp_ns;
            let mut rgb = (*frame.item.rgb).clone();
            let mut dice = Dice::new(k as u64);
            rgb.data.iter_mut().for_each(|x| *x = x.saturating_add((2.99 * dice.unit()) as u8).saturating_sub(1));
            paint(k, &mut rgb);
            frame.item = Frame { rgb: Arc::new(rgb), valid: None };
        }
        set
    }

    fn maker(&self, config: &Config) -> StepMaker {
        let engine =
            Engine::new(ModelSource::open(&config.model).unwrap(), &config.model, 1, config.window.timespan_sec)
                .unwrap()
                .with_skips(&config.skip);
        StepMaker::new(engine, self.cameras.clone(), config, None).unwrap()
    }

    /// Steps of sets `0..n`; after each, its set's number, the step, and skips so far.
    fn run(&self, config: &Config, n: i64, paint: &dyn Fn(i64, &mut RgbPicture)) -> (StepMaker, Vec<(i64, Step, u64)>) {
        self.run_for(config, n, paint, Demand::ALL)
    }

    /// The same, with no more than `demand`.
    fn run_for(
        &self,
        config: &Config,
        n: i64,
        paint: &dyn Fn(i64, &mut RgbPicture),
        demand: Demand,
    ) -> (StepMaker, Vec<(i64, Step, u64)>) {
        let (mut maker, mut builder) = (self.maker(config), WindowBuilder::new(&config.window, 0));
        let mut steps = Vec::new();
        for k in 0..n {
            if let Some(window) = builder.push(self.set(k, paint)) {
                let step = maker.run_for(window, demand).unwrap().unwrap();
                steps.push((k, step, maker.skips().still));
            }
        }
        (maker, steps)
    }
}

fn nothing(_: i64, _: &mut RgbPicture) {}

#[test]
fn standing_steps_are_skipped_restamped_and_checked() {
    let (maker, steps) = Standing::new().run(&Config::default(), 130, &nothing);
    let counts = maker.skips();
    assert!(counts.still as usize >= steps.len() * 8 / 10, "{counts:?} of {}", steps.len());
    assert!(counts.checks >= 1 && counts.broken == 0, "{counts:?}");
    for (i, (k, step, _)) in steps.iter().enumerate() {
        assert_eq!((step.index, step.window.stamp_ns), (i as u64, k * HOP_NS), "the heartbeat goes on");
    }
    let last = &steps.last().unwrap().1;
    assert!(!last.views.is_empty() && !last.scene.gaussians.is_empty());
}

#[test]
fn a_pedestrian_who_steps_out_is_computed_at_once_and_until_he_is_gone_from_all_timesteps() {
    let (out, gone) = (45, 50);
    let walk = |k: i64, p: &mut RgbPicture| {
        if (out..gone).contains(&k) {
            for y in 14..18 {
                for x in 0..2 {
                    let at = 3 * (y * p.width + 10 + x + (k - out) as usize);
                    p.data[at..at + 3].fill(230);
                }
            }
        }
    };
    let (_, steps) = Standing::new().run(&Config::default(), 90, &walk);
    let mut before = 0;
    for (k, _, skipped) in &steps {
        let this = *skipped > before;
        before = *skipped;
        // A window has timesteps 0, 0.5, 1.0 and 1.5 s back; the first one after he is out of them all is computed too.
        let shows = [0, 5, 10, 15].iter().any(|back| (out..gone).contains(&(k - back)));
        assert!(!(shows && this), "set {k} shows him and was skipped");
        if (25..out).contains(k) {
            assert!(this, "set {k} shows nothing new");
        }
    }
    assert!(before > steps.last().unwrap().2 / 2, "skipping comes back");
    let late = steps.iter().filter(|(k, ..)| *k > 75).count();
    assert!(late > 0 && steps.last().unwrap().2 - steps[steps.len() - 1 - late].2 >= late as u64 - 2);
}

#[test]
fn a_gate_that_lets_change_through_is_closed_by_the_contract() {
    let mut config = Config::default();
    // A gate that is nearly blind, and a scene that gets brighter all the time: every check finds a worse picture.
    (config.skip.still_levels, config.skip.still_sigmas, config.skip.check_every) = (60.0, 100.0, 8);
    let dawn = |k: i64, p: &mut RgbPicture| {
        p.data.iter_mut().for_each(|x| *x = x.saturating_add((k / 2) as u8));
    };
    let (maker, steps) = Standing::new().run(&config, 100, &dawn);
    let counts = maker.skips();
    assert!(counts.broken >= 2, "{counts:?}");
    // The level fell within one interval of checks, and stays low.
    let half = steps.len() / 2;
    let (early, late) = (steps[half].2, counts.still - steps[half].2);
    assert!(late <= early && (counts.still as usize) < steps.len() / 2, "{counts:?}: {early} then {late}");
}

#[test]
fn the_contract_holds_without_pictures_too() {
    let flow_alone = Demand { motion: false, tracks: false, objects: false, map: false, pictures: false };
    let mut config = Config::default();
    config.skip.check_every = 8;
    let (maker, steps) = Standing::new().run_for(&config, 60, &nothing, flow_alone);
    assert!(steps.iter().all(|(_, step, _)| step.views.is_empty()));
    let counts = maker.skips();
    assert!(counts.checks >= 2 && counts.broken == 0, "{counts:?}");
    // A nearly blind gate, and cars that are there at one moment and not at the next: the flow tells.
    (config.skip.still_levels, config.skip.still_sigmas) = (200.0, 100.0);
    let shuffled = |k: i64, p: &mut RgbPicture| {
        let width = 3 * p.width;
        p.data.rotate_left(width * (k as usize * 7 % p.height));
    };
    let (maker, _) = Standing::new().run_for(&config, 60, &shuffled, flow_alone);
    let counts = maker.skips();
    assert!(counts.checks >= 1 && counts.broken >= 1, "{counts:?}");
}

#[test]
fn nothing_is_skipped_when_told_so() {
    let mut config = Config::default();
    config.skip.still = false;
    let (maker, steps) = Standing::new().run(&config, 30, &nothing);
    assert!(steps.len() > 10 && maker.skips().still == 0);
    config.skip.still = true;
    config.skip.check_every = 0;
    let (maker, _) = Standing::new().run(&config, 30, &nothing);
    assert_eq!(maker.skips().still, 0);
}

/// A gate that lets everything through, so that only the contract is left.
fn blind_prediction(check_every: usize) -> Config {
    let mut config = Config::default();
    let skip = &mut config.skip;
    (skip.still, skip.predict, skip.check_every) = (false, true, check_every);
    (skip.still_levels, skip.still_sigmas) = (255.0, 100.0);
    (skip.predict_levels, skip.predict_px, skip.predict_sec) = (255.0, 10.0, 60.0);
    config
}

#[test]
fn predicted_steps_go_on_with_the_heartbeat_and_tell_the_map_nothing() {
    let (maker, steps) = Standing::new().run(&blind_prediction(8), 60, &nothing);
    let counts = maker.skips();
    assert!(counts.predicted > 20 && counts.broken == 0 && counts.still == 0, "{counts:?}");
    for (i, (k, step, _)) in steps.iter().enumerate() {
        assert_eq!((step.index, step.window.stamp_ns), (i as u64, k * HOP_NS), "the heartbeat goes on");
        let predicted = step.notch == Some(Notch::Predicted);
        assert_eq!(step.pixels.is_some(), predicted);
        assert!(!step.views.is_empty());
        let (newest_ns, first_ns) = (step.window.stamp_ns, step.window.steps[0].stamp_ns);
        let now_sec = (newest_ns - first_ns) as f32 * 1e-9;
        let last_sec = *step.scene.gaussians.time_sec.last().unwrap();
        assert!((last_sec - now_sec).abs() < 1e-3, "step {i}: {last_sec} s on a clock at {now_sec} s");
    }
    // What a predicted step says comes from a step the map has had.
    let offered = |maker: &StepMaker| {
        let c = maker.map().counts();
        c.merged + c.created + c.skipped + c.rejected
    };
    let (computed, _) = Standing::new().run(&Config::default(), 60, &nothing);
    let per_step = |offered: u64, steps: u64| offered / steps.max(1);
    let computed_steps = steps.len() as u64 - counts.predicted;
    let other_steps = steps.len() as u64 - computed.skips().still;
    let (a, b) = (per_step(offered(&maker), computed_steps), per_step(offered(&computed), other_steps));
    assert!(a.abs_diff(b) * 20 < a.max(b), "{a} and {b} Gaussians offered per computed step");
}

#[test]
fn a_drive_that_defeats_prediction_makes_the_level_fall_within_the_interval() {
    let every = 8;
    let turns = 60;
    // After a while that earns trust, the world jumps with every picture.
    let adversary = |k: i64, p: &mut RgbPicture| {
        if k >= turns {
            let width = 3 * p.width;
            p.data.rotate_left(width * (k as usize * 7 % p.height));
        }
    };
    let (maker, steps) = Standing::new().run(&blind_prediction(every), 110, &adversary);
    let predicted = |from: i64, to: i64| {
        let within = steps.iter().filter(|(k, ..)| (from..to).contains(k));
        within.filter(|(_, step, _)| step.notch == Some(Notch::Predicted)).count()
    };
    assert!(predicted(0, turns) > 20, "{:?}", maker.skips());
    assert!(predicted(turns, 110) <= every, "{:?}", maker.skips());
    assert_eq!(predicted(turns + every as i64 + 2, 110), 0, "{:?}", maker.skips());
    let counts = maker.skips();
    assert!(counts.level == 0 && counts.broken >= 1 && counts.notches[1].level == 0, "{counts:?}");
}

#[test]
fn prediction_has_to_earn_its_first_step() {
    // From the first window on nothing is as predicted: not one step is taken unchecked.
    let jumps = |k: i64, p: &mut RgbPicture| {
        let width = 3 * p.width;
        p.data.rotate_left(width * (k as usize * 7 % p.height));
    };
    let (maker, steps) = Standing::new().run(&blind_prediction(8), 60, &jumps);
    let counts = maker.skips();
    assert!(counts.predicted == 0 && counts.checks >= 2 && counts.broken == counts.checks, "{counts:?}");
    assert!(steps.iter().all(|(_, step, _)| step.notch.is_none()));
}

#[test]
fn approximations_are_checked_first_and_then_now_and_then() {
    let mut config = Config::default();
    (config.skip.still, config.skip.check_every) = (false, 6);
    config.skip.kv_pool = 2;
    let loose = |c: &mut Config| {
        (c.skip.max_psnr_loss_db, c.skip.max_flow_change, c.skip.max_mask_change) = (100.0, 100.0, 1.0);
    };
    let mut any = config.clone();
    loose(&mut any);
    let (maker, steps) = Standing::new().run(&any, 50, &nothing);
    let counts = maker.skips();
    assert!(steps[0].1.notch.is_none(), "the first one is a check");
    assert_eq!(steps[1].1.notch, Some(Notch::Approximate));
    assert!(counts.approximate as usize > steps.len() / 2 && counts.level == 3 && counts.broken == 0, "{counts:?}");
    assert!(counts.notches[2].checks as usize >= steps.len() / 8, "{counts:?}");
    // Nothing is approximated where nothing may be taken unchecked.
    any.skip.check_every = 0;
    let (maker, _) = Standing::new().run(&any, 30, &nothing);
    assert_eq!((maker.skips().approximate, maker.skips().level), (0, 0));
}

/// Windows that go on from older ones, in those ones' frame: under a contract that lets them, and not under one that does not.
#[test]
fn older_timesteps_are_taken_again_under_the_contract() {
    // A vehicle that drives.
    let size = DriveOptions { seconds: 6.0, cameras: 1, width: 48, height: 32, ..DriveOptions::default() };
    let moves = |d: &Drive| d.map_from_base(0.0).translation.distance(d.map_from_base(5.9).translation) > 20.0;
    let drive = (0..20).map(|seed| Drive::new(&DriveOptions { seed, ..size.clone() }).unwrap()).find(moves).unwrap();
    let cameras: Vec<_> = drive.cameras().iter().map(|c| c.intrinsics).collect();
    let run = |config: &Config| {
        let source = ModelSource::open(&config.model).unwrap();
        let engine = Engine::new(source, &config.model, 1, config.window.timespan_sec).unwrap();
        let engine = engine.with_skips(&config.skip);
        let mut maker = StepMaker::new(engine, cameras.clone(), config, None).unwrap();
        let mut builder = WindowBuilder::new(&config.window, 0);
        let windows = (0..60).filter_map(|i| builder.push(posed_set(&drive, i).0));
        let steps: Vec<Step> = windows.map(|w| maker.run(w).unwrap().unwrap()).collect();
        (maker.skips(), steps)
    };
    let mut config = Config::default();
    (config.skip.still, config.skip.reuse, config.skip.check_every) = (false, 3, 8);
    (config.skip.max_psnr_loss_db, config.skip.max_flow_change, config.skip.max_mask_change) = (100.0, 100.0, 1.0);
    let (counts, steps) = run(&config);
    // Three of four windows could, where no check takes their place.
    assert!(counts.approximate as usize > steps.len() / 3 && counts.broken == 0 && counts.checks > 2, "{counts:?}");
    for step in &steps {
        let anchored = step.window.steps[0].frames[0].map_from_camera.translation;
        let ahead = step.window.map_from_anchor.translation.distance(anchored);
        // Taken again: the frame is an older window's, behind this one's first timestep.
        assert!(step.notch.is_some() || ahead < 1e-9, "{ahead}");
        assert!(step.scene.gaussians.means.iter().flatten().all(|x| x.is_finite()));
    }
    assert!(steps.iter().any(|s| {
        let first = &s.window.steps[0].frames[0].map_from_camera.translation;
        s.notch == Some(Notch::Approximate) && s.window.map_from_anchor.translation.distance(*first) > 0.1
    }));
    (config.skip.max_psnr_loss_db, config.skip.max_flow_change, config.skip.max_mask_change) = (0.0, 0.0, 0.0);
    let (counts, steps) = run(&config);
    assert!(counts.approximate == 0 && counts.broken == counts.checks && counts.checks > 0, "{counts:?}");
    assert!(steps.iter().all(|s| s.notch.is_none()));
}
