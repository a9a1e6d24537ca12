//! What the system says of this process.

/// Time all threads of this process have run, milliseconds, without what other programs took; `None` where the system
/// does not say.
pub fn cpu_ms() -> Option<f64> {
    let mut sum = 0.0;
    for task in std::fs::read_dir("/proc/self/task").ok()? {
        // A thread that has just ended has no file any more.
        let text = std::fs::read_to_string(task.ok()?.path().join("schedstat")).unwrap_or_default();
        sum += text.split_whitespace().next().and_then(|ns| ns.parse::<f64>().ok()).unwrap_or(0.0);
    }
    Some(sum * 1e-6)
}

/// Resident memory, MB; `None` where the system does not say.
pub fn rss_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmRSS:"))?;
    Some(line.split_whitespace().nth(1)?.parse::<f64>().ok()? / 1024.0)
}
