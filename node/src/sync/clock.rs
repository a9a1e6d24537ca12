//! Telling a clock jump (a looped recording, a reset simulation) from one message with a wrong stamp.

/// What to do with a message, judged by its stamp.
#[derive(Debug, PartialEq)]
pub(crate) struct Admission<T> {
    /// Messages to process now, oldest arrival first: none, this one, or the held one and this one.
    pub accepted: Vec<(i64, T)>,
    /// A message that was held and is now known to have a stray stamp.
    pub stray: Option<T>,
    /// True when the messages accepted here are the first of a new time base.
    pub jumped: bool,
}

/// Follows the newest stamp of one stream of messages.
///
/// A message far from the newest stamp is held. If the next message is near it, the clock has jumped and both are let
/// through; if the next message is near the old time, the held one had a stray stamp and is discarded. So one wrong
/// stamp never restarts anything, and a true jump costs one message of delay and none lost.
#[derive(Debug)]
pub(crate) struct ClockGuard<T> {
    back_ns: u64,
    forward_ns: u64,
    newest_ns: Option<i64>,
    held: Option<(i64, T)>,
}

impl<T> ClockGuard<T> {
    /// Jumps are steps back by more than `back_sec` or forward by more than `forward_sec`.
    pub fn new(back_sec: f64, forward_sec: f64) -> Self {
        Self { back_ns: unsigned_ns(back_sec), forward_ns: unsigned_ns(forward_sec), newest_ns: None, held: None }
    }

    /// Judges one message.
    pub fn admit(&mut self, stamp_ns: i64, item: T) -> Admission<T> {
        let Some(newest_ns) = self.newest_ns else {
            self.newest_ns = Some(stamp_ns);
            return Admission { accepted: vec![(stamp_ns, item)], stray: None, jumped: false };
        };
        if self.near(newest_ns, stamp_ns) {
            self.newest_ns = Some(newest_ns.max(stamp_ns));
            let stray = self.held.take().map(|(_, x)| x);
            return Admission { accepted: vec![(stamp_ns, item)], stray, jumped: false };
        }
        match self.held.take() {
            // Messages rarer than the forward limit are not near each other, but still tell that time goes on.
            Some((held_ns, held)) if self.near(held_ns, stamp_ns) || (newest_ns < held_ns && held_ns < stamp_ns) => {
                self.newest_ns = Some(held_ns.max(stamp_ns));
                Admission { accepted: vec![(held_ns, held), (stamp_ns, item)], stray: None, jumped: true }
            }
            other => {
                self.held = Some((stamp_ns, item));
                Admission { accepted: Vec::new(), stray: other.map(|(_, x)| x), jumped: false }
            }
        }
    }

    /// True when `stamp_ns` belongs to the same time base as `base_ns`.
    pub fn near(&self, base_ns: i64, stamp_ns: i64) -> bool {
        let limit_ns = if stamp_ns < base_ns { self.back_ns } else { self.forward_ns };
        stamp_ns.abs_diff(base_ns) <= limit_ns
    }

    /// The newest stamp of the present time base.
    pub fn newest_ns(&self) -> Option<i64> {
        self.newest_ns
    }

    /// Messages held until the next one tells what they are: 0 or 1.
    pub fn held(&self) -> usize {
        usize::from(self.held.is_some())
    }

    /// Forgets the time base; gives back the message that was held.
    pub fn reset(&mut self) -> Option<T> {
        self.newest_ns = None;
        self.held.take().map(|(_, x)| x)
    }
}

/// Seconds to whole nanoseconds, saturating; NaN and negative give 0.
pub(crate) fn unsigned_ns(sec: f64) -> u64 {
    // A float-to-integer `as` saturates and takes NaN to 0.
    (sec * 1e9).round() as u64
}

/// Signed seconds to whole nanoseconds, saturating; NaN gives 0.
pub(crate) fn signed_ns(sec: f64) -> i64 {
    (sec * 1e9).round() as i64
}

/// `later - earlier` in seconds, exact in the integers whatever the size of the stamps.
pub(crate) fn seconds_between(earlier_ns: i64, later_ns: i64) -> f64 {
    match later_ns.checked_sub(earlier_ns) {
        Some(ns) => ns as f64 * 1e-9,
        None => (i128::from(later_ns) - i128::from(earlier_ns)) as f64 * 1e-9,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SEC: i64 = 1_000_000_000;

    fn accepted(a: Admission<u32>) -> Vec<u32> {
        a.accepted.into_iter().map(|(_, x)| x).collect()
    }

    #[test]
    fn one_stray_stamp_changes_nothing() {
        let mut g = ClockGuard::new(1.0, 10.0);
        assert_eq!(accepted(g.admit(100 * SEC, 1)), [1]);
        for stray_ns in [0, 1 << 62, i64::MAX, i64::MIN] {
            let a = g.admit(stray_ns, 2);
            assert_eq!((a.accepted.len(), a.jumped, g.held()), (0, false, 1));
            let a = g.admit(101 * SEC, 3);
            assert_eq!((a.stray, a.jumped, g.held()), (Some(2), false, 0));
        }
        assert_eq!(g.newest_ns(), Some(101 * SEC));
    }

    #[test]
    fn a_jump_is_seen_at_its_second_message_and_loses_none() {
        for base_ns in [0, 50 * SEC, 1 << 62] {
            let mut g = ClockGuard::new(1.0, 10.0);
            g.admit(100 * SEC, 1);
            assert!(accepted(g.admit(base_ns, 2)).is_empty());
            let a = g.admit(base_ns + SEC / 10, 3);
            assert!(a.jumped);
            assert_eq!(accepted(a), [2, 3]);
            assert_eq!(g.newest_ns(), Some(base_ns + SEC / 10));
        }
    }

    #[test]
    fn messages_rarer_than_the_limit_pass() {
        let mut g = ClockGuard::new(1.0, 10.0);
        let passed: usize = (0..9).map(|i| g.admit(i * 20 * SEC, 0u32).accepted.len()).sum();
        assert_eq!((passed, g.held()), (9, 0));
    }

    #[test]
    fn messages_out_of_order_by_less_than_the_limit_pass() {
        let mut g = ClockGuard::new(1.0, 10.0);
        for (stamp_ns, x) in [(10 * SEC, 1), (9 * SEC, 2), (20 * SEC, 3), (30 * SEC, 4)] {
            assert_eq!(accepted(g.admit(stamp_ns, x)), [x]);
        }
        assert_eq!((unsigned_ns(f64::NAN), signed_ns(1e300)), (0, i64::MAX));
        assert_eq!(seconds_between(i64::MIN, i64::MIN + SEC), 1.0);
    }
}
