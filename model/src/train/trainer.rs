//! One training step after another: forward, losses, backward, AdamW, with nothing non-finite let through.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use candle_core::{Device, Tensor, Var};
use storm_render::raster::CpuRasterizer;

use super::adamw::{self, Slot};
use super::clips::TrainClip;
use super::error::TrainError;
use super::loader::DataOptions;
use super::losses::Terms;
use super::lpips::FeatureNetwork;
use super::options::{Stage, TrainOptions};
use super::pixel::{PixelLossOptions, pixel_losses};
use super::raster::SharedRenderer;
use super::render_stage::render_stage_losses;
use super::shares::{self, Learned};
use crate::config::ModelConfig;
use crate::error::ModelError;
use crate::network::Storm;
use crate::weights::Tensors;

/// The one tensor that is never trained.
const FROZEN: &str = "max_scale";

/// What a step did.
#[derive(Debug, Clone, PartialEq)]
pub struct StepReport {
    /// The step, counted from 0.
    pub step: u64,
    /// Sum of the terms.
    pub total: f64,
    /// Every term, weight applied.
    pub terms: Vec<(&'static str, f64)>,
    /// Learning rate used.
    pub learning_rate: f64,
    /// Length of the gradient before clipping.
    pub gradient_norm: f64,
    /// Seconds of the forward pass and losses, of the backward pass, and of the update.
    pub seconds: [f64; 3],
}

/// A network being trained.
pub struct Trainer {
    config: Arc<ModelConfig>,
    options: TrainOptions,
    device: Device,
    slots: Vec<Slot>,
    vars: Vec<Var>,
    frozen: Tensors,
    model: Storm,
    /// One for each thread that learns.
    renderers: Vec<SharedRenderer>,
    features: Option<Arc<FeatureNetwork>>,
    step: u64,
}

impl Trainer {
    /// Starts from given weights.
    pub fn new(
        config: &ModelConfig,
        weights: &Tensors,
        options: TrainOptions,
        device: &Device,
    ) -> Result<Self, TrainError> {
        let slots = weights
            .iter()
            .filter(|(name, _)| name.as_str() != FROZEN)
            .map(|(name, x)| Ok(Slot::new(name, x.dims(), x.flatten_all()?.to_vec1()?)))
            .collect::<Result<_, TrainError>>()?;
        let frozen = weights.iter().filter(|(name, _)| name.as_str() == FROZEN);
        let frozen =
            frozen.map(|(name, x)| Ok((name.clone(), x.to_device(device)?))).collect::<Result<_, TrainError>>()?;
        Self::assemble(config, slots, frozen, options, 0, device)
    }

    pub(super) fn assemble(
        config: &ModelConfig,
        slots: Vec<Slot>,
        frozen: Tensors,
        options: TrainOptions,
        step: u64,
        device: &Device,
    ) -> Result<Self, TrainError> {
        options.check()?;
        let var = |s: &Slot| Var::from_vec(s.weight.clone(), &s.shape[..], device);
        let vars = slots.iter().map(var).collect::<candle_core::Result<Vec<_>>>()?;
        let mut tensors: BTreeMap<String, Tensor> = frozen.clone();
        tensors.extend(slots.iter().zip(&vars).map(|(s, v)| (s.name.clone(), v.as_tensor().clone())));
        let model = Storm::new(config, &tensors)?;
        let config = Arc::new(model.config().clone());
        let renderer = || {
            let raster = CpuRasterizer::new(config.raster_settings()).map_err(|e| ModelError::Render(e.to_string()))?;
            Ok::<SharedRenderer, ModelError>(Arc::new(Mutex::new(raster)))
        };
        let renderers = (0..rayon::current_num_threads()).map(|_| renderer()).collect::<Result<_, _>>()?;
        Ok(Self {
            config,
            options,
            device: device.clone(),
            slots,
            vars,
            frozen,
            model,
            renderers,
            features: None,
            step,
        })
    }

    /// Draws with another renderer from now on.
    pub fn set_renderer(&mut self, renderer: SharedRenderer) {
        self.renderers.iter_mut().for_each(|r| *r = Arc::clone(&renderer));
    }

    /// Uses a feature network for the perceptual term from now on; `name` goes into checkpoints and metadata.
    pub fn set_features(&mut self, name: &str, features: FeatureNetwork) {
        self.options.features = Some(name.to_owned());
        self.features = Some(Arc::new(features));
    }

    /// The network's configuration.
    pub fn config(&self) -> &Arc<ModelConfig> {
        &self.config
    }

    /// The run's options.
    pub fn options(&self) -> &TrainOptions {
        &self.options
    }

    /// Steps taken so far.
    pub fn steps_done(&self) -> u64 {
        self.step
    }

    /// The samples of this run, batch `n` belonging to step `n`.
    pub fn data(&self) -> DataOptions {
        let o = &self.options;
        // Before pictures are drawn, target pictures would be made for nothing.
        let targets_from = match o.stage {
            Stage::Pixel => u64::MAX,
            Stage::Render => 0,
            Stage::Both => o.render_from,
        };
        DataOptions {
            seed: o.seed,
            batch: o.batch,
            clips: o.clips,
            one_camera_batches: o.one_camera_steps,
            targets_from,
            reuse: o.reuse,
        }
    }

    pub(super) fn parts(&self) -> (&[Slot], &Tensors) {
        (&self.slots, &self.frozen)
    }

    /// Number of trained weights.
    pub fn weight_count(&self) -> usize {
        self.slots.iter().map(|s| s.weight.len()).sum()
    }

    /// Copies of the weights, by name: their moving average, or as they are.
    pub fn weights(&self, average: bool) -> Result<Tensors, TrainError> {
        let mut out = self.frozen.clone();
        for s in &self.slots {
            let values = if average { &s.average } else { &s.weight };
            out.insert(s.name.clone(), Tensor::from_slice(values, &s.shape[..], &self.device)?);
        }
        Ok(out)
    }

    /// Trains on one batch.
    ///
    /// # Errors
    /// [`TrainError::NonFinite`] names the step and the tensor; the weights are then still those before the step.
    pub fn step(&mut self, clip: &TrainClip) -> Result<StepReport, TrainError> {
        // Elsewhere than on a processor one graph of the whole batch is fastest.
        let shares = match self.device.is_cpu() {
            true => clip.apart()?,
            false => vec![clip.to_device(&self.device)?],
        };
        let losses = |clip: &TrainClip, renderer: &SharedRenderer| -> Result<Terms, TrainError> {
            Ok(self.losses(&self.model.forward(&clip.context)?, clip, renderer)?)
        };
        let learned = shares::learn(&shares, &self.vars, &losses, &self.renderers)?;
        let Learned { terms: values, gradients, seconds: [forward_sec, backward_sec] } = learned;
        if let Some((name, _)) = values.iter().find(|(_, x)| !x.is_finite()) {
            return Err(self.non_finite(format!("loss {name}"), 1));
        }
        for (gradient, slot) in gradients.iter().zip(&self.slots) {
            let bad = gradient.iter().flatten().filter(|x| !x.is_finite()).count();
            if bad > 0 {
                return Err(self.non_finite(format!("gradient of {}", slot.name), bad));
            }
        }
        let start = Instant::now();
        let learning_rate = self.options.schedule.at(self.step);
        let TrainOptions { average_decay: decay, adam, optimizer, .. } = self.options;
        let gradient_norm =
            adamw::step(&mut self.slots, &gradients, self.step, learning_rate, decay, optimizer, &adam)?;
        if let Some((name, bad)) = self.slots.iter().find_map(Slot::spoiled) {
            self.undo()?;
            return Err(self.non_finite(format!("weight {name}"), bad));
        }
        for (var, slot) in self.vars.iter().zip(&self.slots) {
            var.set(&Tensor::from_slice(&slot.weight, &slot.shape[..], &self.device)?)?;
        }
        let step = self.step;
        self.step += 1;
        Ok(StepReport {
            step,
            total: values.iter().map(|(_, x)| x).sum(),
            terms: values,
            learning_rate,
            gradient_norm,
            seconds: [forward_sec, backward_sec, start.elapsed().as_secs_f64()],
        })
    }

    fn losses(
        &self,
        output: &crate::ClipOutput,
        clip: &TrainClip,
        renderer: &SharedRenderer,
    ) -> Result<Terms, ModelError> {
        let features = self.features.as_deref();
        if let (Some(name), None) = (&self.options.features, features) {
            return Err(ModelError::Input(format!("the run was started with feature network {name}; give it again")));
        }
        match self.options.stage_at(self.step) {
            Stage::Pixel => pixel_losses(output, clip, &self.options.pixel),
            Stage::Render => render_stage_losses(output, clip, renderer, &self.options.render, features, self.step),
            Stage::Both => {
                // The velocity regulariser is in the paper's losses already.
                let pixel = PixelLossOptions { velocity: 0.0, ..self.options.pixel };
                let mut terms = pixel_losses(output, clip, &pixel)?;
                let render = &self.options.render;
                terms.extend(render_stage_losses(output, clip, renderer, render, features, self.step)?);
                Ok(terms)
            }
        }
    }

    /// The weights before an update that spoiled some. Moments and averages that were spoiled start anew.
    fn undo(&mut self) -> Result<(), TrainError> {
        for (var, slot) in self.vars.iter().zip(&mut self.slots) {
            slot.restore(var.flatten_all()?.to_vec1()?);
        }
        Ok(())
    }

    fn non_finite(&self, tensor: String, count: usize) -> TrainError {
        TrainError::NonFinite { step: self.step, tensor, batch_seed: self.options.seed, count }
    }
}
