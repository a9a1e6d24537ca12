//! Several row-wise layers in one pass: a task takes some rows through all of them, so that what lies between two layers stays
//! in the processor's cache and is never a tensor.
//!
//! Every row's result has the bits of the layers applied one after the other.

use std::cell::RefCell;

use rayon::prelude::*;

use super::Isa;
use super::aligned::Aligned;
use super::gemm::{self, BlockScratch, Epilogue, PackedWeight};
use super::math::activation;
use super::{norm, rows};
use crate::ops::Activation;

/// Rows a task starts with at most, and floats between two layers it holds at most, where whole tiles allow.
fn task_size(isa: Isa) -> (usize, usize) {
    match isa {
        // What lies between waits in the third-level cache: fetching the weights anew for fewer rows would take longer.
        Isa::Amx => (192, 192 * 3072),
        // With their packed form they fit a cache of 512 KiB.
        _ => (96, 48 * 1024),
    }
}

/// One layer; its rows are its input's values cut anew into its own width.
#[derive(Debug, Clone, Copy)]
pub enum Step<'a> {
    /// `act(x w^T + bias)`.
    Linear {
        /// Packed for the set the chain runs on.
        weight: &'a PackedWeight,
        /// `(outputs)`.
        bias: Option<&'a [f32]>,
        /// What follows.
        act: Activation,
    },
    /// Layer norm over rows of `width`, then an activation.
    Norm {
        /// Values of a row.
        width: usize,
        /// `(width)`.
        weight: Option<&'a [f32]>,
        /// `(width)`.
        bias: Option<&'a [f32]>,
        /// Added to the variance.
        eps: f64,
        /// What follows.
        act: Activation,
    },
    /// `softmax(x / tau)` over rows of `width`.
    Softmax {
        /// Values of a row.
        width: usize,
        /// Temperature.
        tau: f32,
    },
}

impl Step<'_> {
    /// Values of a row before and after.
    pub fn widths(&self) -> (usize, usize) {
        match *self {
            Self::Linear { weight, .. } => (weight.inputs(), weight.outputs()),
            Self::Norm { width, .. } | Self::Softmax { width, .. } => (width, width),
        }
    }

    fn check(&self) {
        match *self {
            Self::Linear { weight, bias, .. } => {
                assert!(bias.is_none_or(|b| b.len() == weight.outputs()), "bias of {}", weight.outputs());
            }
            Self::Norm { width, weight, bias, .. } => {
                assert!([weight, bias].into_iter().flatten().all(|x| x.len() == width), "gain and offset of {width}");
            }
            Self::Softmax { .. } => {}
        }
    }
}

#[derive(Default)]
struct Scratch {
    blocks: BlockScratch,
    front: Aligned,
    back: Aligned,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

fn apply(isa: Isa, step: &Step<'_>, x: &[f32], residual: Option<&[f32]>, blocks: &mut BlockScratch, out: &mut [f32]) {
    match *step {
        Step::Linear { weight, bias, act } => {
            gemm::block(x, weight, Epilogue { bias, act, residual }, blocks, out);
            return;
        }
        Step::Norm { width, weight, bias, eps, act } => {
            norm::rows(isa, x, width, (weight, bias, eps), out);
            activation(isa, act, out);
        }
        Step::Softmax { width, tau } => rows::softmax_rows(isa, x, width, tau, out),
    }
    if let Some(residual) = residual {
        out.iter_mut().zip(residual).for_each(|(o, r)| *o += r);
    }
}

/// How many values come out of the steps for `count` going in; none when a step's width does not divide what reaches it.
pub fn outputs(steps: &[Step<'_>], count: usize) -> Option<usize> {
    steps.iter().try_fold(count, |count, step| {
        let (from, to) = step.widths();
        (from > 0 && count.is_multiple_of(from)).then(|| count / from * to)
    })
}

/// Takes rows of `width` values through `steps` and adds `residual`, which is as long as `out`.
///
/// Panics when the lengths disagree: every row must become a whole number of each step's rows.
pub fn chain(isa: Isa, x: &[f32], width: usize, steps: &[Step<'_>], residual: Option<&[f32]>, out: &mut [f32]) {
    if out.is_empty() {
        return;
    }
    let Some(per_row) = outputs(steps, width) else { panic!("rows of {width} do not fit the steps") };
    assert!(width > 0 && x.len().is_multiple_of(width) && !steps.is_empty(), "rows of {width}");
    assert!(out.len() == x.len() / width * per_row, "{} rows of {per_row}", x.len() / width);
    assert!(residual.is_none_or(|r| r.len() == out.len()), "residual of {}", out.len());
    steps.iter().for_each(Step::check);
    let mut largest = width;
    steps.iter().fold(width, |count, step| {
        let (from, to) = step.widths();
        largest = largest.max(count / from * to);
        count / from * to
    });
    let tile = isa.row_step();
    let count = x.len() / width;
    let (most_rows, most_floats) = task_size(isa);
    let share = gemm::task_rows(isa, count).min(most_rows);
    let rows = share.min(most_floats / largest / tile * tile).max(tile);
    let tasks = out.par_chunks_mut(rows * per_row).zip(x.par_chunks(rows * width)).enumerate();
    tasks.for_each(|(index, (out, x))| {
        let residual = residual.map(|r| &r[index * rows * per_row..][..out.len()]);
        // No rayon call happens inside, so a thread cannot come back here while it holds its scratch.
        SCRATCH.with_borrow_mut(|Scratch { blocks, front, back }| {
            let (mut from, mut to) = (front, back);
            let mut count = x.len();
            for (k, step) in steps.iter().enumerate() {
                let input = if k == 0 { x } else { &from.as_slice()[..count] };
                let (before, after) = step.widths();
                count = count / before * after;
                if k + 1 == steps.len() {
                    apply(isa, step, input, residual, blocks, out);
                } else {
                    apply(isa, step, input, None, blocks, to.at_least(count));
                }
                std::mem::swap(&mut from, &mut to);
            }
        });
    });
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::kernels::tests::noise;

    /// Fills this thread's scratch with NaN, so that anything read before it is written shows.
    fn poison() {
        SCRATCH.with_borrow_mut(|Scratch { front, back, .. }| {
            [front, back].into_iter().for_each(|b| b.at_least(1 << 16).fill(f32::NAN));
        });
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn a_chain_is_its_steps(
            count in 1usize..150, k in 1usize..70, next in 1usize..20, hidden in 1usize..40, m in 1usize..20,
            add: bool, seed in 0u64..1000,
        ) {
            for isa in Isa::tested() {
                // Norm, a linear layer whose rows split in four, two more, softmax.
                let weight = |seed: u64, n: usize, k: usize| PackedWeight::new(isa, &noise(seed, n * k, 0.3), n, k);
                let (w1, w2, w3) = (weight(1, 4 * next, k), weight(2, hidden, next), weight(3, m, hidden));
                let (gain, offset, bias) = (noise(4, k, 1.0), noise(5, k, 1.0), noise(6, 4 * next, 1.0));
                let steps = [
                    Step::Norm { width: k, weight: Some(&gain), bias: Some(&offset), eps: 1e-3, act: Activation::Gelu },
                    Step::Linear { weight: &w1, bias: Some(&bias), act: Activation::Gelu },
                    Step::Linear { weight: &w2, bias: None, act: Activation::Silu },
                    Step::Linear { weight: &w3, bias: None, act: Activation::None },
                    Step::Softmax { width: m, tau: 0.5 },
                ];
                let x = noise(seed, count * k, 2.0);
                let residual = add.then(|| noise(seed + 1, 4 * count * m, 1.0));
                let mut got = vec![f32::NAN; 4 * count * m];
                poison();
                chain(isa, &x, k, &steps, residual.as_deref(), &mut got);

                let mut y = vec![f32::NAN; x.len()];
                norm::layer_norm(isa, &x, k, Some(&gain), Some(&offset), 1e-3, &mut y);
                activation(isa, Activation::Gelu, &mut y);
                for step in &steps[1..4] {
                    let Step::Linear { weight, bias, act } = *step else { unreachable!() };
                    let mut z = vec![f32::NAN; y.len() / weight.inputs() * weight.outputs()];
                    gemm::linear(&y, weight, Epilogue { bias, act, residual: None }, &mut z);
                    y = z;
                }
                let mut want = vec![f32::NAN; y.len()];
                rows::softmax(isa, &y, m, 0.5, &mut want);
                if let Some(residual) = residual {
                    want.iter_mut().zip(&residual).for_each(|(w, r)| *w += r);
                }
                prop_assert_eq!(&got, &want);
            }
        }
    }

    #[test]
    fn same_bits_for_any_thread_count() {
        let (k, n) = (30, 40);
        let isa = Isa::detect();
        let (w1, w2) =
            (PackedWeight::new(isa, &noise(1, n * k, 0.3), n, k), PackedWeight::new(isa, &noise(2, 50, 0.3), 5, 10));
        let x = noise(3, 331 * k, 1.0);
        let run = |threads: usize| {
            let steps = [
                Step::Linear { weight: &w1, bias: None, act: Activation::Gelu },
                Step::Linear { weight: &w2, bias: None, act: Activation::None },
            ];
            let mut out = vec![f32::NAN; 331 * 20];
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| chain(isa, &x, k, &steps, None, &mut out));
            out
        };
        let one = run(1);
        for threads in [2, 3, 8] {
            assert!(one.iter().zip(&run(threads)).all(|(a, b)| a.to_bits() == b.to_bits()), "{threads} threads");
        }
    }
}
