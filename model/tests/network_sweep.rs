//! The velocity sweep within the network: nothing changes while its last layer is zero, shortcuts go with it, gradients are right.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use candle_core::{Device, Tensor, Var};
use storm_model::train::{ClipOptions, ClipPlan, PixelLossOptions, TrainClip, pixel_losses};
use storm_model::weights::{Tensors, untrained};
use storm_model::{ModelConfig, Shortcuts, Storm};

fn config() -> ModelConfig {
    ModelConfig {
        embed_dim: 32,
        depth: 3,
        num_heads: 2,
        image_height: 16,
        image_width: 24,
        upsampler_widths: vec![16, 16, 8],
        num_motion_tokens: 4,
        sweep_after_block: 2,
        ..ModelConfig::preset("tiny").unwrap()
    }
}

fn clip(config: &ModelConfig, prior_sec: f64) -> TrainClip {
    let options = ClipOptions { width: 24, height: 16, timesteps: 3, targets: 0, prior_sec, ..ClipOptions::default() };
    ClipPlan::training(3, 1, &options).make(&options, config).unwrap()
}

fn values(x: &Tensor) -> Vec<f32> {
    x.flatten_all().unwrap().to_vec1().unwrap()
}

/// Weights whose last sweep layer is not zero.
fn taught(config: &ModelConfig) -> Tensors {
    let mut tensors = untrained(config, 2, &Device::Cpu).unwrap();
    let shape = tensors["sweep.inject.weight"].dims().to_vec();
    let count: usize = shape.iter().product();
    let wave: Vec<f32> = (0..count).map(|i| 0.02 * (i as f32 * 0.37).sin()).collect();
    tensors.insert("sweep.inject.weight".into(), Tensor::from_vec(wave, shape, &Device::Cpu).unwrap());
    tensors
}

#[test]
fn a_sweep_whose_last_layer_is_zero_changes_nothing() {
    let config = config();
    let clip = clip(&config, 0.1);
    let tensors = untrained(&config, 2, &Device::Cpu).unwrap();
    let plain_config = ModelConfig { sweep_after_block: 0, ..config.clone() };
    let plain = tensors.iter().filter(|(name, _)| !name.starts_with("sweep."));
    let plain: Tensors = plain.map(|(name, x)| (name.clone(), x.clone())).collect();
    let with = Storm::new(&config, &tensors).unwrap().forward(&clip.context).unwrap();
    let without = Storm::new(&plain_config, &plain).unwrap().forward(&clip.context).unwrap();
    assert_eq!(values(&with.means), values(&without.means));
    assert_eq!(values(&with.velocity_forward), values(&without.velocity_forward));
    assert!(with.swept_depths.is_some() && without.swept_depths.is_none());
}

#[test]
fn prior_images_and_neighbours_are_seen() {
    let config = config();
    let storm = Storm::new(&config, &taught(&config)).unwrap();
    let full = clip(&config, 0.1);
    let depths = |clip: &TrainClip| values(&storm.forward(&clip.context).unwrap().depths);
    let with = depths(&full);
    let without = depths(&clip(&config, 0.0));
    assert!(with.iter().zip(&without).any(|(a, b)| (a - b).abs() > 1e-3));
    // Windows of one batch are swept each by themselves.
    let two = TrainClip::stack(&[full.clone(), clip(&config, 0.1)]).unwrap();
    let both = depths(&two);
    let worst = both.chunks_exact(with.len()).flat_map(|half| half.iter().zip(&with)).map(|(a, b)| (a / b - 1.0).abs());
    assert!(worst.fold(0f32, f32::max) < 1e-4);
}

#[test]
fn shortcuts_that_leave_everything_in_change_nothing_and_others_stay_near() {
    let config = config();
    let storm = Storm::new(&config, &taught(&config)).unwrap();
    let context = clip(&config, 0.1).context;
    let exact = values(&storm.forward(&context).unwrap().depths);
    let patches = 3 * 3 * 6;
    let all = Shortcuts { keep: Some(vec![true; patches]), ..Shortcuts::default() };
    assert_eq!(values(&storm.forward_with(&context, &all).unwrap().depths), exact);
    let mut keep = vec![true; patches];
    keep[3] = false;
    let some = Shortcuts { keep: Some(keep), merge: 0.1, ..Shortcuts::default() };
    let near = values(&storm.forward_with(&context, &some).unwrap().depths);
    assert!(near.iter().all(|x| x.is_finite()) && near.len() == exact.len());
    let (output, kept) = storm.forward_keeping(&context, Default::default()).unwrap();
    let worst = values(&output.depths).iter().zip(&exact).map(|(a, b)| (a / b - 1.0).abs()).fold(0f32, f32::max);
    assert!(worst < 1e-4, "{worst}");
    let (again, _) = storm.forward_reusing(&context, &kept, Default::default()).unwrap();
    assert!(values(&again.depths).iter().all(|x| x.is_finite()));
}

#[test]
fn prior_images_of_another_shape_are_refused() {
    let config = config();
    let mut context = clip(&config, 0.1).context;
    let prior = context.prior.as_mut().unwrap();
    prior.image = prior.image.narrow(1, 0, 2).unwrap();
    let error = Storm::new(&config, &taught(&config)).unwrap().forward(&context).unwrap_err().to_string();
    assert!(error.contains("intrinsics") || error.contains("prior"), "{error}");
}

#[test]
fn gradients_through_the_sweep_are_those_of_differences() {
    let config = config();
    let clip = clip(&config, 0.1);
    let tensors = taught(&config);
    let options = PixelLossOptions::default();
    let names = ["sweep.inject.weight", "sweep.depth.bias", "transformer.blocks.0.mlp.fc2.bias"];
    let total = |change: Option<(&str, usize, f32)>, train: bool| {
        let (mut own, mut vars) = (tensors.clone(), Vec::new());
        for name in names {
            let mut x = values(&own[name]);
            if let Some((_, at, by)) = change.filter(|c| c.0 == name) {
                x[at] += by;
            }
            let var = Var::from_vec(x, own[name].dims().to_vec(), &Device::Cpu).unwrap();
            own.insert(name.into(), if train { var.as_tensor().clone() } else { var.as_detached_tensor() });
            vars.push(var);
        }
        let output = Storm::new(&config, &own).unwrap().forward(&clip.context).unwrap();
        let terms = pixel_losses(&output, &clip, &options).unwrap();
        // The evidence itself is not differentiated: where the swept depth moves, only its own term may be compared.
        let depth_only = |name: &str| name.starts_with("sweep.depth");
        let named = change.is_some_and(|c| depth_only(c.0));
        let value = terms.iter().filter(|(n, _)| !named || *n == "swept_depth").map(|(_, x)| x.clone());
        (value.reduce(|a, b| (a + b).unwrap()).unwrap(), vars, terms)
    };
    for name in &names[..2] {
        let at_change = (*name, 0, 0.0);
        let (value, vars, _) = total(Some(at_change), true);
        let grads = value.backward().unwrap();
        let k = names.iter().position(|n| n == name).unwrap();
        let gradient = values(grads.get(&vars[k]).unwrap());
        let largest = gradient.iter().fold(0f32, |m, x| m.max(x.abs()));
        let at = gradient.iter().position(|x| x.abs() == largest).unwrap();
        let step = 1e-2;
        let side = |by: f32| f64::from(total(Some((*name, at, by)), false).0.to_scalar::<f32>().unwrap());
        let difference = (side(step) - side(-step)) / f64::from(2.0 * step);
        let error = (difference - f64::from(gradient[at])).abs() / f64::from(largest);
        assert!(error < 0.03, "{name}: {difference} for {}", gradient[at]);
    }
}
