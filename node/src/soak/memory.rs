//! Where memory is: what every part says it holds, beside what the allocator and the system say.

use serde::Serialize;

use crate::pipeline::timing::rss_mb;

/// Megabytes per part.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Memory {
    /// Resident, as the system says.
    pub resident: f64,
    /// Asked of the allocator and not given back; 0 where it does not say.
    pub allocated: f64,
    /// Kept by the allocator though nobody uses it.
    pub unused: f64,
    /// The map's tiles.
    pub tiles: f64,
    /// The map's index of tiles, on disk too, and what fusing needs.
    pub map_side: f64,
    /// Trajectories.
    pub tracks: f64,
    /// Moving objects.
    pub objects: f64,
    /// Predictions kept to be compared with later ones.
    pub overlap: f64,
    /// The drive's pictures waiting for their windows.
    pub sets: f64,
    /// The measurements themselves.
    pub measurements: f64,
}

impl Memory {
    /// With the figures of the system and the allocator filled in.
    pub(super) fn of_process(self) -> Self {
        let (allocated, unused) = allocator_mb();
        Self { resident: rss_mb().unwrap_or(0.0), allocated, unused, ..self }
    }
}

/// Megabytes in use and kept unused.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
pub(super) fn allocator_mb() -> (f64, f64) {
    // SAFETY: takes no arguments, and only reads the allocator's own counters under its locks.
    let info = unsafe { libc::mallinfo2() };
    ((info.uordblks + info.hblkhd) as f64 / 1e6, info.fordblks as f64 / 1e6)
}

#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
pub(super) fn allocator_mb() -> (f64, f64) {
    (0.0, 0.0)
}
