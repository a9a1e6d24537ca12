//! The live pipeline on a drive where everything goes wrong that goes wrong on a vehicle: messages are made of the drive,
//! spoiled by a seeded plan, and pushed into [`Live`]; a sink makes all that a node would publish and counts it. Nothing is
//! replaced: decoding, synchronisation, poses, windows, the network, the map and the trajectories are those of `storm node`.

mod disk;
mod driver;
mod plan;
mod report;
mod sink;

pub use driver::{FaultSoak, run_with_faults};
pub use report::{Check, FaultReport, LiveQuarter};

#[cfg(test)]
mod tests {
    use storm_render::world::DriveOptions;

    use super::*;
    use crate::config::Config;

    #[test]
    fn a_minute_of_faults_adds_up() {
        let dir = tempfile::tempdir().unwrap();
        let drive =
            DriveOptions { seed: 5, seconds: 60.0, width: 24, height: 16, cameras: 2, ..DriveOptions::default() };
        let mut config = Config::default();
        config.map.max_gaussians = 2000;
        config.live.queue = 4;
        // Limits of the process would reach into other tests.
        let options = FaultSoak { drive, config, map_dir: dir.path().join("map"), disk: false };
        let report = run_with_faults(&options, &|_| ()).unwrap();
        let failed: Vec<&Check> = report.checks.iter().filter(|c| !c.ok).collect();
        assert!(failed.is_empty(), "{failed:?}");
        assert!(report.steps > 100 && report.published == report.steps, "{report:?}");
        assert_eq!(report.nonfinite, 0);
        for kind in
            ["missing", "late", "duplicate", "reordered", "corrupt", "poison", "pose_nan", "clock", "panic", "burst"]
        {
            assert!(
                report.injected.get(kind).is_some_and(|n| *n > 0),
                "{kind} was never injected: {:?}",
                report.injected
            );
        }
        for reason in ["late", "duplicate", "incomplete", "decode", "overflow", "panic"] {
            assert!(report.dropped.get(reason).is_some_and(|n| *n > 0), "{reason}: {:?}", report.dropped);
        }
        assert!(report.panicked_steps > 0 && report.spilled + report.evicted > 0, "{report:?}");
    }
}
