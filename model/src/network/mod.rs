//! STORM itself: pictures with poses in, moving Gaussians out. Modules carry the names of the authors' checkpoints.

mod embed;
mod gaussians;
mod motion;
mod output;
mod params;
mod resample;
mod reuse;
mod shortcuts;
mod sky;
mod stages;
pub(crate) mod sweep;
mod tokens;
mod transformer;
mod upsample;
mod validity;

use std::path::Path;
use std::sync::Arc;

use candle_core::{DType, Device, Tensor};
pub use output::ClipOutput;
pub(crate) use params::NORM_EPS;
use params::Params;
pub(crate) use resample::resample;
pub use reuse::Kept;
pub use shortcuts::{MAX_KV_POOL, MAX_MERGE, Shortcuts};
pub use stages::Stages;
use tokens::{Grid, TokenPlan};

use crate::clip::ClipBatch;
use crate::config::ModelConfig;
use crate::error::ModelError;
use crate::ops::{Activation, Linear, linear};
use crate::rays::Rays;
use crate::weights::{self, Tensors};

/// The network with its weights. Cheap to clone (weights are shared).
#[derive(Debug, Clone)]
pub struct Storm {
    config: Arc<ModelConfig>,
    embed: embed::Embed,
    sky_token: Option<Tensor>,
    affine_token: Option<Tensor>,
    motion_tokens: Option<Tensor>,
    transformer: transformer::Transformer,
    sweep: Option<sweep::SweepHead>,
    gaussians: gaussians::GaussianHead,
    motion: motion::MotionHead,
    sky: Option<Arc<sky::SkyHead>>,
    affine: Option<Linear>,
}

impl Storm {
    /// The network over given tensors (all on one device and of one type), named as [`weights::tensor_specs`] lists them.
    ///
    /// Tensors that are variables stay variables: to train, pass each variable's tensor.
    ///
    /// # Errors
    /// An invalid configuration, or a missing, extra or mis-shaped tensor.
    pub fn new(config: &ModelConfig, tensors: &Tensors) -> Result<Self, ModelError> {
        config.validate()?;
        weights::check_shapes(config, tensors.iter().map(|(name, x)| (name.as_str(), x.dims())))?;
        let params = Params(tensors);
        let mut config = config.clone();
        config.max_scale = weights::frozen_max_scale(tensors)?;
        let token = |used: bool, name: &str| used.then(|| params.get(name)).transpose();
        let sky = config.use_sky_token.then(|| sky::SkyHead::new(&config, &params)).transpose()?;
        Ok(Self {
            embed: embed::Embed::new(&config, &params)?,
            sky_token: token(config.use_sky_token, "sky_token")?,
            affine_token: token(config.use_affine_token, "affine_token")?,
            motion_tokens: token(config.num_motion_tokens > 0, "motion_tokens")?,
            transformer: transformer::Transformer::new(&config, &params)?,
            sweep: (config.sweep_after_block > 0).then(|| sweep::SweepHead::new(&params)).transpose()?,
            gaussians: gaussians::GaussianHead::new(&params)?,
            motion: motion::MotionHead::new(&config, &params)?,
            sky: sky.map(Arc::new),
            affine: config.use_affine_token.then(|| params.linear("affine_linear")).transpose()?,
            config: Arc::new(config),
        })
    }

    /// The network in a weight file: safetensors, or a PyTorch `.pth`/`.pt` (state dict or training checkpoint).
    ///
    /// The configuration comes from the file's metadata, else from its tensors' shapes (with the authors' choices).
    pub fn load(path: &Path, device: &Device) -> Result<Self, ModelError> {
        let (config, tensors) = weights::load(path, None, device)?;
        Self::new(&config, &tensors)
    }

    /// The network in a weight file, with this configuration instead of the file's own or the inferred one.
    pub fn load_as(path: &Path, config: &ModelConfig, device: &Device) -> Result<Self, ModelError> {
        let (config, tensors) = weights::load(path, Some(config), device)?;
        Self::new(&config, &tensors)
    }

    /// An untrained network; the same seed gives the same network everywhere.
    pub fn untrained(config: &ModelConfig, seed: u64, device: &Device) -> Result<Self, ModelError> {
        Self::new(config, &weights::untrained(config, seed, device)?)
    }

    /// The same network computing in f64, without kernels: slow, and the reference of what f32 loses.
    pub fn in_f64(config: &ModelConfig, tensors: &Tensors) -> Result<Self, ModelError> {
        let wide = tensors.iter().map(|(name, x)| Ok((name.clone(), x.to_dtype(DType::F64)?)));
        Self::new(config, &wide.collect::<Result<Tensors, ModelError>>()?)
    }

    /// The configuration, `max_scale` as the weights have it.
    pub fn config(&self) -> &ModelConfig {
        &self.config
    }

    /// Runs the network over a batch of windows.
    ///
    /// Any 1-10 timesteps, 1-6 cameras (with affine tokens at most `num_cams`, fewer use the first ones) and any
    /// picture size that is a multiple of the patch size.
    pub fn forward(&self, batch: &ClipBatch) -> Result<ClipOutput, ModelError> {
        self.forward_with(batch, &Shortcuts::default())
    }

    /// As [`Storm::forward`], with what `shortcuts` leaves out or rounds.
    ///
    /// # Errors
    /// Those of [`Storm::forward`], and shortcuts that do not fit the batch.
    pub fn forward_with(&self, batch: &ClipBatch, shortcuts: &Shortcuts) -> Result<ClipOutput, ModelError> {
        let [b, ..] = batch.dims()?;
        if shortcuts.merge > 0.0 && b > 1 {
            // Windows may merge to different numbers of tokens.
            let each = (0..b).map(|i| self.run(&batch.window(i)?, shortcuts, &mut Stages::none()));
            return ClipOutput::stack(&each.collect::<Result<Vec<_>, _>>()?);
        }
        self.run(batch, shortcuts, &mut Stages::none())
    }

    /// As [`Storm::forward`], keeping the intermediate tensors that `stages` asks for.
    pub fn forward_stages(&self, batch: &ClipBatch, stages: &mut Stages) -> Result<ClipOutput, ModelError> {
        self.run(batch, &Shortcuts::default(), stages)
    }

    fn run(&self, batch: &ClipBatch, shortcuts: &Shortcuts, stages: &mut Stages) -> Result<ClipOutput, ModelError> {
        let config = &*self.config;
        let [_, timesteps, v, h, w] = batch.dims()?;
        self.check_sizes(v, h, w)?;
        let (rows, cols) = (h / config.patch_size, w / config.patch_size);
        let grid = Grid { timesteps, cameras: v, rows, cols };
        shortcuts.check(grid.patches())?;
        let with_mask = validity::without_unseen(shortcuts, batch, grid, config.patch_size)?;
        let shortcuts = with_mask.as_ref().unwrap_or(shortcuts);
        let rays = Rays::new(config, batch)?;
        stages.keep("ray_directions", &rays.directions);
        stages.keep("plucker", &rays.plucker);
        let image_tokens = self.embed.forward(batch, &rays, stages)?;
        let tokens = self.with_extra_tokens(image_tokens, v)?;
        stages.keep("tokens_in", &tokens);
        let activity = match shortcuts.merge > 0.0 {
            true => Some(tokens::activity(&batch.image.get(0)?, config.patch_size)?),
            false => None,
        };
        let extra = tokens.dim(1)? - grid.patches();
        let plan = TokenPlan::new(shortcuts, grid, extra, activity.as_deref());
        let mut swept = None;
        let tokens = self.transformer.forward(tokens, &plan, shortcuts.precision, stages, &mut |blocks, x| {
            let Some(head) = self.sweep.as_ref().filter(|_| blocks == config.sweep_after_block) else { return Ok(x) };
            let evidence = head.forward(config, batch, 0, &plan.patches(&x, extra)?)?;
            let x = plan.add(x, &evidence.added, extra)?;
            swept = Some(evidence.depths);
            Ok(x)
        })?;

        let newest = (shortcuts.newest_only && timesteps > 1).then_some(timesteps - 1);
        let mut output = self.decode(batch, rays, &tokens, newest, stages)?;
        output.swept_depths = swept;
        if let Some(keep) = &shortcuts.keep {
            output.hide(keep, grid)?;
        }
        Ok(output)
    }

    /// Gaussians, sky and exposure of the normed tokens `[sky | affine | motion | patches]`; of one timestep, whose patches alone
    /// they are then, or of all.
    fn decode(
        &self,
        batch: &ClipBatch,
        rays: Rays,
        tokens: &Tensor,
        newest: Option<usize>,
        stages: &mut Stages,
    ) -> Result<ClipOutput, ModelError> {
        let config = &*self.config;
        let [b, _, v, h, w] = batch.dims()?;
        let (rows, cols) = (h / config.patch_size, w / config.patch_size);
        let (image, time_sec, valid, rays) = match newest {
            Some(t) => {
                let valid = batch.valid.as_ref().map(|x| x.narrow(1, t, 1)).transpose()?;
                (batch.image.narrow(1, t, 1)?, batch.time_sec.narrow(1, t, 1)?, valid, rays.timestep(t)?)
            }
            None => (batch.image.clone(), batch.time_sec.clone(), batch.valid.clone(), rays),
        };
        let dims = [b, image.dim(1)?, v, h, w];
        let (mut at, d) = (0, config.embed_dim);
        let mut take = |count: usize| {
            at += count;
            tokens.narrow(1, at - count, count)?.contiguous()
        };
        let sky_token = if self.sky.is_some() { Some(take(1)?) } else { None };
        let affine = match &self.affine {
            Some(layer) => Some(linear(&take(v)?, layer, Activation::None, None)?.reshape((dims[0], v, 3, 4))?),
            None => None,
        };
        let motion_tokens = if self.motion_tokens.is_some() { Some(take(config.num_motion_tokens)?) } else { None };
        let image_tokens = take(dims[1] * v * rows * cols)?;
        debug_assert_eq!(image_tokens.dims()[2], d);

        let gaussians = self.gaussians.forward(config, &image_tokens, &image, &rays, stages)?;
        let motion = self.motion.forward(config, &image_tokens, motion_tokens.as_ref(), dims, stages)?;
        let mut output = ClipOutput {
            means: gaussians.means,
            scales: gaussians.scales,
            quats: gaussians.quats,
            opacities: gaussians.opacities,
            colors: gaussians.colors,
            depths: gaussians.depths,
            velocity_backward: motion.velocity_backward,
            velocity_forward: motion.velocity_forward,
            motion_weights: motion.weights,
            motion_bases: motion.bases,
            swept_depths: None,
            affine,
            sky_token,
            time_sec,
            valid: valid.clone(),
            config: Arc::clone(&self.config),
            sky: self.sky.clone(),
        };
        if let Some(valid) = &valid {
            output.show_only(valid)?;
        }
        Ok(output)
    }

    /// The position embedding on a patch grid, `(1, rows * cols, embed_dim)`; none when the network has none.
    pub fn position_embedding(&self, rows: usize, cols: usize) -> Result<Option<Tensor>, ModelError> {
        self.embed.position(rows, cols)
    }

    fn check_sizes(&self, cameras: usize, height: usize, width: usize) -> Result<(), ModelError> {
        let (patch, most) = (self.config.patch_size, self.config.num_cams);
        if height == 0 || width == 0 || !height.is_multiple_of(patch) || !width.is_multiple_of(patch) {
            let text = format!("pictures are {width}x{height} pixels; both sides must be multiples of {patch}");
            return Err(ModelError::Input(text));
        }
        if self.affine_token.is_some() && cameras > most {
            let text = format!("{cameras} cameras, but the network has affine tokens for {most}; use fewer cameras");
            return Err(ModelError::Input(text));
        }
        Ok(())
    }

    /// Puts `[sky | affine, one per camera | motion]` in front of the image tokens `(b, n, d)`.
    fn with_extra_tokens(&self, image: Tensor, cameras: usize) -> Result<Tensor, ModelError> {
        let (b, _, d) = image.dims3()?;
        let mut parts = Vec::with_capacity(4);
        let mut push = |token: &Tensor| -> Result<(), ModelError> {
            parts.push(token.expand((b, token.dim(1)?, d))?.contiguous()?);
            Ok(())
        };
        if let Some(token) = &self.sky_token {
            push(token)?;
        }
        if let Some(token) = &self.affine_token {
            push(&token.narrow(1, 0, cameras)?)?;
        }
        if let Some(tokens) = &self.motion_tokens {
            push(tokens)?;
        }
        parts.push(image);
        Ok(Tensor::cat(&parts, 1)?)
    }
}
