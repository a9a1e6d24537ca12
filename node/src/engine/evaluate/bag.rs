//! Clips cut from a recording: the bag is read twice, once to see which windows it has, once for the pictures of the chosen
//! ones; at no time is more of it in memory than the clips at hand.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::sync::Arc;

use anyhow::{Result, bail};
use storm_render::Intrinsics;

use super::{Clip, TAIL_SEC};
use crate::config::{Config, WindowConfig};
use crate::engine::truth::TruthAt;
use crate::pipeline::front::{Front, FrontOutput, TruthImage};
use crate::pipeline::posed::PoseStore;
use crate::source::bag::BagSource;
use crate::source::topics::TruthKind;
use crate::source::{Frame, Rig};
use crate::sync::clock::signed_ns;
use crate::window::{PosedSet, Window};

/// Ground truth may be recorded this long after its picture's successors, seconds.
const LATE_SEC: f64 = 1.0;

/// Which part of a recording, and how many clips of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Part {
    /// First moment used, seconds after the first synchronized set.
    pub from_sec: f64,
    /// Last moment used; infinite: to the end.
    pub to_sec: f64,
    /// Most clips; they are spread evenly and overlap where the part is short.
    pub clips: usize,
}

/// A synchronized set or window, as far as planning needs it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Span {
    epoch: u32,
    first_ns: i64,
    last_ns: i64,
}

/// One clip to cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Plan {
    window: Span,
    /// Frames before this are held out, those after it do not belong to the clip.
    end_ns: i64,
}

/// A bag with the clips that will be cut from it.
pub struct BagClips {
    source: BagSource,
    config: Config,
    plans: Vec<Plan>,
    zero_ns: i64,
}

impl BagClips {
    /// Opens a bag and chooses clips; `size` is the network's picture size, `prior_sec` how long before each timestep its sweep has one
    /// more image (0: none), which is not held out then.
    ///
    /// # Errors
    /// A bag that cannot be read, or whose part holds no window with a frame that is not context.
    pub fn open(path: &Path, config: &Config, size: (usize, usize), prior_sec: f64, part: &Part) -> Result<Self> {
        let mut config = config.clone();
        config.model.sweep_prior_sec = prior_sec;
        let config = &config;
        let source = BagSource::open(path, config, size)?;
        source.rig().log(size);
        let (mut sets, mut windows) = (Vec::new(), Vec::new());
        run_front(&source, config, |output| {
            match output {
                FrontOutput::Set(set) => sets.push((set.epoch, set.stamp_ns)),
                FrontOutput::Window(w) => windows.extend(span(&w)),
                FrontOutput::Truth { .. } => {}
            }
            Ok(true)
        })?;
        let zero_ns = sets.first().map_or(0, |s| s.1);
        let plans = plan(&sets, &windows, &config.window, zero_ns, part);
        if plans.is_empty() {
            bail!(
                "{} has no window of {} timesteps {} s apart with frames between them from {} s to {} s ({} synchronized sets)",
                path.display(),
                config.window.timesteps,
                config.window.stride_sec,
                part.from_sec,
                part.to_sec,
                sets.len()
            );
        }
        Ok(Self { source, config: config.clone(), plans, zero_ns })
    }

    /// Number of clips.
    pub fn count(&self) -> usize {
        self.plans.len()
    }

    /// The cameras.
    pub fn rig(&self) -> Arc<Rig> {
        self.source.rig()
    }

    /// Cuts the clips, in order of time; `each` gets them one by one.
    pub fn each(&self, mut each: impl FnMut(Clip) -> Result<()>) -> Result<()> {
        let rig = self.source.rig();
        let mut cutter = Cutter::new(&self.plans, rig.intrinsics(), rig.reference, self.zero_ns);
        run_front(&self.source, &self.config, |output| {
            match output {
                FrontOutput::Set(set) => {
                    let now = (set.epoch, set.stamp_ns);
                    cutter.set(set);
                    while let Some(clip) = cutter.ready(Some(now)) {
                        each(clip)?;
                    }
                }
                FrontOutput::Window(window) => cutter.window(window),
                FrontOutput::Truth { camera, stamp_ns, kind, image } => cutter.truth(camera, stamp_ns, kind, &image),
            }
            Ok(!cutter.plans.is_empty())
        })?;
        while let Some(clip) = cutter.ready(None) {
            each(clip)?;
        }
        Ok(())
    }
}

fn span(window: &Window<Frame>) -> Option<Span> {
    let first_ns = window.steps.first()?.stamp_ns;
    Some(Span { epoch: window.epoch, first_ns, last_ns: window.stamp_ns })
}

/// The bag through decode, sync and poses; `each` returns false to stop early.
pub(crate) fn run_front(
    source: &BagSource,
    config: &Config,
    mut each: impl FnMut(FrontOutput) -> Result<bool>,
) -> Result<()> {
    let rig = source.rig();
    let store = PoseStore::of_bag(source, &rig, config);
    let mut front = Front::new(config, &rig, store);
    let mut ready = VecDeque::new();
    let mut ended: Result<bool> = Ok(true);
    let mut hand_on = |ready: &mut VecDeque<FrontOutput>| -> Result<bool> {
        while let Some(output) = ready.pop_front() {
            if !each(output)? {
                return Ok(false);
            }
        }
        Ok(true)
    };
    source.events(|event| {
        front.take(event, &mut ready);
        ended = hand_on(&mut ready);
        matches!(ended, Ok(true))
    })?;
    if ended? {
        front.finish(&mut ready);
        hand_on(&mut ready)?;
    }
    Ok(())
}

/// Chooses windows that have frames besides their timesteps, evenly over the part. If there are any, only those that span
/// what they should (the first ones of a recording are short), and whose half second afterwards is recorded too.
fn plan(sets: &[(u32, i64)], windows: &[Span], config: &WindowConfig, zero_ns: i64, part: &Part) -> Vec<Plan> {
    let from_ns = zero_ns.saturating_add(signed_ns(part.from_sec));
    let to_ns = if part.to_sec.is_finite() { zero_ns.saturating_add(signed_ns(part.to_sec)) } else { i64::MAX };
    let tail_ns = signed_ns(TAIL_SEC);
    let wanted_ns = signed_ns(config.stride_sec).saturating_mul(config.timesteps.saturating_sub(1) as i64);
    let mut sets = sets.to_vec();
    sets.sort_unstable();
    let before = |epoch: u32, ns: i64| sets.partition_point(|s| *s < (epoch, ns));
    let mut plans = Vec::new();
    for &window in windows.iter().filter(|w| w.first_ns >= from_ns && w.last_ns <= to_ns) {
        let Span { epoch, first_ns, last_ns } = window;
        let end_ns = last_ns.saturating_add(tail_ns).min(to_ns.saturating_add(1));
        let start = before(epoch, first_ns);
        let span_ns = last_ns.saturating_sub(first_ns);
        let gaps = before(epoch, last_ns).saturating_sub(start).max(1);
        let period_ns = span_ns / gaps as i64;
        let newest_ns = before(epoch.saturating_add(1), i64::MIN).checked_sub(1).map_or(last_ns, |i| sets[i].1);
        let full = span_ns.abs_diff(wanted_ns) <= period_ns.unsigned_abs().div_ceil(2);
        let complete = newest_ns.min(to_ns).saturating_add(period_ns) >= last_ns.saturating_add(tail_ns);
        if before(epoch, end_ns).saturating_sub(start) > config.timesteps {
            plans.push((Plan { window, end_ns }, full, complete));
        }
    }
    if plans.iter().any(|p| p.1) {
        plans.retain(|p| p.1);
    }
    if plans.iter().any(|p| p.2) {
        plans.retain(|p| p.2);
    }
    let n = plans.len();
    let want = part.clips.min(n);
    let pick = |k: usize| if want > 1 { (k * (n - 1) + (want - 1) / 2) / (want - 1) } else { n / 2 };
    (0..want).map(|k| plans[pick(k)].0).collect()
}

/// Collects what the planned clips need as the bag runs by.
struct Cutter {
    plans: VecDeque<Plan>,
    cameras: Vec<Intrinsics>,
    reference: usize,
    zero_ns: i64,
    sets: VecDeque<Arc<PosedSet<Frame>>>,
    windows: BTreeMap<(u32, i64), Window<Frame>>,
    truth: BTreeMap<(i64, usize), TruthAt>,
}

impl Cutter {
    fn new(plans: &[Plan], cameras: Vec<Intrinsics>, reference: usize, zero_ns: i64) -> Self {
        Self {
            plans: plans.iter().copied().collect(),
            cameras,
            reference,
            zero_ns,
            sets: VecDeque::new(),
            windows: BTreeMap::new(),
            truth: BTreeMap::new(),
        }
    }

    /// Whether a stamp lies in a clip still to come, with room for cameras that are not quite together.
    fn wanted(&self, stamp_ns: i64) -> bool {
        let room_ns = signed_ns(LATE_SEC);
        self.plans
            .iter()
            .any(|p| stamp_ns >= p.window.first_ns - room_ns && stamp_ns < p.end_ns.saturating_add(room_ns))
    }

    fn set(&mut self, set: Arc<PosedSet<Frame>>) {
        if self.wanted(set.stamp_ns) {
            self.sets.push_back(set);
        }
    }

    fn window(&mut self, window: Window<Frame>) {
        if self.plans.iter().any(|p| Some(p.window) == span(&window)) {
            self.windows.insert((window.epoch, window.stamp_ns), window);
        }
    }

    fn truth(&mut self, camera: usize, stamp_ns: i64, kind: TruthKind, image: &TruthImage) {
        let Some(k) = self.cameras.get(camera).filter(|_| self.wanted(stamp_ns)) else { return };
        let size = (k.width, k.height);
        self.truth.entry((stamp_ns, camera)).or_insert_with(|| TruthAt::none(size)).set(kind, image);
    }

    /// The next clip once the recording is well past it (`now`), or at its end (`None`).
    fn ready(&mut self, now: Option<(u32, i64)>) -> Option<Clip> {
        loop {
            let plan = *self.plans.front()?;
            let past = |(epoch, stamp_ns): (u32, i64)| {
                epoch > plan.window.epoch || stamp_ns > plan.end_ns.saturating_add(signed_ns(LATE_SEC))
            };
            if !now.is_none_or(past) {
                return None;
            }
            self.plans.pop_front();
            let window = self.windows.remove(&(plan.window.epoch, plan.window.last_ns));
            let clip = window.map(|window| self.cut(&plan, window));
            let oldest_ns = self.plans.iter().map(|p| p.window.first_ns).min().unwrap_or(i64::MAX);
            let limit_ns = oldest_ns.saturating_sub(signed_ns(LATE_SEC));
            while self.sets.front().is_some_and(|s| s.stamp_ns < limit_ns) {
                self.sets.pop_front();
            }
            self.truth = self.truth.split_off(&(limit_ns, 0));
            if clip.is_some() {
                return clip;
            }
        }
    }

    fn cut(&self, plan: &Plan, window: Window<Frame>) -> Clip {
        let inside = |s: &&Arc<PosedSet<Frame>>| {
            s.epoch == plan.window.epoch && s.stamp_ns >= plan.window.first_ns && s.stamp_ns < plan.end_ns
        };
        let frames = self.sets.iter().filter(inside).map(|set| {
            let truth = self.cameras.iter().zip(&set.frames).enumerate().map(|(camera, (k, frame))| {
                let known = self.truth.get(&(frame.stamp_ns, camera));
                let known = known.cloned().unwrap_or_else(|| TruthAt::none((k.width, k.height)));
                known.seen(frame.item.valid.as_ref())
            });
            (set.clone(), truth.collect())
        });
        let frames = frames.collect();
        let since_sec = (plan.window.first_ns.saturating_sub(self.zero_ns)) as f64 * 1e-9;
        let seed = plan.window.first_ns.saturating_sub(self.zero_ns).unsigned_abs();
        let name = format!("clip at {since_sec:.2} s");
        Clip::new(name, seed, window, self.reference, frames, self.cameras.clone(), Vec::new())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP_NS: i64 = 100_000_000;
    const ZERO_NS: i64 = 7_000_000_000;

    fn recording(frames: i64) -> (Vec<(u32, i64)>, Vec<Span>) {
        let stamp = |i: i64| ZERO_NS + i * STEP_NS;
        let windows = (15..frames).map(|i| Span { epoch: 0, first_ns: stamp(i - 15), last_ns: stamp(i) });
        ((0..frames).map(|i| (0, stamp(i))).collect(), windows.collect())
    }

    fn starts(plans: &[Plan]) -> Vec<i64> {
        plans.iter().map(|p| (p.window.first_ns - ZERO_NS) / STEP_NS).collect()
    }

    #[test]
    fn clips_are_spread_evenly_and_stay_in_their_part() {
        let (sets, windows) = recording(101);
        let part = Part { from_sec: 0.0, to_sec: f64::INFINITY, clips: 5 };
        let plans = plan(&sets, &windows, &WindowConfig::default(), ZERO_NS, &part);
        // 20 frames each: the last one starts at frame 81 of 101.
        assert_eq!(starts(&plans), [0, 20, 41, 61, 81]);
        assert_eq!(plans[0].end_ns - ZERO_NS, 20 * STEP_NS);
        let half = Part { from_sec: 5.0, ..part };
        let plans = plan(&sets, &windows, &WindowConfig::default(), ZERO_NS, &half);
        assert_eq!((starts(&plans)[0], starts(&plans)[4]), (50, 81));
        let first = Part { to_sec: 5.0, ..part };
        let plans = plan(&sets, &windows, &WindowConfig::default(), ZERO_NS, &first);
        assert!(plans.iter().all(|p| p.end_ns <= ZERO_NS + 50 * STEP_NS + 1), "{plans:?}");
        assert_eq!(starts(&plans)[0], 0);
        let one = Part { clips: 1, ..part };
        assert_eq!(starts(&plan(&sets, &windows, &WindowConfig::default(), ZERO_NS, &one)), [41]);
        assert!(plan(&sets, &windows, &WindowConfig::default(), ZERO_NS, &Part { clips: 0, ..part }).is_empty());
        assert!(plan(&sets, &windows, &WindowConfig::default(), ZERO_NS, &Part { from_sec: 9.0, ..part }).is_empty());
    }

    #[test]
    fn short_first_windows_are_left_out() {
        let (sets, mut windows) = recording(40);
        // What the window builder gives first at 10 Hz: frames 0, 4, 9 and 14.
        let first = Span { last_ns: ZERO_NS + 14 * STEP_NS, ..windows[0] };
        windows.insert(0, first);
        let part = Part { from_sec: 0.0, to_sec: f64::INFINITY, clips: 100 };
        let plans = plan(&sets, &windows, &WindowConfig::default(), ZERO_NS, &part);
        assert!(plans.iter().all(|p| p.window != first) && starts(&plans) == (0..=20).collect::<Vec<i64>>());
    }

    #[test]
    fn a_recording_that_ends_with_its_window_is_still_used() {
        let (sets, windows) = recording(16);
        let part = Part { from_sec: 0.0, to_sec: f64::INFINITY, clips: 3 };
        assert_eq!(starts(&plan(&sets, &windows, &WindowConfig::default(), ZERO_NS, &part)), [0]);
    }
}
