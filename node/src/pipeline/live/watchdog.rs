//! Says when an input stops and when it is back. Driven by the caller's clock, so it works under simulated time.

/// Messages after a silence until an input counts as back: one that arrives now and then is not.
const BACK_AFTER: u32 = 3;

/// An input that sent within this share of the silence limit still sends.
const LIVELY_SHARE: f64 = 0.5;

/// What happened to an input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Change {
    /// Nothing for so long, seconds.
    Silent {
        /// Which input.
        input: usize,
        /// How long, seconds.
        for_sec: f64,
    },
    /// It sends again.
    Back {
        /// Which input.
        input: usize,
    },
}

#[derive(Debug, Clone, Default)]
struct Input {
    last_ns: Option<i64>,
    silent: bool,
    since_silent: u32,
}

/// Watches several inputs.
#[derive(Debug)]
pub struct Watchdog {
    silence_sec: f64,
    inputs: Vec<Input>,
    polled_ns: Option<i64>,
    /// When last no camera sent.
    quiet_ns: Option<i64>,
}

impl Watchdog {
    /// For so many inputs; one is silent after `silence_sec` without a message.
    pub fn new(inputs: usize, silence_sec: f64) -> Self {
        Self { silence_sec, inputs: vec![Input::default(); inputs], polled_ns: None, quiet_ns: None }
    }

    /// Another limit from now on, seconds.
    pub fn set_silence(&mut self, silence_sec: f64) {
        self.silence_sec = silence_sec;
    }

    /// A message of `input` came in at `now_ns`.
    pub fn heard(&mut self, input: usize, now_ns: i64) {
        if let Some(i) = self.inputs.get_mut(input) {
            i.last_ns = Some(now_ns);
            i.since_silent = i.since_silent.saturating_add(1);
        }
    }

    /// What has changed by `now_ns`. The first call starts the watch of inputs that never sent.
    pub fn poll(&mut self, now_ns: i64) -> Vec<Change> {
        let mut changes = Vec::new();
        // Polls come several times within the limit. A clock that moved on by more than that in between was set (the first
        // message of /clock, a bag that skips), and everything that sent before then sent just now.
        let moved_ns = self.polled_ns.map_or(0, |p| now_ns.saturating_sub(p));
        let set_ns = if moved_ns as f64 * 1e-9 > self.silence_sec { moved_ns } else { 0 };
        self.polled_ns = Some(now_ns);
        for (input, i) in self.inputs.iter_mut().enumerate() {
            // A clock that went back starts the wait anew.
            let last_ns = i.last_ns.map_or(now_ns, |l| l.saturating_add(set_ns).min(now_ns));
            i.last_ns = Some(last_ns);
            let for_sec = (now_ns - last_ns) as f64 * 1e-9;
            if !i.silent && for_sec > self.silence_sec {
                (i.silent, i.since_silent) = (true, 0);
                changes.push(Change::Silent { input, for_sec });
            } else if i.silent && i.since_silent >= BACK_AFTER && for_sec <= self.silence_sec {
                i.silent = false;
                changes.push(Change::Back { input });
            }
        }
        changes
    }

    /// Which of the first `cameras` inputs to go on with: those that are not silent, as long as one of them still sends.
    /// None when nothing does (all have been stopped, or are just about to be silent too): nothing is gained by a change.
    /// None also for as long as the silence limit after such a stop, since cameras do not come back all at once.
    pub fn lively(&mut self, cameras: usize, now_ns: i64) -> Option<Vec<usize>> {
        let silent = |i: &usize| self.inputs.get(*i).is_none_or(|input| input.silent);
        let left: Vec<usize> = (0..cameras).filter(|i| !silent(i)).collect();
        let sends = |i: &usize| {
            let last_ns = self.inputs.get(*i).and_then(|input| input.last_ns);
            last_ns.is_some_and(|l| (now_ns.saturating_sub(l) as f64) * 1e-9 < LIVELY_SHARE * self.silence_sec)
        };
        if !left.iter().any(sends) {
            self.quiet_ns = Some(now_ns);
        }
        // A clock that went back ends the wait.
        let waits = |q: i64| (0.0..=self.silence_sec).contains(&(now_ns.saturating_sub(q) as f64 * 1e-9));
        (!self.quiet_ns.is_some_and(waits)).then_some(left)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SEC: i64 = 1_000_000_000;

    /// Polls ten times a second up to `to_ns`.
    fn watch(w: &mut Watchdog, from_ns: i64, to_ns: i64) -> Vec<Change> {
        (from_ns..=to_ns).step_by(SEC as usize / 10).flat_map(|now_ns| w.poll(now_ns)).collect()
    }

    #[test]
    fn silence_is_said_once_and_its_end_once() {
        let mut w = Watchdog::new(2, 1.0);
        assert_eq!(watch(&mut w, 0, SEC), []);
        w.heard(0, SEC);
        let changes = watch(&mut w, SEC, SEC * 6 / 5);
        assert!(matches!(changes[..], [Change::Silent { input: 1, .. }]), "{changes:?}");
        assert_eq!(w.lively(2, SEC * 6 / 5), Some(vec![0]));
        assert_eq!(w.lively(2, SEC * 8 / 5), None, "input 0 has not sent for half the limit");
        for k in 0..2 {
            w.heard(1, SEC * 13 / 10 + k);
        }
        w.heard(0, SEC * 13 / 10);
        assert_eq!(w.poll(SEC * 14 / 10), [], "two messages are not a stream");
        w.heard(1, SEC * 14 / 10 + 5);
        assert_eq!(w.poll(SEC * 15 / 10), [Change::Back { input: 1 }]);
        assert_eq!(w.poll(SEC * 16 / 10), []);
        assert_eq!(watch(&mut w, SEC * 17 / 10, 4 * SEC).len(), 2, "both stop");
    }

    #[test]
    fn cameras_that_come_back_one_after_the_other_are_waited_for() {
        let mut w = Watchdog::new(2, 1.0);
        let mut seen = Vec::new();
        for tick in 0..80 {
            let now_ns = tick * SEC / 10;
            // Both stop at 1 s; input 0 is back at 3 s, input 1 at 3.8 s; input 1 stops for good at 5 s.
            let sends = [!(10..30).contains(&tick), !(10..38).contains(&tick) && tick < 50];
            (0..2).filter(|&i| sends[i]).for_each(|i| w.heard(i, now_ns));
            w.poll(now_ns);
            if let Some(lively) = w.lively(2, now_ns)
                && seen.last() != Some(&lively)
            {
                seen.push(lively);
            }
        }
        assert_eq!(seen, [vec![0, 1], vec![0]]);
    }

    #[test]
    fn a_clock_that_is_set_or_stands_is_no_silence() {
        let mut w = Watchdog::new(1, 1.0);
        assert_eq!(w.poll(0), []);
        assert_eq!(w.poll(100 * SEC), [], "the first message of /clock");
        w.heard(0, 100 * SEC);
        assert_eq!(w.poll(100 * SEC), []);
        assert_eq!(w.poll(10 * SEC), []);
        assert_eq!(w.poll(10 * SEC), []);
        assert_eq!(watch(&mut w, 10 * SEC, 12 * SEC).len(), 1);
    }
}
