//! `storm soak`: long procedural drives through the map and the trackers, without a network.

use std::path::PathBuf;

use anyhow::{Context, Result};
use storm_render::world::DriveOptions;

use super::{Outcome, UsageError, progress_bar};
use crate::config::Config;
use crate::soak::{FaultReport, FaultSoak, OracleErrors, SoakOptions, SoakReport, run as soak, run_with_faults};

/// Arguments of `storm soak`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Seed of the drive.
    #[arg(long, default_value_t = 10_000)]
    seed: u64,
    /// Length of the drive, seconds.
    #[arg(long, default_value_t = 60.0)]
    seconds: f64,
    /// Picture size, WIDTHxHEIGHT.
    #[arg(long, default_value = "96x64")]
    size: String,
    /// Sets a second.
    #[arg(long, default_value_t = 10.0)]
    rate: f64,
    /// Cameras.
    #[arg(long, default_value_t = 3)]
    cameras: usize,
    /// Error of depth, standard deviation as a part of depth.
    #[arg(long, default_value_t = 0.0)]
    depth_error: f64,
    /// Error of velocity, standard deviation per component, m/s.
    #[arg(long, default_value_t = 0.0)]
    velocity_error: f64,
    /// Chance that a road user is taken for standing, per picture.
    #[arg(long, default_value_t = 0.0)]
    missed: f64,
    /// Part of the ego motion that is taken for the scene's, standard deviation over windows.
    #[arg(long, default_value_t = 0.0)]
    ego_leak: f64,
    /// Only times and memory: no pictures, surfaces and ghosts.
    #[arg(long)]
    no_quality: bool,
    /// Folder for the map's tiles; a temporary one when not given.
    #[arg(long)]
    map: Option<PathBuf>,
    /// Threads; 0: all cores.
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Through the live pipeline with its network, and with faults of all kinds: cameras that miss, messages late, twice,
    /// out of order and broken, poses that jump, clocks too, a full and a slow disk, panics. Fails when a count does not
    /// add up.
    #[arg(long)]
    faults: bool,
    /// Write everything as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
    /// Configuration file; `map`, `tracks` and `window` count.
    #[arg(long)]
    config: Option<PathBuf>,
    /// Single configuration values, key=value.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// Drives, prints the figures.
pub fn run(args: &Args, progress: bool) -> Result<Outcome> {
    let (width, height) = super::parse_size("--size", &args.size)?;
    let config = Config::from_arguments(args.config.as_deref(), &args.set)?;
    let drive = DriveOptions {
        seed: args.seed,
        seconds: args.seconds,
        width,
        height,
        rate_hz: args.rate,
        cameras: args.cameras,
        // The oracle has no exposure of its own to undo.
        exposure: false,
        noise: 0.0,
        ..DriveOptions::default()
    };
    drive.check().map_err(|e| UsageError(e.to_string()))?;
    let errors = OracleErrors {
        depth: args.depth_error,
        velocity_mps: args.velocity_error,
        missed: args.missed,
        ego_leak: args.ego_leak,
    };
    let temporary = tempfile::tempdir().context("no temporary folder")?;
    let map_dir = args.map.clone().unwrap_or_else(|| temporary.path().to_path_buf());
    if args.faults {
        let drive = DriveOptions { exposure: true, noise: 1.5, ..drive };
        let map_dir = if args.map.is_some() { map_dir } else { map_dir.join("map") };
        return with_faults(args, FaultSoak { drive, config, map_dir, disk: true }, progress);
    }
    let options = SoakOptions { drive, errors, quality: !args.no_quality, map_dir: Some(map_dir), config };
    let bar = progress_bar(progress, (args.seconds * args.rate) as u64, "driving");
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads).build()?;
    let report = pool.install(|| soak(&options, &|done| bar.set_position(done as u64)))?;
    bar.finish_and_clear();
    print(&report);
    if let Some(path) = &args.json {
        let json = serde_json::to_string_pretty(&report)?;
        std::fs::write(path, json + "\n").with_context(|| format!("cannot write {}", path.display()))?;
    }
    Ok(Outcome::Done)
}

fn with_faults(args: &Args, options: FaultSoak, progress: bool) -> Result<Outcome> {
    if args.threads > 0 {
        // Fails only when a pool was set up before in this process; then that one is kept.
        let _ = rayon::ThreadPoolBuilder::new().num_threads(args.threads).build_global();
    }
    let bar = progress_bar(progress, (args.seconds * args.rate) as u64, "driving");
    let report = run_with_faults(&options, &|done| bar.set_position(done as u64))?;
    bar.finish_and_clear();
    print_faults(&report);
    if let Some(path) = &args.json {
        let json = serde_json::to_string_pretty(&report)?;
        std::fs::write(path, json + "\n").with_context(|| format!("cannot write {}", path.display()))?;
    }
    Ok(if report.holds() { Outcome::Done } else { Outcome::Lost })
}

/// Counts as `merged 12, created 3`; those of nothing are left out.
fn counts(of: &impl serde::Serialize) -> String {
    let value = serde_json::to_value(of).unwrap_or_default();
    let items = value.as_object().into_iter().flatten().filter(|(_, n)| n.as_u64() != Some(0));
    let items: Vec<String> = items.map(|(name, n)| format!("{} {n}", name.replace('_', " "))).collect();
    if items.is_empty() { "none".into() } else { items.join(", ") }
}

fn print_faults(r: &FaultReport) {
    say!("seed {}: {:.0} s in {:.0} s; faults {}", r.seed, r.seconds, r.wall_sec, counts(&r.injected));
    say!("{} images sent, {} used, dropped {}", r.images_sent, r.images_used, counts(&r.dropped));
    say!(
        "{} sets, {} steps ({} not computed), {} published, {:.0} MB; {} windows lost to panics, {} clock jumps, {} poses refused",
        r.sets,
        r.steps,
        r.steps_skipped,
        r.published,
        r.published_bytes as f64 / 1e6,
        r.panicked_steps,
        r.epochs,
        r.poses_rejected
    );
    say!(
        "map: {} Gaussians saved, {} tiles put to disk, {} Gaussians given up, {} tiles refused by the disk, {} tiles lost, {} saves failed",
        r.saved_gaussians,
        r.spilled,
        r.evicted,
        r.spill_failed,
        r.tiles_lost,
        r.failed_saves
    );
    say!("quarter  resident MB (mean, most)   steps   latency ms (p50, p99, most)   map Gaussians   on disk MB");
    for (i, q) in r.quarters.iter().enumerate() {
        say!(
            "{:7}  {:12.1} {:11.1}   {:5}   {:8.1} {:8.1} {:8.1}   {:13}   {:10.1}",
            i + 1,
            q.rss_mb[0],
            q.rss_mb[1],
            q.steps,
            q.latency_ms[0],
            q.latency_ms[1],
            q.latency_ms[2],
            q.map_gaussians,
            q.map_disk_mb
        );
    }
    say!("last quarter against the second: resident {:+.1} %", 100.0 * r.memory_growth);
    for c in &r.checks {
        say!("{:9} {}: {} = {}", if c.ok { "holds" } else { "DOES NOT" }, c.what, c.left, c.right);
    }
}

fn print(r: &SoakReport) {
    say!(
        "seed {}: {:.0} s, {:.0} m, {} windows of {} Gaussians, {} threads",
        r.seed,
        r.seconds,
        r.metres,
        r.steps,
        r.gaussians,
        r.threads
    );
    for (name, t) in
        [("fuse", &r.fuse_ms), ("overlap", &r.overlap_ms), ("tracks", &r.track_ms), ("objects", &r.object_ms)]
    {
        say!(
            "{name:8} p50 {:.1} ms, p99 {:.1} ms; processor time p50 {:.1} ms, p99 {:.1} ms",
            t.p50,
            t.p99,
            t.cpu_p50,
            t.cpu_p99
        );
    }
    say!("quarter  step p99 ms   processor p99 ms   resident MB (mean, most)   map Gaussians in memory");
    for (i, q) in r.quarters.iter().enumerate() {
        say!(
            "{:7}  {:11.1}   {:16.1}   {:12.0} {:10.0}   {:23}",
            i + 1,
            q.step_ms.p99,
            q.step_ms.cpu_p99,
            q.rss_mb[0],
            q.rss_mb[1],
            q.map_gaussians[0]
        );
    }
    let g = &r.growth;
    say!(
        "last quarter against the second: resident {:+.1} %, step p99 {:+.1} %, its processor time {:+.1} %",
        100.0 * g.resident,
        100.0 * g.step_p99,
        100.0 * g.step_cpu_p99
    );
    for (i, m) in r.quarters.iter().map(|q| &q.memory_mb).enumerate() {
        say!(
            "memory after quarter {}: resident {:.1} MB, allocated {:.1} (unused {:.1}): tiles {:.1}, their index {:.2}, tracks {:.2}, objects {:.2}, overlap {:.1}, sets {:.1}, measurements {:.2}",
            i + 1,
            m.resident,
            m.allocated,
            m.unused,
            m.tiles,
            m.map_side,
            m.tracks,
            m.objects,
            m.overlap,
            m.sets,
            m.measurements
        );
    }
    say!(
        "map      {} Gaussians, {:.0} MB in memory, {:.0} MB on disk; {}",
        r.map_gaussians,
        r.map_mb,
        r.map_disk_mb,
        counts(&r.map)
    );
    say!("tracks   {} alive at most; {}", r.live_tracks, counts(&r.tracks));
    let show = |x: Option<f64>| x.map_or("-".into(), |x| format!("{x:.3}"));
    if let Some(q) = &r.map_quality {
        say!(
            "static PSNR at {} held-out poses: window {} dB, map {} dB; covered {}",
            q.pictures,
            show(q.window_psnr),
            show(q.map_psnr),
            show(q.covered)
        );
        say!(
            "within 0.2 m up to 20 m: accuracy {} (mean error {} m), completeness {}; left by moving things: {} of the mass, {} of the Gaussians",
            show(q.accuracy),
            show(q.error_m),
            show(q.completeness),
            q.ghost_share.map_or("-".into(), |x| format!("{x:.5}")),
            q.ghost_gaussians.map_or("-".into(), |x| format!("{x:.5}"))
        );
    }
    if let Some(m) = &r.motion_quality {
        for (name, s) in [("as given", &m.before), ("after overlap", &m.after)] {
            say!(
                "{name:14} of standing pixels {:.4} are said to move ({:.3} m/s on average), of moving ones {:.4} (speed off by {:.3} m/s)",
                s.still_moving,
                s.still_error_mps,
                s.moving_kept,
                s.moving_error_mps
            );
        }
    }
    if let Some(o) = &r.object_quality {
        say!(
            "objects  ARI {}, moving pixels covered {}, velocity off by {} m/s, acceleration by {} m/s^2 ({} if said to be 0); {} road users, {:.2} objects and {:.2} switches each",
            show(o.fg_ari),
            show(o.covered),
            show(o.velocity_error_mps),
            show(o.acceleration_error_mps2),
            show(o.no_acceleration_error_mps2),
            o.road_users,
            o.objects_each,
            o.switches_each
        );
    }
    if let Some(t) = &r.track_quality {
        say!(
            "{} trajectories on road users ({} astray, {:.1} each), {:.2} s long on average; {} switched; velocity off by {:.3} m/s",
            t.judged,
            t.astray,
            t.per_mover,
            t.mean_life_sec,
            t.switches,
            t.velocity_error_mps
        );
        for (name, s) in
            [("chained", &t.tracks), ("constant velocity", &t.constant_velocity), ("true flow", &t.oracle_flow)]
        {
            say!("{name:18} APD3D {}, OA {}", show(s.apd3d), show(s.occlusion_accuracy));
        }
    }
}
