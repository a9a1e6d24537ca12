//! Times, and what this machine could do at best.

use rayon::prelude::*;
use serde_json::{Value, json};
use std::hint::black_box;
use std::time::Instant;

pub type Error = Box<dyn std::error::Error>;

/// Times of the repeats of one piece of work, milliseconds.
pub struct Times {
    sorted_ms: Vec<f64>,
    /// Processor time of all threads per repeat.
    cpu_ms: Option<f64>,
}

impl Times {
    pub fn median_ms(&self) -> f64 {
        self.sorted_ms.get(self.sorted_ms.len() / 2).copied().unwrap_or(f64::NAN)
    }

    /// Processor time of all threads, or the wall clock where it is not known.
    pub fn busy_ms(&self) -> f64 {
        self.cpu_ms.unwrap_or_else(|| self.median_ms())
    }

    pub fn json(&self) -> Value {
        let best = self.sorted_ms.first();
        json!({"median_ms": self.median_ms(), "best_ms": best, "cpu_ms": self.cpu_ms, "repeats": self.sorted_ms.len()})
    }
}

impl std::fmt::Display for Times {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let best = self.sorted_ms.first().copied().unwrap_or(f64::NAN);
        let cpu = self.cpu_ms.map_or("-".into(), |ms| format!("{ms:.1}"));
        write!(f, "median {:8.1} ms, best {best:8.1}, processor time {cpu:>8}", self.median_ms())
    }
}

/// Runs `work` once to warm up and then `repeats` times.
pub fn measure(repeats: usize, mut work: impl FnMut() -> Result<(), Error>) -> Result<Times, Error> {
    work()?;
    let mut sorted_ms = Vec::new();
    let cpu_start = cpu_ms();
    for _ in 0..repeats.max(1) {
        let start = Instant::now();
        work()?;
        sorted_ms.push(start.elapsed().as_secs_f64() * 1e3);
    }
    let cpu_ms = cpu_start.zip(cpu_ms()).map(|(from, to)| (to - from) / sorted_ms.len() as f64);
    sorted_ms.sort_by(f64::total_cmp);
    Ok(Times { sorted_ms, cpu_ms })
}

/// Median of some milliseconds.
pub fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Processor time of this process's threads so far, milliseconds; `None` where `/proc` does not say.
fn cpu_ms() -> Option<f64> {
    let threads = std::fs::read_dir("/proc/self/task").ok()?;
    // The first number of a thread's schedstat: nanoseconds it has run.
    let ran_ns = |thread: std::fs::DirEntry| -> Option<f64> {
        std::fs::read_to_string(thread.path().join("schedstat")).ok()?.split_whitespace().next()?.parse().ok()
    };
    let total_ns: f64 = threads.filter_map(|thread| ran_ns(thread.ok()?)).sum();
    (total_ns > 0.0).then_some(total_ns * 1e-6)
}

/// Peak rates of all cores, measured now.
pub struct Peaks {
    pub bytes_per_ms: f64,
    /// Multiply-adds count as two; `None` where this program knows no vector instructions.
    pub flops_per_ms: Option<f64>,
}

impl Peaks {
    pub fn measure() -> Result<Self, Error> {
        /// Far more than any cache, f32 numbers.
        const NUMBERS: usize = 1 << 26;
        let data = vec![1.0f32; NUMBERS];
        let read = measure(5, || {
            let sum: f64 = data.par_chunks(1 << 16).map(|c| f64::from(c.iter().fold(0.0, |a: f32, &x| a.max(x)))).sum();
            black_box(sum);
            Ok(())
        })?;
        let bytes = (4 * NUMBERS) as f64;
        const ROUNDS: usize = 2_000_000;
        let burst = measure(5, || {
            black_box(rayon::broadcast(|_| multiply_adds(ROUNDS)));
            Ok(())
        })?;
        let flops = (2 * CHAINS * LANES * ROUNDS * rayon::current_num_threads()) as f64;
        let best = |times: &Times| times.sorted_ms.first().copied().unwrap_or(f64::NAN);
        let flops_per_ms = multiply_adds(0).map(|_| flops / best(&burst));
        Ok(Self { bytes_per_ms: bytes / best(&read), flops_per_ms })
    }
}

/// Independent chains of vectors: more than latency times throughput of any processor.
const CHAINS: usize = 12;
const LANES: usize = 8;

/// So many rounds of multiply-adds on vectors; `None` without AVX2.
fn multiply_adds(rounds: usize) -> Option<f32> {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx2,fma")]
        fn run(rounds: usize) -> f32 {
            let mut chains = [[1.0f32; LANES]; CHAINS];
            for _ in 0..rounds {
                for chain in &mut chains {
                    for x in chain.iter_mut() {
                        *x = x.mul_add(0.999, 0.001);
                    }
                }
            }
            chains.iter().flatten().sum()
        }
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            // SAFETY: the processor has just reported these features.
            return Some(unsafe { run(rounds) });
        }
    }
    let _ = rounds;
    None
}
