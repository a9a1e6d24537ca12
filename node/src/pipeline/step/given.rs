//! Which sets the map was given: a window repeats three of the four, and those of windows that were skipped it never had.

use std::collections::VecDeque;

/// Stamps remembered: those of a window's length at 100 Hz.
const KEPT: usize = 512;

/// Stamps of the present epoch's sets that were given.
#[derive(Debug, Default)]
pub(super) struct Given {
    epoch: u32,
    stamps_ns: VecDeque<i64>,
}

impl Given {
    /// The first of the newest timesteps that were not given before, as they are now. Another epoch's sets are others,
    /// whatever their stamps.
    pub fn first_new(&mut self, epoch: u32, stamps_ns: &[i64]) -> usize {
        if self.epoch != epoch {
            *self = Self { epoch, ..Self::default() };
        }
        let new = stamps_ns.iter().rev().take_while(|s| !self.stamps_ns.contains(s)).count();
        self.stamps_ns.extend(&stamps_ns[stamps_ns.len() - new..]);
        while self.stamps_ns.len() > KEPT {
            self.stamps_ns.pop_front();
        }
        stamps_ns.len() - new
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_given_is_not_new_and_a_looped_recording_is() {
        let mut given = Given::default();
        assert_eq!(given.first_new(0, &[0, 5, 10, 15]), 0);
        assert_eq!(given.first_new(0, &[5, 10, 15, 20]), 3);
        // Two windows between were skipped.
        assert_eq!(given.first_new(0, &[20, 25, 30, 35]), 1);
        // The recording starts again, with the same stamps.
        assert_eq!(given.first_new(1, &[0, 5, 10, 15]), 0);
        assert_eq!(given.first_new(1, &[5, 10, 15, 20]), 3);
        for k in 0..2 * KEPT as i64 {
            given.first_new(1, &[100 + k]);
        }
        assert_eq!(given.stamps_ns.len(), KEPT);
    }
}
