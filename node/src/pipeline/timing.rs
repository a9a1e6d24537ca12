//! Stage times and their percentiles.

use std::collections::BTreeMap;
use std::time::Instant;

use serde::Serialize;

/// Times of one stage over a run.
#[derive(Debug, Clone, Serialize, PartialEq)]
pub struct StageStats {
    /// Median, milliseconds.
    pub p50: f64,
    /// 99th percentile, milliseconds.
    pub p99: f64,
}

/// Times kept per stage; beyond it the older half goes, so that a node may run for weeks.
const MAX_TIMES: usize = 1 << 16;

/// Milliseconds per stage, one entry per run of the stage.
#[derive(Debug, Clone, Default)]
pub struct Timings {
    stages: BTreeMap<&'static str, Vec<f32>>,
}

impl Timings {
    /// Runs `work` and books its time under `stage`.
    pub fn time<R>(&mut self, stage: &'static str, work: impl FnOnce() -> R) -> R {
        let start = Instant::now();
        let result = work();
        self.add(stage, start.elapsed().as_secs_f64() * 1e3);
        result
    }

    /// Books `ms` under `stage`.
    pub fn add(&mut self, stage: &'static str, ms: f64) {
        let times = self.stages.entry(stage).or_default();
        if times.len() >= MAX_TIMES {
            times.drain(..MAX_TIMES / 2);
        }
        times.push(ms as f32);
    }

    /// The newest time of every stage, milliseconds.
    pub fn last(&self) -> impl Iterator<Item = (&'static str, f64)> + '_ {
        self.stages.iter().filter_map(|(stage, ms)| Some((*stage, f64::from(*ms.last()?))))
    }

    /// The newest time of one stage, milliseconds; 0 before its first.
    pub fn newest(&self, stage: &str) -> f64 {
        self.stages.get(stage).and_then(|ms| ms.last()).map_or(0.0, |ms| f64::from(*ms))
    }

    /// Takes over all of `other`'s entries.
    pub fn merge(&mut self, other: Self) {
        for (stage, mut ms) in other.stages {
            self.stages.entry(stage).or_default().append(&mut ms);
        }
    }

    /// Median and 99th percentile (nearest rank) per stage.
    pub fn stats(&self) -> BTreeMap<String, StageStats> {
        self.stages.iter().map(|(k, ms)| (k.to_string(), stats(ms))).collect()
    }
}

fn stats(ms: &[f32]) -> StageStats {
    let mut sorted = ms.to_vec();
    sorted.sort_by(f32::total_cmp);
    let rank = |q: f64| {
        let i = (q * sorted.len() as f64).ceil() as usize;
        sorted.get(i.saturating_sub(1)).copied().unwrap_or(0.0) as f64
    };
    StageStats { p50: rank(0.5), p99: rank(0.99) }
}

/// Time all threads of this process have run, milliseconds, without what other programs took; `None` where the system
/// does not say.
#[cfg(unix)]
pub fn cpu_ms() -> Option<f64> {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `time` is valid for the write, which is all that the call does.
    let failed = unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &raw mut time) };
    (failed == 0).then_some(time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 * 1e-6)
}

/// Time all threads of this process have run; not known here.
#[cfg(not(unix))]
pub fn cpu_ms() -> Option<f64> {
    None
}

/// Starts the count of [`peak_rss_mb`] anew, where the system can.
pub fn reset_peak_rss() {
    // Not being able to (other systems, locked-down containers) only means that the peak covers more than was asked.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// Largest resident memory of this process so far, MB; `None` where the system does not say.
pub fn peak_rss_mb() -> Option<f64> {
    status_mb("VmHWM:")
}

/// Resident memory of this process, MB; `None` where the system does not say.
pub fn rss_mb() -> Option<f64> {
    status_mb("VmRSS:")
}

fn status_mb(key: &str) -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with(key))?;
    let kb: f64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(kb / 1024.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(unix)]
    fn processor_time_counts_work() {
        let of = |work: fn()| {
            let before = cpu_ms().unwrap();
            work();
            cpu_ms().unwrap() - before
        };
        let busy = of(|| {
            let start = Instant::now();
            while start.elapsed().as_millis() < 20 {
                std::hint::black_box((0..1000).sum::<u64>());
            }
        });
        assert!(busy > 0.5, "{busy}");
    }

    #[test]
    fn percentiles_are_nearest_rank() {
        let mut t = Timings::default();
        for i in 1..=100 {
            t.add("a", i as f64);
        }
        assert_eq!(t.stats()["a"], StageStats { p50: 50.0, p99: 99.0 });
        let mut one = Timings::default();
        one.time("b", || ());
        t.merge(one);
        assert!(t.stats()["b"].p99 >= t.stats()["b"].p50);
    }
}
