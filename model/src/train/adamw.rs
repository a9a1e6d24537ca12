//! AdamW with decoupled weight decay (and, where chosen, Muon), and clipping by the global gradient norm.
//!
//! Plain loops over plain numbers, tensors in parallel: each tensor is walked by one thread in order and norms are summed
//! in the tensors' order, so the result does not depend on the number of threads.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::muon::{self, Optimizer};

/// AdamW's constants.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AdamOptions {
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Added to the root of the second moment.
    pub eps: f64,
    /// Decoupled decay per step, times the learning rate; only on the weights that have it.
    pub weight_decay: f64,
    /// Gradients longer than this (all tensors together) are scaled down to it; 0 never.
    pub clip_norm: f64,
    /// Learning rate of the velocity bases' decoder over that of all else: how far bases get from where they start.
    pub basis_rate: f64,
}

impl Default for AdamOptions {
    fn default() -> Self {
        Self { beta1: 0.9, beta2: 0.95, eps: 1e-8, weight_decay: 0.05, clip_norm: 3.0, basis_rate: 1.0 }
    }
}

/// One trained tensor and what AdamW remembers of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Slot {
    /// The tensor's name.
    pub name: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// Its values.
    pub weight: Vec<f32>,
    /// First moment.
    pub first: Vec<f32>,
    /// Second moment.
    pub second: Vec<f32>,
    /// Moving average of the values.
    pub average: Vec<f32>,
    /// Whether it decays.
    pub decays: bool,
}

impl Slot {
    /// A tensor before its first step.
    pub fn new(name: &str, shape: &[usize], weight: Vec<f32>) -> Self {
        let zeros = vec![0.0; weight.len()];
        Self {
            name: name.to_owned(),
            shape: shape.to_vec(),
            average: weight.clone(),
            first: zeros.clone(),
            second: zeros,
            weight,
            decays: decays(name, shape),
        }
    }
}

/// Norms, biases, tokens and position embeddings keep their size.
fn decays(name: &str, shape: &[usize]) -> bool {
    shape.len() >= 2 && !name.ends_with("_token") && !name.ends_with("_tokens") && name != "pos_embed"
}

/// What the learning rate of a tensor is multiplied by.
fn rate_factor(name: &str, options: &AdamOptions) -> f64 {
    if name.starts_with("motion_basis_decoder") { options.basis_rate } else { 1.0 }
}

/// Length of all gradients together; a missing gradient is zero.
pub fn global_norm(gradients: &[Option<Vec<f32>>]) -> f64 {
    let square = |g: &Option<Vec<f32>>| g.iter().flatten().map(|&x| f64::from(x) * f64::from(x)).sum::<f64>();
    let squares: Vec<f64> = gradients.par_iter().map(square).collect();
    squares.iter().sum::<f64>().sqrt()
}

/// One step of all tensors: clip, AdamW or Muon, moving average. `step` counts from 0; `gradients` in the slots' order.
///
/// Returns the gradients' norm before clipping.
pub fn step(
    slots: &mut [Slot],
    gradients: &[Option<Vec<f32>>],
    step: u64,
    learning_rate: f64,
    average_decay: f64,
    optimizer: Optimizer,
    options: &AdamOptions,
) -> candle_core::Result<f64> {
    let norm = global_norm(gradients);
    let clip = if options.clip_norm > 0.0 && norm > options.clip_norm { options.clip_norm / norm } else { 1.0 };
    let power = i32::try_from(step + 1).unwrap_or(i32::MAX);
    let (fix1, fix2) = (1.0 - options.beta1.powi(power), 1.0 - options.beta2.powi(power));
    let (b1, b2) = (options.beta1 as f32, options.beta2 as f32);
    let (root, eps) = ((1.0 / fix2.sqrt()) as f32, options.eps as f32);
    // An average over the first steps would mostly remember the untrained network.
    let keep = average_decay.min((1.0 + step as f64) / (10.0 + step as f64)) as f32;
    let clip = clip as f32;
    slots.par_iter_mut().zip(gradients).try_for_each(|(slot, gradient)| {
        let learning_rate = learning_rate * rate_factor(&slot.name, options);
        let rate = (learning_rate / fix1) as f32;
        let shrink = if slot.decays { (1.0 - learning_rate * options.weight_decay) as f32 } else { 1.0 };
        let Slot { name, shape, weight, first, second, average, .. } = slot;
        let clipped = |i: usize| gradient.as_ref().map_or(0.0, |g| g[i] * clip);
        if optimizer == Optimizer::Muon && muon::takes(name, shape) {
            let gradient: Vec<f32> = (0..weight.len()).map(clipped).collect();
            let update = muon::update(name, shape, &gradient, first)?;
            for (w, u) in weight.iter_mut().zip(update) {
                *w = shrink * *w - learning_rate as f32 * u;
            }
        } else {
            for i in 0..weight.len() {
                let g = clipped(i);
                first[i] = b1 * first[i] + (1.0 - b1) * g;
                second[i] = b2 * second[i] + (1.0 - b2) * g * g;
                weight[i] = shrink * weight[i] - rate * first[i] / (root * second[i].sqrt() + eps);
            }
        }
        for (a, w) in average.iter_mut().zip(weight) {
            *a = keep * *a + (1.0 - keep) * *w;
        }
        candle_core::Result::Ok(())
    })?;
    Ok(norm)
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Tensor, Var};
    use candle_nn::{Optimizer, ParamsAdamW};

    use super::*;

    /// Difference to candle's AdamW, which rounds in another order.
    const ROUNDING: f32 = 2e-6;

    #[test]
    fn steps_as_candles_adamw_does() {
        let start: Vec<f32> = (0..12).map(|i| (i as f32 * 0.7).sin()).collect();
        let var = Var::from_tensor(&Tensor::from_vec(start.clone(), (3, 4), &Device::Cpu).unwrap()).unwrap();
        let options = AdamOptions { clip_norm: 0.0, ..AdamOptions::default() };
        let params = ParamsAdamW { lr: 0.01, beta1: 0.9, beta2: 0.95, eps: 1e-8, weight_decay: 0.05 };
        let mut theirs = candle_nn::AdamW::new(vec![var.clone()], params).unwrap();
        let mut slots = [Slot::new("a.weight", &[3, 4], start)];
        for k in 0..20 {
            let loss = (var.as_tensor() - f64::from(k % 3)).unwrap().sqr().unwrap().sum_all().unwrap();
            let grads = loss.backward().unwrap();
            let g = grads.get(&var).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
            step(&mut slots, &[Some(g)], k as u64, 0.01, 0.999, muon::Optimizer::AdamW, &options).unwrap();
            theirs.step(&grads).unwrap();
        }
        let want = var.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for (a, b) in slots[0].weight.iter().zip(want) {
            assert!((a - b).abs() <= ROUNDING, "{a} for {b}");
        }
    }

    #[test]
    fn only_the_bases_decoder_has_its_own_rate() {
        let options = AdamOptions { basis_rate: 10.0, weight_decay: 0.0, ..AdamOptions::default() };
        let names = ["motion_basis_decoder.fc2.bias", "motion_query_heads.0.fc1.bias"];
        let mut slots = names.map(|name| Slot::new(name, &[1], vec![0.0]));
        let gradients = [Some(vec![1.0]), Some(vec![1.0])];
        step(&mut slots, &gradients, 0, 1e-3, 0.9, muon::Optimizer::AdamW, &options).unwrap();
        assert!((slots[0].weight[0] + 1e-2).abs() < 1e-6 && (slots[1].weight[0] + 1e-3).abs() < 1e-7);
    }

    #[test]
    fn long_gradients_are_clipped_and_norms_do_not_decay() {
        let options = AdamOptions { clip_norm: 1.0, ..AdamOptions::default() };
        let mut slots = [Slot::new("norm.weight", &[2], vec![1.0; 2]), Slot::new("x.weight", &[1, 2], vec![1.0; 2])];
        assert!(!slots[0].decays && slots[1].decays);
        assert!(!Slot::new("motion_tokens", &[1, 2, 3], vec![0.0; 6]).decays);
        let gradients = [Some(vec![3.0, 0.0]), Some(vec![0.0, 4.0])];
        let norm = step(&mut slots, &gradients, 0, 0.1, 0.9, muon::Optimizer::AdamW, &options).unwrap();
        assert_eq!(norm, 5.0);
        // First moments hold a tenth of the clipped gradient.
        assert!((slots[0].first[0] - 0.06).abs() < 1e-7 && (slots[1].first[1] - 0.08).abs() < 1e-7);
        assert_eq!(slots[0].weight[1], 1.0);
        assert!((slots[1].weight[0] - (1.0 - 0.1 * 0.05)).abs() < 1e-7);
    }
}
