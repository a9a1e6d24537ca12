//! Every figure of the rasteriser in one run: `cargo run --release -p storm-render --features wgpu --example raster_bench
//! -- [--quick] [--only SECTION] [--json FILE] [--plot FILE.svg] [--peer-opensplat PROGRAM] [--peer-wgpu-viewer PROGRAM]`.
//! Sections: window, million_720p, peers_300k, cost, skips, wgpu.
//!
//! Times are wall clock medians with processor time beside them. The peers are programs of their own (`tests/peers` says
//! how they are built); what is not given is not compared. Without the feature `wgpu` or an adapter, its rows are missing.

mod floor;
mod measure;
mod peers;
mod plot;
mod scenes;

use floor::Floor;
use measure::{Error, Peaks, Times, measure};
use scenes::{HEIGHT, Scene, WIDTH, front, rig};
use serde_json::{Map, Value, json};
use std::ops::Range;
use std::path::PathBuf;
use storm_render::View;
use storm_render::raster::{Channels, CpuRasterizer, PictureGradient, RasterSettings, SplatGradients};

/// What an earlier measurement of the fastest CPU peer gave, for where it cannot be built: OpenSplat's CPU rasteriser, 300,000
/// Gaussians, 240x160, milliseconds per view on two Zen 4 cores.
const QUOTED_PEER_MS: f64 = 462.0;

/// The command line.
#[derive(Default)]
struct Args {
    quick: bool,
    only: Option<PathBuf>,
    json: Option<PathBuf>,
    plot: Option<PathBuf>,
    opensplat: Option<PathBuf>,
    wgpu_viewer: Option<PathBuf>,
}

impl Args {
    fn parse() -> Result<Self, Error> {
        let mut args = Self::default();
        let mut words = std::env::args().skip(1);
        while let Some(word) = words.next() {
            if word == "--quick" {
                args.quick = true;
                continue;
            }
            let slot = match word.as_str() {
                "--only" => &mut args.only,
                "--json" => &mut args.json,
                "--plot" => &mut args.plot,
                "--peer-opensplat" => &mut args.opensplat,
                "--peer-wgpu-viewer" => &mut args.wgpu_viewer,
                _ => {
                    return Err(format!("{word}: unknown; see the head of render/examples/raster_bench/main.rs").into());
                }
            };
            *slot = Some(words.next().ok_or_else(|| format!("{word} needs a file"))?.into());
        }
        Ok(args)
    }

    fn repeats(&self, many: usize) -> usize {
        if self.quick { many.div_ceil(5) } else { many }
    }
}

fn main() -> Result<(), Error> {
    let args = Args::parse()?;
    let peaks = Peaks::measure()?;
    println!(
        "{} threads; measured now: {:.1} GB/s read, {} GFLOP/s",
        rayon::current_num_threads(),
        peaks.bytes_per_ms * 1e-6,
        peaks.flops_per_ms.map_or("-".into(), |rate| format!("{:.0}", rate * 1e-6)),
    );
    let mut report = Map::new();
    report.insert("threads".into(), json!(rayon::current_num_threads()));
    report.insert(
        "peaks".into(),
        json!({"read_gb_per_sec": peaks.bytes_per_ms * 1e-6, "gflops": peaks.flops_per_ms.map(|r| r * 1e-6)}),
    );
    type Section = fn(&Args, &Peaks) -> Result<Value, Error>;
    let sections: [(&str, Section); 6] = [
        ("window", window),
        ("million_720p", million),
        ("peers_300k", against_peers),
        ("cost", cost),
        ("skips", skips),
        ("wgpu", device),
    ];
    for (name, section) in sections {
        if args.only.as_deref().is_none_or(|only| only.as_os_str() == name) {
            report.insert(name.into(), section(&args, &peaks)?);
        }
    }
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string_pretty(&report)? + "\n")?;
    }
    Ok(())
}

fn rasterizer() -> Result<CpuRasterizer, Error> {
    Ok(CpuRasterizer::new(RasterSettings::default())?)
}

/// Three views of one step's Gaussians, forward and with the gradients.
fn window(args: &Args, peaks: &Peaks) -> Result<Value, Error> {
    println!("\n460,800 pixel-aligned Gaussians, three views of {WIDTH}x{HEIGHT}");
    let views = rig(11.0);
    let mut scene = Scene::window();
    let mut rows = Vec::new();
    for channels in [3, 6, 22] {
        scene = scene.with_channels(channels);
        let mut r = rasterizer()?;
        let mut pictures = Vec::new();
        let forward = measure(args.repeats(15), || Ok(r.render_into(&scene.splats(), &views, &mut pictures)?))?;
        let (stats, work) = (r.stats(), r.work());
        let pixels = views.len() * WIDTH * HEIGHT;
        let floor = |backward| Floor::new(peaks, &stats, &work, channels, pixels, backward);
        println!("{channels:2} channels, forward                 {forward}; {}", floor(false));
        let upstream: Vec<PictureGradient> = pictures
            .iter()
            .map(|p| PictureGradient {
                features: scene.noise(p.features.len()),
                alpha: scene.noise(p.alpha.len()),
                depth: scene.noise(p.depth.len()),
            })
            .collect();
        let mut gradients = SplatGradients::default();
        let both = measure(args.repeats(15), || {
            r.render_into(&scene.splats(), &views, &mut pictures)?;
            Ok(r.backward_into(&scene.splats(), &views, &pictures, &upstream, &mut gradients)?)
        })?;
        println!("            forward and backward    {both}; {}", floor(true));
        rows.push(json!({
            "channels": channels,
            "forward": forward.json(),
            "forward_floor": floor(false).json(),
            "forward_backward": both.json(),
            "forward_backward_floor": floor(true).json(),
        }));
        if channels == 3 {
            println!("            {stats:?}\n            {work:?}");
        }
    }
    Ok(json!(rows))
}

fn million(args: &Args, peaks: &Peaks) -> Result<Value, Error> {
    let (width, height) = (1280, 720);
    let scene = Scene::cloud(1_000_000, width, height).with_channels(3);
    let views = [front(width, height)];
    let mut r = rasterizer()?;
    let mut pictures = Vec::new();
    let times = measure(args.repeats(10), || Ok(r.render_into(&scene.splats(), &views, &mut pictures)?))?;
    let floor = Floor::new(peaks, &r.stats(), &r.work(), 3, width * height, false);
    println!("\n1,000,000 Gaussians, 1280x720          {times}; {floor}");
    Ok(json!({"forward": times.json(), "floor": floor.json()}))
}

/// One view of 300,000 Gaussians, beside other programs on the same scene.
fn against_peers(args: &Args, _: &Peaks) -> Result<Value, Error> {
    let scene = Scene::cloud(300_000, WIDTH, HEIGHT).with_channels(3);
    let view = front(WIDTH, HEIGHT);
    let mut r = rasterizer()?;
    let mut pictures = Vec::new();
    let times = measure(args.repeats(15), || Ok(r.render_into(&scene.splats(), &[view], &mut pictures)?))?;
    println!("\n300,000 Gaussians, one view {WIDTH}x{HEIGHT}     {times}");
    let mut rows = Map::new();
    rows.insert("ours".into(), times.json());
    let folder = std::env::temp_dir().join(format!("raster_bench_{}", std::process::id()));
    std::fs::create_dir_all(&folder)?;
    let file = folder.join("scene");
    peers::write_scene(&file, &scene, &view)?;
    let programs = [("OpenSplat CPU", &args.opensplat), ("wgpu-3dgs-viewer", &args.wgpu_viewer)];
    for (name, program) in programs {
        let (Some(program), Some(ours)) = (program, pictures.first()) else { continue };
        let mut row = peers::run(program, &file, args.repeats(5), ours)?;
        let ratio = row["median_ms"].as_f64().unwrap_or(f64::NAN) / times.median_ms();
        row["ratio"] = json!(ratio);
        println!("  {name}, measured in this run: {ratio:.1} times our median; {row}");
        rows.insert(name.into(), row);
    }
    if args.opensplat.is_none() {
        let ratio = QUOTED_PEER_MS / times.median_ms();
        println!("  OpenSplat CPU, not measured here, quoted {QUOTED_PEER_MS} ms of another machine: {ratio:.1} times");
        rows.insert("OpenSplat CPU (quoted)".into(), json!({"median_ms": QUOTED_PEER_MS, "ratio": ratio}));
    }
    std::fs::remove_dir_all(&folder)?;
    Ok(Value::Object(rows))
}

/// Time over the number of Gaussians, all of them visible.
fn cost(args: &Args, _: &Peaks) -> Result<Value, Error> {
    println!("\ncost, all Gaussians visible, 3 channels");
    let counts = [10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000];
    let counts = if args.quick { &counts[..5] } else { &counts[..] };
    let (mut lines, mut rows) = (Vec::new(), Vec::new());
    for (width, height) in [(240, 160), (640, 480)] {
        let mut points = Vec::new();
        for &n in counts {
            let scene = Scene::cloud(n, width, height).with_channels(3);
            let mut r = rasterizer()?;
            let mut pictures = Vec::new();
            let view = [front(width, height)];
            let repeats = args.repeats(if n > 500_000 { 5 } else { 15 });
            let times = measure(repeats, || Ok(r.render_into(&scene.splats(), &view, &mut pictures)?))?;
            let (visible, each_ns) = (r.stats().visible, times.busy_ms() * 1e6 / n as f64);
            println!("  {width}x{height} {n:>9}: {times}; {each_ns:6.1} ns of processor time each, {visible} visible");
            points.push((visible as f64, times.busy_ms()));
            rows.push(json!({
                "width": width, "height": height, "gaussians": n, "visible": visible, "times": times.json(), "busy_each_ns": each_ns,
            }));
        }
        lines.push(plot::Line { name: format!("{width}x{height}"), points });
    }
    for line in &lines {
        println!("  {}: processor time grows as n^{:.2} (1 is linear)", line.name, line.exponent());
    }
    if let Some(path) = &args.plot {
        std::fs::write(
            path,
            plot::svg("CPU, one view, colour, alpha and depth: processor time of all threads", &lines),
        )?;
    }
    Ok(json!({"rows": rows, "exponents": lines.iter().map(plot::Line::exponent).collect::<Vec<_>>()}))
}

/// What is saved where less is asked for, seen, or new.
fn skips(args: &Args, _: &Peaks) -> Result<Value, Error> {
    println!("\nwhat skipping buys");
    let views = rig(11.0);
    let scene = Scene::window().with_channels(22);
    let mut rows = Map::new();
    let mut row = |name: &str, times: Times| {
        println!("  {name:44}{times}");
        rows.insert(name.into(), times.json());
    };
    let mut pictures = Vec::new();
    let mut r = rasterizer()?;
    row(
        "window, 22 channels, rendered afresh",
        measure(args.repeats(15), || Ok(r.render_into(&scene.splats(), &views, &mut pictures)?))?,
    );
    row("window, loading", measure(args.repeats(5), || Ok(r.load(&scene.splats(), None).map(|_| ())?))?);
    let loaded = r.load(&scene.splats(), None)?;
    let mut draw = |views: &[View], channels: Range<usize>| {
        measure(args.repeats(15), || Ok(r.draw_into(loaded, 0.0, &Channels(channels.clone()), views, &mut pictures)?))
    };
    row("window, loaded, 22 channels", draw(&views, 0..22)?);
    row("window, loaded, flow alone (3 channels)", draw(&views, 3..6)?);
    row("window, loaded, depth and alpha alone", draw(&views, 0..0)?);
    row("window, loaded, depth and alpha, one view", draw(&views[1..2], 0..0)?);

    let (scene, view) = Scene::sectors(300_000);
    let scene = scene.with_channels(3);
    let mut r = rasterizer()?;
    row(
        "300k of which 10 % are seen, afresh",
        measure(args.repeats(15), || Ok(r.render_into(&scene.splats(), &[view], &mut pictures)?))?,
    );
    let loaded = r.load(&scene.splats(), None)?;
    let channels = Channels(0..3);
    row(
        "300k of which 10 % are seen, loaded",
        measure(args.repeats(15), || Ok(r.draw_into(loaded, 0.0, &channels, &[view], &mut pictures)?))?,
    );
    let (stats, work) = (r.stats(), r.work());
    println!("    {} visible, {} never read", stats.visible, work.unread);
    Ok(Value::Object(rows))
}

#[cfg(not(feature = "wgpu"))]
fn device(_: &Args, _: &Peaks) -> Result<Value, Error> {
    println!("\nwgpu: not in this build (--features wgpu)");
    Ok(Value::Null)
}

/// The device there is: reported, not judged.
#[cfg(feature = "wgpu")]
fn device(args: &Args, _: &Peaks) -> Result<Value, Error> {
    use storm_render::Renderer;
    use storm_render::gpu::{GpuOptions, GpuRasterizer};
    let mut gpu = match GpuRasterizer::new(RasterSettings::default(), &GpuOptions::default()) {
        Ok(gpu) => gpu,
        Err(error) => {
            println!("\nwgpu: {error}");
            return Ok(Value::Null);
        }
    };
    println!("\nwgpu on {}", gpu.describe());
    let mut rows = Map::new();
    let mut row = |name: &str, times: Times, gpu: &GpuRasterizer| {
        println!("  {name:44}{times}; {:?}", gpu.timings());
        rows.insert(name.into(), times.json());
    };
    let repeats = args.repeats(5);
    for n in [10_000, 100_000, 300_000] {
        let scene = Scene::cloud(n, WIDTH, HEIGHT).with_channels(3);
        let loaded = gpu.load(&scene.splats(), None)?;
        let (channels, view) = (Channels(0..3), [front(WIDTH, HEIGHT)]);
        let times = measure(repeats, || Ok(gpu.draw(loaded, 0.0, &channels, &view).map(|_| ())?))?;
        row(&format!("{n} Gaussians, one view"), times, &gpu);
    }
    let scene = Scene::window().with_channels(22);
    let loaded = gpu.load(&scene.splats(), None)?;
    for (name, channels) in [("22 channels", 0..22), ("flow alone", 3..6), ("depth and alpha alone", 0..0)] {
        let channels = Channels(channels);
        let times = measure(1, || Ok(gpu.draw(loaded, 0.0, &channels, &rig(11.0)[1..2]).map(|_| ())?))?;
        row(&format!("window, one view, {name}"), times, &gpu);
    }
    rows.insert("adapter".into(), json!(gpu.describe()));
    Ok(Value::Object(rows))
}
