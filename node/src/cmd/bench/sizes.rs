//! Cost against size: tokens, cameras and timesteps, measured beside the counted operations.

use std::time::Instant;

use anyhow::{Context, Result};
use serde::Serialize;
use storm_model::Shortcuts;
use storm_render::world::{Drive, DriveOptions};

use super::flops::{WindowSize, count};
use super::pairs::{Pairs, Turns, median};
use crate::config::Config;
use crate::engine::evaluate::Clip;
use crate::engine::{Engine, ModelSource};
use crate::source::world::posed_set;
use crate::window::WindowBuilder;

const SEED: u64 = 424_242;
/// Runs of one point, each beside one of the usual size; where they take long, fewer.
const TURNS: Turns = Turns { least: 6, most: 15, seconds: 10.0 };
/// The usual size.
const USUAL: WindowSize = WindowSize { timesteps: 4, cameras: 3, width: 96, height: 64 };

/// One point of a curve.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Point {
    /// `tokens`, `cameras` or `timesteps`: what varies along its curve.
    pub curve: &'static str,
    pub timesteps: usize,
    pub cameras: usize,
    pub picture: [usize; 2],
    pub tokens: usize,
    pub gflop: f64,
    pub network_ms: f64,
    /// How many times as long as the usual size's, run in turn.
    pub times_usual: f64,
    /// Those turns: this size's passes and the usual one's.
    pub turns_ms: Pairs,
}

/// Picture sizes of 3 cameras x 4 timesteps: 404 to 10,388 tokens with patches of 8 pixels.
const PICTURES: [(usize, usize); 7] = [(64, 32), (64, 64), (96, 64), (128, 96), (160, 128), (192, 160), (288, 192)];
/// 32,276 tokens.
const LARGEST: (usize, usize) = (448, 384);

/// What is measured: curve and window.
pub(super) fn plan(largest: bool) -> Vec<(&'static str, WindowSize)> {
    let window = |timesteps, cameras, (width, height)| WindowSize { timesteps, cameras, width, height };
    let mut all: Vec<_> = PICTURES.iter().map(|&p| ("tokens", window(4, 3, p))).collect();
    if largest {
        all.push(("tokens", window(4, 3, LARGEST)));
    }
    all.extend((1..=6).map(|cameras| ("cameras", window(4, cameras, (96, 64)))));
    all.extend([1, 2, 3, 4, 6, 8, 10].map(|timesteps| ("timesteps", window(timesteps, 3, (96, 64)))));
    all
}

/// An untrained network of `tiny`'s width and a window of some size.
struct Pass {
    engine: Engine,
    clip: Clip,
}

impl Pass {
    /// Of a network that has run already.
    fn new(size: WindowSize) -> Result<Self> {
        let mut config = Config::default();
        config.model.weights = crate::engine::UNTRAINED.into();
        (config.model.image_width, config.model.image_height) = (size.width, size.height);
        config.window.timesteps = size.timesteps;
        let clip = clip(&config, size)?;
        let source = ModelSource::open(&config.model)?;
        let engine = Engine::new(source, &config.model, size.cameras, config.window.timespan_sec)?;
        let mut pass = Self { engine, clip };
        pass.ms()?;
        Ok(pass)
    }

    fn ms(&mut self) -> Result<f64> {
        let start = Instant::now();
        self.engine.step(&self.clip.window, &self.clip.cameras)?;
        Ok(start.elapsed().as_secs_f64() * 1e3)
    }
}

/// Times one point.
pub(super) fn measure(curve: &'static str, size: WindowSize) -> Result<Point> {
    let (mut pass, mut usual) = (Pass::new(size)?, Pass::new(USUAL)?);
    let work = count(pass.engine.model_config(), size, &Shortcuts::default());
    let pairs = Pairs::take(TURNS, &mut |_| pass.ms(), Some(&mut |_| usual.ms()))?;
    Ok(Point {
        curve,
        timesteps: size.timesteps,
        cameras: size.cameras,
        picture: [size.width, size.height],
        tokens: work.tokens,
        gflop: work.flops * 1e-9,
        times_usual: pairs.times_less().map_or(f64::NAN, |less| 1.0 / less),
        network_ms: median(pairs.one.clone()).unwrap_or(f64::NAN),
        turns_ms: pairs,
    })
}

/// A window of that size.
fn clip(config: &Config, size: WindowSize) -> Result<Clip> {
    let rate_hz = 1.0 / config.window.stride_sec;
    let options = DriveOptions {
        seed: SEED,
        seconds: (size.timesteps + 1) as f64 / rate_hz,
        cameras: size.cameras,
        width: size.width,
        height: size.height,
        rate_hz,
        ..DriveOptions::default()
    };
    let drive = Drive::new(&options)?;
    let mut builder = WindowBuilder::new(&config.window, 0);
    let window = (0..drive.frame_count()).find_map(|i| builder.push(posed_set(&drive, i).0));
    let window = window.with_context(|| format!("no window of {} timesteps", size.timesteps))?;
    let cameras = drive.cameras().iter().map(|c| c.intrinsics).collect();
    Ok(Clip::new(String::new(), SEED, window, 0, Vec::new(), cameras, Vec::new()))
}

/// Operations per second that the largest point of a curve reaches: what the others are compared with.
pub(super) fn rate(points: &[&Point]) -> f64 {
    points.last().map_or(1.0, |p| p.gflop / p.network_ms)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_plan_spans_what_it_says() {
        let tiny = storm_model::config::ModelConfig::preset("tiny").unwrap();
        let tokens = |size| count(&tiny, size, &Shortcuts::default()).tokens;
        let all = plan(true);
        let of = |curve| all.iter().filter(move |(c, _)| *c == curve).map(|(_, s)| *s).collect::<Vec<_>>();
        let sizes = of("tokens");
        assert!((380..440).contains(&tokens(sizes[0])), "{}", tokens(sizes[0]));
        assert!(tokens(sizes[6]) > 9_500 && tokens(sizes[7]) > 31_000 && plan(false).len() + 1 == all.len());
        assert_eq!(of("cameras").iter().map(|s| s.cameras).collect::<Vec<_>>(), [1, 2, 3, 4, 5, 6]);
        assert_eq!(of("timesteps").last().unwrap().timesteps, 10);
    }

    #[test]
    fn a_point_is_measured() {
        let size = WindowSize { timesteps: 2, cameras: 1, width: 32, height: 16 };
        let p = measure("tokens", size).unwrap();
        assert_eq!((p.tokens, p.cameras), (16 + 20, 1));
        assert!(p.network_ms > 0.0 && p.gflop > 0.0);
        assert!((0.0..1.0).contains(&p.times_usual), "{}", p.times_usual);
    }
}
