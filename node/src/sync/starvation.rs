//! What to tell the user when no synchronized set comes together.

use std::collections::VecDeque;

use serde::Serialize;

use super::clock::seconds_between;

/// Stamps remembered per camera: several seconds at camera rates, and few enough that comparing all of them is instant.
const REMEMBERED_STAMPS: usize = 64;

/// What one camera sent while no set came together.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TopicReport {
    /// Images since the last set (or the start).
    pub images: u64,
    /// Images since then that could not be read.
    pub unreadable: u64,
    /// Newest stamp ever seen, offsets applied.
    pub newest_stamp_ns: Option<i64>,
}

/// Given when no synchronized set came together for `sync.starvation_sec`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StarvationReport {
    /// How long there has been no set, seconds.
    pub quiet_sec: f64,
    /// One entry per camera, in camera order.
    pub topics: Vec<TopicReport>,
    /// The closest the cameras came to a set: the smallest, over all images, of the distance in time to the farthest of
    /// the other cameras' nearest images. Cameras without images are left out; none when fewer than two have any.
    pub nearest_gap_sec: Option<f64>,
    /// The slop the gap has to fit in, seconds.
    pub slop_sec: f64,
}

impl StarvationReport {
    /// One line for the log; `topics` are the image topics in camera order.
    pub fn describe(&self, topics: &[String]) -> String {
        let mut out = format!("no synchronized set for {:.1} s:", self.quiet_sec);
        for (i, t) in self.topics.iter().enumerate() {
            let name = topics.get(i).map_or_else(|| format!("camera {i}"), Clone::clone);
            out += &format!(" {name} {} images", t.images);
            if t.unreadable > 0 {
                out += &format!(" and {} that cannot be read", t.unreadable);
            }
            if let Some(stamp_ns) = t.newest_stamp_ns {
                out += &format!(
                    " (newest stamp {}.{:09})",
                    stamp_ns.div_euclid(1_000_000_000),
                    stamp_ns.rem_euclid(1_000_000_000)
                );
            }
            out += if i + 1 < self.topics.len() { "," } else { ";" };
        }
        if let Some(gap_sec) = self.nearest_gap_sec {
            out += &format!(" nearest stamp gap {gap_sec:.3} s against sync.slop_sec {:.3}.", self.slop_sec);
        }
        out += if self.topics.iter().any(|t| t.images == 0 && t.unreadable > 0) {
            " A camera's images cannot be read; the warnings about them say why."
        } else if self.topics.iter().any(|t| t.images == 0) {
            " A camera sends nothing: check its topic, and live its QoS."
        } else if self.nearest_gap_sec.is_some_and(|gap_sec| gap_sec > self.slop_sec) {
            " Raise sync.slop_sec, or set input.image_time_offset_sec."
        } else {
            " Images come too late for each other: raise sync.timeout_sec."
        };
        out
    }
}

/// Watches one synchronizer.
#[derive(Debug)]
pub(crate) struct StarvationWatch {
    starvation_sec: f64,
    slop_sec: f64,
    cameras: Vec<Seen>,
    sets: u64,
    /// The caller's time at which the present quiet began, and the number of sets by then.
    quiet_since: Option<(i64, u64)>,
}

#[derive(Debug, Default)]
struct Seen {
    images: u64,
    unreadable: u64,
    /// Images in all.
    total: u64,
    newest_ns: Option<i64>,
    recent_ns: VecDeque<i64>,
}

impl StarvationWatch {
    pub fn new(cameras: usize, starvation_sec: f64, slop_sec: f64) -> Self {
        let cameras = (0..cameras).map(|_| Seen::default()).collect();
        Self { starvation_sec, slop_sec, cameras, sets: 0, quiet_since: None }
    }

    pub fn image(&mut self, camera: usize, stamp_ns: i64) {
        if let Some(seen) = self.cameras.get_mut(camera) {
            seen.images += 1;
            seen.total += 1;
            seen.newest_ns = Some(seen.newest_ns.map_or(stamp_ns, |n| n.max(stamp_ns)));
            seen.recent_ns.push_back(stamp_ns);
            if seen.recent_ns.len() > REMEMBERED_STAMPS {
                seen.recent_ns.pop_front();
            }
        }
    }

    pub fn unreadable(&mut self, camera: usize) {
        if let Some(seen) = self.cameras.get_mut(camera) {
            seen.unreadable += 1;
        }
    }

    pub fn set_emitted(&mut self) {
        self.sets += 1;
        for seen in &mut self.cameras {
            (seen.images, seen.unreadable) = (0, 0);
            seen.recent_ns.clear();
        }
    }

    /// Only differences of `now_ns` count, so it may come from another clock than the stamps.
    pub fn report(&mut self, now_ns: i64) -> Option<StarvationReport> {
        let (since_ns, sets) = *self.quiet_since.get_or_insert((now_ns, self.sets));
        let quiet_sec = seconds_between(since_ns, now_ns);
        if sets != self.sets || quiet_sec < 0.0 {
            self.quiet_since = Some((now_ns, self.sets));
            return None;
        }
        if quiet_sec < self.starvation_sec {
            return None;
        }
        self.quiet_since = Some((now_ns, self.sets));
        let topic = |s: &Seen| TopicReport { images: s.images, unreadable: s.unreadable, newest_stamp_ns: s.newest_ns };
        let topics = self.cameras.iter().map(topic).collect();
        Some(StarvationReport { quiet_sec, topics, nearest_gap_sec: self.nearest_gap_sec(), slop_sec: self.slop_sec })
    }

    /// In one sentence why images found no partner, with the key that may change it.
    pub fn why_incomplete(&self, names: &[String]) -> String {
        let name = |i: usize| names.get(i).map_or_else(|| format!("camera {i}"), Clone::clone);
        let count = |(i, s): (usize, &Seen)| format!("{} {}", name(i), s.total);
        let counts: Vec<String> = self.cameras.iter().enumerate().map(count).collect();
        let (least, most) = (self.cameras.iter().map(|s| s.total).min(), self.cameras.iter().map(|s| s.total).max());
        let advice = match self.nearest_gap_sec() {
            Some(gap_sec) if gap_sec > self.slop_sec => {
                let slop_sec = self.slop_sec;
                format!(
                    "the nearest stamps lie {gap_sec:.3} s apart, sync.slop_sec is {slop_sec}: raise it, or set input.image_time_offset_sec"
                )
            }
            _ if least.zip(most).is_some_and(|(least, most)| least.saturating_mul(2) < most) => {
                "a set takes one image of each camera: leave the rare camera out with input.images".into()
            }
            _ => "they come too late for each other: raise sync.timeout_sec".into(),
        };
        format!("images of the cameras ({}) do not come together; {advice}", counts.join(", "))
    }

    fn nearest_gap_sec(&self) -> Option<f64> {
        let present: Vec<_> = self.cameras.iter().filter(|s| !s.recent_ns.is_empty()).collect();
        if present.len() < 2 {
            return None;
        }
        let stamps = present.iter().flat_map(|s| s.recent_ns.iter().copied());
        stamps
            .map(|r| {
                let nearest = |s: &Seen| s.recent_ns.iter().map(|t| t.abs_diff(r)).min().unwrap_or(u64::MAX);
                present.iter().map(|s| nearest(s)).max().unwrap_or(u64::MAX)
            })
            .min()
            .map(|gap_ns| gap_ns as f64 * 1e-9)
    }
}
