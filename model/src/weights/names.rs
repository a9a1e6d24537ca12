//! Every tensor of a network: its name in the authors' checkpoints, its shape, and how an untrained one starts.

use crate::config::{MaskDecoder, ModelConfig, SkyKind};
use crate::network::sweep;

/// Channels of the frequency-encoded time (128 cosines, 128 sines).
pub(crate) const TIME_CHANNELS: usize = 256;

/// Octaves of the frequency-encoded sky direction (as NeRF encodes view directions).
pub(crate) const SKY_OCTAVES: usize = 4;

/// How an untrained tensor starts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Init {
    /// All zero.
    Zeros,
    /// All one.
    Ones,
    /// All this value.
    Constant(f64),
    /// Normal with this standard deviation, cut at two of them.
    Normal(f64),
    /// Rows of the Gaussian head: spread depths, everything else small.
    GaussianHead,
    /// Offsets of the Gaussian head: depths about 5-40 m, half-open opacity, unit quaternion.
    GaussianHeadBias,
    /// The middle of the depths that an untrained network shows.
    MiddleDepth,
    /// The exposure that changes nothing.
    IdentityAffine,
}

/// One tensor of a network.
#[derive(Debug, Clone, PartialEq)]
pub struct TensorSpec {
    /// Name in the authors' state dict.
    pub name: String,
    /// Shape, outermost first.
    pub shape: Vec<usize>,
    /// How an untrained one starts.
    pub init: Init,
}

/// Standard deviation of tokens and of most layers, as vision transformers start.
const STD: f64 = 0.02;

struct Specs(Vec<TensorSpec>);

impl Specs {
    fn add(&mut self, name: impl Into<String>, shape: &[usize], init: Init) {
        self.0.push(TensorSpec { name: name.into(), shape: shape.to_vec(), init });
    }

    fn linear(&mut self, name: &str, inputs: usize, outputs: usize) {
        self.add(format!("{name}.weight"), &[outputs, inputs], Init::Normal(STD));
        self.add(format!("{name}.bias"), &[outputs], Init::Zeros);
    }

    fn norm(&mut self, name: &str, width: usize) {
        self.add(format!("{name}.weight"), &[width], Init::Ones);
        self.add(format!("{name}.bias"), &[width], Init::Zeros);
    }

    /// The two or three linear layers `fc1`, `fc2`, ... of an MLP. Layers whose width shrinks towards a product of
    /// two outputs (queries and keys) start at `1/sqrt(inputs)`, so that the softmax over them is not flat.
    fn mlp(&mut self, name: &str, widths: &[usize]) {
        for (k, pair) in widths.windows(2).enumerate() {
            let std = (pair[0] as f64).sqrt().recip();
            self.add(format!("{name}.fc{}.weight", k + 1), &[pair[1], pair[0]], Init::Normal(std));
            self.add(format!("{name}.fc{}.bias", k + 1), &[pair[1]], Init::Zeros);
        }
    }
}

/// All tensors of the network a (valid) configuration describes, in the order of the authors' modules.
pub fn tensor_specs(config: &ModelConfig) -> Vec<TensorSpec> {
    let mut specs = Specs(Vec::new());
    tokens(&mut specs, config);
    transformer(&mut specs, config);
    heads(&mut specs, config);
    mask_decoder(&mut specs, config);
    specs.0
}

fn tokens(specs: &mut Specs, config: &ModelConfig) {
    let d = config.embed_dim;
    let (rows, cols) = config.grid();
    if !config.disable_pos_embed {
        specs.add("pos_embed", &[1, rows * cols, d], Init::Normal(STD));
    }
    if config.use_sky_token {
        specs.add("sky_token", &[1, 1, d], Init::Normal(STD));
    }
    if config.use_affine_token {
        specs.add("affine_token", &[1, config.num_cams, d], Init::Normal(STD));
    }
    specs.add("max_scale", &[1], Init::Constant(config.max_scale));
    if config.num_motion_tokens > 0 {
        specs.add("motion_tokens", &[1, config.num_motion_tokens, d], Init::Normal(STD));
    }
    let p = config.patch_size;
    specs.add("patch_embed.proj.weight", &[d, ModelConfig::INPUT_CHANNELS, p, p], Init::Normal(STD));
    specs.add("patch_embed.proj.bias", &[d], Init::Zeros);
    specs.linear("time_embedder.mlp.0", TIME_CHANNELS, d);
    specs.linear("time_embedder.mlp.2", d, d);
}

fn transformer(specs: &mut Specs, config: &ModelConfig) {
    let d = config.embed_dim;
    for k in 0..config.depth {
        let block = format!("transformer.blocks.{k}");
        specs.norm(&format!("{block}.norm1"), d);
        specs.linear(&format!("{block}.attn.qkv"), d, 3 * d);
        specs.linear(&format!("{block}.attn.proj"), d, d);
        specs.norm(&format!("{block}.norm2"), d);
        specs.linear(&format!("{block}.mlp.fc1"), d, config.mlp_ratio * d);
        specs.linear(&format!("{block}.mlp.fc2"), config.mlp_ratio * d, d);
    }
    specs.norm("norm", d);
    if config.sweep_after_block > 0 {
        specs.norm("sweep.norm", d);
        specs.add("sweep.depth.weight", &[sweep::CELLS * sweep::CELLS, d], Init::Normal(STD));
        specs.add("sweep.depth.bias", &[sweep::CELLS * sweep::CELLS], Init::MiddleDepth);
        specs.add("sweep.inject.weight", &[d, sweep::EVIDENCE], Init::Zeros);
    }
}

/// Inputs and hidden width of the sky head's first layer.
pub(crate) fn sky_widths(kind: SkyKind) -> (usize, usize) {
    match kind {
        SkyKind::Raw512 => (3, 512),
        SkyKind::Frequency64 => (6 * SKY_OCTAVES, 64),
    }
}

fn heads(specs: &mut Specs, config: &ModelConfig) {
    let d = config.embed_dim;
    if config.use_sky_token {
        let (inputs, hidden) = sky_widths(config.sky);
        let std = (inputs as f64).sqrt().recip();
        specs.add("sky_head.linear.weight", &[hidden, inputs], Init::Normal(std));
        specs.add("sky_head.linear.bias", &[hidden], Init::Zeros);
        specs.linear("sky_head.adaLN_modulation.1", hidden, 2 * hidden);
        specs.linear("sky_head.condition_mapping", d, hidden);
        specs.linear("sky_head.output", hidden, 3);
    }
    if config.use_affine_token {
        specs.add("affine_linear.weight", &[12, d], Init::Zeros);
        specs.add("affine_linear.bias", &[12], Init::IdentityAffine);
    }
    let outputs = config.patch_size * config.patch_size * ModelConfig::GAUSSIAN_CHANNELS;
    specs.add("gs_pred.weight", &[outputs, d], Init::GaussianHead);
    specs.add("gs_pred.bias", &[outputs], Init::GaussianHeadBias);
}

/// True where the upsampler normalises after doubling number `stage`.
pub(crate) fn upsampler_norm(config: &ModelConfig, stage: usize) -> bool {
    config.mask_decoder == MaskDecoder::Authors || stage + 1 < config.upsampler_widths.len()
}

fn mask_decoder(specs: &mut Specs, config: &ModelConfig) {
    let (d, projected, m) = (config.embed_dim, config.projected_motion_dim, config.num_motion_tokens);
    let paper = config.mask_decoder == MaskDecoder::Paper;
    let mut inputs = d;
    for (stage, &width) in config.upsampler_widths.iter().enumerate() {
        let std = (inputs as f64).sqrt().recip();
        let conv = format!("output_upscaling.{}", 3 * stage);
        specs.add(format!("{conv}.weight"), &[inputs, width, 2, 2], Init::Normal(std));
        specs.add(format!("{conv}.bias"), &[width], Init::Zeros);
        if upsampler_norm(config, stage) {
            specs.norm(&format!("output_upscaling.{}", 3 * stage + 1), width);
        }
        inputs = width;
    }
    if paper {
        specs.mlp("motion_key_head", &[inputs, projected]);
    } else {
        specs.mlp("motion_key_head", &[inputs, config.key_hidden, projected]);
    }
    for k in 0..m {
        let name = format!("motion_query_heads.{k}");
        if paper {
            specs.mlp(&name, &[d, d, d, projected]);
        } else {
            specs.mlp(&name, &[d, d, projected]);
        }
    }
    if paper && m > 0 {
        (0..m).for_each(|k| basis_decoder(specs, config, &format!("motion_basis_decoders.{k}"), d));
    } else {
        basis_decoder(specs, config, "motion_basis_decoder", if m > 0 { d } else { projected });
    }
}

/// Velocities start below a metre per second whatever `velocity_scale` is, so that an untrained scene hardly moves.
fn basis_decoder(specs: &mut Specs, config: &ModelConfig, name: &str, inputs: usize) {
    let (hidden, velocity) = (config.basis_hidden, config.velocity_channels());
    specs.mlp(name, &[inputs, hidden]);
    let std = (hidden as f64).sqrt().recip() / config.velocity_scale;
    specs.add(format!("{name}.fc2.weight"), &[velocity, hidden], Init::Normal(std));
    specs.add(format!("{name}.fc2.bias"), &[velocity], Init::Zeros);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parameters(name: &str) -> usize {
        let specs = tensor_specs(&ModelConfig::preset(name).unwrap());
        specs.iter().map(|s| s.shape.iter().product::<usize>()).sum()
    }

    #[test]
    fn b8_has_the_published_number_of_parameters() {
        // 100.60 M in the paper; the authors' program counts this, the frozen max_scale included.
        assert_eq!(parameters("b8"), 100_598_707);
    }

    #[test]
    fn names_are_unique_and_sizes_are_positive() {
        for name in ["tiny", "base", "b8", "xl16"] {
            for config in [ModelConfig::preset(name).unwrap(), ModelConfig::preset(name).unwrap().with_paper_choices()]
            {
                let specs = tensor_specs(&config);
                let names: std::collections::BTreeSet<_> = specs.iter().map(|s| s.name.as_str()).collect();
                assert_eq!(names.len(), specs.len());
                assert!(specs.iter().all(|s| s.shape.iter().all(|&n| n > 0)));
            }
        }
    }
}
