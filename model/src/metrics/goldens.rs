//! The figures against those of the authors' own evaluation (`tests/fixtures/{flow,image}_metrics*`).

use std::path::PathBuf;

use safetensors::SafeTensors;
use serde_json::Value;

use super::flow::{Flow, FlowEvaluation, FlowFrame, flow_scores};
use super::image::{Held, Image, ImageScores, ssim_map, unit_from_signed};

/// The authors' program works in f32: sums of thousands of values near 1 are good to about 1e-6 of their size.
const F32_RELATIVE: f64 = 5e-6;
/// acos near 0 amplifies an f32 rounding of the cosine: sqrt(2 * 6e-8) at worst for a point, far less in the mean.
const ANGLE_TOLERANCE: f64 = 2e-5;
/// SSIM in f32 takes differences of means of squares (a few 1e-9 for small variances) against C2 = 9e-4.
const SSIM_MAP_TOLERANCE: f64 = 2e-5;
/// The same in the mean of an image.
const SSIM_TOLERANCE: f64 = 2e-6;

fn fixture(name: &str) -> Vec<u8> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../tests/fixtures").join(name);
    std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

fn values(name: &str) -> Value {
    serde_json::from_slice(&fixture(name)).unwrap()
}

fn floats(tensors: &SafeTensors<'_>, name: &str) -> Vec<f32> {
    let bytes = tensors.tensor(name).unwrap().data().to_vec();
    bytes.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
}

fn flags(tensors: &SafeTensors<'_>, name: &str) -> Vec<bool> {
    tensors.tensor(name).unwrap().data().iter().map(|&b| b > 0).collect()
}

fn flows(tensors: &SafeTensors<'_>, name: &str) -> Vec<Flow> {
    floats(tensors, name).chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect()
}

#[track_caller]
fn close(what: &str, got: f64, want: &Value, tolerance: f64) {
    let want = want.as_f64().unwrap_or_else(|| panic!("no golden value for {what}"));
    let worst = tolerance * want.abs().max(1.0);
    assert!((got - want).abs() <= worst, "{what}: {got} instead of {want} ({:e})", (got - want).abs());
}

#[test]
fn flow_points() {
    let (bytes, want) = (fixture("flow_metrics.safetensors"), values("flow_metrics_values.json"));
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    for case in ["flow", "flow_static"] {
        let pred = flows(&tensors, &format!("{case}.pred"));
        let got = flow_scores(&pred, &flows(&tensors, &format!("{case}.label")), None).unwrap().unwrap();
        close("EPE3D", got.epe3d, &want[case]["EPE3D"], F32_RELATIVE);
        close("Acc5", got.acc5, &want[case]["acc3d_strict"], F32_RELATIVE);
        close("Acc10", got.acc10, &want[case]["acc3d_relax"], F32_RELATIVE);
        close("outliers", got.outliers, &want[case]["outlier"], F32_RELATIVE);
        close("angle", got.theta.unwrap_or(0.0), &want[case]["angle_error"], ANGLE_TOLERANCE);
        assert_eq!(got.theta.is_none(), case == "flow_static");
    }
}

#[test]
fn flow_evaluation() {
    let (bytes, want) = (fixture("flow_metrics.safetensors"), values("flow_metrics_values.json"));
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let (pred, truth) = (flows(&tensors, "flowmap.pred"), flows(&tensors, "flowmap.label"));
    let depth = floats(&tensors, "flowmap.depth");
    let ground: Vec<bool> = floats(&tensors, "flowmap.ground").iter().map(|&g| g > 0.0).collect();
    let timestep = depth.len() / 3;
    for load_ground in [true, false] {
        let frames: Vec<FlowFrame<'_>> = (0..3)
            .map(|t| {
                let range = t * timestep..(t + 1) * timestep;
                FlowFrame {
                    pred: &pred[range.clone()],
                    truth: &truth[range.clone()],
                    depth: &depth[range.clone()],
                    ground: load_ground.then_some(&ground[range]),
                }
            })
            .collect();
        let mut evaluation = FlowEvaluation::default();
        evaluation.add(&frames).unwrap();
        let got = evaluation.means();
        let name = format!("evaluate_flow.load_ground_{}", if load_ground { "True" } else { "False" });
        close("EPE3D", got.epe3d.unwrap(), &want[&name]["flow_epe"], F32_RELATIVE);
        close("Acc5", 100.0 * got.acc5.unwrap(), &want[&name]["flow_acc_strict"], F32_RELATIVE);
        close("Acc10", 100.0 * got.acc10.unwrap(), &want[&name]["flow_acc_relax"], F32_RELATIVE);
        close("angle", got.theta.unwrap(), &want[&name]["flow_angle"], ANGLE_TOLERANCE);
        close("rmse", got.rmse.unwrap(), &want[&name]["flow_rmse"], F32_RELATIVE);
    }
}

/// One image of the fixture, made ready for scoring.
struct Loaded {
    pred: Vec<f32>,
    truth: Vec<f32>,
    pred_depth: Vec<f32>,
    truth_depth: Vec<f32>,
    sky: Vec<bool>,
    dynamic: Vec<bool>,
}

const WIDTH: usize = 24;
const HEIGHT: usize = 16;

impl Loaded {
    fn new(tensors: &SafeTensors<'_>, index: usize) -> Self {
        let pixels = WIDTH * HEIGHT;
        let cut = |name: &str, size: usize| floats(tensors, name)[index * size..(index + 1) * size].to_vec();
        let planes = cut("img.gt", 3 * pixels);
        Self {
            pred: cut("img.pred", 3 * pixels).into_iter().map(unit_from_signed).collect(),
            truth: (0..3 * pixels).map(|i| unit_from_signed(planes[i % 3 * pixels + i / 3])).collect(),
            pred_depth: cut("img.pred_depth", pixels),
            truth_depth: cut("img.gt_depth", pixels),
            sky: flags(tensors, "img.sky")[index * pixels..(index + 1) * pixels].to_vec(),
            dynamic: flags(tensors, "img.dynamic")[index * pixels..(index + 1) * pixels].to_vec(),
        }
    }

    fn held(&self) -> Held<'_> {
        let image = |values| Image { width: WIDTH, height: HEIGHT, channels: 3, values };
        Held {
            pred: image(&self.pred),
            truth: image(&self.truth),
            depth: Some((&self.pred_depth, &self.truth_depth)),
            sky: Some(&self.sky),
            dynamic: Some(&self.dynamic),
            valid: None,
        }
    }
}

fn compare(what: &str, got: &ImageScores, want: &Value) {
    let figures = [
        ("psnr", got.psnr, F32_RELATIVE),
        ("ssim", got.ssim, SSIM_TOLERANCE),
        ("occupied_psnr", got.psnr_occupied, F32_RELATIVE),
        ("occupied_ssim", got.ssim_occupied, SSIM_TOLERANCE),
        ("dynamic_psnr", got.psnr_dynamic, F32_RELATIVE),
        ("dynamic_ssim", got.ssim_dynamic, SSIM_TOLERANCE),
        ("depth_rmse", got.depth_rmse, F32_RELATIVE),
        ("dynamic_depth_rmse", got.depth_rmse_dynamic, F32_RELATIVE),
    ];
    for (name, figure, tolerance) in figures {
        match figure {
            Some(figure) => close(&format!("{what} {name}"), figure, &want[name], tolerance),
            None => assert!(want[name].is_null(), "{what} {name} is missing"),
        }
    }
}

#[test]
fn pictures() {
    let (bytes, want) = (fixture("image_metrics.safetensors"), values("image_metrics_values.json"));
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let mut all = Vec::new();
    for golden in want["evaluate_per_image"].as_array().unwrap() {
        let (t, v) = (golden["t"].as_u64().unwrap() as usize, golden["v"].as_u64().unwrap() as usize);
        let scores = Loaded::new(&tensors, t * 3 + v).held().scores().unwrap();
        compare(&format!("t{t} v{v}"), &scores, golden);
        all.push(scores);
    }
    compare("mean", &ImageScores::mean(&all), &want["evaluate"]);
}

#[test]
fn ssim_map_of_one_picture() {
    let bytes = fixture("image_metrics.safetensors");
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let image = Loaded::new(&tensors, 3);
    let held = image.held();
    let got = ssim_map(&held.pred, &held.truth).unwrap();
    let want = floats(&tensors, "img.ssim_map_t1v0");
    assert_eq!(got.len(), want.len());
    let worst = got.iter().zip(&want).map(|(g, &w)| (g - f64::from(w)).abs()).fold(0.0, f64::max);
    println!("worst difference of the SSIM map: {worst:.2e}");
    assert!(worst < SSIM_MAP_TOLERANCE, "{worst:e}");
}
