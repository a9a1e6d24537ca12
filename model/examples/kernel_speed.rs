//! How fast the kernels run against the machine's multiply-add peak and candle's own matmul.
//!
//! `cargo run --release -p storm-model --example kernel_speed [attention|linear|norm]`; best and median of a few runs.

use std::time::Instant;

use candle_core::{Device, Result, Tensor};
use storm_model::kernels::{Isa, peak};
use storm_model::ops::{self, Activation, Linear};
use storm_model::plain;

/// Timed runs of each case, after one that is not.
const RUNS: usize = 5;
/// Multiply-add steps of the peak loop: about 0.1 s.
const PEAK_STEPS: usize = 40_000_000;

/// Best and median seconds.
fn time<T>(mut f: impl FnMut() -> Result<T>) -> Result<(f64, f64)> {
    f()?;
    let mut seconds = Vec::new();
    for _ in 0..RUNS {
        let start = Instant::now();
        std::hint::black_box(f()?);
        seconds.push(start.elapsed().as_secs_f64());
    }
    seconds.sort_by(f64::total_cmp);
    Ok((seconds[0], seconds[RUNS / 2]))
}

fn report(name: &str, flop: f64, (best, median): (f64, f64), peak: f64) {
    println!(
        "{name:44} best {:8.2} ms {:6.1} GFLOP/s ({:4.1} % of peak), median {:8.2} ms {:6.1} GFLOP/s",
        best * 1e3,
        flop / best / 1e9,
        100.0 * flop / best / peak,
        median * 1e3,
        flop / median / 1e9
    );
}

fn main() -> Result<()> {
    let only = std::env::args().nth(1);
    let wanted = |name: &str| only.as_deref().is_none_or(|o| o == name);
    let cpu = Device::Cpu;
    let peak = (0..3).map(|_| peak::fma_flops(Isa::detect(), PEAK_STEPS)).fold(0.0, f64::max);
    println!("{:?}, {} threads: {:.1} GFLOP/s peak", Isa::detect(), rayon::current_num_threads(), peak / 1e9);

    if wanted("attention") {
        for (n, heads, d) in [(7220, 12, 64), (1152, 6, 32), (384, 6, 32)] {
            let qkv = Tensor::randn(0f32, 1.0, (1, n, 3 * heads * d), &cpu)?;
            let flop = 4.0 * (n * n * heads * d) as f64;
            report(&format!("attention n={n} heads={heads} d={d}"), flop, time(|| ops::attention(&qkv, heads))?, peak);
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
    if wanted("norm") {
        let x = Tensor::randn(0f32, 1.0, (7220, 768), &cpu)?;
        let w = Tensor::randn(0f32, 1.0, 768, &cpu)?;
        let bytes = (7220 * 768 * 8) as f64;
        for (name, (best, median)) in [
            ("layer norm 7220 x 768", time(|| ops::layer_norm(&x, Some(&w), Some(&w), 1e-6))?),
            ("  plain candle", time(|| plain::layer_norm(&x, Some(&w), Some(&w), 1e-6))?),
        ] {
            println!(
                "{name:44} best {:8.2} ms ({:.1} GB/s), median {:8.2} ms",
                best * 1e3,
                bytes / best / 1e9,
                median * 1e3
            );
        }
    }
    Ok(())
}
