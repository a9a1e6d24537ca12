//! A transform tree over time (/tf and /tf_static), in f64.

mod error;

use std::collections::BTreeMap;

pub use error::{TfError, TfProblem};

use crate::config::SyncConfig;
use crate::msg::TransformStamped;
use crate::poses::{PoseLookup, PoseMissing, PoseNote, PoseTiming, Timeline, checked};
use crate::rigid::Rigid;
use crate::sync::clock::seconds_between;
use crate::window::relative;

/// Samples kept per moving transform: more than a minute at 100 Hz, 0.6 MB.
const MAX_SAMPLES: usize = 8192;

/// Frames kept; with [`MAX_SAMPLES`] it bounds memory whatever is published.
const MAX_FRAMES: usize = 512;

/// Frames named in the message about an unknown one.
const FRAMES_NAMED: usize = 12;

/// The transform between two frames at a stamp.
#[derive(Debug, Clone, PartialEq)]
pub enum TfLookup {
    /// `target_from_source`.
    At(Rigid),
    /// Not known yet: a frame or a newer transform may still be published.
    Wait(TfProblem),
    /// There is none and waiting does not help.
    Never(TfProblem),
}

impl TfLookup {
    /// The same outcome without the names.
    pub fn to_pose(&self) -> PoseLookup {
        match self {
            Self::At(t) => PoseLookup::At(*t),
            Self::Never(TfProblem::BeforeFirst { first_ns, .. }) => {
                PoseLookup::Never(PoseMissing::BeforeFirst { first_ns: *first_ns })
            }
            Self::Never(TfProblem::GapTooWide { gap_sec, .. }) => {
                PoseLookup::Never(PoseMissing::GapTooWide { gap_sec: *gap_sec })
            }
            Self::Wait(_) | Self::Never(_) => PoseLookup::Wait,
        }
    }
}

/// How two frames of a tree are connected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Link {
    /// By transforms that hold at all times.
    Static,
    /// By at least one that changes.
    Moving,
}

#[derive(Debug)]
enum Motion {
    Static(Rigid),
    Moving(Timeline),
}

#[derive(Debug)]
struct Edge {
    parent: usize,
    /// `parent_from_child`.
    motion: Motion,
}

#[derive(Debug)]
struct Frame {
    name: String,
    edge: Option<Edge>,
}

/// All frames with their parents; each frame has one parent at most, the one named last.
#[derive(Debug)]
pub struct TfTree {
    sync: SyncConfig,
    frames: Vec<Frame>,
    by_name: BTreeMap<String, usize>,
}

impl TfTree {
    /// Uses `pose_gap_sec` and the clock-jump limits.
    pub fn new(config: &SyncConfig) -> Self {
        Self { sync: config.clone(), frames: Vec::new(), by_name: BTreeMap::new() }
    }

    /// Takes one transform; a leading `/` of frame names does not count. A transform from /tf_static holds at every
    /// stamp.
    pub fn insert(&mut self, message: &TransformStamped, is_static: bool) -> Result<PoseNote, TfError> {
        let (parent, child) = (bare(&message.header.frame_id), bare(&message.child_frame_id));
        if parent.is_empty() || child.is_empty() {
            return Err(TfError::EmptyName { parent: parent.into(), child: child.into() });
        }
        if parent == child {
            return Err(TfError::OwnParent { frame: child.into() });
        }
        let numbers = |reason| TfError::Numbers { parent: parent.into(), child: child.into(), reason };
        let (transform, note) = checked(&message.transform).map_err(numbers)?;
        let (parent_index, child_index) = (self.frame(parent)?, self.frame(child)?);
        if let Some(at) = self.ancestors(parent_index).iter().position(|&f| f == child_index) {
            let around: Vec<_> =
                self.ancestors(parent_index)[..=at].iter().map(|&f| self.frames[f].name.as_str()).collect();
            return Err(TfError::Loop { path: format!("{child} -> {}", around.join(" -> ")) });
        }
        let edge = &mut self.frames[child_index].edge;
        if is_static {
            *edge = Some(Edge { parent: parent_index, motion: Motion::Static(transform) });
            return Ok(note);
        }
        match edge {
            Some(Edge { parent, motion: Motion::Moving(timeline) }) if *parent == parent_index => {
                timeline.push(message.header.stamp_ns, message.transform).map_err(numbers)
            }
            _ => {
                let (back_sec, forward_sec) = (self.sync.jump_back_sec, self.sync.jump_forward_sec);
                let mut timeline = Timeline::new(MAX_SAMPLES, self.sync.pose_gap_sec, back_sec, forward_sec);
                let outcome = timeline.push(message.header.stamp_ns, message.transform).map_err(numbers);
                *edge = Some(Edge { parent: parent_index, motion: Motion::Moving(timeline) });
                outcome
            }
        }
    }

    /// `target_from_source` at a stamp, along the parents both have in common; moving transforms are interpolated,
    /// never extrapolated.
    pub fn lookup(&self, target: &str, source: &str, stamp_ns: i64) -> TfLookup {
        let (target, source) = (bare(target), bare(source));
        let index = |name: &str| self.by_name.get(name).copied();
        let Some(target_index) = index(target) else { return TfLookup::Wait(self.unknown(target)) };
        let Some(source_index) = index(source) else { return TfLookup::Wait(self.unknown(source)) };
        let (above_target, above_source) = (self.ancestors(target_index), self.ancestors(source_index));
        let Some(common) = above_target.iter().copied().find(|f| above_source.contains(f)) else {
            let root = |above: &[usize]| above.last().map(|&f| self.frames[f].name.clone()).unwrap_or_default();
            return TfLookup::Wait(TfProblem::NotConnected {
                target_frame: target.into(),
                target_root: root(&above_target),
                source_frame: source.into(),
                source_root: root(&above_source),
            });
        };
        match (self.climb(target_index, common, stamp_ns), self.climb(source_index, common, stamp_ns)) {
            (TfLookup::At(common_from_target), TfLookup::At(common_from_source)) => {
                TfLookup::At(relative(&common_from_target, &common_from_source))
            }
            // What never comes outweighs what may still come.
            (never @ TfLookup::Never(_), _) | (_, never @ TfLookup::Never(_)) => never,
            (wait @ TfLookup::Wait(_), _) | (_, wait) => wait,
        }
    }

    /// Whether and how two frames are connected, and `target_from_source` with every moving transform at its first sample;
    /// `None` when they are not, or a moving transform has no sample.
    pub fn link(&self, target: &str, source: &str) -> Option<(Link, Rigid)> {
        let index = |name: &str| self.by_name.get(bare(name)).copied();
        let (target, source) = (index(target)?, index(source)?);
        let (above_target, above_source) = (self.ancestors(target), self.ancestors(source));
        let common = above_target.iter().copied().find(|f| above_source.contains(f))?;
        let mut link = Link::Static;
        let mut up = |from: usize| {
            let (mut at, mut at_from_frame) = (from, Rigid::IDENTITY);
            while at != common {
                let Edge { parent, motion } = self.frames[at].edge.as_ref()?;
                let parent_from_at = match motion {
                    Motion::Static(t) => *t,
                    Motion::Moving(timeline) => {
                        link = Link::Moving;
                        timeline.first()?
                    }
                };
                (at, at_from_frame) = (*parent, parent_from_at * at_from_frame);
            }
            Some(at_from_frame)
        };
        let (common_from_target, common_from_source) = (up(target)?, up(source)?);
        Some((link, relative(&common_from_target, &common_from_source)))
    }

    /// The topmost frame above `frame`; `None` when nothing was heard of it.
    pub fn root(&self, frame: &str) -> Option<&str> {
        let index = self.by_name.get(bare(frame)).copied()?;
        self.ancestors(index).last().map(|&top| self.frames[top].name.as_str())
    }

    /// How the moving transforms between two frames come: the stamp up to which all of them are known, and how often the
    /// slowest comes.
    pub fn timing(&self, target: &str, source: &str) -> PoseTiming {
        let index = |name: &str| self.by_name.get(bare(name)).copied();
        let (Some(target), Some(source)) = (index(target), index(source)) else { return PoseTiming::default() };
        let (above_target, above_source) = (self.ancestors(target), self.ancestors(source));
        let one_way = |f: &&usize| above_target.contains(f) != above_source.contains(f);
        let mut timing = PoseTiming::default();
        for &frame in above_target.iter().chain(&above_source).filter(one_way) {
            let Some(Edge { motion: Motion::Moving(timeline), .. }) = &self.frames[frame].edge else { continue };
            let Some(latest_ns) = timeline.latest_ns() else { continue };
            timing.latest_ns = Some(timing.latest_ns.map_or(latest_ns, |ns| ns.min(latest_ns)));
            let interval_sec = timeline.usual_interval_sec().unwrap_or(0.0);
            timing.interval_sec = Some(timing.interval_sec.map_or(interval_sec, |sec| sec.max(interval_sec)));
        }
        timing
    }

    /// True when both names were heard of.
    pub fn knows(&self, frame: &str) -> bool {
        self.by_name.contains_key(bare(frame))
    }

    /// Frame names, sorted.
    pub fn frames(&self) -> impl Iterator<Item = &str> {
        self.by_name.keys().map(String::as_str)
    }

    /// The images' clock jumped and now reads `stamp_ns`: forgets moving transforms that have not jumped there already.
    pub fn follow_clock(&mut self, stamp_ns: i64) {
        for frame in &mut self.frames {
            if let Some(Edge { motion: Motion::Moving(timeline), .. }) = &mut frame.edge
                && !timeline.same_time_base(stamp_ns)
            {
                timeline.clear();
            }
        }
    }

    /// Forgets all moving transforms.
    pub fn clear_moving(&mut self) {
        for frame in &mut self.frames {
            if let Some(Edge { motion: Motion::Moving(timeline), .. }) = &mut frame.edge {
                timeline.clear();
            }
        }
    }

    /// `top_from_frame`, multiplied up from `frame` to its ancestor `top`.
    fn climb(&self, frame: usize, top: usize, stamp_ns: i64) -> TfLookup {
        let (mut at, mut at_from_frame, mut wait) = (frame, Rigid::IDENTITY, None);
        while at != top {
            let Some(Edge { parent, motion }) = &self.frames[at].edge else { break };
            let names = || (self.frames[*parent].name.clone(), self.frames[at].name.clone());
            match motion {
                Motion::Static(parent_from_at) => at_from_frame = *parent_from_at * at_from_frame,
                Motion::Moving(timeline) => match timeline.lookup(stamp_ns) {
                    PoseLookup::At(parent_from_at) => at_from_frame = parent_from_at * at_from_frame,
                    PoseLookup::Wait => {
                        let behind_sec =
                            timeline.latest_ns().map_or(0.0, |latest_ns| seconds_between(latest_ns, stamp_ns));
                        let (parent, child) = names();
                        wait = Some(TfProblem::NotYet { parent, child, behind_sec });
                    }
                    PoseLookup::Never(PoseMissing::BeforeFirst { first_ns }) => {
                        let (parent, child) = names();
                        let after_sec = seconds_between(stamp_ns, first_ns);
                        return TfLookup::Never(TfProblem::BeforeFirst { parent, child, after_sec, first_ns });
                    }
                    PoseLookup::Never(PoseMissing::GapTooWide { gap_sec }) => {
                        let (parent, child) = names();
                        return TfLookup::Never(TfProblem::GapTooWide { parent, child, gap_sec });
                    }
                },
            }
            at = *parent;
        }
        wait.map_or(TfLookup::At(at_from_frame), TfLookup::Wait)
    }

    /// The frame itself, its parent, and so on to the root. Ends, because loops are refused on insertion.
    fn ancestors(&self, frame: usize) -> Vec<usize> {
        let mut above = vec![frame];
        let mut at = frame;
        while let Some(edge) = &self.frames[at].edge {
            at = edge.parent;
            above.push(at);
        }
        above
    }

    fn frame(&mut self, name: &str) -> Result<usize, TfError> {
        if let Some(&index) = self.by_name.get(name) {
            return Ok(index);
        }
        if self.frames.len() >= MAX_FRAMES {
            return Err(TfError::TooManyFrames { frame: name.into(), limit: MAX_FRAMES });
        }
        self.frames.push(Frame { name: name.into(), edge: None });
        self.by_name.insert(name.into(), self.frames.len() - 1);
        Ok(self.frames.len() - 1)
    }

    fn unknown(&self, frame: &str) -> TfProblem {
        let named: Vec<_> = self.frames().take(FRAMES_NAMED).collect();
        let more = if self.frames.len() > FRAMES_NAMED { ", ..." } else { "" };
        let known = if named.is_empty() { "none yet".into() } else { named.join(", ") + more };
        TfProblem::UnknownFrame { frame: frame.into(), known }
    }
}

/// A frame name without leading slashes, as TF 1 wrote them.
fn bare(name: &str) -> &str {
    name.trim_start_matches('/')
}

#[cfg(test)]
mod tests;
