//! The transformer: pre-norm blocks with full attention over all tokens of a window.

use candle_core::Tensor;

use super::params::{Norm, Params};
use super::stages::Stages;
use crate::config::ModelConfig;
use crate::error::ModelError;
use crate::ops::{Activation, Linear, Step, attention, chain, linear};

#[derive(Debug, Clone)]
struct Block {
    norm1: Norm,
    qkv: Linear,
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
                proj: params.linear(&format!("{name}.attn.proj"))?,
                norm2: params.norm(&format!("{name}.norm2"))?,
                fc1: params.linear(&format!("{name}.mlp.fc1"))?,
                fc2: params.linear(&format!("{name}.mlp.fc2"))?,
            })
        };
        let blocks = (0..config.depth).map(block).collect::<Result<_, _>>()?;
        Ok(Self { blocks, norm: params.norm("norm")?, heads: config.num_heads })
    }

    /// `(b, n, d)` to `(b, n, d)`.
    pub fn forward(&self, tokens: Tensor, stages: &mut Stages) -> Result<Tensor, ModelError> {
        let mut x = tokens;
        for (k, block) in self.blocks.iter().enumerate() {
            x = block.forward(&x, self.heads, &mut |part, tensor| {
                let name = format!("block_{k}.{part}");
                if stages.wants(&name) {
                    stages.keep(&name, &tensor()?);
                }
                Ok(())
            })?;
            stages.keep(&format!("block_{k}"), &x);
        }
        let x = self.norm.forward(&x)?;
        stages.keep("tokens_norm", &x);
        Ok(x)
    }
}

/// Takes what is only computed when it is kept.
type Probe<'a> = dyn FnMut(&str, &dyn Fn() -> candle_core::Result<Tensor>) -> candle_core::Result<()> + 'a;

impl Block {
    fn forward(&self, x: &Tensor, heads: usize, probe: &mut Probe<'_>) -> candle_core::Result<Tensor> {
        probe("norm1", &|| self.norm1.forward(x))?;
        let qkv = chain(x, &[self.norm1.step(Activation::None), Step::Linear(&self.qkv, Activation::None)], None)?;
        probe("attn.qkv", &|| Ok(qkv.clone()))?;
        let attended = linear(&attention(&qkv, heads)?, &self.proj, Activation::None, Some(x))?;
        drop(qkv);
        probe("attn", &|| &attended - x)?;
        probe("norm2", &|| self.norm2.forward(&attended))?;
        let steps = [
            self.norm2.step(Activation::None),
            Step::Linear(&self.fc1, Activation::Gelu),
            Step::Linear(&self.fc2, Activation::None),
        ];
        let out = chain(&attended, &steps, Some(&attended))?;
        probe("mlp", &|| &out - &attended)?;
        Ok(out)
    }
}
