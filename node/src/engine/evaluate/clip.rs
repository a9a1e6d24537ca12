//! One clip: its context window, all frames in and after it, and what is true of them.

use std::collections::BTreeMap;
use std::sync::Arc;

use anyhow::{Context, Result};
use glam::Vec3;
use storm_render::world::{Drive, DriveOptions, MoverClass, TrajectoryOptions};
use storm_render::{Intrinsics, View};

use super::tracks::TrackTruth;
use crate::config::WindowConfig;
use crate::engine::truth::TruthAt;
use crate::engine::views_of;
use crate::source::Frame;
use crate::source::world::posed_set;
use crate::sync::clock::seconds_between;
use crate::window::{PosedSet, Window, WindowBuilder};

/// Frames of a clip.
pub const CLIP_FRAMES: usize = 20;
/// Frames per second of a clip.
pub const CLIP_HZ: f64 = 10.0;
/// Frames up to this long after the last context frame are held out too, seconds.
pub const TAIL_SEC: f64 = 0.5;
/// Seeds of the held-out suite; training never sees 10,000 to 19,999.
pub const HELD_OUT_SEEDS: std::ops::Range<u64> = 10_000..10_020;
/// Surface points followed per drive; half of them moving, where there are that many.
const TRACKED_POINTS: usize = 192;

/// One moment of a clip.
pub struct ClipFrame {
    /// The cameras' pictures and poses.
    pub set: Arc<PosedSet<Frame>>,
    /// What is true, per camera.
    pub truth: Vec<TruthAt>,
    /// The timestep of the window it is; `None`: the network does not see it as an image of its window.
    pub context: Option<usize>,
    /// Whether the network sees it as a prior image of a timestep: then it is not held out either.
    pub prior: bool,
}

impl ClipFrame {
    /// Whether it is scored as an image that the network has not seen.
    pub fn held_out(&self) -> bool {
        self.context.is_none() && !self.prior
    }
}

/// One clip.
pub struct Clip {
    /// For people.
    pub name: String,
    /// For whatever draws random numbers.
    pub seed: u64,
    /// The context, as the network sees it.
    pub window: Window<Frame>,
    /// The camera the window is anchored at.
    pub reference: usize,
    /// All frames in order.
    pub frames: Vec<ClipFrame>,
    /// Cameras at the network's picture size.
    pub cameras: Vec<Intrinsics>,
    /// Followed surface points; none in recordings.
    pub tracks: Vec<TrackTruth>,
    /// Classes of road users by object number; none in recordings.
    pub classes: BTreeMap<u16, MoverClass>,
}

impl Clip {
    /// The clip of a seed, three cameras, at the network's picture size: frames 0, 5, 10 and 15 of 20 at 10 Hz are context.
    ///
    /// `prior_sec`: how long before each of them a prior image is, for networks that sweep velocities; 0: none.
    pub fn of_seed(seed: u64, (width, height): (usize, usize), prior_sec: f64) -> Result<Self> {
        let seconds = CLIP_FRAMES as f64 / CLIP_HZ;
        let options =
            DriveOptions { seed, seconds, cameras: 3, width, height, rate_hz: CLIP_HZ, ..DriveOptions::default() };
        let drive = Drive::new(&options)?;
        let reference = 1;
        // Exactly frames 0, 5, 10 and 15: no tolerance.
        let config = WindowConfig { stride_tolerance: 0.01, ..WindowConfig::default() };
        let mut builder = WindowBuilder::new(&config, reference).with_prior(prior_sec);
        let mut window = None;
        let mut frames = Vec::with_capacity(CLIP_FRAMES);
        for i in 0..CLIP_FRAMES {
            let (set, truth) = posed_set(&drive, i);
            let built = builder.push(set.clone());
            window = window.or(built);
            frames.push((Arc::new(set), truth.into_iter().map(TruthAt::of_frame).collect()));
        }
        let window = window.context("the drive gave no window")?;
        let cameras = drive.cameras().iter().map(|c| c.intrinsics).collect();
        let times_sec = window.steps.iter().map(|s| s.stamp_ns as f64 * 1e-9).collect();
        let wanted = TrajectoryOptions { times_sec, points: TRACKED_POINTS, moving_share: 0.5, seed };
        let tracks = TrackTruth::of_drive(&drive.trajectories(&wanted), &window);
        let movers = (0..CLIP_FRAMES).flat_map(|i| drive.movers(drive.frame_time_sec(i, reference)));
        let classes = movers.map(|mover| (mover.instance, mover.class)).collect();
        let clip = Self::new(format!("seed {seed}"), seed, window, reference, frames, cameras, tracks);
        Ok(Self { classes, ..clip })
    }

    /// From its parts; which frames are context follows from the window.
    pub fn new(
        name: String,
        seed: u64,
        window: Window<Frame>,
        reference: usize,
        frames: Vec<(Arc<PosedSet<Frame>>, Vec<TruthAt>)>,
        cameras: Vec<Intrinsics>,
        tracks: Vec<TrackTruth>,
    ) -> Self {
        let context = |stamp_ns: i64| window.steps.iter().position(|s| s.stamp_ns == stamp_ns);
        let prior = |stamp_ns: i64| window.prior.iter().flatten().any(|s| s.stamp_ns == stamp_ns);
        let frame = |(set, truth): (Arc<PosedSet<Frame>>, Vec<TruthAt>)| {
            let (context, prior) = (context(set.stamp_ns), prior(set.stamp_ns));
            ClipFrame { set, truth, context, prior }
        };
        let frames = frames.into_iter().map(frame).collect();
        Self { name, seed, window, reference, frames, cameras, tracks, classes: BTreeMap::new() }
    }

    /// Seconds since the window's first timestep.
    pub fn time_sec(&self, stamp_ns: i64) -> f32 {
        let first_ns = self.window.steps.first().map_or(stamp_ns, |s| s.stamp_ns);
        seconds_between(first_ns, stamp_ns) as f32
    }

    /// The context frames, by timestep.
    pub fn context(&self) -> impl Iterator<Item = (usize, &ClipFrame)> {
        self.frames.iter().filter_map(|f| f.context.map(|step| (step, f)))
    }

    /// The views of a timestep's cameras in the window's anchor frame.
    pub fn views(&self, step: usize) -> Vec<View> {
        let all = |set| views_of(set, &self.window.map_from_anchor, &self.cameras);
        self.window.steps.get(step).map_or(Vec::new(), |set| all(set).into_iter().map(|(view, _)| view).collect())
    }
}

/// The point of the anchor frame that a pixel's centre shows at a z-depth.
pub(super) fn unproject(view: &View, pixel: usize, depth: f32) -> Vec3 {
    let width = view.intrinsics.width.max(1);
    let (u, v) = ((pixel % width) as f32 + 0.5, (pixel / width) as f32 + 0.5);
    view.world_from_camera().transform_point3(view.intrinsics.ray(u, v) * depth)
}
