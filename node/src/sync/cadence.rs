//! How often each camera sends, and what that says of images no set took.

use std::collections::VecDeque;

use super::DropReason;
use crate::poses::usual_interval_ns;

/// Stamps remembered per camera to tell its rate.
const REMEMBERED_STAMPS: usize = 17;

/// A camera whose images come in less than this part of the slowest camera's interval sends more often than sets can be made.
const FASTER: f64 = 0.75;

/// Longer than this many of the slowest camera's intervals between two sets, and an image is missing.
const ONE_INTERVAL: f64 = 1.5;

/// Tells images that a faster camera sent between two sets from images whose partner is missing.
#[derive(Debug)]
pub(super) struct Cadence {
    recent_ns: Vec<VecDeque<i64>>,
    /// Per camera, images dropped as incomplete since the last set.
    left: Vec<u64>,
}

impl Cadence {
    pub fn new(cameras: usize) -> Self {
        Self { recent_ns: vec![VecDeque::new(); cameras], left: vec![0; cameras] }
    }

    /// An image of a camera with this stamp came in.
    pub fn image(&mut self, camera: usize, stamp_ns: i64) {
        let recent = &mut self.recent_ns[camera];
        let at = recent.partition_point(|&s| s < stamp_ns);
        recent.insert(at, stamp_ns);
        if recent.len() > REMEMBERED_STAMPS {
            recent.pop_front();
        }
    }

    /// Images of a camera were dropped as incomplete.
    pub fn left(&mut self, camera: usize, images: usize) {
        self.left[camera] += images as u64;
    }

    /// A set came together this long after the one before: how many of the images left since are surplus.
    pub fn set(&mut self, since_last_ns: u64) -> u64 {
        let slowest_ns = self.slowest_ns();
        let mut surplus = 0;
        for camera in 0..self.left.len() {
            let left = std::mem::take(&mut self.left[camera]);
            if let Some(slowest_ns) = slowest_ns.filter(|_| left > 0)
                && self.is_faster(camera, slowest_ns)
            {
                // Every interval of the slowest camera without a set has lost one image of this camera too.
                let missing = (since_last_ns as f64 / slowest_ns as f64).round() as u64;
                surplus += left.saturating_sub(missing.saturating_sub(1));
            }
        }
        surplus
    }

    /// What an image still waiting is when the recording ends `after_ns` after the last set, or begins so long before the
    /// first; `edge_ns`: what is always taken for the edge.
    pub fn at_edge(&self, camera: usize, after_ns: u64, edge_ns: u64) -> DropReason {
        let slowest_ns = self.slowest_ns().unwrap_or(0);
        let one_interval_ns = (slowest_ns as f64 * ONE_INTERVAL) as u64;
        match after_ns <= edge_ns.max(one_interval_ns) {
            true if self.is_faster(camera, slowest_ns) => DropReason::Surplus,
            true => DropReason::Edge,
            false => DropReason::Incomplete,
        }
    }

    /// Forgets everything, as after a clock jump.
    pub fn reset(&mut self) {
        *self = Self::new(self.left.len());
    }

    fn interval_ns(&self, camera: usize) -> Option<u64> {
        usual_interval_ns(self.recent_ns[camera].iter().copied())
    }

    fn slowest_ns(&self) -> Option<u64> {
        (0..self.left.len()).filter_map(|camera| self.interval_ns(camera)).max().filter(|&ns| ns > 0)
    }

    fn is_faster(&self, camera: usize, slowest_ns: u64) -> bool {
        self.interval_ns(camera).is_some_and(|ns| (ns as f64) < FASTER * slowest_ns as f64)
    }
}
