//! What the live pipeline says of itself.

use std::collections::VecDeque;

use crate::gate::skipper::SkipCounts;
use crate::sync::DropCounts;
use crate::window::WindowCounts;

/// Steps whose latency is remembered: a minute at 10 Hz.
const REMEMBERED: usize = 600;

/// Counts since the start, and the newest times.
#[derive(Debug, Clone, Default)]
pub struct Status {
    /// Images that came in, readable or not, given up or not.
    pub images_in: u64,
    /// Images in synchronized sets with poses.
    pub images_used: u64,
    /// Images given up, by reason.
    pub drops: DropCounts,
    /// Poses and transforms given up because too many waited.
    pub messages_dropped: u64,
    /// Poses and transforms that could not be read.
    pub messages_lost: u64,
    /// Poses refused.
    pub poses_rejected: u64,
    /// Images that came in while paused; they are not used.
    pub paused_images: u64,
    /// Synchronized sets with poses.
    pub sets: u64,
    /// Steps run.
    pub steps: u64,
    /// Sets without a step of their own, because a newer one was there when the last step had ended.
    pub superseded: u64,
    /// What became of the other sets.
    pub windows: WindowCounts,
    /// Windows whose result was not finite.
    pub non_finite_windows: u64,
    /// Steps that were not computed, or approximated, and how checks of them went.
    pub skips: SkipCounts,
    /// Windows lost because a part of the step panicked.
    pub panicked_steps: u64,
    /// Times another stage panicked and was started anew.
    pub panics: u64,
    /// Saves of the map that failed.
    pub failed_saves: u64,
    /// Steps that failed.
    pub failed_steps: u64,
    /// Outputs that could not be sent.
    pub failed_outputs: u64,
    /// Time between the newest stamps of the last two steps, seconds, smoothed.
    pub hop_sec: f64,
    /// Stamp of the newest step, nanoseconds.
    pub stamp_ns: Option<i64>,
    /// Newest time of every stage, milliseconds.
    pub stages_ms: Vec<(&'static str, f64)>,
    /// From the stamp of a step's newest image to its last message sent, milliseconds; the last minute or so.
    pub latencies_ms: VecDeque<f64>,
    /// Gaussians of the newest step.
    pub gaussians: u64,
    /// Gaussians in the map.
    pub map_gaussians: u64,
    /// Memory of the map, MiB.
    pub map_mb: f64,
    /// Map Gaussians given up to the hard cap.
    pub map_evicted: u64,
    /// Trajectories alive.
    pub tracks: u64,
    /// Objects alive and believed.
    pub objects: u64,
    /// Clock jumps and resets.
    pub epochs: u32,
    /// Cameras in use, as numbers of the rig's.
    pub active: Vec<usize>,
    /// Whether steps are held back.
    pub paused: bool,
}

impl Status {
    /// Books one step's latency.
    pub fn latency(&mut self, ms: f64) {
        self.latencies_ms.push_back(ms);
        if self.latencies_ms.len() > REMEMBERED {
            self.latencies_ms.pop_front();
        }
    }

    /// Nearest-rank quantile of the remembered latencies, milliseconds; none before the first step.
    pub fn latency_quantile_ms(&self, q: f64) -> Option<f64> {
        let mut sorted: Vec<f64> = self.latencies_ms.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let rank = (q * sorted.len() as f64).ceil() as usize;
        sorted.get(rank.saturating_sub(1)).copied()
    }
}
