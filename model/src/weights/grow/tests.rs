use candle_core::{D, Var};

use super::*;
use crate::clip::ClipBatch;
use crate::config::{MaskDecoder, VelocityKind};
use crate::network::{ClipOutput, Storm};
use crate::train::{ClipOptions, ClipPlan};
use crate::weights::{shipped, tensor_specs, untrained};

fn flat(x: &Tensor) -> Vec<f32> {
    x.flatten_all().unwrap().to_vec1().unwrap()
}

/// A window of a procedural drive.
fn window(width: usize, height: usize) -> ClipBatch {
    let options = ClipOptions { width, height, cameras: 2, timesteps: 2, ..ClipOptions::default() };
    ClipPlan::of_drive(30_500, &options).make(&options, &ModelConfig::preset("tiny").unwrap()).unwrap().context
}

/// The same window at half the size, each pixel the average of four.
fn halved(clip: &ClipBatch) -> ClipBatch {
    let [b, t, v, h, w] = clip.dims().unwrap();
    let blocks = clip.image.reshape((b * t * v * 3, h / 2, 2, w / 2, 2)).unwrap();
    let image = blocks.mean(4).unwrap().mean(2).unwrap().reshape((b, t, v, 3, h / 2, w / 2)).unwrap();
    let half = Tensor::new(&[0.5f32, 0.5, 1.0], &Device::Cpu).unwrap().reshape((3, 1)).unwrap();
    ClipBatch { image, intrinsics: clip.intrinsics.broadcast_mul(&half).unwrap(), ..clip.clone() }
}

/// A network with weights that are neither zero nor one anywhere, as after training.
fn trained(config: &ModelConfig) -> Tensors {
    let mut tensors = untrained(config, 3, &Device::Cpu).unwrap();
    for (k, (_, x)) in tensors.iter_mut().enumerate().filter(|(_, (name, _))| *name != "max_scale") {
        let noise = crate::kernels::tests::noise(k as u64, x.elem_count(), 0.05);
        *x = (&*x + Tensor::from_vec(noise, x.dims(), &Device::Cpu).unwrap()).unwrap();
    }
    tensors
}

fn small() -> ModelConfig {
    ModelConfig {
        embed_dim: 32,
        depth: 2,
        num_heads: 2,
        patch_size: 4,
        image_height: 16,
        image_width: 24,
        upsampler_widths: vec![12, 8],
        projected_motion_dim: 6,
        key_hidden: 8,
        basis_hidden: 8,
        num_motion_tokens: 4,
        num_cams: 2,
        ..ModelConfig::preset("tiny").unwrap()
    }
}

fn run(config: &ModelConfig, tensors: &Tensors, clip: &ClipBatch) -> ClipOutput {
    Storm::new(config, tensors).unwrap().forward(clip).unwrap()
}

/// The largest differences of two passes' results, each over the largest value of its tensor.
fn differences(a: &ClipOutput, b: &ClipOutput) -> Vec<(&'static str, f32)> {
    let over_largest = |a: &Tensor, b: &Tensor| {
        let largest = flat(a).into_iter().fold(0f32, |m, x| m.max(x.abs()));
        let worst = flat(a)
            .into_iter()
            .zip(flat(b))
            .map(|(a, b)| (a - b).abs())
            .fold(0f32, |m, x| if x.is_nan() { x } else { m.max(x) });
        assert_eq!(a.dims(), b.dims());
        worst / largest.max(1e-9)
    };
    let mut all = vec![
        ("means", over_largest(&a.means, &b.means)),
        ("scales", over_largest(&a.scales, &b.scales)),
        ("quats", over_largest(&a.quats, &b.quats)),
        ("opacities", over_largest(&a.opacities, &b.opacities)),
        ("colors", over_largest(&a.colors, &b.colors)),
        ("velocity", over_largest(&a.velocity_forward, &b.velocity_forward)),
        ("velocity back", over_largest(&a.velocity_backward, &b.velocity_backward)),
    ];
    if let (Some(a), Some(b)) = (&a.affine, &b.affine) {
        all.push(("affine", over_largest(a, b)));
    }
    let directions = Tensor::new(&[[[0.1f32, -0.3, 1.0], [1.0, 0.2, 0.5]]], &Device::Cpu).unwrap();
    if let (Some(a), Some(b)) = (a.sky_color(&directions).unwrap(), b.sky_color(&directions).unwrap()) {
        all.push(("sky", over_largest(&a, &b)));
    }
    all
}

#[track_caller]
fn assert_same(a: &ClipOutput, b: &ClipOutput, within: f32, what: &str) {
    for (name, off) in differences(a, b) {
        assert!(off <= within, "{what}: {name} differ by {off:e} of the largest");
    }
}

#[test]
fn larger_patches_see_the_averages_of_the_image() {
    let (config, tensors) = shipped(&Device::Cpu).unwrap();
    let to = ModelConfig { patch_size: 16, image_height: 128, image_width: 192, ..config.clone() };
    let grown = grow(&config, &tensors, &to, 1).unwrap();
    let clip = window(192, 128);
    let (small, large) = (run(&config, &tensors, &halved(&clip)), run(&to, &grown, &clip));
    // Every second pixel: the same cells, whose Gaussians are half as large.
    let first_child = |x: &Tensor| {
        let pick = |x: Tensor, axis: usize| {
            let places: Vec<u32> = (0..x.dim(axis).unwrap() as u32).step_by(2).collect();
            x.index_select(&Tensor::new(places, &Device::Cpu).unwrap(), axis).unwrap()
        };
        pick(pick(x.clone(), 3), 4)
    };
    let worst = |a: &Tensor, b: &Tensor, f: fn(f32, f32) -> f32| {
        assert_eq!(a.dims(), b.dims());
        flat(a).into_iter().zip(flat(b)).map(|(a, b)| f(a, b).abs()).fold(0f32, f32::max)
    };
    let ratio = |a: f32, b: f32| (a / b).ln();
    // What is left: a block's mean of unit directions and moments is not that of its centre's ray.
    assert!(worst(&first_child(&large.depths), &small.depths, ratio) < 1e-2);
    let scales = (&large.scales * 2.0).unwrap();
    let unclamped = |a: f32, b: f32| if b < 0.49 { (a / b).ln() } else { 0.0 };
    assert!(worst(&first_child(&scales), &small.scales, unclamped) < 2e-2);
    let difference = |a: f32, b: f32| a - b;
    assert!(worst(&first_child(&large.opacities), &small.opacities, difference) < 1e-2);
    assert!(worst(&first_child(&large.velocity_forward), &small.velocity_forward, difference) < 0.05);
    let (a, b) = (large.motion_weights.as_ref().unwrap(), small.motion_weights.as_ref().unwrap());
    assert!(worst(&first_child(a), b, difference) < 1e-2);
    // What is added to a colour is the cell's, and so is all of the block's depth.
    let added = |output: &ClipOutput, clip: &ClipBatch| {
        (&output.colors - clip.image.permute((0, 1, 2, 4, 5, 3)).unwrap()).unwrap()
    };
    assert!(worst(&first_child(&added(&large, &clip)), &added(&small, &halved(&clip)), difference) < 1e-2);
    let lines = large.depths.reshape((4, 64, 2, 96, 2)).unwrap();
    let spread = (lines.max(4).unwrap().max(2).unwrap() - lines.min(4).unwrap().min(2).unwrap()).unwrap();
    assert!(flat(&spread).into_iter().all(|x| x == 0.0), "a block has one depth");
}

#[test]
fn another_image_size_is_what_the_network_does_with_it_anyway() {
    let (config, tensors) = shipped(&Device::Cpu).unwrap();
    let to = ModelConfig { image_height: 80, image_width: 120, ..config.clone() };
    let grown = grow(&config, &tensors, &to, 1).unwrap();
    assert_eq!(grown["pos_embed"].dims(), [1, 150, 192]);
    let clip = window(120, 80);
    assert_same(&run(&config, &tensors, &clip), &run(&to, &grown, &clip), 0.0, "image size");
}

#[test]
fn wider_and_deeper_networks_give_the_same() {
    let clip = window(24, 16);
    let base = small();
    let bases = [
        base.clone(),
        ModelConfig { velocity: VelocityKind::ForwardBackward, mask_decoder: MaskDecoder::Paper, ..base.clone() },
        ModelConfig { num_motion_tokens: 0, ..base.clone() },
        ModelConfig { sweep_after_block: 1, ..base.clone() },
        ModelConfig { use_sky_token: false, use_affine_token: false, disable_pos_embed: true, ..base },
    ];
    for from in bases {
        let tensors = trained(&from);
        let before = run(&from, &tensors, &clip);
        let wider: [(&str, ModelConfig); 10] = [
            ("heads", ModelConfig { embed_dim: 48, num_heads: 3, ..from.clone() }),
            ("twice as wide", ModelConfig { embed_dim: 64, num_heads: 4, ..from.clone() }),
            ("mlp_ratio", ModelConfig { mlp_ratio: 6, ..from.clone() }),
            ("upsampler", ModelConfig { upsampler_widths: vec![14, 16], ..from.clone() }),
            ("keys", ModelConfig { key_hidden: 12, ..from.clone() }),
            ("bases", ModelConfig { basis_hidden: 9, ..from.clone() }),
            ("motion channels", ModelConfig { projected_motion_dim: 8, ..from.clone() }),
            ("depth", ModelConfig { depth: 4, ..from.clone() }),
            ("sweep", ModelConfig { sweep_after_block: 1, ..from.clone() }),
            (
                "all",
                ModelConfig {
                    embed_dim: 48,
                    num_heads: 3,
                    mlp_ratio: 5,
                    upsampler_widths: vec![14, 16],
                    key_hidden: 12,
                    basis_hidden: 9,
                    projected_motion_dim: 8,
                    depth: 3,
                    num_cams: 4,
                    ..from.clone()
                },
            ),
        ];
        for (what, to) in wider {
            let grown = grow(&from, &tensors, &to, 5).unwrap();
            assert_same(&before, &run(&to, &grown, &clip), 2e-4, what);
            // New entries are not all zero: one side of them is ready to learn from.
            let count = |tensors: &Tensors| tensors.values().flat_map(flat).filter(|x| *x != 0.0).count();
            let more = count(&grown) > count(&tensors);
            assert_eq!(more, to != from && !(what == "keys" && from.mask_decoder == MaskDecoder::Paper), "{what}");
        }
    }
}

#[test]
fn new_parts_learn_from_the_first_step_on() {
    let (from, clip) = (small(), window(24, 16));
    let to = ModelConfig { embed_dim: 48, num_heads: 3, depth: 3, ..from.clone() };
    let grown = grow(&from, &trained(&from), &to, 5).unwrap();
    let vars: std::collections::BTreeMap<_, _> =
        grown.iter().map(|(name, x)| (name.clone(), Var::from_tensor(x).unwrap())).collect();
    let tensors: Tensors = vars.iter().map(|(name, x)| (name.clone(), x.as_tensor().clone())).collect();
    let output = run(&to, &tensors, &clip);
    let loss = (output.depths.log().unwrap().sqr().unwrap().mean_all().unwrap()
        + output.velocity_forward.sqr().unwrap().mean_all().unwrap())
    .unwrap();
    let grads = loss.backward().unwrap();
    let gradient = |name: &str| grads.get(vars[name].as_tensor()).unwrap().clone();
    let largest = |x: Tensor| flat(&x).into_iter().fold(0f32, |m, x| m.max(x.abs()));
    // What writes to the new channels, what comes out of the new head, what the new block adds.
    assert!(largest(gradient("patch_embed.proj.weight").narrow(0, 32, 16).unwrap()) > 0.0);
    assert!(largest(gradient("transformer.blocks.0.attn.proj.weight").narrow(1, 32, 16).unwrap()) > 0.0);
    assert!(largest(gradient("transformer.blocks.2.mlp.fc2.weight")) > 0.0);
}

#[test]
fn more_motion_tokens_and_cameras_change_little() {
    let clip = window(24, 16);
    for from in [small(), ModelConfig { num_motion_tokens: 5, ..small() }, small().with_paper_choices()] {
        let from = ModelConfig { num_cams: 2, ..from };
        let tensors = trained(&from);
        let had = from.num_motion_tokens;
        let to = ModelConfig { num_motion_tokens: had + 2, projected_motion_dim: 7, num_cams: 3, ..from.clone() };
        let grown = grow(&from, &tensors, &to, 5).unwrap();
        let (before, after) = (run(&from, &tensors, &clip), run(&to, &grown, &clip));
        // Two tokens more among the 56 of this window; 1,172 is usual.
        assert_same(&before, &after, 0.05, "motion tokens");
        let groups = after.motion_weights.unwrap();
        assert_eq!(groups.dim(D::Minus1).unwrap(), had + 2);
        let kept = flat(&groups).chunks_exact(had + 2).map(|row| row.iter().sum::<f32>()).fold(0f32, f32::max);
        assert!((kept - 1.0).abs() < 1e-5);
    }
}

#[test]
fn every_tensor_of_every_choice_has_a_rule() {
    for from in [small(), small().with_paper_choices(), ModelConfig { num_motion_tokens: 0, ..small() }] {
        let to = ModelConfig { embed_dim: 48, num_heads: 3, ..from.clone() };
        let grown = grow(&from, &trained(&from), &to, 1).unwrap();
        assert_eq!(grown.len(), tensor_specs(&to).len());
    }
}

#[test]
fn what_is_no_growth_is_refused_with_both_values() {
    let from = small();
    let swept = ModelConfig { sweep_after_block: 1, ..from.clone() };
    let error = grow(&swept, &trained(&swept), &from, 1).unwrap_err().to_string();
    assert!(error.contains("sweep_after_block from 1 to 0"), "{error}");
    let tensors = trained(&from);
    type Change = fn(&mut ModelConfig);
    let cases: [(Change, &str, &str, &str); 16] = [
        (|c| (c.patch_size, c.upsampler_widths) = (2, vec![12]), "patch_size", "4", "2"),
        (|c| (c.embed_dim, c.num_heads) = (16, 1), "embed_dim", "32", "16"),
        (|c| c.num_heads = 4, "num_heads", "2", "4"),
        (|c| c.embed_dim = 48, "num_heads", "16", "24"),
        (|c| c.depth = 1, "depth", "2", "1"),
        (|c| c.mlp_ratio = 2, "mlp_ratio", "4", "2"),
        (|c| c.image_width = 16, "image size", "24", "16"),
        (|c| (c.patch_size, c.image_width) = (8, 40), "image size", "24", "40"),
        (|c| (c.patch_size, c.image_height, c.image_width) = (8, 32, 48), "", "", ""),
        (|c| c.num_motion_tokens = 2, "num_motion_tokens", "4", "2"),
        (|c| c.num_motion_tokens = 6, "num_motion_tokens", "4", "projected_motion_dim 7"),
        (|c| (c.num_motion_tokens, c.projected_motion_dim) = (5, 8), "num_motion_tokens", "4", "even"),
        (|c| c.upsampler_widths = vec![8], "upsampler_widths", "[12, 8]", "[8]"),
        (|c| c.upsampler_widths = vec![12, 6], "upsampler_widths", "[12, 8]", "[12, 6]"),
        (|c| c.far = 300.0, "far", "200", "300"),
        (|c| c.mask_decoder = MaskDecoder::Paper, "mask_decoder", "authors", "paper"),
    ];
    for (change, field, a, b) in cases {
        let mut to = from.clone();
        change(&mut to);
        let result = grow(&from, &tensors, &to, 1);
        if field.is_empty() {
            assert!(result.is_ok());
            continue;
        }
        let error = result.unwrap_err().to_string();
        assert!([field, a, b].iter().all(|part| error.contains(part)), "{field}: {error}");
    }
    // What is done with the results is free.
    let free = ModelConfig { time_fade_sec: 0.7, flow_gate_mps: 0.0, ..from.clone() };
    assert_eq!(grow(&from, &tensors, &free, 1).unwrap().len(), tensors.len());
    assert!(grow(&ModelConfig { depth: 1, ..from.clone() }, &tensors, &from, 1).is_err(), "not its tensors");
}
