//! Reading the stored tensors, and comparing with them.
#![allow(clippy::unwrap_used)]
#![allow(dead_code)]

use std::collections::BTreeMap;
use std::path::PathBuf;

use candle_core::{DType, Device, Tensor};
use storm_model::config::ModelConfig;
use storm_model::{ClipBatch, ClipOutput, Stages, Storm};

/// Allowed error over the largest difference between the authors' program in f32 and in f64: another correct f32
/// program rounds differently, by a few times as much.
pub const FLOORS: f32 = 4.0;

/// Allowed error over a tensor's largest value where the floor is zero (both runs computed it in f32): two roundings
/// of an f32 number.
pub const ROUNDINGS: f32 = 2.0 * f32::EPSILON;

pub fn fixture(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../tests/fixtures/tiny_storm").join(name)
}

pub type Goldens = std::collections::HashMap<String, Tensor>;

pub fn read(name: &str) -> Goldens {
    candle_core::safetensors::load(fixture(name), &Device::Cpu).unwrap()
}

/// Configuration of the stored network: the authors' choices at a small size.
pub fn config() -> ModelConfig {
    ModelConfig { embed_dim: 64, depth: 2, num_heads: 4, image_height: 24, image_width: 40, ..ModelConfig::default() }
}

pub fn clip(inputs: &Goldens) -> ClipBatch {
    let timespan = inputs["timespan"].to_vec1::<f32>().unwrap()[0];
    ClipBatch {
        image: inputs["context_image"].clone(),
        intrinsics: inputs["context_intrinsics"].clone(),
        world_from_camera: inputs["context_camtoworlds"].clone(),
        time_sec: (&inputs["context_time"] * f64::from(timespan)).unwrap(),
        valid: None,
        timespan_sec: f64::from(timespan),
        prior: None,
    }
}

pub fn storm() -> Storm {
    Storm::load_as(&fixture("tiny_weights.safetensors"), &config(), &Device::Cpu).unwrap()
}

pub fn run() -> (ClipOutput, Stages) {
    let mut stages = Stages::all();
    let output = storm().forward_stages(&clip(&read("tiny_inputs.safetensors")), &mut stages).unwrap();
    (output, stages)
}

pub fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.to_dtype(DType::F32).unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

/// Compares with the stored tensors and collects every failure before it reports.
pub struct Checker {
    pub goldens: Goldens,
    floors: BTreeMap<String, BTreeMap<String, f64>>,
    failures: Vec<String>,
    pub checked: usize,
}

impl Checker {
    pub fn new() -> Self {
        let text = std::fs::read_to_string(fixture("tiny_noise_floor.json")).unwrap();
        let all: BTreeMap<String, serde_json::Value> = serde_json::from_str(&text).unwrap();
        let floors = all.into_iter().filter_map(|(k, v)| Some((k, serde_json::from_value(v).ok()?))).collect();
        Self { goldens: read("tiny_outputs.safetensors"), floors, failures: Vec::new(), checked: 0 }
    }

    pub fn tolerance(&self, floor: &str) -> f32 {
        let entry = &self.floors[floor];
        let max_abs = entry["max_abs"] as f32;
        if max_abs > 0.0 { FLOORS * max_abs } else { ROUNDINGS * entry["scale"] as f32 }
    }

    /// `ours` against stored tensor `name`, with the tolerance of noise floor entry `floor`.
    pub fn check(&mut self, name: &str, floor: &str, ours: &[f32]) {
        let tolerance = self.tolerance(floor);
        self.check_where(name, tolerance, ours, |_| true);
    }

    /// The same for the elements `keep` accepts.
    pub fn check_where(&mut self, name: &str, tolerance: f32, ours: &[f32], keep: impl Fn(usize) -> bool) {
        let theirs = values(&self.goldens[name]);
        assert_eq!(ours.len(), theirs.len(), "{name}: number of values");
        let (mut worst, mut kept) = (0f32, 0);
        for (_, (a, b)) in ours.iter().zip(&theirs).enumerate().filter(|(index, _)| keep(*index)) {
            kept += 1;
            let difference = (a - b).abs();
            // A NaN must fail too.
            worst = if difference.is_nan() { f32::INFINITY } else { worst.max(difference) };
        }
        assert!(kept > 0, "{name}: nothing to compare");
        println!("{name:28} worst {worst:.2e} of {tolerance:.2e} allowed, {kept} of {} values", theirs.len());
        self.checked += 1;
        if worst > tolerance {
            self.failures.push(format!("{name}: {worst:.3e} > {tolerance:.3e}"));
        }
    }

    pub fn finish(self) {
        assert!(self.failures.is_empty(), "{:#?}", self.failures);
    }
}
