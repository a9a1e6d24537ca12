//! Gaussians kept between pictures: what no time and no view changes is worked out once.
//!
//! Motion moves centres only (paper eq. 1), so orientation, scale and opacity, hence the 3D covariance's root `R S` and
//! the reach of the ellipse, are the same at all times. Beside them lie the bounds of every 32 consecutive Gaussians,
//! which let a view pass over those it cannot see without reading them.

use super::block::{Block, Centers, LANES, Shapes};
use super::motion::Motion;
use super::project::Bounds;
use super::tile::FeatureRows;
use super::{RasterError, Splats};
use rayon::prelude::*;
use std::ops::Range;
use std::sync::atomic::{AtomicU64, Ordering};

/// Consecutive Gaussians that share bounds: a stretch of one picture row where they are pixel-aligned.
pub(crate) const GROUP: usize = 32;
/// Rounding of moved centres in f32, as a share of their distance from the origin.
const CENTER_SLACK: f64 = 1e-6;

/// Names the Gaussians that a renderer keeps, from `load` until its next `load` or `render`; after that, and to any other
/// renderer, it is a name of nothing, so that Gaussians that are gone are never drawn by mistake.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Loaded(u64);

impl Loaded {
    /// A name that nothing had before.
    pub(crate) fn new() -> Self {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        Self(NEXT.fetch_add(1, Ordering::Relaxed))
    }
}

/// What to draw of loaded Gaussians.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Channels(pub Range<usize>);

impl Channels {
    /// Depth and alpha alone.
    pub const NONE: Self = Self(0..0);

    /// Refuses channels there are not.
    pub(crate) fn validate(&self, feature_count: usize) -> Result<(), RasterError> {
        let Range { start, end } = self.0;
        if start <= end && end <= feature_count {
            return Ok(());
        }
        Err(RasterError::Channels { start, end, feature_count })
    }
}

/// Refuses a time that is none.
pub(crate) fn validate_time(draw_sec: f32) -> Result<(), RasterError> {
    if draw_sec.is_finite() {
        return Ok(());
    }
    Err(RasterError::Setting { name: "time_sec", value: draw_sec, need: "a finite number of seconds" })
}

/// Eight Gaussians at any time.
#[derive(Debug, Clone)]
struct Eight {
    shapes: Shapes,
    usable: [bool; LANES],
}

/// What a group's members have in common.
#[derive(Debug, Clone, Copy)]
struct Group {
    bounds: Bounds,
    /// Largest speed in either direction, m/s.
    speed: f64,
    /// When its members were seen.
    first_sec: f64,
    last_sec: f64,
    /// Some member can be drawn.
    any: bool,
    invalid: usize,
}

/// The kept Gaussians.
#[derive(Debug, Default)]
pub(crate) struct Stored {
    means: Vec<[f32; 3]>,
    opacities: Vec<f32>,
    features: Vec<f32>,
    feature_count: usize,
    moves: bool,
    velocity_backward: Vec<[f32; 3]>,
    velocity_forward: Vec<[f32; 3]>,
    time_sec: Vec<f32>,
    eights: Vec<Eight>,
    groups: Vec<Group>,
}

impl Stored {
    /// Takes over validated Gaussians; memory is reused.
    pub(crate) fn fill(&mut self, splats: &Splats, motion: Option<&Motion>) {
        fn copy<T: Copy>(to: &mut Vec<T>, from: &[T]) {
            to.clear();
            to.extend_from_slice(from);
        }
        copy(&mut self.means, splats.means);
        copy(&mut self.opacities, splats.opacities);
        copy(&mut self.features, splats.features);
        self.feature_count = splats.feature_count;
        self.moves = motion.is_some();
        copy(&mut self.velocity_backward, motion.map_or(&[], |m| m.velocity_backward));
        copy(&mut self.velocity_forward, motion.map_or(&[], |m| m.velocity_forward));
        copy(&mut self.time_sec, motion.map_or(&[], |m| m.time_sec));

        let n = splats.len();
        let blank = Block::new();
        let eight = Eight { shapes: blank.shapes, usable: blank.centers.usable };
        self.eights.resize(n.div_ceil(LANES), eight);
        self.groups.resize(n.div_ceil(GROUP), Group::EMPTY);
        let parts = self.groups.par_iter_mut().zip(self.eights.par_chunks_mut(GROUP / LANES)).enumerate();
        parts.for_each(|(index, (group, eights))| {
            *group = Group::of(splats, motion, index * GROUP, eights);
        });
    }

    pub(crate) fn len(&self) -> usize {
        self.means.len()
    }

    pub(crate) fn feature_count(&self) -> usize {
        self.feature_count
    }

    pub(crate) fn opacities(&self) -> &[f32] {
        &self.opacities
    }

    pub(crate) fn features(&self, channels: &Channels) -> FeatureRows<'_> {
        let Range { start, end } = channels.0;
        FeatureRows { values: &self.features, stride: self.feature_count, first: start, count: end - start }
    }

    /// Gaussians that are never drawn, whatever the time.
    pub(crate) fn invalid(&self) -> usize {
        self.groups.iter().map(|group| group.invalid).sum()
    }

    /// Where the members of the group from Gaussian `start` on are at a time; `None` when none of them can be drawn.
    pub(crate) fn bounds(&self, start: usize, draw_sec: f32) -> Option<Bounds> {
        self.groups.get(start / GROUP).filter(|group| group.any).map(|group| group.at(draw_sec))
    }

    /// Puts the centres of the eight Gaussians from `start` on where they are at a time; returns their shapes and how
    /// many of the usable ones have no place then.
    #[inline(always)]
    pub(crate) fn place(&self, start: usize, draw_sec: f32, to: &mut Centers) -> (&Shapes, usize) {
        let eight = &self.eights[start / LANES];
        to.usable = eight.usable;
        let mut lost = 0;
        for l in 0..LANES {
            let i = start + l;
            let Some(mean) = self.means.get(i).filter(|_| eight.usable[l]) else {
                (0..3).for_each(|axis| to.mean[axis][l] = 0.0);
                continue;
            };
            let mut mean = *mean;
            if self.moves {
                mean = self.motion().place(i, &mean, draw_sec);
                to.usable[l] = mean.iter().all(|x| x.is_finite());
                lost += usize::from(!to.usable[l]);
            }
            (0..3).for_each(|axis| to.mean[axis][l] = if to.usable[l] { f64::from(mean[axis]) } else { 0.0 });
        }
        (&eight.shapes, lost)
    }

    #[inline(always)]
    fn motion(&self) -> Motion<'_> {
        Motion {
            velocity_backward: &self.velocity_backward,
            velocity_forward: &self.velocity_forward,
            time_sec: &self.time_sec,
        }
    }
}

impl Group {
    const EMPTY: Self = Self {
        bounds: Bounds { center: [0.0; 3], half: [0.0; 3], size2: 0.0 },
        speed: 0.0,
        first_sec: 0.0,
        last_sec: 0.0,
        any: false,
        invalid: 0,
    };

    /// Works out the shapes of the Gaussians from `start` on and what they have in common.
    fn of(splats: &Splats, motion: Option<&Motion>, start: usize, eights: &mut [Eight]) -> Self {
        let mut group = Self::EMPTY;
        let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
        (group.first_sec, group.last_sec) = (f64::INFINITY, f64::NEG_INFINITY);
        let mut block = Block::new();
        for (index, eight) in eights.iter_mut().enumerate() {
            let first = start + index * LANES;
            let count = (splats.len() - first).min(LANES);
            group.invalid += block.load(splats, first, count, false);
            for l in (0..count).filter(|&l| block.centers.usable[l]) {
                group.any = true;
                for axis in 0..3 {
                    low[axis] = low[axis].min(block.centers.mean[axis][l]);
                    high[axis] = high[axis].max(block.centers.mean[axis][l]);
                }
                group.bounds.size2 = group.bounds.size2.max(block.shapes.size2[l]);
                if let Some(motion) = motion {
                    let i = first + l;
                    for v in [motion.velocity_backward[i], motion.velocity_forward[i]] {
                        let square: f64 = v.iter().map(|&x| f64::from(x) * f64::from(x)).sum();
                        // Not `max`, which would pass over NaN: what has no speed is not bounded by any.
                        group.speed = if square.is_finite() { group.speed.max(square.sqrt()) } else { f64::INFINITY };
                    }
                    let seen = f64::from(motion.time_sec[i]);
                    if seen.is_finite() {
                        (group.first_sec, group.last_sec) = (group.first_sec.min(seen), group.last_sec.max(seen));
                    } else {
                        group.speed = f64::INFINITY;
                    }
                }
            }
            *eight = Eight { shapes: block.shapes.clone(), usable: block.centers.usable };
        }
        for axis in 0..3 {
            group.bounds.center[axis] = 0.5 * (low[axis] + high[axis]);
            group.bounds.half[axis] = 0.5 * (high[axis] - low[axis]);
        }
        if motion.is_none() {
            (group.first_sec, group.last_sec) = (0.0, 0.0);
        }
        group
    }

    /// Bounds of the moved centres. Where a speed or a time is not finite they are not either, and are then never sure
    /// that nothing shows.
    fn at(&self, draw_sec: f32) -> Bounds {
        let mut bounds = self.bounds;
        let draw_sec = f64::from(draw_sec);
        let longest = (draw_sec - self.first_sec).abs().max((draw_sec - self.last_sec).abs());
        for axis in 0..3 {
            // Still Gaussians stay, however far the time is.
            let way = if self.speed == 0.0 { 0.0 } else { self.speed * longest };
            bounds.half[axis] += way + CENTER_SLACK * (bounds.center[axis].abs() + bounds.half[axis] + way);
        }
        bounds
    }
}
