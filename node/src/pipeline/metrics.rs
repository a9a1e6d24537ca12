//! `metrics.json`: what a run did, lost, took and scored.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::engine::score::Scores;
use crate::gate::skipper::SkipCounts;
use crate::map::MapCounts;
use crate::objects::ObjectCounts;
use crate::overlap::OverlapCounts;
use crate::sync::DropReason;
use crate::tracks::TrackCounts;

use super::front::Front;
use super::step::Finished;
use super::timing::StageStats;

/// Counts of a run, taken when its stages have ended.
#[derive(Debug, Clone, Default)]
pub struct Counts {
    /// Images that arrived, readable or not.
    pub images_in: u64,
    /// Images dropped, by reason.
    pub dropped: BTreeMap<String, u64>,
    /// Poses, transforms and ground truth that could not be read.
    pub messages_lost: u64,
    /// Poses refused.
    pub poses_rejected: u64,
    /// Windows whose result was not finite.
    pub non_finite_windows: u64,
    /// Stages that panicked and were started anew.
    pub stage_panics: u64,
    /// What could not be read.
    pub problems: Vec<String>,
    /// Where more than half of the images went and why, if they went one way.
    pub verdict: Option<String>,
}

impl Counts {
    /// From the stages' own counters.
    pub fn new(front: &Front, finished: &Finished, problems: Vec<String>) -> Self {
        let drops = front.drops();
        let dropped = DropReason::ALL.iter().map(|&r| (r.as_str().to_string(), drops.get(r))).collect();
        Self {
            images_in: front.images_in(),
            dropped,
            messages_lost: front.messages_lost(),
            poses_rejected: front.poses_rejected(),
            non_finite_windows: finished.non_finite_windows,
            stage_panics: finished.panics + front.panics(),
            problems,
            verdict: front.verdict(),
        }
    }
}

/// The content of `metrics.json`.
#[derive(Debug, Clone, Serialize)]
pub struct Metrics {
    /// The recording's file or folder name.
    pub recording: String,
    /// The weights file's name, or `untrained`.
    pub weights: String,
    /// The network.
    pub model: String,
    /// Images that arrived, over all cameras.
    pub images_in: u64,
    /// Synchronized sets with poses (frames of the whole rig).
    pub frames_in: u64,
    /// Steps run.
    pub steps: u64,
    /// Steps among them that the network was not run for because the scene did not need it.
    pub steps_skipped: u64,
    /// By which notch of the ladder, how they were checked, and the present level.
    pub skips: SkipCounts,
    /// Images dropped, by reason; every reason is listed.
    pub dropped: BTreeMap<String, u64>,
    /// Share of each camera's pixels that show nothing and take no part, 0 to 1, in the cameras' order.
    pub masked_share: Vec<f64>,
    /// Poses, transforms and ground truth that could not be read.
    pub messages_lost: u64,
    /// Poses refused (not finite, not a rotation).
    pub poses_rejected: u64,
    /// Windows dropped because the network's result was not finite.
    pub non_finite_windows: u64,
    /// Times a stage panicked and was started anew; each lost the window or the images it had. Never anything but 0, unless
    /// the program has a fault.
    pub stage_panics: u64,
    /// Non-finite values in the published clouds and depth pictures, counted as they are written (the file writers refuse
    /// them). Never anything but 0.
    pub nonfinite: u64,
    /// Points withheld from the published clouds because a number in them was not finite.
    pub withheld: u64,
    /// What of the input could not be read.
    pub problems: Vec<String>,
    /// Milliseconds per stage.
    pub latency_ms: BTreeMap<String, StageStats>,
    /// Largest resident memory, MB.
    pub peak_rss_mb: Option<f64>,
    /// Wall time of the run, seconds.
    pub wall_sec: f64,
    /// Time the recording covers, seconds.
    pub recorded_sec: f64,
    /// Gaussians of the last step.
    pub gaussians: u64,
    /// Published Gaussians the size limit left out.
    pub gaussians_left_out: u64,
    /// Gaussians in the map.
    pub map_gaussians: u64,
    /// What became of the Gaussians offered to the map.
    pub map: MapCounts,
    /// Memory of the map, MiB.
    pub map_mb: f64,
    /// Times the map could not be saved.
    pub map_saves_failed: u64,
    /// Map Gaussians given up to the hard cap.
    pub map_evicted: u64,
    /// Trajectories written.
    pub tracks: u64,
    /// What became of points and trajectories.
    pub track_counts: TrackCounts,
    /// What became of moving objects.
    pub objects: ObjectCounts,
    /// What overlapping windows said of each other.
    pub overlap: OverlapCounts,
    /// Windows per forward pass of the network.
    pub batch: usize,
    /// Fixed frame of all outputs.
    pub map_frame: String,
    /// Vehicle frame.
    pub base_frame: String,
    /// What `map.ply` is relative to, map frame, metres.
    pub origin_m: [f64; 3],
    /// Times the clock jumped or the recording looped.
    pub epochs: u32,
    /// Where more than half of the images went and why, if they went one way.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub verdict: Option<String>,
    /// Why no step was run, if none was.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub no_steps: Option<String>,
    /// Error figures on frames that were not context, where there were any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub held_out: Option<Scores>,
}

impl Metrics {
    /// True when something of the input was lost.
    pub fn lost(&self) -> bool {
        self.dropped_lost()
            + self.messages_lost
            + self.nonfinite
            + self.poses_rejected
            + self.non_finite_windows
            + self.stage_panics
            + self.withheld
            + self.map_evicted
            + self.map_saves_failed
            + self.map.spill_failed
            + self.map.tiles_lost
            > 0
            || !self.problems.is_empty()
            || self.no_steps.is_some()
    }

    /// Images dropped that something could have been made of.
    fn dropped_lost(&self) -> u64 {
        DropReason::ALL.iter().filter(|r| r.is_loss()).filter_map(|r| self.dropped.get(r.as_str())).sum()
    }

    /// One line of images nothing could have been made of, by reason; empty when there were none.
    pub fn left_out_line(&self) -> String {
        let count = |r: &DropReason| Some((self.dropped.get(r.as_str()).copied().filter(|&n| n > 0)?, *r));
        let left_out = DropReason::ALL.iter().filter(|r| !r.is_loss()).filter_map(count);
        left_out.map(|(n, reason)| format!("{n} images {reason}")).collect::<Vec<_>>().join(", ")
    }

    /// One line of what was lost, empty when nothing was.
    pub fn loss_line(&self) -> String {
        let dropped = |r: &DropReason| Some((*r, self.dropped.get(r.as_str()).copied().filter(|&n| n > 0)?));
        let lost = DropReason::ALL.iter().filter(|r| r.is_loss()).filter_map(dropped);
        let mut parts: Vec<String> = lost.map(|(reason, n)| format!("{n} images {reason}")).collect();
        for (n, what) in [
            (self.messages_lost, "messages unreadable"),
            (self.nonfinite, "non-finite values published"),
            (self.poses_rejected, "poses refused"),
            (self.non_finite_windows, "windows not finite"),
            (self.stage_panics, "panics of a stage"),
            (self.withheld, "points withheld"),
            (self.map_evicted, "map Gaussians evicted"),
            (self.map_saves_failed, "saves of the map failed"),
            (self.map.spill_failed, "map tiles not put to disk"),
            (self.map.tiles_lost, "map tiles lost"),
        ] {
            if n > 0 {
                parts.push(format!("{n} {what}"));
            }
        }
        parts.extend(self.no_steps.iter().cloned());
        parts.extend(self.problems.iter().cloned());
        parts.join("; ")
    }
}
