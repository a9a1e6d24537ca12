use std::sync::{Arc, Mutex};

use candle_core::{Device, Tensor, Var};
use storm_render::raster::CpuRasterizer;

use super::clips::{ClipOptions, ClipPlan, TrainClip};
use super::raster::SharedRenderer;
use super::render_stage::draw_targets;
use super::views::views;
use crate::config::{AffineKind, ModelConfig, VelocityBases, VelocityKind};
use crate::network::Storm;
use crate::scene::Want;
use crate::weights::untrained;

/// Two f32 programs of the same picture: the sky is computed by layers here and collapsed in a scene.
const SAME_PICTURE: f32 = 2e-4;

/// Central differences against the gradient, over the largest gradient, where colours are linear in the parameter.
const LINEAR: f64 = 0.01;

/// The same where Gaussians move: those below 1/255 of opacity are left out of a pixel, and that edge moves with them, which
/// differences see and no gradient does (measured here: 0.085).
const MOVING: f64 = 0.15;

fn config(velocity: VelocityKind) -> ModelConfig {
    ModelConfig {
        embed_dim: 32,
        depth: 1,
        num_heads: 2,
        image_height: 16,
        image_width: 24,
        upsampler_widths: vec![16, 16, 8],
        num_motion_tokens: 4,
        affine: AffineKind::MatrixBias,
        velocity,
        velocity_bases: VelocityBases::Learned,
        ..ModelConfig::preset("tiny").unwrap()
    }
}

fn clip(config: &ModelConfig) -> TrainClip {
    let options = ClipOptions { width: 24, height: 16, timesteps: 2, targets: 2, ..ClipOptions::default() };
    ClipPlan::training(3, 1, &options).make(&options, config).unwrap()
}

fn renderer(config: &ModelConfig) -> SharedRenderer {
    Arc::new(Mutex::new(CpuRasterizer::new(config.raster_settings()).unwrap()))
}

fn values(x: &Tensor) -> Vec<f32> {
    x.flatten_all().unwrap().to_vec1().unwrap()
}

#[test]
fn targets_are_drawn_as_a_scene_draws_them() {
    for velocity in [VelocityKind::One, VelocityKind::ForwardBackward] {
        let config = config(velocity);
        let clip = clip(&config);
        let storm = Storm::untrained(&config, 2, &Device::Cpu).unwrap();
        let output = storm.forward(&clip.context).unwrap();
        let (target, _) = clip.target.as_ref().unwrap();
        let drawn = draw_targets(&output, target, &renderer(&config)).unwrap();
        let scene = output.scene(0).unwrap();
        let mut raster = CpuRasterizer::new(scene.raster_settings()).unwrap();
        let (views, times) = (views(target).unwrap(), values(&target.time_sec));
        for k in 0..2 {
            let targets: Vec<_> = (0..3).map(|c| (views[3 * k + c], Some(c))).collect();
            let pictures = scene.render(&mut raster, &targets, times[3 * k], Want::default()).unwrap();
            for (c, picture) in pictures.iter().enumerate() {
                let pick = |x: &Tensor| values(&x.get(0).unwrap().get(k).unwrap().get(c).unwrap());
                let color: Vec<f32> = picture.color.iter().flatten().copied().collect();
                let pairs = [(pick(&drawn.image), color), (pick(&drawn.alpha), picture.alpha.clone())];
                for (got, want) in pairs {
                    let worst = got.iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0f32, f32::max);
                    assert!(got.len() == want.len() && worst <= SAME_PICTURE, "{velocity:?} {k} {c}: {worst}");
                }
            }
        }
    }
}

#[test]
fn gradients_reach_velocities_and_sky_as_differences_say() {
    let config = config(VelocityKind::One);
    let clip = clip(&config);
    let (target, _) = clip.target.as_ref().unwrap();
    let tensors = untrained(&config, 2, &Device::Cpu).unwrap();
    let renderer = renderer(&config);
    let names = ["motion_basis_decoder.fc2.bias", "sky_head.output.bias", "affine_linear.bias"];
    let loss = |change: Option<(&str, usize, f32)>, train: bool| {
        let mut own = tensors.clone();
        let mut vars = Vec::new();
        for name in names {
            let mut x = values(&own[name]);
            if let Some((_, at, by)) = change.filter(|(n, _, _)| *n == name) {
                x[at] += by;
            }
            let shape = own[name].shape().clone();
            let var = Var::from_vec(x, shape, &Device::Cpu).unwrap();
            let tensor = if train { var.as_tensor().clone() } else { var.as_detached_tensor() };
            own.insert(name.into(), tensor);
            vars.push(var);
        }
        let output = Storm::new(&config, &own).unwrap().forward(&clip.context).unwrap();
        let drawn = draw_targets(&output, target, &renderer).unwrap();
        let image = drawn.image.to_dtype(candle_core::DType::F64).unwrap();
        (image.sqr().unwrap().mean_all().unwrap(), vars)
    };
    let (value, vars) = loss(None, true);
    let grads = value.backward().unwrap();
    for (name, var) in names.iter().zip(&vars) {
        let gradient = values(grads.get(var).unwrap());
        let largest = gradient.iter().fold(0f32, |m, x| m.max(x.abs()));
        let at = gradient.iter().position(|x| x.abs() == largest).unwrap();
        assert!(largest > 0.0, "{name}");
        // Ten times as many m/s: centimetres, far below a pixel.
        let step = 5e-4;
        let side = |by: f32| loss(Some((name, at, by)), false).0.to_scalar::<f64>().unwrap();
        let difference = (side(step) - side(-step)) / f64::from(2.0 * step);
        let error = (difference - f64::from(gradient[at])).abs() / f64::from(largest);
        let allowed = if name.starts_with("motion") { MOVING } else { LINEAR };
        assert!(error < allowed, "{name}: {difference} for {}", gradient[at]);
    }
}
