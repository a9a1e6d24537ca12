//! Gradients of the kernels: against candle's own of the plain versions in f32, and against central finite differences
//! of the plain versions in f64.

use super::*;
use crate::kernels::arrange::Nesting;
use crate::kernels::tests::noise as noise_values;
use candle_core::backprop::GradStore;
use candle_core::{DType, Device, Var};
use proptest::prelude::*;

/// Of the largest gradient of a tensor: both sides round sums of up to a few hundred products in f32.
const AGAINST_PLAIN: f64 = 3e-5;
/// Of the sum of the absolute terms of a directional derivative: f32 gradients against differences whose own error is
/// `STEP^2` times a third derivative.
const AGAINST_DIFFERENCES: f64 = 2e-5;
/// How much more is allowed where tile units take gradients' products of operands of 16 bits, not 24.
fn coarser() -> f64 {
    if crate::kernels::Isa::detect() == crate::kernels::Isa::Amx { 8.0 } else { 1.0 }
}
/// Step of the differences in f64: its square is far under f32's rounding, and so is f64's rounding over it.
const STEP: f64 = 1e-4;
/// Gradients smaller than this are what is left of terms near 1, and carry those terms' rounding.
const CANCELLED: f64 = 0.03;
/// A usual eps divides rounding by rounding where rows are nearly constant (a single column).
const EPS: f64 = 1e-3;

fn noise(seed: u64, dims: &[usize], scale: f32) -> Tensor {
    Tensor::from_vec(noise_values(seed, dims.iter().product(), scale), dims, &Device::Cpu).unwrap()
}

fn flat(tensor: &Tensor) -> Vec<f64> {
    tensor.flatten_all().unwrap().to_dtype(DType::F64).unwrap().to_vec1().unwrap()
}

fn gradient(store: &GradStore, of: &Tensor) -> Vec<f64> {
    let grad = store.get(of).expect("a gradient");
    assert_eq!(grad.dims(), of.dims());
    flat(grad)
}

/// A scalar of `y` that no symmetry hides anything from: a sum with random weights.
fn loss(y: &Tensor) -> Tensor {
    let weights = noise(987, y.dims(), 1.0).to_dtype(y.dtype()).unwrap();
    (y * weights).unwrap().sum_all().unwrap()
}

/// `fast` and `plain` are the same function of `inputs`; checks all gradients of `fast`.
#[track_caller]
fn check(inputs: &[Tensor], fast: impl Fn(&[Tensor]) -> Result<Tensor>, plain: impl Fn(&[Tensor]) -> Result<Tensor>) {
    check_with(CANCELLED, inputs, fast, plain);
}

/// `check` where gradients smaller than `cancelled` are what is left of larger terms.
#[track_caller]
fn check_with(
    cancelled: f64,
    inputs: &[Tensor],
    fast: impl Fn(&[Tensor]) -> Result<Tensor>,
    plain: impl Fn(&[Tensor]) -> Result<Tensor>,
) {
    let vars: Vec<Tensor> = inputs.iter().map(|t| Var::from_tensor(t).unwrap().as_tensor().clone()).collect();
    let got = loss(&fast(&vars).unwrap()).backward().unwrap();
    let want = loss(&plain(&vars).unwrap()).backward().unwrap();
    for (i, var) in vars.iter().enumerate() {
        let (got, want) = (gradient(&got, var), gradient(&want, var));
        let size = want.iter().fold(cancelled, |a: f64, w| a.max(w.abs()));
        for (g, w) in got.iter().zip(&want) {
            assert!(
                (g - w).abs() <= AGAINST_PLAIN * coarser() * size,
                "input {i} {:?}: {g} and plain's {w}",
                var.dims()
            );
        }
    }

    let wide: Vec<Tensor> = inputs.iter().map(|t| t.to_dtype(DType::F64).unwrap()).collect();
    for (i, var) in vars.iter().enumerate() {
        let direction = noise(1000 + i as u64, var.dims(), 1.0).to_dtype(DType::F64).unwrap();
        let at = |step: f64| {
            let mut moved = wide.clone();
            moved[i] = (&moved[i] + (&direction * step).unwrap()).unwrap();
            loss(&plain(&moved).unwrap()).to_scalar::<f64>().unwrap()
        };
        let difference = (at(STEP) - at(-STEP)) / (2.0 * STEP);
        let terms: Vec<f64> = gradient(&got, var).iter().zip(flat(&direction)).map(|(g, d)| g * d).collect();
        let (sum, size) = (terms.iter().sum::<f64>(), terms.iter().map(|t| t.abs()).sum::<f64>().max(cancelled));
        assert!(
            (sum - difference).abs() <= AGAINST_DIFFERENCES * coarser() * size,
            "input {i} {:?}: {sum} along a direction, differences say {difference}",
            var.dims()
        );
    }
}

/// What a layer norm divides a row by.
fn deviation(row: &[f64]) -> f64 {
    let count = row.len() as f64;
    let mean = row.iter().sum::<f64>() / count;
    (row.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / count + EPS).sqrt()
}

fn layer(inputs: &[Tensor], weight: usize, bias: Option<usize>) -> Linear {
    Linear::new(inputs[weight].clone(), bias.map(|b| inputs[b].clone()))
}

const ACTIVATIONS: [Activation; 3] = [Activation::None, Activation::Gelu, Activation::Silu];

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn linear_gradients(
        b in 1usize..3, m in 1usize..70, n in 1usize..60, k in 1usize..90, seed in 0u64..1000,
        bias: bool, add: bool, act in 0usize..3,
    ) {
        let mut inputs = vec![noise(seed, &[b, m, k], 1.0), noise(seed + 1, &[n, k], (k as f32).powf(-0.5))];
        let bias = bias.then(|| { inputs.push(noise(seed + 2, &[n], 0.5)); inputs.len() - 1 });
        let residual = add.then(|| { inputs.push(noise(seed + 3, &[b, m, n], 1.0)); inputs.len() - 1 });
        check(
            &inputs,
            |t| linear(&t[0], &layer(t, 1, bias), ACTIVATIONS[act], residual.map(|r| &t[r])),
            |t| plain::linear(&t[0], &layer(t, 1, bias), ACTIVATIONS[act], residual.map(|r| &t[r])),
        );
    }

    #[test]
    fn mlp_gradients(
        m in 1usize..60, k in 1usize..40, h in 1usize..90, n in 1usize..40, seed in 0u64..1000,
        biases: bool, add: bool, act in 0usize..3,
    ) {
        let act = ACTIVATIONS[act];
        let mut inputs = vec![
            noise(seed, &[2, m, k], 1.0),
            noise(seed + 1, &[h, k], (k as f32).powf(-0.5)),
            noise(seed + 2, &[n, h], (h as f32).powf(-0.5)),
        ];
        let biases = biases.then(|| { inputs.extend([noise(seed + 3, &[h], 0.5), noise(seed + 4, &[n], 0.5)]); (3, 4) });
        let residual = add.then(|| { inputs.push(noise(seed + 5, &[2, m, n], 1.0)); inputs.len() - 1 });
        let layers = |t: &[Tensor]| (layer(t, 1, biases.map(|b| b.0)), layer(t, 2, biases.map(|b| b.1)));
        check(
            &inputs,
            |t| {
                let (one, two) = layers(t);
                mlp(&t[0], &one, act, &two, residual.map(|r| &t[r]))
            },
            |t| {
                let (one, two) = layers(t);
                plain::linear(&plain::linear(&t[0], &one, act, None)?, &two, Activation::None, residual.map(|r| &t[r]))
            },
        );
    }

    #[test]
    fn attention_gradients(
        b in 1usize..3, n in 1usize..220, heads in 1usize..4, d in 1usize..40, seed in 0u64..1000,
    ) {
        let inputs = [noise(seed, &[b, n, 3 * heads * d], 1.5)];
        check(&inputs, |t| attention(&t[0], heads), |t| plain::attention(&t[0], heads));
    }

    #[test]
    fn layer_norm_gradients(m in 1usize..80, n in 1usize..120, seed in 0u64..1000, weight: bool, bias: bool) {
        let mut inputs = vec![noise(seed, &[2, m, n], 3.0)];
        let weight = weight.then(|| { inputs.push(noise(seed + 1, &[n], 1.0)); inputs.len() - 1 });
        let bias = bias.then(|| { inputs.push(noise(seed + 2, &[n], 1.0)); inputs.len() - 1 });
        // A row's gradient is terms of 1 / deviation less nearly all of themselves where there are two columns.
        let terms = flat(&inputs[0]).chunks_exact(n).map(deviation).fold(1.0, |a: f64, d| a.max(1.0 / d));
        check_with(
            terms,
            &inputs,
            |t| layer_norm(&t[0], weight.map(|w| &t[w]), bias.map(|b| &t[b]), EPS),
            |t| plain::layer_norm(&t[0], weight.map(|w| &t[w]), bias.map(|b| &t[b]), EPS),
        );
    }

    #[test]
    fn elementwise_and_softmax_gradients(m in 1usize..80, n in 1usize..120, seed in 0u64..1000) {
        let inputs = [noise(seed, &[2, m, n], 3.0)];
        check(&inputs, |t| gelu(&t[0]), |t| t[0].gelu_erf());
        check(&inputs, |t| silu(&t[0]), |t| t[0].silu());
        check(&inputs, |t| softmax(&t[0], 0.5), |t| plain::softmax(&t[0], 0.5));
    }
}

/// Parameters of a block of width 24 with 3 heads, after `at` others.
const BLOCK_SHAPES: [&[usize]; 12] =
    [&[24], &[24], &[72, 24], &[72], &[24, 24], &[24], &[24], &[24], &[96, 24], &[96], &[24, 96], &[24]];

fn transformer_inputs() -> Vec<Tensor> {
    let mut inputs = vec![noise(1, &[2, 101, 24], 1.0)];
    for (i, dims) in BLOCK_SHAPES.iter().chain(&BLOCK_SHAPES).enumerate() {
        inputs.push(noise(10 + i as u64, dims, if dims.len() == 2 { (dims[1] as f32).powf(-0.5) } else { 1.0 }));
    }
    inputs
}

fn fast_transformer(t: &[Tensor]) -> Result<Tensor> {
    let mut x = t[0].clone();
    for p in t[1..].chunks_exact(BLOCK_SHAPES.len()) {
        let linears = |w: usize| layer(p, w, Some(w + 1));
        let qkv = linear(&layer_norm(&x, Some(&p[0]), Some(&p[1]), EPS)?, &linears(2), Activation::None, None)?;
        x = linear(&attention(&qkv, 3)?, &linears(4), Activation::None, Some(&x))?;
        let y = layer_norm(&x, Some(&p[6]), Some(&p[7]), EPS)?;
        x = mlp(&y, &linears(8), Activation::Gelu, &linears(10), Some(&x))?;
    }
    Ok(x)
}

fn plain_transformer(t: &[Tensor]) -> Result<Tensor> {
    let mut x = t[0].clone();
    for p in t[1..].chunks_exact(BLOCK_SHAPES.len()) {
        let linears = |w: usize| layer(p, w, Some(w + 1));
        let y = plain::layer_norm(&x, Some(&p[0]), Some(&p[1]), EPS)?;
        let qkv = plain::linear(&y, &linears(2), Activation::None, None)?;
        x = plain::linear(&plain::attention(&qkv, 3)?, &linears(4), Activation::None, Some(&x))?;
        let y = plain::layer_norm(&x, Some(&p[6]), Some(&p[7]), EPS)?;
        let y = plain::linear(&y, &linears(8), Activation::Gelu, None)?;
        x = plain::linear(&y, &linears(10), Activation::None, Some(&x))?;
    }
    Ok(x)
}

#[test]
fn two_blocks_have_the_plain_gradient() {
    check(&transformer_inputs(), fast_transformer, plain_transformer);
}

#[test]
fn same_bits_for_any_thread_count() {
    let vars: Vec<Tensor> =
        transformer_inputs().iter().map(|t| Var::from_tensor(t).unwrap().as_tensor().clone()).collect();
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let grads = loss(&fast_transformer(&vars).unwrap()).backward().unwrap();
            vars.iter().flat_map(|v| gradient(&grads, v)).map(f64::to_bits).collect::<Vec<_>>()
        })
    };
    let one = run(1);
    for threads in [2, 5] {
        assert!(run(threads) == one, "{threads} threads");
    }
}

#[test]
fn any_layout_and_shared_inputs() {
    // A transposed input and weight; the input is its own residual, so its gradient has two parts.
    let inputs = [noise(1, &[20, 15], 1.0), noise(2, &[20, 20], 0.3)];
    let fast = |t: &[Tensor]| {
        let x = t[0].t()?;
        linear(&x, &Linear::new(t[1].t()?, None), Activation::Silu, Some(&x))
    };
    let plain = |t: &[Tensor]| {
        let x = t[0].t()?;
        plain::linear(&x, &Linear::new(t[1].t()?, None), Activation::Silu, Some(&x))
    };
    check(&inputs, fast, plain);
    // A gradient that is a broadcast view, and one result used twice.
    let var = Var::from_tensor(&inputs[1]).unwrap();
    let y = softmax(&layer_norm(&gelu(var.as_tensor()).unwrap(), None, None, EPS).unwrap(), 1.0).unwrap();
    let grads = ((y.sum_all().unwrap() + y.sum_all().unwrap()).unwrap()).backward().unwrap();
    assert!(gradient(&grads, &var).iter().all(|g| g.abs() < 1e-5), "rows of a softmax sum to 1 whatever the input");
}

#[test]
fn nested_pixels_of_any_number_of_levels_and_copies_have_a_gradient() {
    for (levels, copies) in (1..=5).flat_map(|levels| [1, 2, 4].map(|copies| (levels, copies))) {
        let nesting = Nesting { grid: (3, 2), levels, copies };
        let x = noise(levels as u64, &[(2 * 3 * 2) << (2 * levels), 2], 1.0);
        let rows = unnest(&x, nesting).unwrap();
        // candle's own operations take what is not f32.
        let plain = |x: &Tensor| unnest(&x.to_dtype(DType::F64)?, nesting);
        assert_eq!(rows.dims(), [2, (3 << levels) * copies, (2 << levels) * copies, 2]);
        assert_eq!(flat(&rows), flat(&plain(&x).unwrap()), "{levels} levels, {copies} copies: as candle's operations");
        let of = |f: &dyn Fn(&Tensor) -> Result<Tensor>| {
            let var = Var::from_tensor(&x).unwrap();
            gradient(&loss(&f(var.as_tensor()).unwrap()).backward().unwrap(), &var)
        };
        let (got, want) = (of(&|x| unnest(x, nesting)), of(&plain));
        assert!(got.iter().zip(&want).all(|(a, b)| (a - b).abs() < 1e-5), "{levels} levels, {copies} copies");
    }
    assert!(unnest(&noise(1, &[5, 2], 1.0), Nesting { grid: (1, 1), levels: 1, copies: 1 }).is_err());
}

#[test]
fn only_what_is_tracked_gets_a_gradient() {
    let (x, w1, b1, w2) = (noise(1, &[9, 6], 1.0), noise(2, &[8, 6], 1.0), noise(3, &[8], 1.0), noise(4, &[5, 8], 1.0));
    let var = |t: &Tensor| Var::from_tensor(t).unwrap().as_tensor().clone();
    for tracked in 0usize..16 {
        let pick = |i: usize, t: &Tensor| if tracked >> i & 1 == 1 { var(t) } else { t.clone() };
        let parts = [pick(0, &x), pick(1, &w1), pick(2, &b1), pick(3, &w2)];
        let one = Linear::new(parts[1].clone(), Some(parts[2].clone()));
        let two = Linear::new(parts[3].clone(), None);
        let fused = mlp(&parts[0], &one, Activation::Gelu, &two, None).unwrap();
        let apart = linear(&linear(&parts[0], &one, Activation::Gelu, None).unwrap(), &two, Activation::None, None);
        let want = loss(&apart.unwrap()).backward().unwrap();
        let got = loss(&fused).backward().unwrap();
        assert_eq!(fused.track_op(), tracked != 0);
        for (i, part) in parts.iter().enumerate() {
            assert_eq!(got.get(part).is_some(), tracked >> i & 1 == 1, "input {i} of {tracked:b}");
            if tracked >> i & 1 == 1 {
                let (got, want) = (gradient(&got, part), gradient(&want, part));
                assert!(got.iter().zip(&want).all(|(g, w)| (g - w).abs() < 1e-4), "input {i} of {tracked:b}");
            }
        }
    }
}

#[test]
fn passes_over_one_graph_do_not_mix() {
    let vars: Vec<Tensor> =
        transformer_inputs().iter().map(|t| Var::from_tensor(t).unwrap().as_tensor().clone()).collect();
    let loss = loss(&fast_transformer(&vars).unwrap());
    let run = || {
        let grads = loss.backward().unwrap();
        vars.iter().flat_map(|v| gradient(&grads, v)).collect::<Vec<_>>()
    };
    let first = run();
    std::thread::scope(|scope| {
        let passes: Vec<_> = (0..3).map(|_| scope.spawn(run)).collect();
        assert!(passes.into_iter().all(|pass| pass.join().unwrap() == first));
    });
}

#[test]
fn training_moves_the_weights_it_reads() {
    // A layer kept for all steps, its variable written in place: the loss must follow.
    let (x, target) = (noise(1, &[64, 10], 1.0), noise(2, &[64, 4], 1.0));
    let weight = Var::from_tensor(&noise(3, &[4, 10], 0.1)).unwrap();
    let layer = Linear::new(weight.as_tensor().clone(), None);
    layer.prepare().unwrap();
    let mut losses = Vec::new();
    for _ in 0..60 {
        let y = linear(&x, &layer, Activation::None, None).unwrap();
        let error = (y - &target).unwrap().sqr().unwrap().mean_all().unwrap();
        let grads = error.backward().unwrap();
        let step = (grads.get(&weight).unwrap() * 0.5).unwrap();
        weight.set(&(weight.as_tensor() - step).unwrap()).unwrap();
        losses.push(error.to_scalar::<f32>().unwrap());
    }
    assert!(losses.windows(2).all(|pair| pair[1] <= pair[0] * 1.0001), "{losses:?}");
    assert!(losses[59] < 0.95 * losses[0], "{losses:?}");
}
