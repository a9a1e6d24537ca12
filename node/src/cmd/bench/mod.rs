//! `storm bench`: run time against error, on this machine: every setting of the network, skipping over drives that stand, cruise and
//! are busy, the other methods, and cost against size.

mod drives;
mod flops;
mod network;
mod pairs;
mod peers;
mod picture;
mod repeat;
mod report;
mod settings;
mod sizes;

use std::path::{Path, PathBuf};

use anyhow::Result;
use indicatif::ProgressBar;
use serde_json::json;

use super::{Outcome, UsageError, progress_bar};
use crate::config::Config;
use crate::engine::ModelSource;
use crate::engine::evaluate::bag::{BagClips, Part};
use crate::engine::evaluate::{Clip, Method};
use crate::output::atomic::write_bytes;

pub(super) use network::time_network;
use network::{Data, References, Subject};
use report::{Baseline, DriveSetting, Report};
use settings::Named;

/// Networks whose pictures are larger are measured on fewer clips.
const CLIPS_OF_UNTRAINED: usize = 2;
/// The largest network.
const LARGEST: &str = "b8";
/// Names of the files under `--out`.
const DOCUMENT: &str = "bench.md";
const PICTURE: &str = "bench.svg";

/// Arguments of `storm bench`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Only the smallest network at its first settings, and short drives.
    #[arg(long)]
    quick: bool,
    /// Write the table and the picture (bench.md, bench.svg) into this folder.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Write the figures as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
    /// Networks, comma-separated; b8 takes minutes a row, and is measured at few settings [default: tiny,base; with --quick: tiny].
    #[arg(long, value_delimiter = ',')]
    models: Vec<String>,
    /// Another row, `NAME: KEY=VALUE, KEY=VALUE` with any configuration keys; may be given again.
    #[arg(long = "setting", value_parser = Named::parse)]
    more: Vec<Named>,
    /// Only rows whose name contains this.
    #[arg(long)]
    only: Option<String>,
    /// Timed runs of each setting after one warm-up, and at least one of every clip (the largest network: one of every clip).
    #[arg(long, default_value_t = 7)]
    runs: usize,
    /// Held-out clips each setting is scored on.
    #[arg(long, default_value_t = 4)]
    clips: usize,
    /// Recorded bag that each setting's pictures are scored on too.
    #[arg(long)]
    bag: Option<PathBuf>,
    /// Clips cut from it.
    #[arg(long, default_value_t = 3, requires = "bag")]
    bag_clips: usize,
    /// Other methods on the same clips, by the names of `storm eval`; gs3d and nsfp take minutes a clip. `none`: none.
    #[arg(long, default_value = "static,per_frame,per_frame_nearest,nearest_context", value_parser = parse_methods)]
    methods: std::vec::Vec<Method>,
    /// Leave the drives with skipping out.
    #[arg(long)]
    no_drives: bool,
    /// Cost against tokens (400 to 10,000), cameras and timesteps as well.
    #[arg(long)]
    sizes: bool,
    /// With 32,000 tokens too.
    #[arg(long, requires = "sizes")]
    largest: bool,
    /// A Python with PyTorch: times tests/python/peer_network.py at B/8's size in the same run, in f32 and bf16, eager and compiled.
    #[arg(long)]
    peer_python: Option<PathBuf>,
    /// JSON of an earlier bench: says how many of the ratios both have are within 10 % of each other.
    #[arg(long)]
    against: Option<PathBuf>,
}

/// An argument as a document shows it: of a path from the root, which is this machine's own affair, the last part.
fn named(argument: String) -> String {
    let path = Path::new(&argument);
    let last = path.file_name().filter(|_| path.is_absolute());
    last.map_or_else(|| argument.clone(), |name| name.to_string_lossy().into_owned())
}

fn parse_methods(text: &str) -> Result<Vec<Method>, String> {
    if text == "none" { Ok(Vec::new()) } else { Method::parse_list(text) }
}

/// Measures and prints.
pub fn run(args: &Args, progress: bool) -> Result<Outcome> {
    let models: Vec<String> = match (args.models.is_empty(), args.quick) {
        (false, _) => args.models.clone(),
        (true, true) => vec!["tiny".into()],
        (true, false) => ["tiny", "base"].map(String::from).to_vec(),
    };
    let rows = |all: Vec<Named>, quick: usize| -> Vec<Named> {
        let first = if args.quick { quick } else { all.len() };
        let wanted = |row: &Named| args.only.as_ref().is_none_or(|part| row.name.contains(part.as_str()));
        all.into_iter().take(first).chain(args.more.iter().cloned()).filter(wanted).collect()
    };
    let (network_rows, drive_rows) = (rows(settings::network(), 3), rows(settings::drives(), 1));
    let drive_rows = if args.no_drives { Vec::new() } else { drive_rows };
    // Every row is tried before the first is measured.
    for row in network_rows.iter().chain(&drive_rows) {
        for model in &models {
            row.config(model)?;
        }
    }
    let earlier = args.against.as_deref().map(read_json).transpose()?;
    let sizes = if args.sizes { sizes::plan(args.largest) } else { Vec::new() };
    let steps = models.len() * network_rows.len() + 10 * drive_rows.len() + sizes.len() + args.clips + 1;
    let bar = progress_bar(progress, steps as u64, "measuring");
    let mut report = Report {
        machine: machine(),
        command: std::iter::once("storm".to_string())
            .chain(std::env::args().skip(1).map(named))
            .collect::<Vec<_>>()
            .join(" "),
        load: load(),
        ..Report::default()
    };
    say!("{}", report.machine["cpu"].as_str().unwrap_or("unknown processor"));
    let (world_fps, world) = peers::time_world()?;
    report.world = world;
    say!("drive: {world_fps:.0} images of 240x160 with ground truth per second");
    bar.inc(1);
    for model in &models {
        let base = Named { name: String::new(), set: Vec::new(), large: true }.config(model)?;
        let trained = matches!(ModelSource::open(&base.model)?, ModelSource::Loaded { .. });
        let bag = match &args.bag {
            Some(path) if trained => bag_clips(path, &base, args.bag_clips)?,
            _ => Vec::new(),
        };
        let clips = match (trained, model == LARGEST) {
            (true, _) => args.clips,
            (false, true) => 1,
            (false, false) => args.clips.min(CLIPS_OF_UNTRAINED),
        };
        let data = Data::held_out(&base, clips, bag)?;
        let mut references = References::new();
        // The peer before and after the rows of its size, so that a slow while of the machine is in both.
        let peer = args.peer_python.as_ref().filter(|_| model == LARGEST);
        time_peers(peer, &mut report, &bar)?;
        for row in network_rows.iter().filter(|row| row.large || model != LARGEST) {
            bar.set_message(format!("{model}, {}", row.name));
            let config = row.config(model)?;
            let beside = (config != base).then_some(&base);
            let subject = Subject { model, name: &row.name, set: &row.set, config: &config, beside };
            let s = network::measure(&subject, &data, &mut references, args.runs)?;
            let text = |x: Option<f64>| x.map_or("-".to_string(), |x| format!("{x:.3}"));
            bar.suspend(|| {
                say!(
                    "{:6} {:36} {:>6} tokens {:>8.1} GFLOP: step p50 {:>8.1} ms, p99 {:>8.1} ms, {}network {:>8.1} ms, three views {:>6.1} ms, peak {:.0} MB; against {}: PSNR {} dB, EPE3D {} m/s",
                    s.model,
                    s.setting,
                    s.tokens,
                    s.gflop,
                    s.step_ms.p50,
                    s.step_ms.p99,
                    s.times_less.map_or(String::new(), |less| format!("{less:.2} times less, ")),
                    s.stages_ms["network"].p50,
                    s.stages_ms["render"].p50,
                    s.peak_rss_mb.unwrap_or(0.0),
                    s.against,
                    text(s.figures.psnr),
                    text(s.figures.epe3d),
                );
            });
            report.settings.push(s);
            bar.inc(1);
        }
        time_peers(peer, &mut report, &bar)?;
        if trained {
            bar.set_message("other methods");
            let figures = peers::baselines(&data, &args.methods, &mut || bar.inc(1))?;
            report.baselines = figures.into_iter().map(|(method, figures)| Baseline { method, figures }).collect();
        }
    }
    for row in &drive_rows {
        bar.set_message(format!("drives, {}", row.name));
        let from = bar.position();
        let share = if args.quick { 0.4 } else { 1.0 };
        let drives =
            drives::run(&row.config("tiny")?, share, &mut |part| bar.set_position(from + (10.0 * part) as u64))?;
        bar.suspend(|| {
            for r in &drives.rows {
                say!(
                    "{:10} {:44} {:>4} steps, {:>4} still, {:>4} predicted, {:>4} approximate: {:>7.1} ms a step, in full {:>7.1} ms: {:.2} times less",
                    r.drive, row.name, r.steps, r.still, r.predicted, r.approximate, r.ms, r.full_ms, r.ratio
                );
            }
        });
        report.drives.push(DriveSetting { setting: row.name.clone(), set: row.set.clone(), drives });
    }
    for (curve, size) in sizes {
        bar.set_message(format!("cost against {curve}"));
        let p = sizes::measure(curve, size)?;
        bar.suspend(|| {
            say!(
                "{curve}: {:>6} tokens {:>9.2} GFLOP {:>9.1} ms, {:.2} times the usual size's",
                p.tokens,
                p.gflop,
                p.network_ms,
                p.times_usual
            );
        });
        report.sizes.push(p);
        bar.inc(1);
    }
    let peer = args.peer_python.as_ref().filter(|_| report.peers.is_empty());
    time_peers(peer, &mut report, &bar)?;
    bar.finish_and_clear();
    report.compare_peers();
    for peer in &report.peers {
        let Some(seconds) = peer.median_s else { continue };
        say!("PyTorch, {}, at B/8's size: {seconds:.1} s", peer.name);
        if let Some(ratio) = peer.times_less {
            say!("ours in f32 {:.1} s: {ratio:.2} of it", ratio * seconds);
        }
    }
    if let Some(earlier) = &earlier {
        let repeat = repeat::compare(earlier, &serde_json::to_value(&report)?);
        say!("{} of {} ratios are within 10 % of the earlier bench's", repeat.near, repeat.compared);
        for (name, before, now) in &repeat.far {
            say!("  {name}: {before:.2} then, {now:.2} now");
        }
        report.repeat = Some(repeat);
    }
    write(args, &report)?;
    Ok(Outcome::Done)
}

fn time_peers(python: Option<&PathBuf>, report: &mut Report, bar: &ProgressBar) -> Result<()> {
    if let Some(python) = python {
        bar.set_message("PyTorch");
        peers::time_peers(python, &mut report.peers)?;
    }
    Ok(())
}

fn read_json(path: &Path) -> Result<serde_json::Value> {
    let read = std::fs::read(path).map_err(anyhow::Error::from).and_then(|text| Ok(serde_json::from_slice(&text)?));
    read.map_err(|e| UsageError(format!("{} is no bench's JSON: {e}", path.display())).into())
}

fn write(args: &Args, report: &Report) -> Result<()> {
    if let Some(dir) = &args.out {
        std::fs::create_dir_all(dir)
            .map_err(|e| UsageError(format!("cannot make the folder {}: {e}", dir.display())))?;
        write_bytes(&dir.join(DOCUMENT), report.markdown(PICTURE).as_bytes())?;
        write_bytes(&dir.join(PICTURE), report.picture().as_bytes())?;
    }
    if let Some(path) = &args.json {
        write_bytes(path, (serde_json::to_string_pretty(report)? + "\n").as_bytes())?;
    }
    Ok(())
}

fn bag_clips(path: &Path, config: &Config, clips: usize) -> Result<Vec<Clip>> {
    let source = ModelSource::open(&config.model)?;
    let (size, prior_sec) = (source.picture_size(&config.model)?, source.prior_sec(&config.model));
    let part = Part { from_sec: 0.0, to_sec: f64::INFINITY, clips: clips.max(1) };
    let mut all = Vec::new();
    BagClips::open(path, config, size, prior_sec, &part)?.each(|clip| {
        all.push(clip);
        Ok(())
    })?;
    Ok(all)
}

fn machine() -> serde_json::Value {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let field = |name: &str| {
        let line = info.lines().find(|l| l.starts_with(name));
        line.and_then(|l| l.split_once(':')).map(|(_, v)| v.trim().to_string()).unwrap_or_default()
    };
    let flags = field("flags");
    let has = |f: &&str| flags.split(' ').any(|x| x == *f);
    let simd: Vec<&str> =
        ["avx2", "fma", "avx512f", "avx512_bf16", "avx512_vnni", "amx_bf16"].into_iter().filter(has).collect();
    let kernels = format!("{:?}", storm_model::kernels::Isa::detect());
    json!({"cpu": field("model name"), "threads": rayon::current_num_threads(), "simd": simd, "kernels": kernels, "version": env!("CARGO_PKG_VERSION")})
}

/// Mean number of running programs over the last minute.
fn load() -> Option<f64> {
    std::fs::read_to_string("/proc/loadavg").ok()?.split(' ').next()?.parse().ok()
}
