//! Networks with parts left out: the settings of the paper's ablations and of its per-frame baseline.

use storm_model::ModelConfig;
use storm_model::train::TrainOptions;
use storm_model::weights::Tensors;

/// A velocity scale at which whatever the decoder says stands still: nanometres per second.
const STILL_MPS: f64 = 1e-9;

/// Target pictures of the per-frame setting lie within one stride: a frame stands for itself until the next one.
const PER_FRAME_TIMESTEPS: usize = 1;

/// What a new network has.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct VariantArgs {
    /// Motion tokens of a new network; 0: velocities straight from the pixels' features.
    #[arg(long, conflicts_with_all = ["weights", "resume"])]
    pub motion_tokens: Option<usize>,
    /// Context timesteps of the training clips, 1 to 10 [default: 4].
    #[arg(long, conflicts_with = "resume")]
    pub timesteps: Option<usize>,
    /// A new network without sky token and sky head.
    #[arg(long, conflicts_with_all = ["weights", "resume"])]
    pub no_sky_token: bool,
    /// A new network without affine tokens: no exposure per camera.
    #[arg(long, conflicts_with_all = ["weights", "resume"])]
    pub no_affine_token: bool,
    /// Each timestep alone and nothing moves (the GS-LRM setting): one timestep, no motion tokens, velocity 0, targets
    /// within a stride.
    #[arg(long, conflicts_with_all = ["weights", "resume", "motion_tokens", "timesteps"])]
    pub per_frame: bool,
}

impl VariantArgs {
    /// The network's side.
    pub fn configure(&self, config: ModelConfig) -> ModelConfig {
        let mut config = config;
        if let Some(m) = self.motion_tokens {
            config.num_motion_tokens = m;
        }
        if self.no_sky_token {
            config.use_sky_token = false;
        }
        if self.no_affine_token {
            config.use_affine_token = false;
        }
        if self.per_frame {
            config.num_motion_tokens = 0;
            config.velocity_scale = STILL_MPS;
        }
        config
    }

    /// The first weights' side: untrained velocities are made for their scale, so at a scale of nothing they are set to 0.
    pub fn settle(&self, weights: &mut Tensors) -> candle_core::Result<()> {
        let last = |name: &str| name.starts_with("motion_basis_decoder") && name.contains(".fc2.");
        for (_, x) in weights.iter_mut().filter(|(name, _)| self.per_frame && last(name)) {
            *x = x.zeros_like()?;
        }
        Ok(())
    }

    /// The training's side.
    pub fn apply(&self, options: &mut TrainOptions) {
        if let Some(t) = self.timesteps {
            options.clips.timesteps = t;
        }
        if self.per_frame {
            options.clips.timesteps = PER_FRAME_TIMESTEPS;
            options.clips.span_sec = options.clips.stride_sec;
            (options.pixel.flow, options.pixel.velocity, options.render.velocity) = (0.0, 0.0, 0.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use candle_core::Device;
    use storm_model::train::{Stage, Trainer};
    use storm_model::weights::untrained;

    use super::*;

    #[test]
    fn every_variant_is_a_network_that_takes_a_step() {
        let tiny = ModelConfig {
            embed_dim: 32,
            depth: 1,
            num_heads: 2,
            image_height: 16,
            image_width: 24,
            upsampler_widths: vec![16, 16, 8],
            key_hidden: 8,
            basis_hidden: 8,
            ..ModelConfig::preset("tiny").unwrap()
        };
        let with = |change: &dyn Fn(&mut VariantArgs)| {
            let mut args = VariantArgs::default();
            change(&mut args);
            args
        };
        let variants = [
            with(&|_| ()),
            with(&|v| v.motion_tokens = Some(0)),
            with(&|v| v.motion_tokens = Some(32)),
            with(&|v| v.timesteps = Some(1)),
            with(&|v| v.timesteps = Some(6)),
            with(&|v| v.no_sky_token = true),
            with(&|v| v.no_affine_token = true),
            with(&|v| (v.no_sky_token, v.no_affine_token) = (true, true)),
            with(&|v| v.per_frame = true),
        ];
        for variant in variants {
            let config = variant.configure(tiny.clone());
            config.validate().unwrap();
            let mut options = TrainOptions::new(1, 10, 1, 1e-3);
            options.stage = Stage::Both;
            (options.clips.width, options.clips.height, options.clips.targets) = (24, 16, 1);
            variant.apply(&mut options);
            let timesteps = options.clips.timesteps;
            let mut weights = untrained(&config, 1, &Device::Cpu).unwrap();
            variant.settle(&mut weights).unwrap();
            let mut trainer = Trainer::new(&config, &weights, options, &Device::Cpu).unwrap();
            let clip = trainer.data().batch(0, &config).unwrap();
            assert_eq!(clip.context.image.dims()[1], timesteps);
            let report = trainer.step(&clip).unwrap();
            assert!(report.total.is_finite() && report.gradient_norm > 0.0, "{variant:?}");
            let model = storm_model::Storm::new(&config, &trainer.weights(false).unwrap()).unwrap();
            let output = model.forward(&clip.context).unwrap();
            let fastest = output.velocity_forward.abs().unwrap().flatten_all().unwrap().max(0).unwrap();
            let still = fastest.to_scalar::<f32>().unwrap() < 1e-6;
            assert_eq!(still, variant.per_frame, "{variant:?}");
            assert_eq!(output.sky_token.is_some(), !variant.no_sky_token);
            assert_eq!(output.affine.is_some(), !variant.no_affine_token);
        }
    }
}
