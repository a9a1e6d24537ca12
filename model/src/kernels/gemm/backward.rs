//! Gradients of linear layers: products of the same tiles with other packings.
//!
//! For `y = x w^T` and the gradient `g` of `y`: that of `x` is `g w`, a layer whose weight is `w` transposed
//! ([`PackedWeight::transposed`]); that of `w` is `g^T x`, a sum over all rows of the batch. Both packings copy whole
//! runs of floats, nothing is transposed in memory. As in the forward pass, the order of every sum is fixed by the shapes.

use std::cell::Cell;

use rayon::prelude::*;

use super::{Block, Epilogue, PackedWeight, Rows, SCRATCH, Scratch, block_rows, task_rows};
use crate::kernels::Isa;
use crate::kernels::aligned::Aligned;
use crate::kernels::math;
use crate::kernels::simd::dispatch;
use crate::ops::Activation;

/// Rows whose column sums are taken together before the shares are added: fixed, for the same bits on any machine.
const SUM_ROWS: usize = 64;

/// Memory of the calling thread for what lives through one backward step. Taken out while in use: a thread that waits in
/// a parallel loop may begin another step.
#[derive(Default)]
struct Kept {
    inputs: Option<PackedWeight>,
    hidden: Aligned,
    hidden_grad: Aligned,
}

thread_local! {
    static KEPT: Cell<Kept> = Cell::default();
}

/// `out = grad^T x`, the gradient of a weight `(n, k)`, for `grad` `(m, n)` and `x` `(m, k)`.
///
/// Panics when the lengths disagree (callers take them from tensor shapes).
pub fn weight_gradient(isa: Isa, grad: &[f32], x: &[f32], (m, n, k): (usize, usize, usize), out: &mut [f32]) {
    let mut kept = KEPT.take();
    weight_gradient_with(&mut kept.inputs, isa, grad, x, (m, n, k), out);
    KEPT.set(kept);
}

fn weight_gradient_with(
    kept: &mut Option<PackedWeight>,
    isa: Isa,
    grad: &[f32],
    x: &[f32],
    (m, n, k): (usize, usize, usize),
    out: &mut [f32],
) {
    assert!(grad.len() == m * n && x.len() == m * k && out.len() == n * k, "gradient of {n} x {k} from {m} rows");
    if n * k == 0 || m == 0 {
        out.fill(0.0);
        return;
    }
    let packed = match kept {
        Some(packed) if packed.isa == isa => {
            packed.pack_transposed(x, k, m);
            &*packed
        }
        _ => &*kept.insert(PackedWeight::transposed(isa, x, k, m)),
    };
    let threads = rayon::current_num_threads();
    let rows = n.div_ceil(threads).next_multiple_of(isa.row_step()).min(block_rows(isa));
    out.par_chunks_mut(rows * k).enumerate().for_each(|(i, out)| {
        let x = Rows::Standing { values: grad, stride: n, first: i * rows };
        let epilogue = Epilogue { bias: None, act: Activation::None, residual: None };
        // No rayon call happens inside, so a thread cannot come back here while it holds its scratch.
        SCRATCH.with_borrow_mut(|scratch| {
            dispatch(isa, Block { scratch: &mut scratch.blocks, x, w: packed, epilogue, out });
        });
    });
}

/// Sums over rows of `grad` `(m, n)`: the gradient of a bias.
pub fn column_sums(grad: &[f32], n: usize) -> Vec<f32> {
    let mut total = vec![0f32; n];
    if n == 0 {
        return total;
    }
    let shares: Vec<Vec<f32>> = grad
        .par_chunks(SUM_ROWS * n)
        .map(|rows| {
            let mut share = vec![0f32; n];
            for row in rows.chunks_exact(n) {
                share.iter_mut().zip(row).for_each(|(s, g)| *s += g);
            }
            share
        })
        .collect();
    for share in &shares {
        total.iter_mut().zip(share).for_each(|(t, s)| *t += s);
    }
    total
}

/// As [`super::mlp`], but the sums before the activation, `(m, hidden)`, are kept for [`mlp_backward`].
///
/// Panics when the lengths disagree (callers take them from tensor shapes).
pub fn mlp_keeping(
    x: &[f32],
    (w1, first): (&PackedWeight, Epilogue<'_>),
    (w2, second): (&PackedWeight, Epilogue<'_>),
    before: &mut [f32],
    out: &mut [f32],
) {
    let (n, hidden, k) = (w2.n, w1.n, w1.k);
    if n == 0 || hidden == 0 || out.is_empty() {
        return;
    }
    let m = out.len() / n;
    assert!(w1.isa == w2.isa && w2.k == hidden, "{hidden} outputs into {} inputs", w2.k);
    let plain = Epilogue { act: Activation::None, residual: None, ..first };
    super::check(x, w1, &plain, m, before.len());
    super::check(before, w2, &second, m, out.len());
    let rows = task_rows(w1.isa, m);
    let tasks = out.par_chunks_mut(rows * n).zip(before.par_chunks_mut(rows * hidden)).zip(x.par_chunks(rows * k));
    tasks.enumerate().for_each(|(i, ((out, before), x))| {
        let second = second.part(i * rows * n, out.len());
        SCRATCH.with_borrow_mut(|Scratch { blocks, hidden: between }| {
            dispatch(w1.isa, Block { scratch: blocks, x: Rows::Lying(x), w: w1, epilogue: plain, out: before });
            let between = between.at_least(before.len());
            between.copy_from_slice(before);
            math::activation(w1.isa, first.act, between);
            let x = Rows::Lying(between);
            dispatch(w2.isa, Block { scratch: blocks, x, w: w2, epilogue: second, out });
        });
    });
}

/// What the gradients of two layers with an activation between them are taken from; shapes as in [`mlp_backward`].
#[derive(Debug, Clone, Copy)]
pub struct Mlp<'a> {
    /// `(m, k)`.
    pub x: &'a [f32],
    /// `(hidden, k)`.
    pub w1: &'a [f32],
    /// The activation between.
    pub act: Activation,
    /// `(n, hidden)`.
    pub w2: &'a [f32],
    /// The sums before the activation, `(m, hidden)`, from [`mlp_keeping`].
    pub before: &'a [f32],
    /// Gradient of the result, `(m, n)`.
    pub grad: &'a [f32],
}

/// Where they go; those that are `None` are not computed.
#[derive(Debug, Default)]
pub struct MlpGradients<'a> {
    /// `(m, k)`.
    pub x: Option<&'a mut [f32]>,
    /// `(hidden, k)`.
    pub w1: Option<&'a mut [f32]>,
    /// `(hidden)`.
    pub b1: Option<&'a mut Vec<f32>>,
    /// `(n, hidden)`.
    pub w2: Option<&'a mut [f32]>,
}

/// Gradients of `act(x w1^T + b1) w2^T`, for sizes `(m, k, hidden, n)`.
///
/// Panics when the lengths disagree (callers take them from tensor shapes).
pub fn mlp_backward(isa: Isa, mlp: Mlp<'_>, (m, k, hidden, n): (usize, usize, usize, usize), to: MlpGradients<'_>) {
    let Mlp { x, w1, act, w2, before, grad } = mlp;
    assert!(x.len() == m * k && before.len() == m * hidden && grad.len() == m * n, "{m} rows of {k}, {hidden}, {n}");
    if m * k * hidden * n == 0 {
        return;
    }
    let mut kept = KEPT.take();
    let values = kept.hidden.at_least(m * hidden);
    let grads = kept.hidden_grad.at_least(m * hidden);
    let back2 = PackedWeight::transposed(isa, w2, hidden, n);
    let back1 = to.x.is_some().then(|| PackedWeight::transposed(isa, w1, k, hidden));
    let rows = task_rows(isa, m);
    let through = |grad: &[f32], before: &[f32], values: &mut [f32], grads: &mut [f32], x: Option<&mut [f32]>| {
        let epilogue = Epilogue { bias: None, act: Activation::None, residual: None };
        SCRATCH.with_borrow_mut(|Scratch { blocks, .. }| {
            dispatch(isa, Block { scratch: blocks, x: Rows::Lying(grad), w: &back2, epilogue, out: grads });
            math::backward(isa, act, before, grads, Some(values));
            if let Some((out, back1)) = x.zip(back1.as_ref()) {
                dispatch(isa, Block { scratch: blocks, x: Rows::Lying(grads), w: back1, epilogue, out });
            }
        });
    };
    let tasks = grad
        .par_chunks(rows * n)
        .zip(before.par_chunks(rows * hidden))
        .zip(values.par_chunks_mut(rows * hidden))
        .zip(grads.par_chunks_mut(rows * hidden));
    match to.x {
        Some(out) => {
            assert_eq!(out.len(), m * k);
            let tasks = tasks.zip(out.par_chunks_mut(rows * k));
            tasks.for_each(|((((grad, before), values), grads), out)| through(grad, before, values, grads, Some(out)));
        }
        None => tasks.for_each(|(((grad, before), values), grads)| through(grad, before, values, grads, None)),
    }
    if let Some(out) = to.w2 {
        weight_gradient_with(&mut kept.inputs, isa, grad, values, (m, n, hidden), out);
    }
    if let Some(out) = to.w1 {
        weight_gradient_with(&mut kept.inputs, isa, grads, x, (m, hidden, k), out);
    }
    if let Some(out) = to.b1 {
        *out = column_sums(grads, hidden);
    }
    KEPT.set(kept);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::tests::{noise, worst_difference};

    /// Sums of up to 700 products of values under 1: about 20 in size, with one or two roundings for each product.
    const TOLERANCE: f64 = 6e-5;
    /// Where operands have two parts, of 16 bits.
    const TILES_TOLERANCE: f64 = 2e-4;

    #[test]
    fn weight_gradients_of_every_shape() {
        for isa in Isa::tested() {
            for &(m, n, k) in &[(1, 1, 1), (5, 17, 3), (97, 6, 33), (700, 13, 50), (300, 100, 530)] {
                let (grad, x) = (noise(1, m * n, 1.0), noise(2, m * k, 1.0));
                let mut out = vec![f32::NAN; n * k];
                weight_gradient(isa, &grad, &x, (m, n, k), &mut out);
                let mut want = vec![0f64; n * k];
                for p in 0..m {
                    for i in 0..n {
                        for j in 0..k {
                            want[i * k + j] += f64::from(grad[p * n + i]) * f64::from(x[p * k + j]);
                        }
                    }
                }
                let worst = worst_difference(&out, &want);
                let tolerance = if isa == Isa::Amx { TILES_TOLERANCE } else { TOLERANCE };
                assert!(worst < tolerance, "{isa:?} {m} {n} {k}: {worst:e}");
                let sums: Vec<f64> = (0..n).map(|i| (0..m).map(|p| f64::from(grad[p * n + i])).sum()).collect();
                assert!(worst_difference(&column_sums(&grad, n), &sums) < TOLERANCE);
            }
        }
    }

    #[test]
    fn same_bits_for_any_thread_count() {
        let (m, k, hidden, n) = (333, 40, 100, 50);
        let (x, grad) = (noise(1, m * k, 1.0), noise(2, m * n, 1.0));
        let (w1, w2, before) = (noise(3, hidden * k, 0.2), noise(4, n * hidden, 0.1), noise(5, m * hidden, 2.0));
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let (mut dx, mut d1, mut b1, mut d2) =
                (vec![0.0; m * k], vec![0.0; hidden * k], Vec::new(), vec![0.0; n * hidden]);
            let to = MlpGradients { x: Some(&mut dx), w1: Some(&mut d1), b1: Some(&mut b1), w2: Some(&mut d2) };
            let mlp = Mlp { x: &x, w1: &w1, act: Activation::Gelu, w2: &w2, before: &before, grad: &grad };
            pool.install(|| mlp_backward(Isa::detect(), mlp, (m, k, hidden, n), to));
            [dx, d1, b1, d2].concat().iter().map(|v| v.to_bits()).collect::<Vec<_>>()
        };
        let one = run(1);
        for threads in [2, 3, 8] {
            assert!(run(threads) == one, "{threads} threads");
        }
    }
}
