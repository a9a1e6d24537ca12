//! Losses and their gradients against those of the authors' program.
#![allow(clippy::unwrap_used)]

use std::collections::HashMap;
use std::path::PathBuf;

use candle_core::{Device, Tensor, Var};
use storm_model::train::losses::{RenderLossOptions, Rendered, Target, render_losses};

/// Allowed difference of a loss value over itself: sums of some thousand f32 numbers in another order.
const VALUE: f64 = 2e-6;
/// Allowed difference of a gradient over the largest of its tensor: a few roundings of f32.
const GRADIENT: f32 = 1e-6;

fn fixture(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../tests/fixtures").join(name)
}

fn numbers(x: &Tensor) -> Vec<f32> {
    x.flatten_all().unwrap().to_vec1().unwrap()
}

fn check(case: &str, options: &RenderLossOptions, terms: &[(&str, &str)]) {
    let stored: HashMap<String, Tensor> =
        candle_core::safetensors::load(fixture("loss.safetensors"), &Device::Cpu).unwrap();
    let values: serde_json::Value =
        serde_json::from_slice(&std::fs::read(fixture("loss_values.json")).unwrap()).unwrap();
    let var = |name: &str| Var::from_tensor(&stored[&format!("{}.{name}", &case[case.len() - 5..])]).unwrap();
    let names = ["rendered_image", "rendered_depth", "rendered_alpha", "forward_flow"];
    let vars = names.map(var);
    let rendered = Rendered {
        image: vars[0].as_tensor().clone(),
        depth: vars[1].as_tensor().clone(),
        alpha: vars[2].as_tensor().clone(),
    };
    let target = Target {
        image: stored["target.target_image"].clone(),
        depth: Some(stored["target.target_depth"].clone()),
        sky: Some(stored["target.target_sky_masks"].clone()),
        valid: None,
    };
    let found = render_losses(&rendered, &target, &[vars[3].as_tensor()], options, 0).unwrap();
    let by_name: HashMap<_, _> = found.values().unwrap().into_iter().collect();
    assert_eq!(by_name.len(), terms.len(), "{case}: {by_name:?}");
    let close = |name: &str, got: f64| {
        let want = values[case][name].as_f64().unwrap();
        assert!((got - want).abs() <= VALUE * want.abs(), "{case} {name}: {got} for {want}");
    };
    terms.iter().for_each(|(ours, theirs)| close(theirs, by_name[ours]));
    let total = found.total().unwrap();
    close("total", f64::from(total.to_scalar::<f32>().unwrap()));
    let grads = total.backward().unwrap();
    for (name, var) in names.iter().zip(&vars) {
        let got = grads.get(var).map_or_else(|| vec![0.0; var.elem_count()], numbers);
        let want = stored.get(&format!("{case}.grad.{name}")).map_or_else(|| vec![0.0; got.len()], numbers);
        let largest = want.iter().fold(0f32, |m, x| m.max(x.abs()));
        let worst = got.iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0f32, f32::max);
        assert!(worst <= GRADIENT * largest, "{case} d/d {name}: off by {worst} of {largest}");
    }
}

#[test]
fn the_papers_losses() {
    let terms = [
        ("rgb", "rgb_loss"),
        ("depth", "depth_loss"),
        ("velocity", "flow_reg_loss"),
        ("sky_opacity", "sky_opacity_loss"),
    ];
    check("pixel", &RenderLossOptions::default(), &terms);
}

#[test]
fn the_sky_at_a_depth() {
    let options =
        RenderLossOptions { sky_opacity: 0.0, velocity: 0.0, sky_depth_m: Some(300.0), ..RenderLossOptions::default() };
    let terms =
        [("rgb", "rgb_loss"), ("depth", "depth_loss"), ("sky_depth", "sky_depth_loss"), ("opaque", "opacity_loss")];
    check("skydepth_pixel", &options, &terms);
}
