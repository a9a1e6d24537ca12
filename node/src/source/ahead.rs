//! The poses of a recording, read ahead of its images as far as an image needs them: a pose may be recorded long after (a SLAM
//! that lags) or long before (poses written first) the image it is for.
//!
//! Never behind log order: what was recorded before an image comes before it. Where the stamps jump (a recording of a
//! looped one), reading ahead stops until the images have got there, since poses of two times cannot be held at once.

use std::collections::{BTreeMap, HashMap, VecDeque};

use tracing::{info, warn};

use super::event::Event;
use super::survey::edge_name;
use crate::bag::{BagError, Messages, RawMessage};
use crate::config::SyncConfig;
use crate::pipeline::posed::{PoseStore, seconds};
use crate::poses::PoseLookup;
use crate::sync::clock::{signed_ns, unsigned_ns};

/// Pose messages handed on before their turn in log order, at most: half of what a transform's history holds, so that reading
/// ahead never pushes out what an image still needs.
const MOST_AHEAD: usize = 4_000;

/// So much of the recording is always read ahead, seconds: poses recorded out of order fill gaps before these are judged.
const ALWAYS_AHEAD_SEC: f64 = 2.0;

/// Poses farther ahead of an image than this wait for later images, seconds.
const FAR_AHEAD_SEC: f64 = 10.0;

/// Messages read on to tell one wrong stamp from a jump of the clock.
const READ_ON: usize = 64;

/// One message of poses, as events.
struct Read {
    log_time_ns: i64,
    topic: usize,
    events: Vec<Event>,
}

/// Gives poses in the order they are needed.
pub(super) struct PoseAhead<F> {
    messages: Messages,
    translate: F,
    queue: VecDeque<Read>,
    ended: bool,
    /// What was handed on, to know whether an image is covered.
    store: PoseStore,
    newest_ns: HashMap<String, i64>,
    dated_ahead_ns: BTreeMap<String, i64>,
    back_ns: u64,
    forward_ns: u64,
    /// Log times of messages handed on before their turn.
    ahead_ns: VecDeque<i64>,
    limit_said: bool,
    errors: Vec<BagError>,
}

impl<F: FnMut(&RawMessage) -> Vec<Event>> PoseAhead<F> {
    /// Over `messages` of the pose topics, made events by `translate`; `store` starts as the consumer's does.
    pub fn new(
        messages: Messages,
        translate: F,
        store: PoseStore,
        dated_ahead_ns: BTreeMap<String, i64>,
        config: &SyncConfig,
    ) -> Self {
        for (edge, &ahead_ns) in &dated_ahead_ns {
            let sec = seconds(ahead_ns as f64 * 1e-9);
            info!("/tf: {edge} is stamped {sec} s ahead of its recording and is taken back by that");
        }
        Self {
            messages,
            translate,
            queue: VecDeque::new(),
            ended: false,
            store,
            newest_ns: HashMap::new(),
            dated_ahead_ns,
            back_ns: unsigned_ns(config.jump_back_sec),
            forward_ns: unsigned_ns(config.jump_forward_sec),
            ahead_ns: VecDeque::new(),
            limit_said: false,
            errors: Vec::new(),
        }
    }

    /// Hands on, in order, what an image with this stamp, recorded at `log_time_ns`, needs. `each` returns false to stop early;
    /// then this does too.
    pub fn before_image(
        &mut self,
        stamp_ns: i64,
        log_time_ns: i64,
        each: &mut impl FnMut(Option<usize>, Event) -> bool,
    ) -> bool {
        while self.ahead_ns.front().is_some_and(|&ns| ns <= log_time_ns) {
            self.ahead_ns.pop_front();
        }
        let always_ns = log_time_ns.saturating_add(signed_ns(ALWAYS_AHEAD_SEC));
        while self.fill(1) {
            let (next_log_ns, earliest_ns) = self.queue.front().map_or((0, 0), |r| (r.log_time_ns, earliest(r)));
            let due = next_log_ns <= log_time_ns;
            let covered = self.store.lookup(stamp_ns) != PoseLookup::Wait;
            let far = earliest_ns > stamp_ns.saturating_add(signed_ns(FAR_AHEAD_SEC));
            if covered && (next_log_ns > always_ns || (far && !self.jumps())) {
                break;
            }
            if !due && (self.jumps() || self.at_limit()) {
                break;
            }
            if !due {
                self.ahead_ns.push_back(next_log_ns);
            }
            if !self.hand_on(each) {
                return false;
            }
        }
        true
    }

    /// Hands on what is left when the images have ended.
    pub fn rest(&mut self, each: &mut impl FnMut(Option<usize>, Event) -> bool) -> bool {
        while self.fill(1) {
            if !self.hand_on(each) {
                return false;
            }
        }
        true
    }

    /// What could not be read since the last call.
    pub fn errors(&mut self) -> Vec<BagError> {
        std::mem::take(&mut self.errors)
    }

    /// True when at least `n` messages wait.
    fn fill(&mut self, n: usize) -> bool {
        while self.queue.len() < n && !self.ended {
            match self.messages.next() {
                Some(Ok(message)) => {
                    let mut events = (self.translate)(&message);
                    for event in &mut events {
                        if let Event::Transform(t) = event
                            && let Some(&ahead_ns) =
                                self.dated_ahead_ns.get(&edge_name(&t.header.frame_id, &t.child_frame_id))
                        {
                            t.header.stamp_ns = t.header.stamp_ns.saturating_sub(ahead_ns);
                        }
                    }
                    self.queue.push_back(Read { log_time_ns: message.log_time_ns, topic: message.topic, events });
                }
                Some(Err(e)) => self.errors.push(e),
                None => self.ended = true,
            }
        }
        self.queue.len() >= n
    }

    fn hand_on(&mut self, each: &mut impl FnMut(Option<usize>, Event) -> bool) -> bool {
        let jumped = self.jumps();
        let Some(read) = self.queue.pop_front() else { return true };
        for event in read.events {
            if let Some((key, stamp_ns)) = stamped(&event) {
                let newest_ns = self.newest_ns.entry(key).or_insert(stamp_ns);
                // One wrong stamp is no new time.
                if near(*newest_ns, stamp_ns, self.back_ns, self.forward_ns) {
                    *newest_ns = (*newest_ns).max(stamp_ns);
                } else if jumped {
                    *newest_ns = stamp_ns;
                }
                // The consumer says what is refused.
                let _ = self.store.take(&event);
            }
            if !each(Some(read.topic), event) {
                return false;
            }
        }
        true
    }

    /// True when the next message begins another time: its stamp is far from those before it, and the one after it is too.
    fn jumps(&mut self) -> bool {
        let Some(read) = self.queue.front() else { return false };
        let far = |event: &Event, newest: &HashMap<String, i64>| {
            let (key, stamp_ns) = stamped(event)?;
            let newest_ns = *newest.get(&key)?;
            (!near(newest_ns, stamp_ns, self.back_ns, self.forward_ns)).then_some((key, newest_ns))
        };
        let Some((key, newest_ns)) = read.events.iter().find_map(|e| far(e, &self.newest_ns)) else { return false };
        self.fill(READ_ON);
        let later = self.queue.iter().skip(1).flat_map(|r| &r.events).filter_map(stamped).find(|(k, _)| *k == key);
        !later.is_some_and(|(_, stamp_ns)| near(newest_ns, stamp_ns, self.back_ns, self.forward_ns))
    }

    fn at_limit(&mut self) -> bool {
        let full = self.ahead_ns.len() >= MOST_AHEAD;
        if full && !self.limit_said {
            self.limit_said = true;
            warn!(
                "an image's pose is recorded more than {MOST_AHEAD} pose messages after it: no farther is read ahead, so that memory \
                 stays bounded; images without a pose are dropped"
            );
        }
        full
    }
}

fn near(base_ns: i64, stamp_ns: i64, back_ns: u64, forward_ns: u64) -> bool {
    stamp_ns.abs_diff(base_ns) <= if stamp_ns < base_ns { back_ns } else { forward_ns }
}

/// What an event's stamp is compared within, and the stamp.
fn stamped(event: &Event) -> Option<(String, i64)> {
    match event {
        Event::Pose { stamp_ns, .. } => Some((String::new(), *stamp_ns)),
        Event::Transform(t) => Some((edge_name(&t.header.frame_id, &t.child_frame_id), t.header.stamp_ns)),
        _ => None,
    }
}

/// The earliest stamp in a message; with none, no reason to wait.
fn earliest(read: &Read) -> i64 {
    read.events.iter().filter_map(stamped).map(|(_, ns)| ns).min().unwrap_or(i64::MIN)
}

#[cfg(test)]
mod tests;
