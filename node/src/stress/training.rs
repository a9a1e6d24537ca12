//! Learning at the limits: gradients in f32 against f64, no regulariser, a rate that is far too high.

use std::collections::BTreeMap;

use anyhow::Result;
use candle_core::{DType, Device, Var};
use storm_model::train::{Stage, TrainError, TrainOptions, Trainer};
use storm_model::weights::{Tensors, untrained};
use storm_model::{ClipBatch, ModelConfig, Storm};

use super::subject::Size;
use super::{Case, Finding, Sheet, worst};

/// Gradients of a tensor, over the largest of that tensor: sums of some 10,000 terms in f32.
const GRADIENT_LIMIT: f64 = 2e-3;

/// Small enough that the f64 graph fits, with every part of the network there.
fn small() -> Result<ModelConfig> {
    Ok(ModelConfig {
        embed_dim: 48,
        depth: 2,
        num_heads: 3,
        image_height: 16,
        image_width: 24,
        upsampler_widths: vec![24, 16, 8],
        key_hidden: 16,
        basis_hidden: 16,
        num_motion_tokens: 6,
        ..ModelConfig::preset("tiny")?
    })
}

fn options(config: &ModelConfig, rate: f64) -> TrainOptions {
    let mut options = TrainOptions::new(5, 1000, 1, rate);
    options.stage = Stage::Both;
    options.schedule.warmup_steps = 0;
    (options.clips.width, options.clips.height) = (config.image_width, config.image_height);
    (options.clips.cameras, options.clips.targets, options.clips.timesteps) = (2, 1, 2);
    options
}

pub fn run(size: Size, found: &mut dyn FnMut(Case)) -> Result<()> {
    let config = small()?;
    let steps = if size == Size::Full { 60 } else { 3 };
    let weights = untrained(&config, 5, &Device::Cpu)?;
    let data = Trainer::new(&config, &weights, options(&config, 1e-3), &Device::Cpu)?.data();
    let clip = data.batch(0, &config)?.context;

    let mut sheet =
        Sheet { group: "gradients", against: "f64 gradient, over the tensor's largest", limit: GRADIENT_LIMIT, found };
    let painted =
        |value: f64| -> Result<ClipBatch> { Ok(ClipBatch { image: clip.image.affine(0.0, value)?, ..clip.clone() }) };
    let larger = |part: &str, factor: f64| -> Result<Tensors> {
        let mut weights = weights.clone();
        for (_, x) in weights.iter_mut().filter(|(name, _)| name.contains(part)) {
            *x = x.affine(factor, 0.0)?;
        }
        Ok(weights)
    };
    for (name, clip, weights) in [
        ("an ordinary clip", clip.clone(), weights.clone()),
        ("all black", painted(-1.0)?, weights.clone()),
        ("all white", painted(1.0)?, weights.clone()),
        ("queries, keys and values 30 times larger", clip.clone(), larger("attn.qkv.weight", 30.0)?),
        ("Gaussian head 30 times larger", clip.clone(), larger("gs_pred.weight", 30.0)?),
    ] {
        sheet.add(name, gradients(&config, &weights, &clip).unwrap_or_else(|e| super::subject::refused(&e)));
    }

    let mut sheet = Sheet {
        group: "training",
        against: "ends in numbers, or in an error with sound weights",
        limit: 0.0,
        found: sheet.found,
    };
    let still = |o: &mut TrainOptions| (o.pixel.velocity, o.render.velocity) = (0.0, 0.0);
    for (name, rate, off) in [
        ("as usual", 1e-3, false),
        ("without the velocity regulariser", 1e-3, true),
        ("at a rate of 1", 1.0, false),
        ("at a rate of 1 without the velocity regulariser", 1.0, true),
    ] {
        let mut options = options(&config, rate);
        if off {
            still(&mut options);
        }
        sheet.add(format!("{steps} steps {name}"), trained(&config, &weights, options, steps)?);
    }
    Ok(())
}

/// Steps until the end or an error; afterwards the weights have to be numbers.
fn trained(config: &ModelConfig, weights: &Tensors, options: TrainOptions, steps: u64) -> Result<Finding> {
    let mut trainer = Trainer::new(config, weights, options, &Device::Cpu)?;
    for step in 0..steps {
        let clip = trainer.data().batch(step, config)?;
        match trainer.step(&clip) {
            Ok(_) => {}
            Err(TrainError::NonFinite { .. }) => break,
            Err(e) => return Err(e.into()),
        }
    }
    let mut nonfinite = 0;
    for x in trainer.weights(false)?.values() {
        nonfinite += x.flatten_all()?.to_vec1::<f32>()?.iter().filter(|x| !x.is_finite()).count() as u64;
    }
    Ok(Finding { nonfinite, ..Finding::default() })
}

/// Gradients of one sum over all outputs, kernels in f32 against candle's own ops in f64.
fn gradients(config: &ModelConfig, weights: &Tensors, clip: &ClipBatch) -> Result<Finding> {
    let (near, exact) = (gradient(config, weights, clip, DType::F32)?, gradient(config, weights, clip, DType::F64)?);
    let mut finding = Finding::default();
    // Tensors whose true gradient is next to nothing beside all others are judged by the others.
    let largest = |x: &[f64]| x.iter().fold(0.0, |a: f64, b| a.max(b.abs()));
    let all = exact.values().map(|x| largest(x)).fold(0.0, f64::max);
    for (name, truth) in &exact {
        let Some(got) = near.get(name) else {
            finding.worst_error = f64::INFINITY;
            continue;
        };
        finding.nonfinite += got.iter().filter(|x| !x.is_finite()).count() as u64;
        let scale = largest(truth).max(1e-3 * all).max(f64::MIN_POSITIVE);
        let gap = got.iter().zip(truth).map(|(a, b)| (a - b).abs()).fold(0.0, worst);
        finding.worst_error = worst(finding.worst_error, gap / scale);
    }
    Ok(finding)
}

fn gradient(
    config: &ModelConfig,
    weights: &Tensors,
    clip: &ClipBatch,
    dtype: DType,
) -> Result<BTreeMap<String, Vec<f64>>> {
    let mut vars = BTreeMap::new();
    let mut tensors = Tensors::new();
    for (name, x) in weights {
        let var = Var::from_tensor(&x.to_dtype(dtype)?)?;
        tensors.insert(name.clone(), var.as_tensor().clone());
        vars.insert(name.clone(), var);
    }
    let output = Storm::new(config, &tensors)?.forward(&clip.to_dtype(dtype)?)?;
    let mut loss = output.depths.log()?.sqr()?.mean_all()?;
    for x in [&output.colors, &output.opacities, &output.quats, &output.scales, &output.velocity_forward] {
        loss = (loss + x.sqr()?.mean_all()?)?;
    }
    if let Some(affine) = &output.affine {
        loss = (loss + affine.sqr()?.mean_all()?)?;
    }
    let grads = loss.backward()?;
    let mut out = BTreeMap::new();
    for (name, var) in &vars {
        if let Some(g) = grads.get(var.as_tensor()) {
            out.insert(name.clone(), g.to_dtype(DType::F64)?.flatten_all()?.to_vec1::<f64>()?);
        }
    }
    Ok(out)
}
