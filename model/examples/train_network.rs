//! Seconds of forward and backward of the whole network of the `tiny` preset on this machine's processor.
//!
//! `cargo run --release -p storm-model --example train_network [--cameras 1] [--batch 2] [--steps 3]`
//!
//! 4 timesteps; the loss is the mean square of what the network says about every pixel (nothing is drawn). Best wall and
//! processor time of a few steps, as JSON. `CANDLE_NUM_THREADS=2` shows what candle's own thread pool costs.

mod common;

use std::time::Instant;

use candle_core::{Device, Tensor, Var};
use glam::{Affine3A, Vec3};
use storm_model::weights::{Tensors, untrained};
use storm_model::{ClipBatch, ClipOutput, ModelConfig, ModelError, PixelLayout, Storm, ViewInput};
use storm_render::Intrinsics;

use common::cpu_seconds;

/// Timesteps of a window.
const TIMESTEPS: usize = 4;

fn clip(config: &ModelConfig, batch: usize, cameras: usize) -> Result<ClipBatch, ModelError> {
    let (height, width) = (config.image_height, config.image_width);
    let picture: Vec<f32> = (0..3 * height * width).map(|i| (0.37 * i as f32).sin()).collect();
    let view = |time: usize| ViewInput {
        rgb: &picture,
        intrinsics: Intrinsics::from_fov(70.0, width, height),
        world_from_camera: Affine3A::from_translation(0.4 * time as f32 * Vec3::X),
        time_sec: 0.5 * time as f32,
        valid: None,
    };
    let views: Vec<Vec<ViewInput<'_>>> =
        (0..TIMESTEPS).map(|time| (0..cameras).map(|_| view(time)).collect()).collect();
    let one = ClipBatch::from_views(&views, PixelLayout::Hwc, 2.0, &Device::Cpu)?;
    let repeat = |tensor: &Tensor| Tensor::cat(&vec![tensor; batch], 0);
    Ok(ClipBatch {
        image: repeat(&one.image)?,
        intrinsics: repeat(&one.intrinsics)?,
        world_from_camera: repeat(&one.world_from_camera)?,
        time_sec: repeat(&one.time_sec)?,
        valid: None,
        timespan_sec: one.timespan_sec,
        prior: None,
    })
}

fn loss(output: &ClipOutput) -> candle_core::Result<Tensor> {
    let parts = [&output.scales, &output.quats, &output.opacities, &output.colors, &output.velocity_forward];
    let mut loss = output.means.sqr()?.mean_all()?;
    for part in parts {
        loss = (loss + part.sqr()?.mean_all()?)?;
    }
    Ok(loss)
}

fn main() -> Result<(), ModelError> {
    // SAFETY: nothing has started a thread yet.
    unsafe { storm_model::ops::set_up_training() };
    let args: Vec<String> = std::env::args().collect();
    let number = |name: &str, default: usize| {
        let given = args.iter().position(|a| a == name).and_then(|at| args.get(at + 1));
        given.and_then(|v| v.parse().ok()).unwrap_or(default)
    };
    let (cameras, batch, steps) = (number("--cameras", 1), number("--batch", 2), number("--steps", 3));
    let config = ModelConfig::preset("tiny")?;
    let (mut tensors, mut parameters) = (Tensors::new(), 0);
    for (name, tensor) in untrained(&config, 1, &Device::Cpu)? {
        parameters += tensor.elem_count();
        tensors.insert(name, Var::from_tensor(&tensor)?.into_inner());
    }
    let storm = Storm::new(&config, &tensors)?;
    let clip = clip(&config, batch, cameras)?;
    let mut best = [[f64::INFINITY; 2]; 2];
    let mut last = 0f32;
    for step in 0..=steps {
        let seconds = |start: (Instant, Option<f64>)| {
            let busy = start.1.zip(cpu_seconds()).map_or(f64::NAN, |(before, after)| after - before);
            [start.0.elapsed().as_secs_f64(), busy]
        };
        let start = (Instant::now(), cpu_seconds());
        let loss = loss(&storm.forward(&clip)?)?;
        let forward = seconds(start);
        let start = (Instant::now(), cpu_seconds());
        std::hint::black_box(loss.backward()?);
        let backward = seconds(start);
        // The first step finds no memory to use again.
        if step > 0 {
            for (best, new) in best.iter_mut().flatten().zip([forward, backward].concat()) {
                *best = best.min(new);
            }
        }
        last = loss.to_scalar::<f32>()?;
    }
    let [[forward, forward_cpu], [backward, backward_cpu]] = best;
    println!(
        "{{\"preset\": \"tiny\", \"parameters\": {parameters}, \"batch\": {batch}, \"cameras\": {cameras}, \
         \"forward_sec\": {forward:.4}, \"backward_sec\": {backward:.4}, \"forward_cpu_sec\": {forward_cpu:.4}, \
         \"backward_cpu_sec\": {backward_cpu:.4}, \"sec_per_sample\": {:.4}, \"cpu_sec_per_sample\": {:.4}, \
         \"loss\": {last}}}",
        (forward + backward) / batch as f64,
        (forward_cpu + backward_cpu) / batch as f64,
    );
    Ok(())
}
