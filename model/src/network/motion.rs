//! Motion tokens and mask decoder: velocities as a soft mixture of a few bases (paper section 3.1).

use candle_core::{D, Tensor};

use super::params::{Mlp, Params};
use super::stages::Stages;
use super::upsample::{Prepared, Upsampler};
use crate::config::{MaskDecoder, ModelConfig, VelocityBases, VelocityKind, spread_bases};
use crate::error::ModelError;
use crate::kernels::arrange::Nesting;
use crate::ops::{Activation, Linear, Step, chain, linear, softmax, unnest};

/// Velocities of every pixel and how they came about.
pub(crate) struct Motion {
    /// `(b, t, v, h, w, 3)`, m/s, used for earlier times.
    pub velocity_backward: Tensor,
    /// `(b, t, v, h, w, 3)`, m/s, used for later times.
    pub velocity_forward: Tensor,
    /// `(b, t, v, h, w, M)`, rows sum to 1; none without motion tokens.
    pub weights: Option<Tensor>,
    /// `(b, M, 3 | 6)`, m/s as the network states them.
    pub bases: Option<Tensor>,
}

/// The decoder.
#[derive(Debug, Clone)]
pub(crate) struct MotionHead {
    upsampler: Upsampler,
    keys: Mlp,
    queries: Vec<Mlp>,
    /// One, or one per token.
    bases: Vec<Mlp>,
}

/// The picture whose pixel-wise stages are kept for comparison: timestep 0, camera 1 (camera 0 of one-camera windows).
const PROBED_PICTURE: usize = 1;

/// Pixels that go through the upsampler and the decoder at a time: a whole window's features would not fit in memory at full
/// size.
const PART_PIXELS: usize = 1 << 17;

/// Pictures of one window that are decoded together.
struct Part {
    window: usize,
    first: usize,
    count: usize,
}

/// All pictures in order, in parts within one window; one by one where stages of one picture are asked for.
fn parts(windows: usize, pictures: usize, pixels: usize, one_by_one: bool) -> Vec<Part> {
    let most = if one_by_one { 1 } else { (PART_PIXELS / pixels.max(1)).max(1) };
    let of_window = |window: usize| {
        (0..pictures).step_by(most).map(move |k| Part {
            window,
            first: window * pictures + k,
            count: most.min(pictures - k),
        })
    };
    (0..windows).flat_map(of_window).collect()
}

/// Dot products of every row of `x` with every row of `rows`.
fn product(x: &Tensor, rows: Tensor) -> candle_core::Result<Tensor> {
    linear(x, &Linear::new(rows, None), Activation::None, None)
}

/// The velocities that spread bases start from, `(M, 3 | 6)`.
fn fan(config: &ModelConfig, like: &Tensor) -> candle_core::Result<Tensor> {
    let row = |v: [f32; 3]| match config.velocity {
        VelocityKind::One => v.to_vec(),
        // `v-` is the velocity for earlier times with its sign turned (paper eq. 1).
        VelocityKind::ForwardBackward => [v.map(|x| -x), v].concat(),
    };
    let bases = spread_bases(config.num_motion_tokens).into_iter().flat_map(row).collect::<Vec<f32>>();
    let shape = (config.num_motion_tokens, config.velocity_channels());
    Tensor::from_vec(bases, shape, like.device())?.to_dtype(like.dtype())
}

impl MotionHead {
    pub fn new(config: &ModelConfig, params: &Params<'_>) -> Result<Self, ModelError> {
        let m = config.num_motion_tokens;
        let bases = if config.mask_decoder == MaskDecoder::Paper && m > 0 {
            (0..m).map(|k| params.mlp(&format!("motion_basis_decoders.{k}"))).collect::<Result<_, _>>()?
        } else {
            vec![params.mlp("motion_basis_decoder")?]
        };
        let queries = (0..m).map(|k| params.mlp(&format!("motion_query_heads.{k}")));
        Ok(Self {
            upsampler: Upsampler::new(config, params)?,
            keys: params.mlp("motion_key_head")?,
            queries: queries.collect::<Result<_, _>>()?,
            bases,
        })
    }

    /// `image` tokens `(b, t v rows cols, d)` and `motion` tokens `(b, M, d)`; `dims` is `(b, t, v, h, w)`.
    pub fn forward(
        &self,
        config: &ModelConfig,
        image: &Tensor,
        motion: Option<&Tensor>,
        dims: [usize; 5],
        stages: &mut Stages,
    ) -> Result<Motion, ModelError> {
        let [b, t, v, h, w] = dims;
        let grid = (h / config.patch_size, w / config.patch_size);
        let nesting = Nesting { grid, levels: config.upsampler_widths.len(), copies: config.motion_copies() };
        let pictures = image.reshape((b * t * v, grid.0 * grid.1, config.embed_dim))?;
        let mixture = motion.map(|tokens| self.mixture(tokens, config)).transpose()?;
        if let Some((queries, bases)) = &mixture {
            stages.keep("motion_queries", queries);
            stages.keep("motion_bases", bases);
        }
        let upsampler = self.upsampler.prepare()?;
        let (mut all_weights, mut all_velocities) = (Vec::new(), Vec::new());
        for Part { window, first, count } in parts(b, t * v, h * w, stages.asked()) {
            let mut none = Stages::none();
            let probed = first == PROBED_PICTURE.min(t * v - 1);
            let stages = if probed { &mut *stages } else { &mut none };
            let tokens = pictures.narrow(0, first, count)?.reshape((count * grid.0 * grid.1, config.embed_dim))?;
            let queries = mixture.as_ref().map(|(queries, _)| queries.get(window)).transpose()?;
            let decoded = self.decode(&upsampler, &tokens, grid, queries, config.tau, stages)?;
            let velocity = match &mixture {
                Some((_, bases)) => {
                    let velocity = product(&decoded, bases.get(window)?.t()?.contiguous()?)?;
                    all_weights.push(unnest(&decoded, nesting)?);
                    velocity
                }
                None => (self.bases[0].forward(&decoded)? * config.velocity_scale)?,
            };
            all_velocities.push(unnest(&velocity, nesting)?);
        }
        let velocity = Tensor::cat(&all_velocities, 0)?.reshape((b, t, v, h, w, config.velocity_channels()))?;
        let weights = match all_weights.first() {
            Some(first) => Some(Tensor::cat(&all_weights, 0)?.reshape((b, t, v, h, w, first.dim(3)?))?),
            None => None,
        };
        let (velocity_backward, velocity_forward) = match config.velocity {
            VelocityKind::One => (velocity.clone(), velocity),
            // Paper eq. 1 subtracts (t' - t) v- for earlier times: as a velocity in metres per second it is -v-.
            VelocityKind::ForwardBackward => {
                let backward = velocity.narrow(D::Minus1, 0, 3)?.neg()?;
                (backward, velocity.narrow(D::Minus1, 3, 3)?.contiguous()?)
            }
        };
        Ok(Motion { velocity_backward, velocity_forward, weights, bases: mixture.map(|(_, bases)| bases) })
    }

    /// Motion weights `(pixels, M)` of pictures' `tokens` `(patches, d)` in nested order; without queries their keys `(pixels, e)`.
    fn decode(
        &self,
        upsampler: &Prepared<'_>,
        tokens: &Tensor,
        grid: (usize, usize),
        queries: Option<Tensor>,
        tau: f64,
        stages: &mut Stages,
    ) -> Result<Tensor, ModelError> {
        if stages.asked() {
            let features = upsampler.forward(tokens, grid, stages)?;
            let keys = self.keys.forward(&features)?;
            if stages.wants("motion_keys") {
                let levels = upsampler.steps().count();
                let nesting = Nesting { grid, levels, copies: 1 };
                stages.keep("motion_keys", &unnest(&keys, nesting)?.get(0)?);
            }
            return Ok(match queries {
                Some(queries) => softmax(&product(&keys, queries)?, tau)?,
                None => keys,
            });
        }
        // The last doubling's features are the widest: they go on to the weights without ever being a tensor.
        let mut x = tokens.clone();
        let mut doublings = upsampler.steps().peekable();
        let mut steps = Vec::new();
        while let Some(doubling) = doublings.next() {
            match doublings.peek() {
                Some(_) => x = chain(&x, &doubling, None)?,
                None => steps = doubling,
            }
        }
        steps.extend(self.keys.steps());
        let width = queries.as_ref().map(|queries| queries.dim(0)).transpose()?;
        let queries = queries.map(|queries| Linear::new(queries, None));
        steps.extend(queries.iter().map(|queries| Step::Linear(queries, Activation::None)));
        steps.extend(width.map(|width| Step::Softmax { width, tau }));
        Ok(chain(&x, &steps, None)?)
    }

    /// Queries `(b, M, e)` and scaled bases `(b, M, 3 | 6)` of the motion tokens.
    fn mixture(&self, tokens: &Tensor, config: &ModelConfig) -> Result<(Tensor, Tensor), ModelError> {
        let each = |mlps: &[Mlp]| -> Result<Tensor, ModelError> {
            let rows = mlps.iter().enumerate().map(|(k, mlp)| mlp.forward(&tokens.narrow(1, k, 1)?.contiguous()?));
            Ok(Tensor::cat(&rows.collect::<candle_core::Result<Vec<_>>>()?, 1)?)
        };
        let queries = each(&self.queries)?;
        let bases = match &self.bases[..] {
            [shared] => shared.forward(&tokens.contiguous()?)?,
            own => each(own)?,
        };
        let bases = if config.velocity_scale == 1.0 { bases } else { (bases * config.velocity_scale)? };
        let bases = match config.velocity_bases {
            VelocityBases::Learned => bases,
            VelocityBases::Spread => bases.broadcast_add(&fan(config, &bases)?)?,
        };
        Ok((queries, bases))
    }
}
