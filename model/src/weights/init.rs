//! Untrained weights: seeded, the same on every machine, and such that an untrained network already shows something.

use candle_core::{Device, Tensor};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::Tensors;
use super::names::{Init, TensorSpec, tensor_specs};
use crate::config::{DepthActivation, ModelConfig};
use crate::error::ModelError;

/// Two standard deviations of the depths an untrained network shows, metres.
const START_DEPTHS_M: [f64; 2] = [5.0, 40.0];

/// Raw value of an opacity of one half, before the offset.
const START_OPACITY: f64 = 0.5;

/// Spread of the raw Gaussian channels other than depth.
const START_SPREAD: f64 = 0.1;

/// All tensors of an untrained network, by name. The same seed gives the same bytes; each tensor depends only on its
/// own name and the seed.
pub fn untrained(config: &ModelConfig, seed: u64, device: &Device) -> Result<Tensors, ModelError> {
    config.validate()?;
    let mut tensors = Tensors::new();
    for spec in tensor_specs(config) {
        let values = values(config, &spec, seed);
        tensors.insert(spec.name, Tensor::from_vec(values, spec.shape, device)?);
    }
    Ok(tensors)
}

/// FNV-1a, 64 bit: a stable hash of a name.
pub(crate) fn fnv1a(name: &str) -> u64 {
    name.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3))
}

fn values(config: &ModelConfig, spec: &TensorSpec, seed: u64) -> Vec<f32> {
    let count: usize = spec.shape.iter().product();
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ fnv1a(&spec.name));
    let channels = ModelConfig::GAUSSIAN_CHANNELS;
    match spec.init {
        Init::Zeros => vec![0.0; count],
        Init::Ones => vec![1.0; count],
        Init::Constant(value) => vec![value as f32; count],
        Init::Normal(std) => (0..count).map(|_| (std * cut_normal(&mut rng)) as f32).collect(),
        Init::GaussianHead => {
            // Tokens leave the last norm with unit variance, so an output's spread is the row's norm.
            let width = config.embed_dim;
            let unit = (width as f64).sqrt().recip();
            let depth_spread = 0.25 * (raw_depth(config, START_DEPTHS_M[1]) - raw_depth(config, START_DEPTHS_M[0]));
            let spread = |i: usize| if (i / width).is_multiple_of(channels) { depth_spread } else { START_SPREAD };
            (0..count).map(|i| (spread(i) * unit * cut_normal(&mut rng)) as f32).collect()
        }
        Init::MiddleDepth => vec![middle_depth(config) as f32; count],
        Init::GaussianHeadBias => {
            let depth = middle_depth(config);
            let opacity = logit(START_OPACITY) - config.opacity_offset;
            let row = |channel| match channel {
                0 => depth,
                4 => 1.0,
                8 => opacity,
                _ => 0.0,
            };
            (0..count).map(|i| row(i % channels) as f32).collect()
        }
        Init::IdentityAffine => (0..count).map(|i| if i % 5 == 0 { 1.0 } else { 0.0 }).collect(),
    }
}

fn middle_depth(config: &ModelConfig) -> f64 {
    0.5 * (raw_depth(config, START_DEPTHS_M[0]) + raw_depth(config, START_DEPTHS_M[1]))
}

/// The raw depth channel that gives `depth_m`, as far as the near and far planes allow it.
fn raw_depth(config: &ModelConfig, depth_m: f64) -> f64 {
    let fraction = match config.depth_activation {
        DepthActivation::Sigmoid => (depth_m - config.near) / (config.far - config.near),
        DepthActivation::Log => (depth_m / config.near).ln() / (config.far / config.near).ln(),
    };
    logit(fraction.clamp(0.005, 0.995))
}

fn logit(p: f64) -> f64 {
    (p / (1.0 - p)).ln()
}

/// Standard normal, drawn again past two standard deviations.
fn cut_normal(rng: &mut ChaCha8Rng) -> f64 {
    loop {
        // Box-Muller; 1 - u is in (0, 1], so the logarithm is finite.
        let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
        let x = radius * (std::f64::consts::TAU * rng.random::<f64>()).cos();
        if x.abs() <= 2.0 {
            return x;
        }
    }
}
