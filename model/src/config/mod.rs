//! The one description of a network: sizes, and every choice the paper and the authors' program make differently.

mod choices;
mod presets;
mod validate;

pub use choices::{
    AffineKind, ColorActivation, ColorBase, DepthActivation, DepthMeaning, GsplatConvention, MaskDecoder,
    RayPixelOffset, SkyKind, VelocityBases, VelocityKind, spread_bases,
};
use serde::{Deserialize, Serialize};
pub use validate::{MAX_CAMERAS, MAX_TIMESTEPS};

/// Everything needed to build a STORM network and to read its results. Stored as JSON in the weight files we write.
///
/// Defaults are the authors' STORM-B/8. See [`ModelConfig::preset`] and [`ModelConfig::with_paper_choices`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelConfig {
    /// Patch side, pixels; a power of two (the upsampler doubles up to once per factor of two).
    pub patch_size: usize,
    /// Token width.
    pub embed_dim: usize,
    /// Transformer blocks.
    pub depth: usize,
    /// Attention heads; divides `embed_dim`.
    pub num_heads: usize,
    /// Hidden width of a block's MLP over `embed_dim`.
    pub mlp_ratio: usize,
    /// Picture height the position embedding was made for, pixels; other sizes resample it.
    pub image_height: usize,
    /// Picture width the position embedding was made for, pixels.
    pub image_width: usize,
    /// Leave the learned per-patch position embedding out.
    pub disable_pos_embed: bool,

    /// Affine tokens: the most cameras a window may have. A window with fewer uses the first ones.
    pub num_cams: usize,
    /// One token that conditions the sky head.
    pub use_sky_token: bool,
    /// One token per camera for exposure.
    pub use_affine_token: bool,

    /// Motion tokens M; 0 reads velocities straight from the motion keys.
    pub num_motion_tokens: usize,
    /// Width of motion queries and keys.
    pub projected_motion_dim: usize,
    /// Temperature of the motion softmax.
    pub tau: f64,
    /// One velocity, or one for each direction of time (paper eq. 1).
    pub velocity: VelocityKind,
    /// Velocities are the decoder's output times this, m/s.
    pub velocity_scale: f64,
    /// What that output is added to.
    pub velocity_bases: VelocityBases,
    /// Which mask decoder.
    pub mask_decoder: MaskDecoder,
    /// Channels after each doubling of the upsampler; at most one entry per factor of two in `patch_size`. With fewer, motion is
    /// as much coarser than the image: 3 entries with patches of 16 give every 2 x 2 pixels one motion.
    pub upsampler_widths: Vec<usize>,
    /// Hidden width of the motion key MLP (unused by the paper's linear keys).
    pub key_hidden: usize,
    /// Hidden width of the velocity basis MLP.
    pub basis_hidden: usize,

    /// Blocks before a sweep over velocities gives matching evidence to the tokens; 0: none, as in the paper. Less than `depth`.
    pub sweep_after_block: usize,

    /// Nearest depth, metres; also the rasteriser's near plane.
    pub near: f64,
    /// Farthest depth, metres; also the rasteriser's far plane.
    pub far: f64,
    /// What the depth channel measures.
    pub depth_meaning: DepthMeaning,
    /// How the raw depth channel becomes metres.
    pub depth_activation: DepthActivation,
    /// Where in a pixel its ray passes.
    pub ray_pixel_offset: RayPixelOffset,
    /// The moment half of the ray embedding is multiplied by this (1 in the paper); scenes many metres wide want less.
    pub ray_moment_scale: f64,
    /// Activation of the colour channels.
    pub color_activation: ColorActivation,
    /// Whether colours are absolute or added to the input pixel.
    pub color: ColorBase,
    /// Scales are `min(exp(x + scale_offset), max_scale)` metres.
    pub scale_offset: f64,
    /// Largest Gaussian scale, metres. A weight file's own `max_scale` takes precedence.
    pub max_scale: f64,
    /// Opacities are `sigmoid(x + opacity_offset)`.
    pub opacity_offset: f64,

    /// Which sky head.
    pub sky: SkyKind,
    /// What the exposure matrix does.
    pub affine: AffineKind,
    /// Velocities slower than this are drawn as zero in rendered flow, m/s; 0 draws all.
    pub flow_gate_mps: f64,
    /// How fast Gaussians give way, away from their own time, to those nearer to the time that is drawn, seconds: their optical
    /// depths are weighted by `exp(-|time - own time| / this)`, relative to the mean over the window's pictures; 0: all alike, as in the paper.
    pub time_fade_sec: f64,
    /// Variance that rasterising adds to both axes of every splat, square pixels: gsplat's 0.3 for the authors' sizes. A smaller
    /// one draws sharper, by networks that were trained to be drawn so.
    pub screen_blur_px2: f64,
    /// Which gsplat rules rendering follows.
    pub gsplat: GsplatConvention,
}

impl ModelConfig {
    /// Gaussian channels per pixel: depth 1, scale 3, quaternion 4, opacity 1, colour 3.
    pub const GAUSSIAN_CHANNELS: usize = 12;

    /// Input channels: colour 3, ray moment 3, ray direction 3.
    pub const INPUT_CHANNELS: usize = 9;

    /// Patches per column and row of the picture the position embedding was made for.
    pub fn grid(&self) -> (usize, usize) {
        (self.image_height / self.patch_size, self.image_width / self.patch_size)
    }

    /// Tokens in front of the image tokens: sky, one affine token per camera, motion.
    pub fn auxiliary_tokens(&self) -> usize {
        let affine = if self.use_affine_token { self.num_cams } else { 0 };
        usize::from(self.use_sky_token) + affine + self.num_motion_tokens
    }

    /// The size in one line, for people.
    pub fn describe(&self) -> String {
        format!(
            "patch {}, width {}, depth {}, {} heads, {} motion tokens, made for {}x{}",
            self.patch_size,
            self.embed_dim,
            self.depth,
            self.num_heads,
            self.num_motion_tokens,
            self.image_width,
            self.image_height
        )
    }

    /// Channels of a velocity: 3, or 6 with one for each direction of time.
    pub fn velocity_channels(&self) -> usize {
        match self.velocity {
            VelocityKind::One => 3,
            VelocityKind::ForwardBackward => 6,
        }
    }

    /// Side of the block of pixels that share one motion: what the upsampler's doublings leave of a patch.
    pub fn motion_copies(&self) -> usize {
        self.patch_size.checked_shr(self.upsampler_widths.len() as u32).unwrap_or(0).max(1)
    }

    /// Channels of the upsampled image features.
    pub fn feature_channels(&self) -> usize {
        self.upsampler_widths.last().copied().unwrap_or(self.embed_dim)
    }
}

#[cfg(test)]
mod tests;
