//! The network under every choice, window shape and bad input, on a small untrained network.
#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use candle_core::{DType, Device, Tensor, Var};
use glam::{Affine3A, Quat, Vec3};
use storm_model::config::{
    AffineKind, ColorBase, DepthActivation, DepthMeaning, MaskDecoder, RayPixelOffset, SkyKind, VelocityKind,
};
use storm_model::scene::Want;
use storm_model::weights::{Tensors, untrained};
use storm_model::{ClipBatch, ModelConfig, ModelError, PixelLayout, Stages, Storm, ViewInput};
use storm_render::raster::CpuRasterizer;
use storm_render::{Intrinsics, View};

fn small() -> ModelConfig {
    ModelConfig {
        embed_dim: 32,
        depth: 2,
        num_heads: 2,
        patch_size: 4,
        image_height: 8,
        image_width: 12,
        upsampler_widths: vec![12, 8],
        projected_motion_dim: 6,
        key_hidden: 16,
        basis_hidden: 16,
        num_motion_tokens: 3,
        ..ModelConfig::default()
    }
}

fn intrinsics(height: usize, width: usize) -> Intrinsics {
    Intrinsics::from_fov(70.0, width, height)
}

/// Camera `v` at timestep `t`: forward is world x, 0.4 m further every step, cameras fanned out.
fn pose(t: usize, v: usize) -> Affine3A {
    let yaw = Quat::from_rotation_z(0.5 - 0.5 * v as f32);
    let optical = Quat::from_mat3(&glam::Mat3::from_cols(-Vec3::Y, -Vec3::Z, Vec3::X));
    Affine3A::from_rotation_translation(yaw * optical, Vec3::new(0.4 * t as f32, 0.1 * v as f32, 0.0))
}

fn clip(t: usize, v: usize, height: usize, width: usize) -> ClipBatch {
    let wave =
        |seed: usize| -> Vec<f32> { (0..3 * height * width).map(|i| (0.13 * i as f32 + seed as f32).sin()).collect() };
    let images: Vec<Vec<Vec<f32>>> = (0..t).map(|t| (0..v).map(|v| wave(7 * t + v)).collect()).collect();
    let view = |ti: usize, vi: usize| ViewInput {
        rgb: &images[ti][vi],
        intrinsics: intrinsics(height, width),
        world_from_camera: pose(ti, vi),
        time_sec: 0.5 * ti as f32,
        valid: None,
    };
    let views: Vec<Vec<ViewInput<'_>>> = (0..t).map(|ti| (0..v).map(|vi| view(ti, vi)).collect()).collect();
    ClipBatch::from_views(&views, PixelLayout::Hwc, 2.0, &Device::Cpu).unwrap()
}

fn values(x: &Tensor) -> Vec<f32> {
    x.flatten_all().unwrap().to_vec1().unwrap()
}

fn worst(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, |m, d| if d > m || d.is_nan() { d } else { m })
}

#[test]
fn every_choice_runs_and_renders() {
    let base = small();
    let paper = small().with_paper_choices();
    let configs = [
        base.clone(),
        paper.clone(),
        ModelConfig { num_motion_tokens: 0, ..base.clone() },
        ModelConfig { num_motion_tokens: 0, ..paper.clone() },
        ModelConfig { use_sky_token: false, use_affine_token: false, ..base.clone() },
        ModelConfig { disable_pos_embed: true, ..base.clone() },
        ModelConfig { color: ColorBase::Residual, depth_activation: DepthActivation::Log, ..base.clone() },
        ModelConfig { sky: SkyKind::Frequency64, affine: AffineKind::MatrixBias, ..base.clone() },
        ModelConfig { mask_decoder: MaskDecoder::Paper, velocity_scale: 10.0, ..base.clone() },
        ModelConfig { upsampler_widths: vec![12], ..base },
    ];
    for config in configs {
        let storm = Storm::untrained(&config, 5, &Device::Cpu).unwrap();
        let output = storm.forward(&clip(2, 2, 8, 12)).unwrap();
        let scene = output.scene(0).unwrap();
        assert_eq!(scene.gaussians.len(), scene.shape.len());
        assert_eq!(scene.affine.len(), if config.use_affine_token { 2 } else { 0 });
        assert_eq!(scene.motion_bases.len(), config.num_motion_tokens);
        let mut rasterizer = CpuRasterizer::new(scene.raster_settings()).unwrap();
        let view = View::from_pose(pose(0, 0), intrinsics(8, 12));
        let want = Want { flow: true, motion: true };
        let targets = [(view, Some(0)), (view, None)];
        let views = scene.render(&mut rasterizer, &targets, 0.25, want).unwrap();
        assert_eq!(views.len(), 2);
        assert_eq!(views[0].motion_id.is_some(), config.num_motion_tokens > 0);
        // An untrained network shows something: surfaces at usable depths, not empty space.
        let hit: f32 = views[0].alpha.iter().sum::<f32>() / 96.0;
        assert!(hit > 0.3, "mean alpha {hit} with {config:?}");
        let mean_depth = scene.depths.iter().sum::<f32>() / scene.depths.len() as f32;
        assert!((5.0..40.0).contains(&mean_depth), "mean depth {mean_depth} m with {config:?}");
        assert!(scene.render(&mut rasterizer, &[(view, Some(2))], 0.25, want).is_err(), "camera 2 of 2");
        assert!(scene.render(&mut rasterizer, &targets, f32::NAN, want).is_err());
    }
}

#[test]
fn what_was_seen_nearer_in_time_counts_for_more() {
    let storm = Storm::untrained(&small(), 5, &Device::Cpu).unwrap();
    let mut scene = storm.forward(&clip(2, 2, 8, 12)).unwrap().scene(0).unwrap();
    let plain = scene.gaussians.opacities.clone();
    let of_first = plain.len() / 2;
    let time_sec = scene.gaussians.time_sec[0];
    assert!(scene.gaussians.time_sec[of_first] != time_sec, "two timesteps");
    Arc::make_mut(&mut scene.config).time_fade_sec = 0.0;
    assert_eq!(*scene.opacities_at(time_sec), plain);
    Arc::make_mut(&mut scene.config).time_fade_sec = 0.25;
    let faded = scene.opacities_at(time_sec).into_owned();
    let denser = |i: usize| f64::from(-faded[i]).ln_1p() / f64::from(-plain[i]).ln_1p();
    for i in 0..of_first {
        assert!(denser(i) > 1.0 && denser(of_first + i) < 1.0, "{} {}", denser(i), denser(of_first + i));
        let mean = 0.5 * (denser(i) + denser(of_first + i));
        assert!((mean - 1.0).abs() < 1e-3, "optical depth is kept on the mean: {mean}");
    }
    for fade in [1e-300, 1e-30, 1e30] {
        Arc::make_mut(&mut scene.config).time_fade_sec = fade;
        assert!(scene.opacities_at(time_sec + 100.0).iter().all(|a| (0.0..=1.0).contains(a)), "{fade}");
    }
    scene.gaussians.opacities.fill(1.0);
    assert!(scene.opacities_at(time_sec).iter().all(|a| *a == 1.0), "what is opaque stays so");
}

#[test]
fn presets_run_at_their_own_size() {
    let config = ModelConfig::preset("tiny").unwrap();
    let storm = Storm::untrained(&config, 1, &Device::Cpu).unwrap();
    let output = storm.forward(&clip(4, 3, config.image_height, config.image_width)).unwrap();
    let scene = output.scene(0).unwrap();
    let mut depths = scene.depths.clone();
    depths.sort_by(f32::total_cmp);
    let at = |share: f64| depths[(share * (depths.len() - 1) as f64) as usize];
    assert!(
        at(0.05) > 2.0 && at(0.5) > 8.0 && at(0.5) < 25.0 && at(0.95) < 80.0,
        "{} {} {}",
        at(0.05),
        at(0.5),
        at(0.95)
    );
}

#[test]
fn any_window_shape_within_the_limits() {
    let config = ModelConfig { num_cams: 6, ..small() };
    let storm = Storm::untrained(&config, 2, &Device::Cpu).unwrap();
    for (t, v, h, w) in [(1, 1, 8, 12), (10, 6, 4, 4), (3, 2, 20, 8), (2, 1, 12, 28)] {
        let output = storm.forward(&clip(t, v, h, w)).unwrap();
        assert_eq!(output.means.dims(), [1, t, v, h, w, 3]);
        output.scene(0).unwrap();
    }
    let error = storm.forward(&clip(1, 1, 6, 12)).unwrap_err().to_string();
    assert!(error.contains("12x6") && error.contains("multiples of 4"), "{error}");
    let two = Storm::untrained(&ModelConfig { num_cams: 2, ..small() }, 2, &Device::Cpu).unwrap();
    let error = two.forward(&clip(1, 3, 8, 12)).unwrap_err().to_string();
    assert!(error.contains("3 cameras") && error.contains('2'), "{error}");
}

#[test]
fn a_batch_is_its_windows() {
    let storm = Storm::untrained(&small(), 3, &Device::Cpu).unwrap();
    let (a, b) = (clip(2, 2, 8, 12), clip(2, 2, 8, 12));
    let b = ClipBatch { image: (b.image * 0.5).unwrap(), ..b };
    let both = storm.forward(&ClipBatch::stack(&[a.clone(), b.clone()]).unwrap()).unwrap();
    for (index, one) in [a, b].iter().enumerate() {
        let one = storm.forward(one).unwrap();
        // The same sums in another blocking: a few roundings of means up to 400 m.
        assert!(worst(&values(&one.means), &values(&both.means.get(index).unwrap())) < 1e-3);
        assert!(worst(&values(&one.velocity_forward), &values(&both.velocity_forward.get(index).unwrap())) < 1e-4);
        assert_eq!(both.scene(index).unwrap().shape, one.scene(0).unwrap().shape);
    }
    assert!(both.scene(2).is_err());
    let first = both.scene(0).unwrap().gaussians;
    assert_eq!(first, both.scene(0).unwrap().gaussians);
    assert_eq!(
        values(&storm.forward(&clip(2, 2, 8, 12)).unwrap().means),
        values(&storm.forward(&clip(2, 2, 8, 12)).unwrap().means)
    );
}

#[test]
fn pictures_decoded_together_are_those_decoded_one_by_one() {
    // 88 x 120 pixels: three pictures fit into one part, so a window of eight takes parts of 3, 3 and 2.
    let storm = Storm::untrained(&small(), 5, &Device::Cpu).unwrap();
    let batch = ClipBatch::stack(&[clip(4, 2, 88, 120), clip(4, 2, 88, 120)]).unwrap();
    let together = storm.forward(&batch).unwrap();
    // Asking for a stage of one picture makes the decoder go picture by picture.
    let one_by_one = storm.forward_stages(&batch, &mut Stages::only(&["motion_keys"])).unwrap();
    let pairs = [
        (&together.velocity_forward, &one_by_one.velocity_forward),
        (together.motion_weights.as_ref().unwrap(), one_by_one.motion_weights.as_ref().unwrap()),
    ];
    for (a, b) in pairs {
        assert_eq!(a.dims(), b.dims());
        assert!(worst(&values(a), &values(b)) <= 1e-6, "{}", worst(&values(a), &values(b)));
    }
}

#[test]
fn depth_meanings_place_gaussians_on_their_rays() {
    for (meaning, offset, shift) in [
        (DepthMeaning::ZDepth, RayPixelOffset::DoubleHalf, 1.0),
        (DepthMeaning::ZDepth, RayPixelOffset::Half, 0.5),
        (DepthMeaning::RayDistance, RayPixelOffset::Half, 0.5),
    ] {
        let config = ModelConfig { depth_meaning: meaning, ray_pixel_offset: offset, ..small() };
        let scene = Storm::untrained(&config, 4, &Device::Cpu).unwrap().forward(&clip(2, 2, 8, 12)).unwrap();
        let scene = scene.scene(0).unwrap();
        let range = scene.shape.picture(1, 1);
        let view = View::from_pose(pose(1, 1), intrinsics(8, 12));
        for i in range.clone() {
            let pixel = i - range.start;
            let p = view.camera_from_world.transform_point3(Vec3::from(scene.gaussians.means[i]));
            let (u, v) = view.intrinsics.project(p).unwrap();
            let (col, row) = ((pixel % 12) as f32, (pixel / 12) as f32);
            assert!((u - col - shift).abs() < 1e-3 && (v - row - shift).abs() < 1e-3, "{u} {v} for pixel {col} {row}");
            let depth = if meaning == DepthMeaning::ZDepth { p.z } else { p.length() };
            assert!((depth - scene.depths[i]).abs() < 1e-4 * depth);
        }
    }
}

#[test]
fn two_velocities_follow_equation_one() {
    let config = ModelConfig { velocity: VelocityKind::ForwardBackward, num_motion_tokens: 1, ..small() };
    let output = Storm::untrained(&config, 6, &Device::Cpu).unwrap().forward(&clip(2, 1, 8, 12)).unwrap();
    let scene = output.scene(0).unwrap();
    // With one motion token every velocity is the one basis: v- first, v+ last.
    let basis = &scene.motion_bases[0];
    let i = scene.shape.picture(1, 0).start;
    let mean = scene.gaussians.means[i];
    let earlier = scene.means_at(0.25)[i];
    let later = scene.means_at(1.0)[i];
    for axis in 0..3 {
        // Seen at 0.5 s: t' - t is -0.25 and +0.5 s.
        assert!((earlier[axis] - (mean[axis] + 0.25 * basis[axis])).abs() < 1e-5);
        assert!((later[axis] - (mean[axis] + 0.5 * basis[3 + axis])).abs() < 1e-5);
    }
    assert_eq!(scene.means_at(0.5)[i], mean);
}

#[test]
fn the_collapsed_sky_is_the_layers() {
    for sky in [SkyKind::Raw512, SkyKind::Frequency64] {
        let config = ModelConfig { sky, affine: AffineKind::MatrixBias, ..small() };
        let mut tensors = untrained(&config, 8, &Device::Cpu).unwrap();
        // Larger numbers than an untrained network's, so that every term matters.
        for (k, (name, tensor)) in tensors.iter_mut().enumerate() {
            if name.starts_with("sky_head") {
                let wave: Vec<f32> =
                    (0..tensor.elem_count()).map(|i| (0.7 * i as f32 + k as f32).sin() * 0.3).collect();
                *tensor = Tensor::from_vec(wave, tensor.shape(), &Device::Cpu).unwrap();
            }
        }
        let output = Storm::new(&config, &tensors).unwrap().forward(&clip(1, 2, 8, 12)).unwrap();
        let model = output.scene(0).unwrap().sky.unwrap();
        let directions: Vec<f32> =
            (0..300).map(|i| (1.3 * i as f32).sin() + if i % 3 == 2 { 0.2 } else { 0.0 }).collect();
        let plain: Vec<f32> =
            directions.chunks(3).flat_map(|d| model.color([0, 1, 2].map(|k| f64::from(d[k])))).collect();
        let tensor = Tensor::from_vec(directions, (1, 100, 3), &Device::Cpu).unwrap();
        let layers = values(&output.sky_color(&tensor).unwrap().unwrap());
        let scale = layers.iter().fold(0f32, |m, x| m.max(x.abs()));
        // f32 layers of up to 512 terms against f64.
        assert!(worst(&plain, &layers) < 2e-5 * scale, "{sky:?}: {} of {scale}", worst(&plain, &layers));
    }
}

#[test]
fn exposure_in_tensors_is_exposure_in_numbers() {
    for affine in [AffineKind::Gain, AffineKind::MatrixBias] {
        let config = ModelConfig { affine, ..small() };
        let mut tensors = untrained(&config, 8, &Device::Cpu).unwrap();
        let wave: Vec<f32> = (0..12).map(|i| (1.1 * i as f32).sin()).collect();
        tensors.insert("affine_linear.bias".into(), Tensor::from_vec(wave, 12, &Device::Cpu).unwrap());
        let output = Storm::new(&config, &tensors).unwrap().forward(&clip(1, 2, 8, 12)).unwrap();
        let scene = output.scene(0).unwrap();
        let colors = Tensor::new(&[[[[0.1f32, -0.4, 0.9]], [[0.5, 0.2, -0.3]]]], &Device::Cpu).unwrap();
        let ours = values(&output.apply_affine(&colors).unwrap());
        let plain = [scene.affine[0].apply([0.1, -0.4, 0.9]), scene.affine[1].apply([0.5, 0.2, -0.3])].concat();
        assert!(worst(&ours, &plain) < 1e-6);
    }
}

#[test]
fn non_finite_weights_and_inputs_are_named() {
    let mut tensors = untrained(&small(), 9, &Device::Cpu).unwrap();
    tensors.insert("gs_pred.bias".into(), Tensor::full(f32::NAN, 192, &Device::Cpu).unwrap());
    let output = Storm::new(&small(), &tensors).unwrap().forward(&clip(1, 1, 8, 12)).unwrap();
    let error = output.scene(0).unwrap_err();
    assert!(matches!(&error, ModelError::NonFinite { tensor, count } if tensor == "means" && *count == 288), "{error}");

    let storm = Storm::untrained(&small(), 9, &Device::Cpu).unwrap();
    let mut bad = clip(2, 2, 8, 12);
    let mut poses = values(&bad.world_from_camera);
    poses[16 * 3 + 7] = f32::INFINITY;
    bad.world_from_camera = Tensor::from_vec(poses, (1, 2, 2, 4, 4), &Device::Cpu).unwrap();
    let error = storm.forward(&bad).unwrap_err();
    assert!(matches!(error, ModelError::NonFiniteInput { what: "pose", camera: 1, timestep: 1, count: 1 }), "{error}");
    let mut bad = clip(2, 2, 8, 12);
    bad.time_sec = Tensor::zeros((1, 2, 3), candle_core::DType::F32, &Device::Cpu).unwrap();
    assert!(storm.forward(&bad).unwrap_err().to_string().contains("time_sec"));
}

#[test]
fn gradients_reach_every_trained_tensor_and_weights_are_followed() {
    let config = ModelConfig { ray_moment_scale: 0.1, ..small().with_paper_choices() };
    let plain = untrained(&config, 10, &Device::Cpu).unwrap();
    let vars: Vec<(String, Var)> = plain.iter().map(|(name, x)| (name.clone(), Var::from_tensor(x).unwrap())).collect();
    let tensors: Tensors = vars.iter().map(|(name, var)| (name.clone(), var.as_tensor().clone())).collect();
    let storm = Storm::new(&config, &tensors).unwrap();
    let clip = clip(2, 2, 8, 12);
    let output = storm.forward(&clip).unwrap();
    // Variables keep what the backward pass needs, plain tensors do not: both give the same numbers.
    let fast = Storm::new(&config, &plain).unwrap().forward(&clip).unwrap();
    assert!(worst(&values(&output.means), &values(&fast.means)) < 1e-3);
    assert!(worst(&values(&output.velocity_forward), &values(&fast.velocity_forward)) < 1e-4);

    let directions = Tensor::ones((1, 4, 3), candle_core::DType::F32, &Device::Cpu).unwrap();
    let sky = output.sky_color(&directions).unwrap().unwrap().reshape((1, 2, 2, 3)).unwrap();
    let image = output.apply_affine(&sky).unwrap();
    let parts = [&output.means, &output.scales, &output.quats, &output.opacities, &output.colors, &image];
    let mut loss = (output.velocity_forward.sqr().unwrap().sum_all().unwrap()
        + output.velocity_backward.sqr().unwrap().sum_all().unwrap())
    .unwrap();
    for part in parts {
        loss = (loss + part.sqr().unwrap().sum_all().unwrap()).unwrap();
    }
    let gradients = loss.backward().unwrap();
    for (name, var) in &vars {
        let gradient = gradients.get(var.as_tensor());
        if name == "max_scale" {
            continue;
        }
        let size = values(gradient.unwrap_or_else(|| panic!("{name} has no gradient")));
        assert!(size.iter().all(|x| x.is_finite()), "{name}");
        // Biases of queries' keys may cancel in the softmax; every matrix must feel the loss.
        assert!(!name.ends_with("weight") || size.iter().any(|x| *x != 0.0), "{name} has a zero gradient");
    }
    // A step on the upsampler is seen by the next forward pass.
    let (_, conv) = vars.iter().find(|(name, _)| name == "output_upscaling.0.weight").unwrap();
    conv.set(&(conv.as_tensor() * 2.0).unwrap()).unwrap();
    let after = storm.forward_stages(&clip, &mut Stages::only(&["motion_keys"])).unwrap();
    assert!(worst(&values(&after.velocity_forward), &values(&output.velocity_forward)) > 0.0);
}

/// Largest difference over 1 + the magnitude.
fn apart(a: &Tensor, b: &Tensor) -> f64 {
    let wide = |x: &Tensor| x.to_dtype(DType::F64).unwrap().flatten_all().unwrap().to_vec1::<f64>().unwrap();
    wide(a).iter().zip(wide(b)).map(|(a, b)| (a - b).abs() / (1.0 + b.abs())).fold(0.0, f64::max)
}

#[test]
fn f64_says_what_f32_says_and_more_exactly() {
    let paper = small().with_paper_choices();
    for config in [small(), ModelConfig { color: ColorBase::Residual, ..paper.clone() }, paper] {
        let tensors = untrained(&config, 3, &Device::Cpu).unwrap();
        // Another picture size than the embedding's, so that its resampling is compared too.
        let batch = clip(2, 2, 16, 12);
        let near = Storm::new(&config, &tensors).unwrap().forward(&batch).unwrap();
        let wide = Storm::in_f64(&config, &tensors).unwrap();
        let exact = wide.forward(&batch.to_dtype(DType::F64).unwrap()).unwrap();
        assert_eq!(exact.means.dtype(), DType::F64);
        for (a, b) in [
            (&near.means, &exact.means),
            (&near.colors, &exact.colors),
            (&near.velocity_forward, &exact.velocity_forward),
            (&near.opacities, &exact.opacities),
        ] {
            let error = apart(a, b);
            assert!(error > 0.0 && error < 1e-4, "{error}");
        }
        let (a, b) = (near.scene(0).unwrap(), exact.scene(0).unwrap());
        assert_eq!(a.shape, b.shape);
        assert_eq!(a.sky.is_some(), b.sky.is_some());
    }
}
