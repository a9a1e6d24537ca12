//! What the stamps of a recording look like: how often images and poses come, how they lie to each other and to the times of
//! recording. A replay looks at the beginning, `storm info` at all of it.

use std::collections::BTreeMap;

use thiserror::Error;

use super::topics::{PoseTopic, TopicPlan};
use crate::bag::{Bag, BagError};
use crate::cdr::decode as cdr;
use crate::config::InputConfig;
use crate::poses::usual_interval_ns;
use crate::sync::clock::{seconds_between, signed_ns};

/// Most stamps of one stream that are kept; beyond it only counts and limits go on.
const KEPT_STAMPS: usize = 4096;

/// Bytes of images that a look at the beginning reads at most, once every camera has given one.
const START_IMAGE_BYTES: usize = 64 << 20;
/// Seconds of recording that it reads at most.
const START_SEC: f64 = 10.0;
/// Pose messages that it reads at most.
const START_POSES: u64 = 2_000;

/// Beyond the length of the recording, images and poses of one clock lie no farther apart than this, seconds.
const ONE_CLOCK_SEC: f64 = 60.0;

/// Images recorded later than this after their stamp are of another clock than the recording's, seconds.
const RECORDING_CLOCK_SEC: f64 = 10.0;

/// A transform stamped at least so long after its recording is dated ahead, seconds.
const AHEAD_SEC: f64 = 0.1;

/// Stamps with which no picture can be given a pose. Each message names the key to set.
#[derive(Debug, Error)]
pub enum StampError {
    /// Headers that were never filled in.
    #[error(
        "{topic}: all {count} stamps are {stamp_sec} s, the headers are not filled in; set input.stamps=recorded to go by the \
         times of recording"
    )]
    Constant {
        /// The topic.
        topic: String,
        /// Messages seen.
        count: u64,
        /// Their stamp, seconds.
        stamp_sec: f64,
    },
    /// Images and poses are stamped by two clocks.
    #[error(
        "images are stamped {apart} s {way} than poses: two clocks; set input.stamps=recorded to go by the times of recording, or \
         input.image_time_offset_sec=[{offset_sec}]"
    )]
    TwoClocks {
        /// Distance, seconds, for people.
        apart: String,
        /// `later` or `earlier`.
        way: &'static str,
        /// What would bring the images to the poses, seconds, one entry per camera.
        offset_sec: String,
    },
    /// No image lies between two poses.
    #[error(
        "no image lies between two poses: images are stamped {images}, poses {poses} (seconds); set input.image_time_offset_sec if \
         one of them is off"
    )]
    Apart {
        /// First and last stamp of the images.
        images: String,
        /// First and last stamp of the poses.
        poses: String,
    },
}

/// The stamps of one stream of messages.
#[derive(Debug, Clone, Default)]
pub struct Stamps {
    /// Messages whose header could be read.
    pub count: u64,
    /// Messages whose header could not be read.
    pub unreadable: u64,
    /// The earliest stamp, nanoseconds.
    pub first_ns: i64,
    /// The latest stamp, nanoseconds.
    pub last_ns: i64,
    /// The largest step between two messages in a row, seconds.
    pub gap_sec: f64,
    newest_ns: i64,
    kept_ns: Vec<i64>,
    /// Time of recording less stamp, nanoseconds.
    lags_ns: Vec<i64>,
}

impl Stamps {
    fn add(&mut self, stamp_ns: i64, log_time_ns: i64) {
        if self.count == 0 {
            (self.first_ns, self.last_ns) = (stamp_ns, stamp_ns);
        } else {
            self.gap_sec = self.gap_sec.max(seconds_between(self.newest_ns, stamp_ns));
        }
        self.count += 1;
        self.newest_ns = stamp_ns;
        (self.first_ns, self.last_ns) = (self.first_ns.min(stamp_ns), self.last_ns.max(stamp_ns));
        if self.kept_ns.len() < KEPT_STAMPS {
            self.kept_ns.push(stamp_ns);
            self.lags_ns.push(log_time_ns.saturating_sub(stamp_ns));
        }
    }

    /// The usual time between two messages, seconds; none with fewer than two.
    pub fn interval_sec(&self) -> Option<f64> {
        let mut sorted = self.kept_ns.clone();
        sorted.sort_unstable();
        Some(usual_interval_ns(sorted.into_iter())? as f64 * 1e-9)
    }

    /// The part `share` (0 to 1) of the messages was recorded no later than this after its stamp, nanoseconds.
    fn lag_ns(&self, share: f64) -> Option<i64> {
        let mut lags_ns = self.lags_ns.clone();
        let at = (lags_ns.len().checked_sub(1)? as f64 * share) as usize;
        Some(*lags_ns.select_nth_unstable(at).1)
    }

    fn merged<'a>(all: impl Iterator<Item = &'a Self>) -> Option<(i64, i64)> {
        let spans = all.filter(|s| s.count > 0).map(|s| (s.first_ns, s.last_ns));
        spans.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)))
    }
}

/// The stamps of a recording's images and poses.
#[derive(Debug, Clone, Default)]
pub struct Survey {
    /// One per camera of the plan.
    pub cameras: Vec<Stamps>,
    /// Of the pose topic, or of each moving transform, by `parent -> child`.
    pub poses: BTreeMap<String, Stamps>,
    /// False when only the beginning was read.
    pub whole: bool,
}

impl Survey {
    /// Reads the beginning: enough to tell clocks and rates apart.
    pub fn beginning(bag: &Bag, plan: &TopicPlan) -> Result<Self, BagError> {
        let mut survey = Self { cameras: vec![Stamps::default(); plan.cameras.len()], whole: true, ..Self::default() };
        let images: Vec<usize> = plan.cameras.iter().map(|c| c.image).collect();
        let (mut bytes, mut start_ns) = (0, None);
        for message in bag.messages(&images)?.flatten() {
            survey.image(plan, message.topic, &message.data, message.log_time_ns);
            bytes += message.data.len();
            let sec = seconds_between(*start_ns.get_or_insert(message.log_time_ns), message.log_time_ns);
            let heard = survey.cameras.iter().all(|c| c.count > 0);
            if heard && (bytes > START_IMAGE_BYTES || sec > START_SEC) {
                survey.whole = false;
                break;
            }
        }
        let mut start_ns = None;
        for (seen, message) in (1..).zip(bag.messages(&plan.pose_topics())?.flatten()) {
            survey.pose(bag, plan, message.topic, &message.data, message.log_time_ns);
            let sec = seconds_between(*start_ns.get_or_insert(message.log_time_ns), message.log_time_ns);
            if seen >= START_POSES || sec > START_SEC {
                survey.whole = false;
                break;
            }
        }
        Ok(survey)
    }

    /// Reads everything.
    pub fn whole(bag: &Bag, plan: &TopicPlan) -> Result<Self, BagError> {
        let mut survey = Self { cameras: vec![Stamps::default(); plan.cameras.len()], whole: true, ..Self::default() };
        let mut wanted: Vec<usize> = plan.cameras.iter().map(|c| c.image).collect();
        wanted.extend(plan.pose_topics());
        for message in bag.messages(&wanted)?.flatten() {
            survey.image(plan, message.topic, &message.data, message.log_time_ns);
            survey.pose(bag, plan, message.topic, &message.data, message.log_time_ns);
        }
        Ok(survey)
    }

    fn image(&mut self, plan: &TopicPlan, topic: usize, data: &[u8], log_time_ns: i64) {
        for (_, stamps) in plan.cameras.iter().zip(&mut self.cameras).filter(|(c, _)| c.image == topic) {
            match cdr::header(data) {
                Ok(header) => stamps.add(header.stamp_ns, log_time_ns),
                Err(_) => stamps.unreadable += 1,
            }
        }
    }

    fn pose(&mut self, bag: &Bag, plan: &TopicPlan, topic: usize, data: &[u8], log_time_ns: i64) {
        let Some(t) = bag.topics().get(topic).filter(|_| plan.pose_topics().contains(&topic)) else { return };
        match plan.pose {
            PoseTopic::Message(_) => {
                let stamps = self.poses.entry(t.name.clone()).or_default();
                match cdr::header(data) {
                    Ok(header) => stamps.add(header.stamp_ns, log_time_ns),
                    Err(_) => stamps.unreadable += 1,
                }
            }
            PoseTopic::Tf => {
                for t in cdr::tf_message(data).unwrap_or_default() {
                    let stamps = self.poses.entry(edge_name(&t.header.frame_id, &t.child_frame_id)).or_default();
                    stamps.add(t.header.stamp_ns, log_time_ns);
                }
            }
        }
    }

    /// Transforms dated ahead of their recording (a localiser's transform tolerance), by `parent -> child`, and by how much,
    /// nanoseconds. None where the images' stamps are not of the recording's clock, so that nobody can say.
    pub fn dated_ahead(&self) -> BTreeMap<String, i64> {
        let image_lags = self.cameras.iter().filter_map(|c| c.lag_ns(0.5));
        let recorded_at_once =
            image_lags.map(|ns| ns as f64 * 1e-9).all(|sec| sec > -AHEAD_SEC && sec < RECORDING_CLOCK_SEC);
        let ahead = |stamps: &Stamps| {
            // What was recorded fastest says most exactly how far it is dated ahead.
            let (usual_ns, least_ns) = (stamps.lag_ns(0.5)?, stamps.lag_ns(0.1)?);
            (usual_ns < signed_ns(-AHEAD_SEC)).then_some(least_ns.saturating_neg())
        };
        let edges = self.poses.iter().filter(|_| recorded_at_once);
        edges.filter_map(|(edge, stamps)| Some((edge.clone(), ahead(stamps)?))).collect()
    }

    /// Refuses stamps with which no image can get a pose; `recorded_sec`: length of the recording.
    pub fn check(&self, plan: &TopicPlan, config: &InputConfig, recorded_sec: f64) -> Result<(), StampError> {
        if config.stamps == "recorded" {
            return Ok(());
        }
        let constant = |s: &Stamps| s.count > 1 && s.first_ns == s.last_ns;
        let images = plan.cameras.iter().map(|c| c.name.as_str()).zip(&self.cameras).find(|(_, s)| constant(s));
        // A transform among many that never changes may keep one stamp; all of them may not.
        let poses = self.poses.iter().map(|(name, s)| (name.as_str(), s));
        let poses = poses.clone().all(|(_, s)| constant(s)).then(|| poses.clone().next()).flatten();
        if let Some((topic, s)) = images.or(poses) {
            let (topic, stamp_sec) = (topic.to_owned(), s.first_ns as f64 * 1e-9);
            return Err(StampError::Constant { topic, count: s.count, stamp_sec });
        }
        let shifted: Vec<Stamps> = self.cameras.iter().enumerate().map(|(i, s)| s.shifted(config, i)).collect();
        let (Some(images), Some(poses)) =
            (Stamps::merged(shifted.iter()), Stamps::merged(self.poses.values().filter(|s| !constant(s))))
        else {
            return Ok(());
        };
        let (later_sec, earlier_sec) = (seconds_between(poses.1, images.0), seconds_between(images.1, poses.0));
        let limit_sec = recorded_sec + ONE_CLOCK_SEC;
        if later_sec.max(earlier_sec) > limit_sec {
            let way = if later_sec > 0.0 { "later" } else { "earlier" };
            let offset_sec = seconds_between(images.0, poses.0).round();
            let offset_sec = vec![format!("{offset_sec:.0}"); self.cameras.len()].join(", ");
            let apart = crate::pipeline::posed::seconds(seconds_between(poses.0, images.0).abs());
            return Err(StampError::TwoClocks { apart, way, offset_sec });
        }
        if self.whole && later_sec.max(earlier_sec) > 0.0 {
            let span = |(first, last): (i64, i64)| format!("{:.3} to {:.3}", first as f64 * 1e-9, last as f64 * 1e-9);
            return Err(StampError::Apart { images: span(images), poses: span(poses) });
        }
        Ok(())
    }
}

impl Stamps {
    /// With the offset the configuration gives this camera.
    fn shifted(&self, config: &InputConfig, camera: usize) -> Self {
        let offset_ns = config.image_time_offset_sec.get(camera).map_or(0, |&sec| signed_ns(sec));
        let mut all = self.clone();
        all.first_ns = all.first_ns.saturating_add(offset_ns);
        all.last_ns = all.last_ns.saturating_add(offset_ns);
        all
    }
}

/// How a moving transform is named.
pub(super) fn edge_name(parent: &str, child: &str) -> String {
    format!("{} -> {}", parent.trim_start_matches('/'), child.trim_start_matches('/'))
}

#[cfg(test)]
mod tests;
