//! The transformer: pre-norm blocks with full attention over all tokens of a window.

use std::sync::{Arc, OnceLock};

use candle_core::Tensor;

use super::params::{Norm, Params};
use super::stages::Stages;
use super::tokens::{Groups, TokenPlan, select};
use crate::config::ModelConfig;
use crate::error::ModelError;
use crate::ops::{Activation, Linear, Precision, Step, attention_at, chain, cross_attention, linear};

#[derive(Debug, Clone)]
struct Block {
    norm1: Norm,
    qkv: Linear,
    /// Its two parts, queries and keys with values, made when they are first taken apart.
    split: Arc<OnceLock<(Linear, Linear)>>,
    proj: Linear,
    norm2: Norm,
    fc1: Linear,
    fc2: Linear,
}

/// All blocks and the final norm.
#[derive(Debug, Clone)]
pub(crate) struct Transformer {
    blocks: Vec<Block>,
    norm: Norm,
    heads: usize,
}

impl Transformer {
    pub fn new(config: &ModelConfig, params: &Params<'_>) -> Result<Self, ModelError> {
        let block = |k: usize| {
            let name = format!("transformer.blocks.{k}");
            Ok::<_, ModelError>(Block {
                norm1: params.norm(&format!("{name}.norm1"))?,
                qkv: params.linear(&format!("{name}.attn.qkv"))?,
                split: Arc::default(),
                proj: params.linear(&format!("{name}.attn.proj"))?,
                norm2: params.norm(&format!("{name}.norm2"))?,
                fc1: params.linear(&format!("{name}.mlp.fc1"))?,
                fc2: params.linear(&format!("{name}.mlp.fc2"))?,
            })
        };
        let blocks = (0..config.depth).map(block).collect::<Result<_, _>>()?;
        Ok(Self { blocks, norm: params.norm("norm")?, heads: config.num_heads })
    }

    /// `(b, n, d)` to `(b, n, d)`, products in `precision`, `between` the blocks; as many tokens as the plan puts out.
    pub fn forward(
        &self,
        tokens: Tensor,
        plan: &TokenPlan,
        precision: Precision,
        stages: &mut Stages,
        between: &mut Between<'_>,
    ) -> Result<Tensor, ModelError> {
        let entered = plan.enter(tokens)?;
        let mut x = entered.tokens.clone();
        for (k, block) in self.blocks.iter().enumerate() {
            let last = k + 1 == self.blocks.len();
            let pooled = plan.pooled.as_ref().filter(|_| k > 0 && !last);
            let look = Look {
                heads: self.heads,
                precision,
                pooled,
                sizes: pooled.map(|groups| &groups.sizes[..]).or(plan.sizes()),
                queries: plan.last_queries.as_deref().filter(|_| last),
            };
            x = block.forward(&x, &look, &mut |part, tensor| {
                let name = format!("block_{k}.{part}");
                if stages.wants(&name) {
                    stages.keep(&name, &tensor()?);
                }
                Ok(())
            })?;
            stages.keep(&format!("block_{k}"), &x);
            x = between(k + 1, x)?;
        }
        let x = self.norm.forward(&plan.finish(x, &entered)?)?;
        stages.keep("tokens_norm", &x);
        Ok(x)
    }

    /// `(b, n, d)` to `(b, n, d)`, and of every block the keys and values of all patches, older ones first, `(b, m, 2 d)`.
    pub fn forward_taking(
        &self,
        tokens: Tensor,
        taken: &Taken<'_>,
        precision: Precision,
        between: &mut Between<'_>,
    ) -> Result<(Tensor, Vec<Tensor>), ModelError> {
        let (mut x, mut kept) = (tokens, Vec::with_capacity(self.blocks.len()));
        for (k, block) in self.blocks.iter().enumerate() {
            let older = taken
                .older
                .map(|all| all.get(k).ok_or_else(|| ModelError::Input(format!("no keys are kept for block {k}"))));
            let (out, keys_values) =
                block.forward_taking(&x, taken.extra, older.transpose()?, self.heads, precision)?;
            kept.push(keys_values);
            x = between(k + 1, out)?;
        }
        Ok((self.norm.forward(&x)?, kept))
    }
}

/// What a pass over a window's newest tokens takes of the older ones.
pub(crate) struct Taken<'a> {
    /// Tokens at the front that are no patches: their keys are not kept.
    pub extra: usize,
    /// Keys and values of older patches, one `(b, n, 2 d)` per block; none: all tokens are new.
    pub older: Option<&'a [Tensor]>,
}

/// What happens to the tokens after so many blocks.
pub(crate) type Between<'a> = dyn FnMut(usize, Tensor) -> Result<Tensor, ModelError> + 'a;

/// Takes what is only computed when it is kept.
type Probe<'a> = dyn FnMut(&str, &dyn Fn() -> candle_core::Result<Tensor>) -> candle_core::Result<()> + 'a;

/// How a block looks at its tokens.
struct Look<'a> {
    heads: usize,
    precision: Precision,
    /// Keys and values that are taken as one.
    pooled: Option<&'a Groups>,
    /// Patches each key stands for; none: one.
    sizes: Option<&'a [f32]>,
    /// Tokens that are worked out; none: all.
    queries: Option<&'a [u32]>,
}

impl Block {
    fn forward(&self, x: &Tensor, look: &Look<'_>, probe: &mut Probe<'_>) -> candle_core::Result<Tensor> {
        probe("norm1", &|| self.norm1.forward(x))?;
        let precision = look.precision;
        let proj = self.proj.at(precision);
        let attended = if look.sizes.is_none() && look.queries.is_none() {
            let qkv = self.qkv.at(precision);
            let qkv = chain(x, &[self.norm1.step(Activation::None), Step::Linear(&qkv, Activation::None)], None)?;
            probe("attn.qkv", &|| Ok(qkv.clone()))?;
            let attended = attention_at(&qkv, look.heads, precision)?;
            drop(qkv);
            linear(&attended, &proj, Activation::None, Some(x))?
        } else {
            self.attend_apart(x, look, &proj)?
        };
        // Where not all are queries there are fewer rows than in `x`.
        if look.queries.is_none() {
            probe("attn", &|| &attended - x)?;
        }
        probe("norm2", &|| self.norm2.forward(&attended))?;
        let out = self.mlp(&attended, precision)?;
        probe("mlp", &|| &out - &attended)?;
        Ok(out)
    }

    /// The second half: norm and MLP, added to what comes in.
    fn mlp(&self, x: &Tensor, precision: Precision) -> candle_core::Result<Tensor> {
        let (fc1, fc2) = (self.fc1.at(precision), self.fc2.at(precision));
        let steps = [
            self.norm2.step(Activation::None),
            Step::Linear(&fc1, Activation::Gelu),
            Step::Linear(&fc2, Activation::None),
        ];
        chain(x, &steps, Some(x))
    }

    /// The block over `[extra | new patches]` whose keys are theirs and those of `older` patches; and all patches' keys and
    /// values, older ones first.
    fn forward_taking(
        &self,
        x: &Tensor,
        extra: usize,
        older: Option<&Tensor>,
        heads: usize,
        precision: Precision,
    ) -> candle_core::Result<(Tensor, Tensor)> {
        let (_, n, d) = x.dims3()?;
        let (qkv, proj) = (self.qkv.at(precision), self.proj.at(precision));
        let qkv = chain(x, &[self.norm1.step(Activation::None), Step::Linear(&qkv, Activation::None)], None)?;
        let keys_values = qkv.narrow(2, d, 2 * d)?;
        let patches = keys_values.narrow(1, extra, n - extra)?;
        let (attended, patches) = match older {
            None => (attention_at(&qkv, heads, precision)?, patches.contiguous()?),
            Some(older) => {
                let patches = Tensor::cat(&[older, &patches], 1)?;
                let keys_values = Tensor::cat(&[&keys_values.narrow(1, 0, extra)?, &patches], 1)?;
                let queries = qkv.narrow(2, 0, d)?.contiguous()?;
                (cross_attention(&queries, &keys_values, None, heads, precision)?, patches)
            }
        };
        let attended = linear(&attended, &proj, Activation::None, Some(x))?;
        Ok((self.mlp(&attended, precision)?, patches))
    }

    /// Attention whose queries are not its keys, added to the queries' tokens.
    fn attend_apart(&self, x: &Tensor, look: &Look<'_>, proj: &Linear) -> candle_core::Result<Tensor> {
        let (query, key_value) = self.split()?;
        let (query, key_value) = (query.at(look.precision), key_value.at(look.precision));
        let normed = self.norm1.forward(x)?;
        // The layer is affine: keys of a mean are the mean of the keys.
        let keys_values = match look.pooled {
            Some(groups) => linear(&groups.mean(&normed)?, &key_value, Activation::None, None)?,
            None => linear(&normed, &key_value, Activation::None, None)?,
        };
        let (normed, x) = match look.queries {
            Some(rows) => (select(&normed, rows)?, select(x, rows)?),
            None => (normed, x.clone()),
        };
        let queries = linear(&normed, &query, Activation::None, None)?;
        let attended = cross_attention(&queries, &keys_values, look.sizes, look.heads, look.precision)?;
        linear(&attended, proj, Activation::None, Some(&x))
    }

    /// The query layer and that of keys with values.
    fn split(&self) -> candle_core::Result<(Linear, Linear)> {
        let part = |first: usize, count: usize| {
            let bias = self.qkv.bias.as_ref().map(|bias| bias.narrow(0, first, count)).transpose()?;
            Ok::<_, candle_core::Error>(Linear::new(self.qkv.weight.narrow(0, first, count)?.contiguous()?, bias))
        };
        let d = self.qkv.weight.dim(0)? / 3;
        let make = || Ok::<_, candle_core::Error>((part(0, d)?, part(d, 2 * d)?));
        if self.qkv.weight.track_op() {
            return make();
        }
        if let Some(both) = self.split.get() {
            return Ok(both.clone());
        }
        let both = make()?;
        Ok(self.split.get_or_init(|| both).clone())
    }
}
