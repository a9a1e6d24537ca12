//! The end of the line: makes all messages that a node would send of a step, looks at every number, and keeps the times.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use anyhow::Result;

use crate::cdr::encode;
use crate::config::Config;
use crate::pipeline::demand::Demand;
use crate::pipeline::live::Outlet;
use crate::pipeline::messages::{self, Pictures, Published};
use crate::pipeline::step::{Step, StepMaker};
use crate::rigid::Rigid;
use crate::source::Rig;

/// What came out.
#[derive(Debug, Default)]
pub struct Seen {
    /// Steps.
    pub steps: u64,
    /// Vehicle poses.
    pub vehicles: u64,
    /// Bytes of all messages.
    pub bytes: u64,
    /// Numbers that are not finite, in scenes, pictures and messages.
    pub nonfinite: u64,
    /// Points withheld because a number in them was not finite.
    pub withheld: u64,
    /// From the push of a frame to the end of its step, milliseconds, one per step.
    pub latency_ms: Vec<f32>,
    /// Map Gaussians put to disk, given up, and tiles lost so far.
    pub spilled: u64,
    pub evicted: u64,
    pub spill_failed: u64,
    pub tiles_lost: u64,
    /// Bytes of the map on disk.
    pub disk_bytes: u64,
}

/// Frames whose moment is remembered: more than a window and all that may wait.
const REMEMBERED: usize = 1024;

/// Stamps and moments of the newest frames pushed, oldest first: the clock latencies are measured with. Stamps jump, moments do not.
#[derive(Debug)]
pub struct PushClock(Mutex<VecDeque<(i64, Instant)>>);

impl PushClock {
    pub fn new() -> Arc<Self> {
        Arc::new(Self(Mutex::new([(0, Instant::now())].into())))
    }

    /// A frame of this stamp is pushed now.
    pub fn pushed(&self, stamp_ns: i64) {
        let mut frames = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        frames.push_back((stamp_ns, Instant::now()));
        if frames.len() > REMEMBERED {
            frames.pop_front();
        }
    }

    /// The stamp a frame would have that is pushed now.
    pub fn now_ns(&self) -> i64 {
        let frames = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        frames.back().map_or(0, |(stamp_ns, at)| stamp_ns.saturating_add(at.elapsed().as_nanos() as i64))
    }

    /// How long ago the frame of this stamp was pushed, milliseconds: the nearest one, since cameras' stamps differ within a frame,
    /// and of stamps that came twice the newer.
    pub fn age_ms(&self, stamp_ns: i64) -> f64 {
        let frames = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let nearest = frames.iter().rev().min_by_key(|(pushed_ns, _)| pushed_ns.abs_diff(stamp_ns));
        nearest.map_or(0.0, |(_, at)| at.elapsed().as_secs_f64() * 1e3)
    }
}

/// Takes the steps.
pub struct Sink {
    pub rig: Arc<Rig>,
    pub config: Config,
    pub seen: Arc<Mutex<Seen>>,
    pub clock: Arc<PushClock>,
}

fn bad(values: impl Iterator<Item = f32>) -> u64 {
    values.filter(|x| !x.is_finite()).count() as u64
}

impl Outlet for Sink {
    fn demand(&mut self) -> Demand {
        Demand::ALL
    }

    fn vehicle(&mut self, _: i64, map_from_base: Rigid) {
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        seen.vehicles += 1;
        seen.nonfinite += u64::from(!map_from_base.is_finite());
    }

    fn step(&mut self, step: &Step, maker: &StepMaker, active: &[usize]) -> Result<()> {
        let mut counts = Published::default();
        let mut bytes = 0;
        let mut sent = |message: Vec<u8>| bytes += message.len() as u64;
        sent(encode::encode_tf_message(&[messages::anchor_transform(step, &self.rig.map_frame)])?);
        sent(encode::encode_point_cloud2(&messages::gaussians(step, &self.config, &mut counts)?)?);
        sent(encode::encode_point_cloud2(&messages::flow(step, &mut counts)?)?);
        for (view, &camera) in active.iter().enumerate() {
            let Some(pictures) = Pictures::new(step, view, &self.rig.cameras[camera]) else { continue };
            sent(encode::encode_image(&pictures.rendered())?);
            sent(encode::encode_image(&pictures.depth(&mut counts))?);
            sent(encode::encode_image(&pictures.motion_mask())?);
            sent(encode::encode_image(&pictures.mask_color()?)?);
            sent(encode::encode_camera_info(&pictures.camera_info())?);
        }
        let g = &step.scene.gaussians;
        let mut nonfinite = bad(g.means.iter().flatten().copied()) + bad(g.scales.iter().flatten().copied());
        nonfinite += bad(g.opacities.iter().copied()) + bad(g.velocity_forward.iter().flatten().copied());
        nonfinite += maker.tracks().iter().filter(|t| !t.end().position_map.is_finite()).count() as u64;
        let newest_ns = step.window.steps.last().and_then(|s| s.frames.iter().map(|f| f.stamp_ns).max());
        let age_ms = newest_ns.map_or(0.0, |newest_ns| self.clock.age_ms(newest_ns));
        let map = maker.map();
        let mut seen = self.seen.lock().unwrap_or_else(PoisonError::into_inner);
        seen.steps += 1;
        seen.bytes += bytes;
        seen.nonfinite += nonfinite + counts.non_finite;
        seen.withheld += counts.withheld;
        seen.latency_ms.push(age_ms as f32);
        let c = map.counts();
        (seen.spilled, seen.evicted, seen.spill_failed, seen.tiles_lost) =
            (c.spilled, c.evicted, c.spill_failed, c.tiles_lost);
        seen.disk_bytes = map.disk_bytes();
        Ok(())
    }

    fn idle(&mut self, _: &StepMaker) -> Result<()> {
        Ok(())
    }

    fn configure(&mut self, _: &Config) {}

    fn times(&mut self, _: &[(&'static str, f64)]) {}
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn ages_are_of_the_frame_whatever_its_stamps_did_since() {
        let clock = PushClock::new();
        clock.pushed(1_000_000_000);
        std::thread::sleep(Duration::from_millis(30));
        clock.pushed(100_000_000_000);
        clock.pushed(2_000_000_000);
        let [first, jumped, back] =
            [1_010_000_000, 100_000_000_000, 2_000_000_000].map(|stamp_ns| clock.age_ms(stamp_ns));
        assert!(jumped >= back && first - jumped >= 29.0, "{first} {jumped} {back}");
    }
}
