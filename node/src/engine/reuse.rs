//! What steps leave for those that go on from them: the older timesteps of a window are the newest ones of the window one
//! stride before, whose keys, values and Gaussians are taken again ([`Storm::forward_reusing`]).
//!
//! Windows of neighbouring phases interleave, so what is left is looked up by the pictures themselves: a window goes on from
//! the one whose last timesteps are its first ones, the very same sets, in the frame of that one's anchor. After so many in a
//! row one is computed in full, in a frame of its own.
//!
//! [`Storm::forward_reusing`]: storm_model::Storm::forward_reusing

#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::sync::Arc;

use storm_model::Kept;
use storm_render::Intrinsics;

use crate::source::Frame;
use crate::sync::clock::seconds_between;
use crate::window::Window;

/// Most that is kept at once, bytes: ten phases of `tiny`'s size.
const MOST_BYTES: usize = 256 << 20;

/// What one step left.
pub struct Left {
    /// The window, in the frame it was computed in.
    window: Window<Frame>,
    cameras: Vec<Intrinsics>,
    /// When that frame's clock began, nanoseconds.
    zero_ns: i64,
    /// What the network left.
    pub kept: Kept,
    /// Windows in a row since the last full one.
    followers: usize,
}

impl Left {
    /// By a window that was computed in full.
    pub fn new(window: Window<Frame>, cameras: Vec<Intrinsics>, kept: Kept) -> Self {
        let zero_ns = window.steps.first().map_or(window.stamp_ns, |s| s.stamp_ns);
        Self { window, cameras, zero_ns, kept, followers: 0 }
    }

    /// By the next window, which went on from this and is in its frame.
    pub fn followed_by(self, window: Window<Frame>, kept: Kept) -> Self {
        Self { window, kept, followers: self.followers + 1, ..self }
    }

    /// The next window in this frame, on its clock.
    pub fn placed(&self, next: &Window<Frame>) -> Window<Frame> {
        let lead_sec = self.lead_sec(next);
        let time_sec = next.time_sec.iter().map(|row| row.iter().map(|t| t + lead_sec).collect()).collect();
        Window { map_from_anchor: self.window.map_from_anchor, time_sec, ..next.clone() }
    }

    /// How long this frame's clock had run at the window's first timestep, seconds.
    pub fn lead_sec(&self, window: &Window<Frame>) -> f64 {
        window.steps.first().map_or(0.0, |first| seconds_between(self.zero_ns, first.stamp_ns))
    }

    fn goes_on_with(&self, next: &Window<Frame>, cameras: &[Intrinsics]) -> bool {
        let (before, now) = (&self.window.steps, &next.steps);
        self.window.epoch == next.epoch
            && self.cameras == cameras
            && before.len() == now.len()
            && now.len() > 1
            && before[1..].iter().zip(now).all(|(a, b)| Arc::ptr_eq(a, b))
    }
}

/// What the last steps left.
pub struct Reuse {
    most: usize,
    left: VecDeque<Left>,
}

impl Reuse {
    /// `most` windows in a row go on from each other; 0: none ever does.
    pub fn new(most: usize) -> Self {
        Self { most, left: VecDeque::new() }
    }

    /// Whether steps leave anything.
    pub fn enabled(&self) -> bool {
        self.most > 0
    }

    /// Forgets.
    pub fn forget(&mut self) {
        self.left.clear();
    }

    /// What this window may go on from.
    pub fn at_hand(&self, window: &Window<Frame>, cameras: &[Intrinsics]) -> Option<usize> {
        self.left.iter().position(|left| left.followers < self.most && left.goes_on_with(window, cameras))
    }

    /// The same, to be used: one window goes on from each.
    pub fn take(&mut self, window: &Window<Frame>, cameras: &[Intrinsics]) -> Option<Left> {
        self.at_hand(window, cameras).and_then(|index| self.left.remove(index))
    }

    /// For the window after this one. What can no longer be gone on from goes, and what there is no room for, oldest first.
    pub fn leave(&mut self, new: Left) {
        let oldest_ns = new.window.steps.first().map_or(i64::MIN, |s| s.stamp_ns);
        self.left.retain(|left| {
            left.window.epoch == new.window.epoch
                && left.window.stamp_ns >= oldest_ns
                && left.window.stamp_ns != new.window.stamp_ns
        });
        self.left.push_back(new);
        while self.left.len() > 1 && self.left.iter().map(|left| left.kept.bytes()).sum::<usize>() > MOST_BYTES {
            self.left.pop_front();
        }
    }
}
