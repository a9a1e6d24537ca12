//! Seconds of a training step of a small transformer on this machine's processor: forward, backward and AdamW.
//!
//! `cargo run --release -p storm-model --example train_speed [plain] [--batch 8] [--steps 5] [--tokens 384] [--width 192] [--layers 6]`
//!
//! Patches of 8 x 8 pixels with 9 channels, a pre-norm transformer with heads of 32 channels, one linear layer to 12
//! channels for each pixel, squared error. `plain` takes candle's own composed operations instead of the kernels.
//! `tests/python/peer_training.py` is the same step in PyTorch. Wall and processor time are printed as JSON; on a machine
//! that others use, the processor time is the one to compare.

mod common;

use std::time::Instant;

use candle_core::{Device, Result, Tensor, Var};
use candle_nn::{AdamW, Optimizer, ParamsAdamW};
use storm_model::ops::{self, Activation, Linear};
use storm_model::plain;

use common::cpu_seconds;

/// Inputs of a token: 8 x 8 pixels of 9 channels.
const PATCH_INPUTS: usize = 576;
/// Outputs of a token: 8 x 8 pixels of 12 channels.
const PATCH_OUTPUTS: usize = 768;
/// Channels of an attention head.
const HEAD_DIM: usize = 32;
/// Epsilon of the layer norms.
const NORM_EPS: f64 = 1e-6;
/// Spread of the starting weights.
const START_SPREAD: f32 = 0.02;

/// Which operations the network is made of.
#[derive(Clone, Copy)]
struct Ops {
    plain: bool,
}

impl Ops {
    fn linear(self, x: &Tensor, layer: &Linear, residual: Option<&Tensor>) -> Result<Tensor> {
        match self.plain {
            true => plain::linear(x, layer, Activation::None, residual),
            false => ops::linear(x, layer, Activation::None, residual),
        }
    }

    fn norm(self, x: &Tensor, (weight, bias): &(Tensor, Tensor)) -> Result<Tensor> {
        match self.plain {
            true => plain::layer_norm(x, Some(weight), Some(bias), NORM_EPS),
            false => ops::layer_norm(x, Some(weight), Some(bias), NORM_EPS),
        }
    }

    fn attention(self, qkv: &Tensor, heads: usize) -> Result<Tensor> {
        match self.plain {
            true => plain::attention(qkv, heads),
            false => ops::attention(qkv, heads),
        }
    }

    fn mlp(self, x: &Tensor, first: &Linear, second: &Linear, residual: &Tensor) -> Result<Tensor> {
        match self.plain {
            true => {
                let x = plain::linear(x, first, Activation::Gelu, None)?;
                plain::linear(&x, second, Activation::None, Some(residual))
            }
            false => ops::mlp(x, first, Activation::Gelu, second, Some(residual)),
        }
    }
}

struct Block {
    norms: [(Tensor, Tensor); 2],
    qkv: Linear,
    proj: Linear,
    fc1: Linear,
    fc2: Linear,
}

struct Network {
    embed: Linear,
    blocks: Vec<Block>,
    norm: (Tensor, Tensor),
    head: Linear,
    heads: usize,
}

impl Network {
    fn new(width: usize, layers: usize, vars: &mut Vec<Var>) -> Result<Self> {
        let cpu = Device::Cpu;
        let mut keep = |tensor: Tensor| -> Result<Tensor> {
            let var = Var::from_tensor(&tensor)?;
            vars.push(var.clone());
            Ok(var.as_tensor().clone())
        };
        let mut linear = |n: usize, k: usize| -> Result<Linear> {
            let weight = keep(Tensor::randn(0f32, START_SPREAD, (n, k), &cpu)?)?;
            Ok(Linear::new(weight, Some(keep(Tensor::zeros(n, candle_core::DType::F32, &cpu)?)?)))
        };
        let mut embed_and_head = vec![linear(width, PATCH_INPUTS)?, linear(PATCH_OUTPUTS, width)?];
        let mut sets = Vec::new();
        for _ in 0..layers {
            let list = [(3 * width, width), (width, width), (4 * width, width), (width, 4 * width)];
            sets.push(list.map(|(n, k)| linear(n, k)));
        }
        let mut norm = || -> Result<(Tensor, Tensor)> {
            let ones = keep(Tensor::ones(width, candle_core::DType::F32, &cpu)?)?;
            Ok((ones, keep(Tensor::zeros(width, candle_core::DType::F32, &cpu)?)?))
        };
        let mut blocks = Vec::new();
        for [qkv, proj, fc1, fc2] in sets {
            blocks.push(Block { norms: [norm()?, norm()?], qkv: qkv?, proj: proj?, fc1: fc1?, fc2: fc2? });
        }
        let head = embed_and_head.remove(1);
        Ok(Self { embed: embed_and_head.remove(0), blocks, norm: norm()?, head, heads: width / HEAD_DIM })
    }

    fn forward(&self, ops: Ops, patches: &Tensor) -> Result<Tensor> {
        let mut x = ops.linear(patches, &self.embed, None)?;
        for block in &self.blocks {
            let qkv = ops.linear(&ops.norm(&x, &block.norms[0])?, &block.qkv, None)?;
            x = ops.linear(&ops.attention(&qkv, self.heads)?, &block.proj, Some(&x))?;
            x = ops.mlp(&ops.norm(&x, &block.norms[1])?, &block.fc1, &block.fc2, &x)?;
        }
        ops.linear(&ops.norm(&x, &self.norm)?, &self.head, None)
    }
}

/// Best wall and processor seconds of each part of a step.
struct Best([(f64, f64); 3]);

impl Best {
    fn update(&mut self, part: usize, start: (Instant, Option<f64>)) {
        let busy = start.1.zip(cpu_seconds()).map_or(f64::NAN, |(before, after)| after - before);
        let (wall, cpu) = &mut self.0[part];
        *wall = wall.min(start.0.elapsed().as_secs_f64());
        *cpu = cpu.min(busy);
    }
}

fn main() -> Result<()> {
    // SAFETY: nothing has started a thread yet.
    unsafe { ops::set_up_training() };
    let args: Vec<String> = std::env::args().collect();
    let number = |name: &str, default: usize| -> Result<usize> {
        match args.iter().position(|a| a == name) {
            Some(at) => args
                .get(at + 1)
                .and_then(|v| v.parse().ok())
                .map_or_else(|| candle_core::bail!("{name} is followed by no whole number"), Ok),
            None => Ok(default),
        }
    };
    let (batch, steps, tokens) = (number("--batch", 8)?, number("--steps", 5)?, number("--tokens", 384)?);
    let (width, layers) = (number("--width", 192)?, number("--layers", 6)?);
    let ops = Ops { plain: args.iter().any(|a| a == "plain") };

    let mut vars = Vec::new();
    let network = Network::new(width, layers, &mut vars)?;
    let parameters: usize = vars.iter().map(|v| v.elem_count()).sum();
    let mut optimiser = AdamW::new(vars, ParamsAdamW { lr: 1e-3, ..Default::default() })?;
    let x = Tensor::randn(0f32, 1.0, (batch, tokens, PATCH_INPUTS), &Device::Cpu)?;
    let target = Tensor::randn(0f32, 1.0, (batch, tokens, PATCH_OUTPUTS), &Device::Cpu)?;

    let now = || (Instant::now(), cpu_seconds());
    let mut best = Best([(f64::INFINITY, f64::INFINITY); 3]);
    let mut losses = Vec::new();
    for step in 0..=steps {
        let (forward, loss) = (now(), (network.forward(ops, &x)? - &target)?.sqr()?.mean_all()?);
        let mut timed = Best([(f64::INFINITY, f64::INFINITY); 3]);
        timed.update(0, forward);
        let start = now();
        let grads = loss.backward()?;
        timed.update(1, start);
        let start = now();
        optimiser.step(&grads)?;
        timed.update(2, start);
        losses.push(loss.to_scalar::<f32>()?);
        // The first step finds no memory to use again.
        if step > 0 {
            for (best, new) in best.0.iter_mut().zip(timed.0) {
                *best = (best.0.min(new.0), best.1.min(new.1));
            }
        }
    }
    let [forward, backward, adamw] = best.0;
    let per_sample = |part: f64| part / batch as f64;
    println!(
        "{{\"ops\": \"{}\", \"threads\": {}, \"parameters\": {parameters}, \"batch\": {batch}, \"tokens\": {tokens}, \
         \"forward_sec\": {:.4}, \"backward_sec\": {:.4}, \"adamw_sec\": {:.4}, \"forward_cpu_sec\": {:.4}, \
         \"backward_cpu_sec\": {:.4}, \"adamw_cpu_sec\": {:.4}, \"sec_per_sample\": {:.4}, \"cpu_sec_per_sample\": {:.4}, \
         \"samples_per_sec\": {:.2}, \"losses\": {losses:?}}}",
        if ops.plain { "plain" } else { "kernels" },
        rayon::current_num_threads(),
        forward.0,
        backward.0,
        adamw.0,
        forward.1,
        backward.1,
        adamw.1,
        per_sample(forward.0 + backward.0),
        per_sample(forward.1 + backward.1),
        batch as f64 / (forward.0 + backward.0 + adamw.0),
    );
    Ok(())
}
