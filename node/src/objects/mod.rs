//! Moving objects: what moves, as things with a place, a size, a velocity and a look.
//!
//! Moving Gaussians of a step are grouped by motion token, velocity and connectedness (`cluster`); groups are matched
//! to the objects known so far (`matching`); each object is a filter over its velocity and place (`object`) and keeps
//! its Gaussians in its own frame, so that one seen from several sides becomes complete. An object can be put back
//! into the scene at any time it was followed, or left out of it.

mod cluster;
mod matching;
mod object;
#[cfg(test)]
mod tests;

use serde::Serialize;

use crate::config::ObjectsConfig;
use crate::sync::clock::seconds_between;
pub use cluster::ObjectPoint;
use cluster::{Cluster, clusters};
use matching::match_clusters;
pub use object::{MovingObject, ObjectState};

/// What became of groups and objects.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct ObjectCounts {
    /// Objects started.
    pub born: u64,
    /// Objects that ended after they were confirmed.
    pub ended: u64,
    /// Objects that ended before.
    pub unconfirmed: u64,
    /// Groups that continued an object.
    pub continued: u64,
    /// Points refused: not finite, or absurdly fast.
    pub rejected: u64,
    /// Steps refused: stamp not newer than the last.
    pub out_of_order: u64,
}

/// Follows moving objects from step to step.
#[derive(Debug)]
pub struct ObjectTracker {
    config: ObjectsConfig,
    epoch: Option<u32>,
    stamp_ns: i64,
    next_id: u32,
    /// In order of id.
    live: Vec<MovingObject>,
    ended: Vec<MovingObject>,
    counts: ObjectCounts,
}

impl ObjectTracker {
    /// With no objects.
    pub fn new(config: &ObjectsConfig) -> Self {
        let (live, ended) = (Vec::new(), Vec::new());
        let counts = ObjectCounts::default();
        Self { config: config.clone(), epoch: None, stamp_ns: 0, next_id: 0, live, ended, counts }
    }

    /// Takes the moving Gaussians of a step's newest timestep. Per point: the object it belongs to, if it belongs to
    /// one. A new epoch ends all objects.
    pub fn step(&mut self, stamp_ns: i64, epoch: u32, points: &[ObjectPoint]) -> Vec<Option<u32>> {
        let mut owners = vec![None; points.len()];
        if self.epoch != Some(epoch) {
            self.end_where(|_| true);
            self.epoch = Some(epoch);
        } else if stamp_ns <= self.stamp_ns {
            self.counts.out_of_order += 1;
            return owners;
        }
        self.stamp_ns = stamp_ns;
        let (groups, rejected) = clusters(points, &self.config);
        self.counts.rejected += rejected;
        let matched = match_clusters(&self.live, &groups, stamp_ns, &self.config);
        for (group, object) in groups.iter().zip(&matched) {
            let at = match object {
                Some(at) => {
                    self.counts.continued += 1;
                    *at
                }
                None => match self.start(stamp_ns, group) {
                    Some(at) => at,
                    None => continue,
                },
            };
            let object = &mut self.live[at];
            object.observe(stamp_ns, group, points, &self.config);
            group.members.iter().for_each(|&m| owners[m] = Some(object.id));
        }
        let bridge_sec = self.config.bridge_sec;
        self.end_where(|o| seconds_between(o.last_seen_ns(), stamp_ns) > bridge_sec);
        owners
    }

    fn start(&mut self, stamp_ns: i64, group: &Cluster) -> Option<usize> {
        if self.live.len() >= self.config.max_objects {
            return None;
        }
        self.live.push(MovingObject::new(self.next_id, stamp_ns, group));
        self.next_id = self.next_id.wrapping_add(1);
        self.counts.born += 1;
        Some(self.live.len() - 1)
    }

    /// Objects alive, in order of id, those not confirmed yet included (see [`MovingObject::confirmed`]).
    pub fn live(&self) -> &[MovingObject] {
        &self.live
    }

    /// Confirmed objects that have ended since the last call, in order of id.
    pub fn drain(&mut self) -> Vec<MovingObject> {
        self.ended.sort_by_key(|o| o.id);
        std::mem::take(&mut self.ended)
    }

    /// End of the recording: ends all objects and gives those not drained yet.
    pub fn finish(&mut self) -> Vec<MovingObject> {
        self.end_where(|_| true);
        self.drain()
    }

    /// Memory held, bytes.
    pub fn bytes(&self) -> usize {
        let parts: usize = self.live.iter().chain(&self.ended).map(MovingObject::bytes).sum();
        parts + (self.live.capacity() + self.ended.capacity()) * size_of::<MovingObject>()
    }

    /// What became of groups and objects so far.
    pub fn counts(&self) -> ObjectCounts {
        self.counts
    }

    /// Ends all objects; the next step starts new ones.
    pub fn end_all(&mut self) {
        self.end_where(|_| true);
        self.epoch = None;
    }

    fn end_where(&mut self, ended: impl Fn(&MovingObject) -> bool) {
        let config = &self.config;
        for object in self.live.extract_if(.., |o| ended(o)) {
            if object.confirmed(config) {
                self.counts.ended += 1;
                self.ended.push(object);
            } else {
                self.counts.unconfirmed += 1;
            }
        }
    }
}
