//! What several examples measure with.
#![allow(dead_code)] // Each example uses a part of it.

/// Seconds all threads of this process have run (Linux), which other programs on the machine do not inflate.
pub fn cpu_seconds() -> Option<f64> {
    let mut nanoseconds = 0f64;
    for task in std::fs::read_dir("/proc/self/task").ok()? {
        let text = std::fs::read_to_string(task.ok()?.path().join("schedstat")).ok()?;
        nanoseconds += text.split_whitespace().next()?.parse::<f64>().ok()?;
    }
    Some(nanoseconds * 1e-9)
}

/// Multiply-add steps of the peak loop: some 30 ms, because the system's processor times lag by up to a tick.
const PEAK_STEPS: usize = 15_000_000;

/// Floating-point operations a second of processor time that multiply-adds in registers reach.
pub fn fma_peak() -> f64 {
    let cpu = cpu_seconds();
    let (flop, seconds) = storm_model::kernels::peak::fma(storm_model::kernels::Isa::detect(), PEAK_STEPS);
    let threads = rayon::current_num_threads() as f64;
    let busy = cpu.zip(cpu_seconds()).map_or(threads * seconds, |(before, after)| after - before);
    flop / busy
}
