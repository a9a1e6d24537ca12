//! Counted work of a forward pass: a multiplication and an addition are two operations; what grows with neither tokens nor pixels
//! is left out (motion queries, sky conditioning), as are norms and activations.

use storm_model::Shortcuts;
use storm_model::config::{MaskDecoder, ModelConfig};

/// A window's size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct WindowSize {
    pub timesteps: usize,
    pub cameras: usize,
    pub width: usize,
    pub height: usize,
}

impl WindowSize {
    /// Image tokens of a network with patches of this side.
    pub fn patches(&self, patch: usize) -> usize {
        self.timesteps * self.cameras * (self.width / patch) * (self.height / patch)
    }
}

/// Tokens the blocks work on, and floating-point operations of one pass.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Work {
    pub tokens: usize,
    pub flops: f64,
}

/// Of a network on a window, with these shortcuts (`keep` depends on what is seen and is not counted).
pub(super) fn count(config: &ModelConfig, size: WindowSize, shortcuts: &Shortcuts) -> Work {
    let patches = size.patches(config.patch_size);
    let merged = (f64::from(shortcuts.merge) * patches as f64) as usize;
    let auxiliary = config.auxiliary_tokens();
    let image = patches - merged;
    let tokens = image + auxiliary;
    let (n, d) = (tokens as f64, config.embed_dim as f64);
    let newest = if shortcuts.newest_only { 1.0 / size.timesteps.max(1) as f64 } else { 1.0 };
    let mut flops = 0.0;
    for block in 0..config.depth {
        let last = block + 1 == config.depth;
        let middle = block > 0 && !last;
        let pooled = if middle { (shortcuts.kv_pool * shortcuts.kv_pool) as f64 } else { 1.0 };
        let keys = image as f64 / pooled + auxiliary as f64;
        let queries = if last { image as f64 * newest + auxiliary as f64 } else { n };
        // q, k and v; scores and their sums; the way out; both layers of the MLP.
        flops += 2.0 * d * d * (queries + 2.0 * n);
        flops += 4.0 * queries * keys * d;
        flops += 2.0 * queries * d * d * (1.0 + 2.0 * config.mlp_ratio as f64);
    }
    let (p2, all) = ((config.patch_size * config.patch_size) as f64, patches as f64);
    flops += 2.0 * all * d * p2 * ModelConfig::INPUT_CHANNELS as f64;
    let heads = 2.0 * all * d * p2 * ModelConfig::GAUSSIAN_CHANNELS as f64 + decoder(config, all);
    Work { tokens, flops: flops + newest * heads }
}

/// Upsampler, motion keys and the mixture, for so many patches.
fn decoder(config: &ModelConfig, patches: f64) -> f64 {
    let (mut flops, mut inputs, mut cells) = (0.0, config.embed_dim as f64, patches);
    for &width in &config.upsampler_widths {
        flops += 2.0 * cells * inputs * 4.0 * width as f64;
        (inputs, cells) = (width as f64, 4.0 * cells);
    }
    let (projected, m) = (config.projected_motion_dim as f64, config.num_motion_tokens as f64);
    let keys = match config.mask_decoder {
        MaskDecoder::Paper => inputs * projected,
        MaskDecoder::Authors => config.key_hidden as f64 * (inputs + projected),
    };
    flops + 2.0 * cells * (keys + m * (projected + config.velocity_channels() as f64))
}

#[cfg(test)]
mod tests {
    use super::*;

    const FULL: WindowSize = WindowSize { timesteps: 4, cameras: 3, width: 240, height: 160 };

    #[test]
    fn b8_at_full_size_is_what_was_counted_by_hand() {
        // 3.28 TFLOP: attention 1.92, linears 1.23, heads 0.13.
        let b8 = ModelConfig::preset("b8").unwrap();
        let work = count(&b8, FULL, &Shortcuts::default());
        assert_eq!(work.tokens, 7220);
        assert!((work.flops / 3.28e12 - 1.0).abs() < 0.02, "{:.3} TFLOP", work.flops / 1e12);
    }

    #[test]
    fn every_shortcut_counts_less() {
        let tiny = ModelConfig::preset("tiny").unwrap();
        let size = WindowSize { width: 96, height: 64, ..FULL };
        let exact = count(&tiny, size, &Shortcuts::default());
        assert_eq!(exact.tokens, 1172);
        for less in [
            Shortcuts { kv_pool: 2, ..Shortcuts::default() },
            Shortcuts { merge: 0.25, ..Shortcuts::default() },
            Shortcuts { newest_only: true, ..Shortcuts::default() },
        ] {
            assert!(count(&tiny, size, &less).flops < exact.flops, "{less:?}");
        }
        let half = count(&tiny, size, &Shortcuts { merge: 0.5, ..Shortcuts::default() });
        assert_eq!(half.tokens, 20 + 576);
    }
}
