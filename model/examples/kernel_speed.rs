//! How fast the kernels run against the machine's multiply-add peak and candle's own matmul.
//!
//! `cargo run --release -p storm-model --example kernel_speed [attention|linear|mlp|norm]`; best and median of a few runs,
//! and processor time, which is the one to read on a machine that others use.

mod common;

use std::time::Instant;

use candle_core::{Device, Result, Tensor};
use storm_model::kernels::Isa;
use storm_model::ops::{self, Activation, Linear, Precision};
use storm_model::plain;

use common::{cpu_seconds, fma_peak};

/// Timed runs of each case, after one that is not.
const RUNS: usize = 7;
/// Runs of the peak loop, of which the best counts.
const PEAK_RUNS: usize = 10;

/// Seconds of one run.
#[derive(Clone, Copy)]
struct Seconds {
    best: f64,
    median: f64,
    /// Least processor time, spread over the threads.
    cpu: Option<f64>,
}

fn time<T>(mut f: impl FnMut() -> Result<T>) -> Result<Seconds> {
    f()?;
    let (mut walls, mut cpus) = (Vec::new(), Vec::new());
    for _ in 0..RUNS {
        let (start, cpu) = (Instant::now(), cpu_seconds());
        std::hint::black_box(f()?);
        walls.push(start.elapsed().as_secs_f64());
        cpus.extend(cpu.zip(cpu_seconds()).map(|(before, after)| after - before));
    }
    walls.sort_by(f64::total_cmp);
    let cpu = cpus.into_iter().min_by(f64::total_cmp).map(|s| s / rayon::current_num_threads() as f64);
    Ok(Seconds { best: walls[0], median: walls[RUNS / 2], cpu })
}

/// `peak` in FLOP per second of wall and of processor time.
fn report(name: &str, flop: f64, seconds: Seconds, peak: f64) {
    let rate = |seconds: f64| format!("{:8.2} ms {:6.1} GFLOP/s", seconds * 1e3, flop / seconds / 1e9);
    let cpu = seconds.cpu.map_or(String::new(), |cpu| {
        format!(", processor time {} ({:4.1} % of peak)", rate(cpu), 100.0 * flop / cpu / peak)
    });
    println!("{name:36} best {}, median {}{cpu}", rate(seconds.best), rate(seconds.median));
}

fn main() -> Result<()> {
    let only = std::env::args().nth(1);
    let wanted = |name: &str| only.as_deref().is_none_or(|o| o == name);
    let cpu = Device::Cpu;
    let threads = rayon::current_num_threads();
    let peak = threads as f64 * (0..PEAK_RUNS).map(|_| fma_peak()).fold(0.0, f64::max);
    println!("{:?}, {} threads: {:.1} GFLOP/s peak", Isa::detect(), threads, peak / 1e9);

    if wanted("attention") {
        for (n, heads, d) in [(7220, 12, 64), (1152, 6, 32), (384, 6, 32)] {
            let qkv = Tensor::randn(0f32, 1.0, (1, n, 3 * heads * d), &cpu)?;
            let flop = 4.0 * (n * n * heads * d) as f64;
            report(&format!("attention n={n} heads={heads} d={d}"), flop, time(|| ops::attention(&qkv, heads))?, peak);
            let whole = || ops::attention_at(&qkv, heads, Precision::Int16);
            report("  in whole numbers", flop, time(whole)?, peak);
            report("  in bf16", flop, time(|| ops::attention_at(&qkv, heads, Precision::Bf16))?, peak);
            if n < 2000 {
                report("  plain candle", flop, time(|| plain::attention(&qkv, heads))?, peak);
            }
        }
    }
    if wanted("linear") {
        let sizes = [
            (7220, 768, 2304),
            (7220, 768, 768),
            (7220, 768, 3072),
            (7220, 3072, 768),
            (1152, 192, 576),
            (1152, 192, 768),
            (20, 768, 768),
        ];
        for (m, k, n) in sizes {
            let x = Tensor::randn(0f32, 1.0, (m, k), &cpu)?;
            let layer = Linear::new(Tensor::randn(0f32, 0.03, (n, k), &cpu)?, Some(Tensor::randn(0f32, 0.1, n, &cpu)?));
            let residual = Tensor::randn(0f32, 1.0, (m, n), &cpu)?;
            let flop = 2.0 * (m * k * n) as f64;
            let name = |what: &str| format!("{what} {m} x {k} x {n}");
            report(&name("linear"), flop, time(|| ops::linear(&x, &layer, Activation::None, None))?, peak);
            let whole = layer.at(Precision::Int16);
            report("  in whole numbers", flop, time(|| ops::linear(&x, &whole, Activation::None, None))?, peak);
            let bf16 = layer.at(Precision::Bf16);
            report("  in bf16", flop, time(|| ops::linear(&x, &bf16, Activation::None, None))?, peak);
            report(
                "  + GELU + residual",
                flop,
                time(|| ops::linear(&x, &layer, Activation::Gelu, Some(&residual)))?,
                peak,
            );
            let t = layer.weight.t()?;
            report("  candle matmul alone", flop, time(|| x.matmul(&t))?, peak);
        }
    }
    if wanted("mlp") {
        let x = Tensor::randn(0f32, 1.0, (7220, 768), &cpu)?;
        let one =
            Linear::new(Tensor::randn(0f32, 0.03, (3072, 768), &cpu)?, Some(Tensor::randn(0f32, 0.1, 3072, &cpu)?));
        let two =
            Linear::new(Tensor::randn(0f32, 0.03, (768, 3072), &cpu)?, Some(Tensor::randn(0f32, 0.1, 768, &cpu)?));
        let flop = 4.0 * 7220.0 * 768.0 * 3072.0;
        report(
            "mlp 7220 x 768 x 3072 x 768, GELU",
            flop,
            time(|| ops::mlp(&x, &one, Activation::Gelu, &two, Some(&x)))?,
            peak,
        );
        let calls = || ops::linear(&ops::linear(&x, &one, Activation::Gelu, None)?, &two, Activation::None, Some(&x));
        report("  as two linear layers", flop, time(calls)?, peak);
    }
    if wanted("norm") {
        let x = Tensor::randn(0f32, 1.0, (7220, 768), &cpu)?;
        let w = Tensor::randn(0f32, 1.0, 768, &cpu)?;
        let bytes = (7220 * 768 * 8) as f64;
        for (name, seconds) in [
            ("layer norm 7220 x 768", time(|| ops::layer_norm(&x, Some(&w), Some(&w), 1e-6))?),
            ("  plain candle", time(|| plain::layer_norm(&x, Some(&w), Some(&w), 1e-6))?),
        ] {
            let Seconds { best, median, .. } = seconds;
            println!(
                "{name:36} best {:.2} ms ({:.1} GB/s), median {:.2} ms",
                best * 1e3,
                bytes / best / 1e9,
                median * 1e3
            );
        }
    }
    Ok(())
}
