//! Networks with parts left out: the settings of the paper's ablations and of its per-frame baseline.

use std::collections::BTreeSet;

use anyhow::Result;
use candle_core::Device;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use storm_model::train::TrainOptions;
use storm_model::weights::{Tensors, grow, untrained};
use storm_model::{ModelConfig, ModelError};

use crate::cmd::UsageError;

/// A velocity scale at which whatever the decoder says stands still: nanometres per second.
const STILL_MPS: f64 = 1e-9;

/// Target pictures of the per-frame setting lie within one stride: a frame stands for itself until the next one.
const PER_FRAME_TIMESTEPS: usize = 1;

/// What makes a network other than the one it starts from.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct VariantArgs {
    /// Change a key of the network's configuration, as `--network depth=6 --network color=absolute`; may be given again.
    /// Keys and values are those in a weight file's header. With --weights, tensors whose shape changes start anew.
    #[arg(long, value_name = "KEY=VALUE", conflicts_with = "resume")]
    pub network: Vec<String>,
    /// Motion tokens; 0: velocities straight from the pixels' features.
    #[arg(long, conflicts_with = "resume")]
    pub motion_tokens: Option<usize>,
    /// Context timesteps of the training clips, 1 to 10 [default: 4].
    #[arg(long, conflicts_with = "resume")]
    pub timesteps: Option<usize>,
    /// Without sky token and sky head.
    #[arg(long, conflicts_with = "resume")]
    pub no_sky_token: bool,
    /// Without affine tokens: no exposure per camera.
    #[arg(long, conflicts_with = "resume")]
    pub no_affine_token: bool,
    /// Each timestep alone and nothing moves (the GS-LRM setting): one timestep, no motion tokens, velocity 0, targets
    /// within a stride.
    #[arg(long, conflicts_with_all = ["resume", "motion_tokens", "timesteps"])]
    pub per_frame: bool,
}

/// A network to start training from.
pub struct Beginning {
    pub config: ModelConfig,
    pub weights: Tensors,
    /// What happened to it so far.
    pub history: String,
}

impl VariantArgs {
    /// The network's side.
    fn configure(&self, config: &ModelConfig) -> Result<ModelConfig> {
        let mut config = set_keys("--network", config, &self.network)?;
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
        config.validate().map_err(|e| UsageError(e.to_string()))?;
        Ok(config)
    }

    /// A new network.
    pub fn make(&self, config: &ModelConfig, seed: u64, name: &str) -> Result<Beginning> {
        let config = self.configure(config)?;
        let mut weights = untrained(&config, seed, &Device::Cpu)?;
        self.settle(&mut weights)?;
        Ok(Beginning { config, weights, history: format!("untrained {name}, seed {seed}") })
    }

    /// A trained network, changed: what keeps its name and shape keeps its values, the rest starts anew.
    pub fn change(&self, from: Beginning, seed: u64) -> Result<Beginning> {
        let config = self.configure(&from.config)?;
        if config == from.config {
            return Ok(from);
        }
        let mut weights = untrained(&config, seed, &Device::Cpu)?;
        let mut anew = BTreeSet::new();
        for (name, x) in &mut weights {
            match from.weights.get(name).filter(|old| old.dims() == x.dims()) {
                Some(old) => *x = old.clone(),
                None => {
                    anew.insert(name.split('.').next().unwrap_or(name).to_owned());
                }
            }
        }
        self.settle(&mut weights)?;
        let parts = anew.into_iter().collect::<Vec<_>>().join(", ");
        let anew = if parts.is_empty() { "nothing".to_owned() } else { parts };
        let history =
            format!("{}; changed to {}, where {anew} began anew (seed {seed})", from.history, config.describe());
        Ok(Beginning { config, weights, history })
    }

    /// A trained network grown into a larger one: `into`, or its own configuration, changed.
    pub fn grow(&self, from: Beginning, into: Option<ModelConfig>, seed: u64) -> Result<Beginning> {
        let mut into = into.unwrap_or_else(|| from.config.clone());
        into.num_cams = into.num_cams.max(from.config.num_cams);
        let config = self.configure(&into)?;
        let weights = grow(&from.config, &from.weights, &config, seed).map_err(|e| match e {
            ModelError::Growth { .. } => UsageError(format!("--grow-from: {e}")).into(),
            e => anyhow::Error::from(e),
        })?;
        let history = format!("{}; grown to {} (seed {seed})", from.history, config.describe());
        Ok(Beginning { config, weights, history })
    }

    /// Untrained velocities are made for their scale, so at a scale of nothing they are set to 0.
    fn settle(&self, weights: &mut Tensors) -> Result<()> {
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

/// Something with some of its keys set from `KEY=VALUE` texts, values in YAML; `option` is for messages.
pub fn set_keys<T: Serialize + DeserializeOwned>(option: &str, of: &T, changes: &[String]) -> Result<T> {
    let mut all = serde_json::to_value(of)?;
    for change in changes {
        let wrong = |why: String| UsageError(format!("{option} {change}: {why}"));
        let (key, value) = change.split_once('=').ok_or_else(|| wrong("expected KEY=VALUE".into()))?;
        let value: Value = serde_yaml::from_str(value).map_err(|e| wrong(e.to_string()))?;
        let Some(place) = all.get_mut(key) else {
            let keys: Vec<&str> = all.as_object().into_iter().flatten().map(|(k, _)| k.as_str()).collect();
            return Err(wrong(format!("there is no such key; there are {}", keys.join(", "))).into());
        };
        *place = value;
        // One by one, so that the message is about this key.
        serde_json::from_value::<T>(all.clone()).map_err(|e| wrong(e.to_string()))?;
    }
    Ok(serde_json::from_value(all)?)
}

#[cfg(test)]
mod tests {
    use storm_model::train::{Stage, Trainer};

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
            let Beginning { config, weights, .. } = variant.make(&tiny, 1, "small").unwrap();
            let mut options = TrainOptions::new(1, 10, 1, 1e-3);
            options.stage = Stage::Both;
            (options.clips.width, options.clips.height, options.clips.targets) = (24, 16, 1);
            variant.apply(&mut options);
            let timesteps = options.clips.timesteps;
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

    #[test]
    fn keys_of_the_network_are_set_by_name_and_wrong_ones_say_which_there_are() {
        let base = ModelConfig::preset("tiny").unwrap();
        let with =
            |changes: &[&str]| set_keys("--network", &base, &changes.iter().map(|c| c.to_string()).collect::<Vec<_>>());
        assert_eq!(with(&[]).unwrap(), base);
        let deep = with(&["depth=6", "color=absolute"]).unwrap();
        assert_eq!((deep.depth, deep.color), (6, storm_model::config::ColorBase::Absolute));
        for (change, says) in [
            ("layers=6", "embed_dim"),
            ("depth", "KEY=VALUE"),
            ("depth=deep", "invalid type"),
            ("color=pink", "absolute"),
            ("depth=[", "depth=["),
        ] {
            let error = with(&[change]).unwrap_err().to_string();
            assert!(error.contains(says), "{change}: {error}");
        }
        let wrong = VariantArgs { network: vec!["num_heads=5".into()], ..VariantArgs::default() };
        assert!(wrong.make(&base, 1, "tiny").is_err());
    }

    #[test]
    fn a_changed_network_keeps_what_still_fits() {
        let (config, weights) = storm_model::weights::shipped(&Device::Cpu).unwrap();
        let from = || Beginning { config: config.clone(), weights: weights.clone(), history: "shipped".into() };
        let same = VariantArgs::default().change(from(), 1).unwrap();
        assert_eq!((same.config, same.history.as_str()), (config.clone(), "shipped"));
        let fewer = VariantArgs { motion_tokens: Some(4), ..VariantArgs::default() };
        let fewer = fewer.change(from(), 1).unwrap();
        let values = |w: &Tensors, name: &str| w[name].flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let mut kept = 0;
        for name in fewer.weights.keys() {
            let fits = weights.get(name).is_some_and(|x| x.dims() == fewer.weights[name].dims());
            assert_eq!(fits && values(&weights, name) == values(&fewer.weights, name), fits, "{name}");
            kept += usize::from(fits);
        }
        assert!(kept > 40 && kept < fewer.weights.len(), "{kept} of {}", fewer.weights.len());
        assert!(fewer.history.contains("motion_token"), "{}", fewer.history);
    }

    #[test]
    fn a_grown_network_is_the_larger_one_and_says_where_it_came_from() {
        let (config, weights) = storm_model::weights::shipped(&Device::Cpu).unwrap();
        let from = || Beginning { config: config.clone(), weights: weights.clone(), history: "shipped".into() };
        let args = |keys: &[&str]| VariantArgs {
            network: keys.iter().map(|k| (*k).to_owned()).collect(),
            ..VariantArgs::default()
        };
        let keys = ["patch_size=16", "image_height=160", "image_width=240", "depth=5"];
        let grown = args(&keys).grow(from(), None, 1).unwrap();
        assert_eq!((grown.config.patch_size, grown.config.grid(), grown.config.depth), (16, (10, 15), 5));
        assert_eq!(grown.weights["pos_embed"].dims(), [1, 150, 192]);
        assert!(grown.history.starts_with("shipped; grown to patch 16"), "{}", grown.history);
        let error = args(&["depth=3"]).grow(from(), None, 1).err().unwrap();
        assert!(error.downcast_ref::<UsageError>().is_some(), "{error}");
        assert!(error.to_string().contains("cannot grow depth from 4 to 3"), "{error}");
        let b8 = ModelConfig::preset("b8").unwrap();
        assert!(args(&[]).grow(from(), Some(b8), 1).is_err());
    }
}
