//! Skipped steps through the real network: what is skipped, what is not, and what the contract does about a gate that lets too much
//! through.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::sync::Arc;

use storm_node::config::Config;
use storm_node::decode::RgbPicture;
use storm_node::dice::Dice;
use storm_node::engine::{Engine, ModelSource};
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
            frame.item = Frame { rgb: Arc::new(rgb) };
        }
        set
    }

    fn maker(&self, config: &Config) -> StepMaker {
        let engine =
            Engine::new(ModelSource::open(&config.model).unwrap(), &config.model, 1, config.window.timespan_sec)
                .unwrap();
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
    let (maker, steps) = Standing::new().run(&Config::default(), 120, &nothing);
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
