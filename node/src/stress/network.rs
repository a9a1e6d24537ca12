//! Weights at their limits, and weights with fewer bits.

use anyhow::Result;
use candle_core::{DType, Device, Tensor};
use storm_model::Stages;
use storm_model::weights::Tensors;

use super::subject::{Subject, apart, nonfinite, refused};
use super::windows::F32;
use super::{Case, Finding, Sheet};

/// Attention logits the brief names: softmax is then all but a choice, and f32 knows a logit of 1e4 to 1e-3.
const LARGE_LOGIT: f64 = 1e4;
const LARGE_LOGIT_LIMIT: f64 = 0.05;
/// Motion weights at a temperature of 1e-3 see every error of a key a thousand times larger.
const COLD_LIMIT: f64 = 0.05;
/// What fewer bits of the weights may cost at the worst pixel. Not what a user would see: see the error figures for that.
const BITS: [(&str, f64); 3] = [("f16", 0.05), ("bf16", 0.3), ("int8, one scale per output", 1.0)];

pub fn run(subject: &Subject, found: &mut dyn FnMut(Case)) -> Result<()> {
    let mut sheet =
        Sheet { group: "weights", against: "f64 network with the same weights, relative", limit: F32, found };
    let both = |tensors: &Tensors| -> Finding {
        let run = || -> Result<Finding> {
            let mut other = Subject::with(subject.size(), &subject.config, tensors)?;
            let (window, cameras) = (other.plain_window()?, other.cameras.clone());
            Ok(other.compare(&window, &cameras))
        };
        run().unwrap_or_else(|e| refused(&e))
    };
    sheet.add("as they ship", both(&subject.tensors));

    for k in [0, subject.config.depth - 1] {
        let factor = (LARGE_LOGIT / largest_logit(subject, k)?).sqrt();
        let name = format!("transformer.blocks.{k}.attn.qkv");
        let width = subject.config.embed_dim;
        let scaled =
            altered(&subject.tensors, &name, |row, _, x| if row < 2 * width { (factor * x as f64) as f32 } else { x })?;
        let title = format!("attention logits of block {k} up to 1e4 ({factor:.0} times queries and keys)");
        sheet.add_within(title, LARGE_LOGIT_LIMIT, both(&scaled));
    }
    for (name, channels, value) in [
        ("depth at its far limit", 0..1, 1e4),
        ("depth at its near limit", 0..1, -1e4),
        ("scales at their cap", 1..4, 1e4),
        ("scales of 0", 1..4, -1e4),
        ("opacity 1", 8..9, 1e4),
        ("opacity 0", 8..9, -1e4),
    ] {
        sheet.add(name, both(&with_channel(&subject.tensors, &channels, value, false)?));
    }
    sheet.add("quaternions of 0", both(&with_channel(&subject.tensors, &(4..8), 0.0, true)?));
    for size in [1e-30, 1e30] {
        sheet.add(format!("quaternions of {size:e}"), both(&with_channel(&subject.tensors, &(4..8), size, true)?));
    }
    let names: Vec<&String> = subject.tensors.keys().filter(|n| n.starts_with("motion_basis_decoder")).collect();
    let last = names.iter().filter_map(|n| n.strip_suffix(".weight")).max().map(str::to_owned);
    if let Some(last) = last {
        let fast = altered(&subject.tensors, &last, |_, _, x| 100.0 * x)?;
        sheet.add("velocity bases 100 times larger", both(&fast));
    }
    let mut cold = subject.config.clone();
    cold.tau = 1e-3;
    let mut other = Subject::with(subject.size(), &cold, &subject.tensors)?;
    let (window, cameras) = (other.plain_window()?, other.cameras.clone());
    sheet.add_within("motion softmax at tau 1e-3", COLD_LIMIT, other.compare(&window, &cameras));
    for value in [f32::NAN, f32::INFINITY] {
        let broken =
            altered(&subject.tensors, "transformer.blocks.0.mlp.fc1", |row, _, x| if row == 3 { value } else { x })?;
        sheet.add_refused(format!("a row of {value} in a layer"), both(&broken));
    }

    let mut plain = Subject::with(subject.size(), &subject.config, &subject.tensors)?;
    let (window, cameras) = (plain.plain_window()?, plain.cameras.clone());
    let (best, _) = plain.step(&window, &cameras)?;
    let mut sheet = Sheet {
        group: "bits of the weights",
        against: "f32 weights, relative, worst pixel",
        limit: 0.0,
        found: sheet.found,
    };
    for (bits, limit) in BITS {
        let mut other = Subject::with(subject.size(), &subject.config, &fewer_bits(&subject.tensors, bits)?)?;
        let finding = other.step(&window, &cameras).map_or_else(
            |e| refused(&e),
            |(scene, views)| Finding {
                worst_error: apart(&scene, &best),
                nonfinite: nonfinite(&scene, &views),
                refused: None,
            },
        );
        sheet.add_within(format!("{bits} weights"), limit, finding);
    }
    Ok(())
}

/// Largest `q k / sqrt(head)` of a block on the subject's window.
fn largest_logit(subject: &Subject, block: usize) -> Result<f64> {
    let name = format!("block_{block}.attn.qkv");
    let mut stages = Stages::only(&[&name]);
    subject.stages(&mut stages)?;
    let Some(qkv) = stages.get(&name) else { anyhow::bail!("the network has no stage {name}") };
    let (b, n, d3) = qkv.dims3()?;
    let (heads, head) = (subject.config.num_heads, d3 / 3 / subject.config.num_heads);
    let parts = qkv.reshape((b, n, 3, heads, head))?.permute((2, 0, 3, 1, 4))?.contiguous()?;
    let logits = parts.get(0)?.contiguous()?.matmul(&parts.get(1)?.transpose(2, 3)?.contiguous()?)?;
    let largest = logits.abs()?.flatten_all()?.max(0)?.to_dtype(DType::F64)?.to_scalar::<f64>()?;
    Ok((largest / (head as f64).sqrt()).max(1e-6))
}

/// A layer's weight and bias, number by number: row, column (0 in the bias), value.
fn altered(tensors: &Tensors, layer: &str, change: impl Fn(usize, usize, f32) -> f32) -> Result<Tensors> {
    let mut tensors = tensors.clone();
    for part in ["weight", "bias"] {
        let name = format!("{layer}.{part}");
        if let Some(x) = tensors.get(&name) {
            let shape = x.dims().to_vec();
            let columns = shape[1..].iter().product::<usize>().max(1);
            let values = x.flatten_all()?.to_vec1::<f32>()?;
            let values: Vec<f32> =
                values.iter().enumerate().map(|(i, &x)| change(i / columns, i % columns, x)).collect();
            tensors.insert(name, Tensor::from_vec(values, shape, &Device::Cpu)?);
        }
    }
    Ok(tensors)
}

/// The Gaussian head with the bias of some of a pixel's channels set (and their weights to 0, so that nothing else is left).
fn with_channel(tensors: &Tensors, channels: &std::ops::Range<usize>, bias: f32, alone: bool) -> Result<Tensors> {
    let count = storm_model::ModelConfig::GAUSSIAN_CHANNELS;
    let mine = |row: usize| channels.contains(&(row % count));
    let mut tensors = tensors.clone();
    for (part, value) in [("weight", alone.then_some(0.0)), ("bias", Some(bias))] {
        let (Some(value), name) = (value, format!("gs_pred.{part}")) else { continue };
        let Some(x) = tensors.get(&name) else { anyhow::bail!("the network has no {name}") };
        let shape = x.dims().to_vec();
        let columns = shape[1..].iter().product::<usize>().max(1);
        let mut values = x.flatten_all()?.to_vec1::<f32>()?;
        values.iter_mut().enumerate().filter(|(i, _)| mine(i / columns)).for_each(|(_, x)| *x = value);
        tensors.insert(name, Tensor::from_vec(values, shape, &Device::Cpu)?);
    }
    Ok(tensors)
}

/// Matrices rounded; vectors stay.
fn fewer_bits(tensors: &Tensors, bits: &str) -> Result<Tensors> {
    let mut out = tensors.clone();
    for x in out.values_mut().filter(|x| x.rank() >= 2) {
        *x = match bits {
            "f16" => x.to_dtype(DType::F16)?.to_dtype(DType::F32)?,
            "bf16" => x.to_dtype(DType::BF16)?.to_dtype(DType::F32)?,
            _ => {
                let rows = x.dim(0)?;
                let flat = x.reshape((rows, ()))?;
                let scale = (flat.abs()?.max_keepdim(1)? / 127.0)?.maximum(f64::from(f32::MIN_POSITIVE))?;
                flat.broadcast_div(&scale)?.round()?.broadcast_mul(&scale)?.reshape(x.dims())?
            }
        };
    }
    Ok(out)
}
