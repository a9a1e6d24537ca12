//! The mask decoder's upsampler: token features to pixel features.
//!
//! A transposed convolution with kernel 2 and stride 2 does not overlap, so it is one linear layer from a pixel to its
//! four children. Pixels are kept in that nested order (patch, child, child of child, ...): every layer is then a plain
//! matrix product over rows, and one permutation at the very end puts the result into rows and columns.

use candle_core::{Result, Tensor};

use super::params::{Arranged, Norm, Params};
use super::stages::Stages;
use crate::config::ModelConfig;
use crate::error::ModelError;
use crate::kernels::arrange::Nesting;
use crate::ops::{Activation, Linear, Step, gelu, linear, unnest};
use crate::weights::names::upsampler_norm;

#[derive(Debug, Clone)]
struct Doubling {
    conv: Arranged,
    width: usize,
    norm: Option<Norm>,
}

/// The stack of doublings.
#[derive(Debug, Clone)]
pub(crate) struct Upsampler(Vec<Doubling>);

/// PyTorch's transposed convolution `(in, out, 2, 2)` as a matrix `(row bit, col bit, out; in)`.
fn children_as_rows(conv: &Linear) -> Result<Linear> {
    let (inputs, width, _, _) = conv.weight.dims4()?;
    let weight = conv.weight.permute((2, 3, 1, 0))?.contiguous()?.reshape((4 * width, inputs))?;
    let bias = match &conv.bias {
        Some(bias) => Some(Tensor::cat(&[bias, bias, bias, bias], 0)?),
        None => None,
    };
    Ok(Linear::new(weight, bias))
}

/// The layers of one forward pass.
pub(crate) struct Prepared<'a>(Vec<(Linear, &'a Doubling)>);

impl Upsampler {
    pub fn new(config: &ModelConfig, params: &Params<'_>) -> std::result::Result<Self, ModelError> {
        let stage = |(k, &width): (usize, &usize)| {
            let norm = upsampler_norm(config, k).then(|| params.norm(&format!("output_upscaling.{}", 3 * k + 1)));
            let conv = params.linear(&format!("output_upscaling.{}", 3 * k))?;
            Ok::<_, ModelError>(Doubling {
                conv: Arranged::new(conv, children_as_rows)?,
                width,
                norm: norm.transpose()?,
            })
        };
        Ok(Self(config.upsampler_widths.iter().enumerate().map(stage).collect::<std::result::Result<_, _>>()?))
    }

    /// Once per forward pass, before the first picture.
    pub fn prepare(&self) -> Result<Prepared<'_>> {
        Ok(Prepared(self.0.iter().map(|stage| Ok((stage.conv.layer()?, stage))).collect::<Result<_>>()?))
    }
}

impl Prepared<'_> {
    /// `(patches, d)` of one or more pictures to `(patches * 4^stages, width)`, each picture in nested order.
    ///
    /// `grid` is used only to arrange the stages kept for comparison.
    pub fn forward(&self, patches: &Tensor, grid: (usize, usize), stages: &mut Stages) -> Result<Tensor> {
        let mut x = patches.clone();
        for (k, (layer, Doubling { width, norm, .. })) in self.0.iter().enumerate() {
            x = linear(&x, layer, Activation::None, None)?.reshape(((), *width))?;
            keep(stages, 3 * k, &x, grid, k + 1)?;
            if let Some(norm) = norm {
                x = norm.forward(&x)?;
                keep(stages, 3 * k + 1, &x, grid, k + 1)?;
            }
            x = gelu(&x)?;
            keep(stages, 3 * k + 2, &x, grid, k + 1)?;
        }
        Ok(x)
    }

    /// The layers of each doubling as parts of a chain.
    pub fn steps(&self) -> impl Iterator<Item = Vec<Step<'_>>> {
        self.0.iter().map(|(layer, stage)| match &stage.norm {
            Some(norm) => vec![Step::Linear(layer, Activation::None), norm.step(Activation::Gelu)],
            None => vec![Step::Linear(layer, Activation::Gelu)],
        })
    }
}

fn keep(stages: &mut Stages, layer: usize, x: &Tensor, grid: (usize, usize), levels: usize) -> Result<()> {
    let name = format!("upscaling_{layer}");
    if stages.wants(&name) {
        stages.keep(&name, &unnest(x, Nesting { grid, levels, copies: 1 })?.get(0)?);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device};

    use super::*;

    #[test]
    fn linear_and_unnest_are_the_transposed_convolution() {
        // A small asymmetric case against candle's own conv_transpose2d, two levels deep.
        let device = Device::Cpu;
        let wave = |n: usize, f: f64| -> Vec<f32> { (0..n).map(|i| (f * i as f64).sin() as f32).collect() };
        let (rows, cols, d, c1, c2) = (2, 3, 5, 4, 3);
        let x = Tensor::from_vec(wave(rows * cols * d, 0.7), (rows * cols, d), &device).unwrap();
        let w1 = Tensor::from_vec(wave(d * c1 * 4, 0.31), (d, c1, 2, 2), &device).unwrap();
        let w2 = Tensor::from_vec(wave(c1 * c2 * 4, 0.17), (c1, c2, 2, 2), &device).unwrap();
        let layer = |w: &Tensor, c: usize| Doubling {
            conv: Arranged::new(
                Linear::new(w.clone(), Some(Tensor::zeros(c, DType::F32, &device).unwrap())),
                children_as_rows,
            )
            .unwrap(),
            width: c,
            norm: None,
        };
        let upsampler = Upsampler(vec![layer(&w1, c1), layer(&w2, c2)]);
        let prepared = upsampler.prepare().unwrap();
        let ours = prepared.forward(&x, (rows, cols), &mut Stages::none()).unwrap();
        let ours = unnest(&ours, Nesting { grid: (rows, cols), levels: 2, copies: 1 }).unwrap().get(0).unwrap();
        let chw = x.reshape((1, rows, cols, d)).unwrap().permute((0, 3, 1, 2)).unwrap().contiguous().unwrap();
        let y = chw.conv_transpose2d(&w1, 0, 0, 2, 1).unwrap().gelu_erf().unwrap();
        let y = y.conv_transpose2d(&w2, 0, 0, 2, 1).unwrap().gelu_erf().unwrap();
        let y = y.squeeze(0).unwrap().permute((1, 2, 0)).unwrap();
        let worst = (ours - y).unwrap().abs().unwrap().flatten_all().unwrap().max(0).unwrap();
        assert!(worst.to_scalar::<f32>().unwrap() < 1e-5);
    }
}
