//! What the soak found, and whether its counts add up.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::pipeline::live::Status;

use super::super::memory::Memory;
use super::sink::Seen;

/// Two counts that have to be the same.
#[derive(Debug, Clone, Serialize)]
pub struct Check {
    /// What is counted, as an equation.
    pub what: &'static str,
    /// Its left side.
    pub left: u64,
    /// Its right side.
    pub right: u64,
    /// Whether they agree.
    pub ok: bool,
}

impl Check {
    fn equal(what: &'static str, left: u64, right: u64) -> Self {
        Self { what, left, right, ok: left == right }
    }
}

/// A quarter of the drive.
#[derive(Debug, Clone, Default, Serialize)]
pub struct LiveQuarter {
    /// Mean and largest resident memory, MB.
    pub rss_mb: [f64; 2],
    /// Steps.
    pub steps: u64,
    /// From the push of a frame to the end of its step, milliseconds: median, 99th percentile, largest. Bursts and clock jumps
    /// in the middle of a frame are in it.
    pub latency_ms: [f64; 3],
    /// Map Gaussians, those on disk included.
    pub map_gaussians: u64,
    /// Megabytes of the map on disk.
    pub map_disk_mb: f64,
    /// Trajectories and objects alive.
    pub alive: [u64; 2],
    /// What the allocator says at its end.
    pub memory_mb: Memory,
}

/// What a soak with faults found.
#[derive(Debug, Clone, Serialize)]
pub struct FaultReport {
    /// Seed of drive and faults.
    pub seed: u64,
    /// Seconds driven.
    pub seconds: f64,
    /// Seconds it took.
    pub wall_sec: f64,
    /// Faults by kind: single ones, and episodes that began.
    pub injected: BTreeMap<&'static str, u64>,
    /// Image messages sent.
    pub images_sent: u64,
    /// Image messages that came in.
    pub images_in: u64,
    /// Images in synchronized sets.
    pub images_used: u64,
    /// Images dropped, by reason.
    pub dropped: BTreeMap<&'static str, u64>,
    /// Sets.
    pub sets: u64,
    /// Steps.
    pub steps: u64,
    /// Steps that were not computed because nothing had changed.
    pub steps_skipped: u64,
    /// Steps that reached the sink.
    pub published: u64,
    /// Bytes of what was published.
    pub published_bytes: u64,
    /// Windows lost to a panic.
    pub panicked_steps: u64,
    /// Poses refused.
    pub poses_rejected: u64,
    /// Clock jumps.
    pub epochs: u32,
    /// Saves of the map that failed.
    pub failed_saves: u64,
    /// Map tiles put to disk, Gaussians given up, tiles that could not be put to disk, tiles lost.
    pub spilled: u64,
    /// Gaussians given up to the cap.
    pub evicted: u64,
    /// Tiles that could not be put to disk.
    pub spill_failed: u64,
    /// Tiles that could not be read back.
    pub tiles_lost: u64,
    /// Numbers published that are not finite.
    pub nonfinite: u64,
    /// Points withheld because a number in them was not finite.
    pub withheld: u64,
    /// Quarters of the drive.
    pub quarters: Vec<LiveQuarter>,
    /// What mean resident memory of the last quarter has more than the second's, as a part.
    pub memory_growth: f64,
    /// Gaussians of the saved map, read back after the end.
    pub saved_gaussians: u64,
    /// Counts that have to agree.
    pub checks: Vec<Check>,
}

impl FaultReport {
    /// Whether everything adds up and nothing that is not finite came out.
    pub fn holds(&self) -> bool {
        self.checks.iter().all(|c| c.ok)
    }
}

/// What has to add up.
pub fn checks(sent: u64, status: &Status, seen: &Seen, panics: u64, saved: Option<u64>) -> Vec<Check> {
    let s = status;
    let w = &s.windows;
    let without = s.superseded + w.filling + w.hop + w.gap + w.out_of_order + w.malformed;
    let lost = s.non_finite_windows + s.panicked_steps + s.failed_steps;
    vec![
        Check::equal("images sent = images in", sent, s.images_in),
        Check::equal(
            "images in = images used + images dropped by reason",
            s.images_in,
            s.images_used + s.drops.total(),
        ),
        Check::equal("sets = steps + sets without a window + windows lost", s.sets, s.steps + without + lost),
        Check::equal("steps = steps published", s.steps, seen.steps),
        Check::equal("sets = vehicle poses published", s.sets, seen.vehicles),
        Check::equal("panics injected = windows lost to a panic", panics, s.panicked_steps),
        Check::equal("numbers published that are not finite = 0", seen.nonfinite, 0),
        Check::equal("steps failed, outputs failed, other panics = 0", s.failed_steps + s.failed_outputs + s.panics, 0),
        Check::equal("map Gaussians = Gaussians of the saved map", s.map_gaussians, saved.unwrap_or(u64::MAX)),
    ]
}
