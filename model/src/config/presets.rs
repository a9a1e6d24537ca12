//! Named sizes, and the paper's choices over the authors'.

use super::*;
use crate::error::ModelError;

impl Default for ModelConfig {
    fn default() -> Self {
        Self {
            patch_size: 8,
            embed_dim: 768,
            depth: 12,
            num_heads: 12,
            mlp_ratio: 4,
            image_height: 160,
            image_width: 240,
            disable_pos_embed: false,
            num_cams: 3,
            use_sky_token: true,
            use_affine_token: true,
            num_motion_tokens: 16,
            projected_motion_dim: 32,
            tau: 0.5,
            velocity: VelocityKind::One,
            velocity_scale: 1.0,
            velocity_bases: VelocityBases::Learned,
            mask_decoder: MaskDecoder::Authors,
            upsampler_widths: vec![512, 256, 128],
            key_hidden: 256,
            basis_hidden: 256,
            sweep_after_block: 0,
            near: 0.2,
            far: 400.0,
            depth_meaning: DepthMeaning::ZDepth,
            depth_activation: DepthActivation::Sigmoid,
            ray_pixel_offset: RayPixelOffset::DoubleHalf,
            ray_moment_scale: 1.0,
            color_activation: ColorActivation::None,
            color: ColorBase::Absolute,
            scale_offset: -2.3,
            max_scale: 0.5,
            opacity_offset: -2.0,
            sky: SkyKind::Raw512,
            affine: AffineKind::Gain,
            flow_gate_mps: 1.0,
            time_fade_sec: 0.0,
            screen_blur_px2: 0.3,
            gsplat: GsplatConvention::Pinned,
        }
    }
}

impl ModelConfig {
    /// A named size: the authors' `b8 l8 xl8 h8 b16 l16 xl16 h16` (also written `STORM-B/8`), or `tiny` and `base`.
    ///
    /// The authors' sizes come with the authors' choices, so their weights give their numbers. `tiny` (a window of
    /// 3 cameras x 4 timesteps of 64 x 96 pixels in about 10 GFLOP) and `base` use what learns fastest on a small budget. `base` takes
    /// the authors' 160 x 240 pixels with `tiny`'s widths in patches of 16, one motion for 2 x 2 pixels, so that weights of
    /// `tiny` can be grown into it (`weights::grow`).
    pub fn preset(name: &str) -> Result<Self, ModelError> {
        let plain: String = name.to_ascii_lowercase().chars().filter(|c| c.is_ascii_alphanumeric()).collect();
        let plain = plain.strip_prefix("storm").unwrap_or(&plain);
        match plain {
            "tiny" => return Ok(Self::tiny()),
            "base" => return Ok(Self::base()),
            _ => {}
        }
        let unknown = || ModelError::UnknownPreset { name: name.to_owned() };
        let (size, patch) = if let Some(size) = plain.strip_suffix("16") {
            (size, 16)
        } else {
            (plain.strip_suffix('8').ok_or_else(unknown)?, 8)
        };
        let (embed_dim, depth, num_heads) = match size {
            "b" => (768, 12, 12),
            "l" => (1024, 24, 16),
            "xl" => (1152, 28, 16),
            "h" => (1280, 32, 16),
            _ => return Err(unknown()),
        };
        let upsampler_widths = if patch == 16 { vec![512, 256, 128, 128] } else { vec![512, 256, 128] };
        Ok(Self { patch_size: patch, embed_dim, depth, num_heads, upsampler_widths, ..Self::default() })
    }

    fn tiny() -> Self {
        Self {
            embed_dim: 192,
            depth: 4,
            num_heads: 6,
            image_height: 64,
            image_width: 96,
            projected_motion_dim: 16,
            upsampler_widths: vec![96, 64, 32],
            key_hidden: 64,
            basis_hidden: 64,
            // What its weights were trained to be drawn with.
            screen_blur_px2: 0.3,
            ..Self::small_budget()
        }
    }

    fn base() -> Self {
        Self { patch_size: 16, image_height: 160, image_width: 240, screen_blur_px2: 0.1, ..Self::tiny() }
    }

    /// Choices that let a network of a few million parameters start from a useful point.
    fn small_budget() -> Self {
        Self {
            near: 0.5,
            far: 200.0,
            depth_activation: DepthActivation::Log,
            ray_pixel_offset: RayPixelOffset::Half,
            ray_moment_scale: 0.1,
            color: ColorBase::Residual,
            sky: SkyKind::Frequency64,
            affine: AffineKind::MatrixBias,
            flow_gate_mps: 1.0,
            time_fade_sec: 0.2,
            screen_blur_px2: 0.1,
            velocity_scale: 10.0,
            velocity_bases: VelocityBases::Spread,
            ..Self::default()
        }
    }

    /// The same size with every choice as the paper states it (the authors' program departs from it in each).
    pub fn with_paper_choices(self) -> Self {
        Self {
            near: 0.1,
            far: 400.0,
            velocity: VelocityKind::ForwardBackward,
            velocity_bases: VelocityBases::Learned,
            mask_decoder: MaskDecoder::Paper,
            depth_meaning: DepthMeaning::RayDistance,
            depth_activation: DepthActivation::Sigmoid,
            ray_pixel_offset: RayPixelOffset::Half,
            color_activation: ColorActivation::TanhLike,
            color: ColorBase::Absolute,
            scale_offset: -2.3,
            max_scale: 0.5,
            opacity_offset: -2.0,
            sky: SkyKind::Frequency64,
            affine: AffineKind::MatrixBias,
            flow_gate_mps: 0.0,
            time_fade_sec: 0.0,
            screen_blur_px2: 0.3,
            ..self
        }
    }
}
