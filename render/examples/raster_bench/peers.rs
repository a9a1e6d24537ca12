//! Other rasterisers on the same scene, as programs of their own (`tests/peers`).

use super::measure::{Error, median};
use super::scenes::Scene;
use serde_json::{Value, json};
use std::io::Write;
use std::path::Path;
use std::process::Command;
use storm_render::View;
use storm_render::raster::Picture;

/// Writes a scene with three channels, seen from the identity pose, as the peers read it.
pub fn write_scene(path: &Path, scene: &Scene, view: &View) -> Result<(), Error> {
    let mut file = std::io::BufWriter::new(std::fs::File::create(path)?);
    let k = &view.intrinsics;
    file.write_all(b"STORMSP1")?;
    for word in [scene.means.len(), k.width, k.height] {
        file.write_all(&u32::try_from(word)?.to_le_bytes())?;
    }
    let numbers = [k.fx, k.fy, k.cx, k.cy];
    let arrays = [
        numbers.as_slice(),
        scene.means.as_flattened(),
        scene.quats.as_flattened(),
        scene.scales.as_flattened(),
        &scene.opacities,
        &scene.features,
    ];
    for x in arrays.into_iter().flatten() {
        file.write_all(&x.to_le_bytes())?;
    }
    Ok(file.flush()?)
}

/// Runs a peer; its times with the median, and how far its picture is from ours (of 255).
pub fn run(program: &Path, scene: &Path, repeats: usize, ours: &Picture) -> Result<Value, Error> {
    let picture = scene.with_extension("picture");
    let output = Command::new(program).arg(scene).arg(repeats.to_string()).arg(&picture).output()?;
    if !output.status.success() {
        let what = String::from_utf8_lossy(&output.stderr).trim().to_owned();
        return Err(format!("{} failed: {what}", program.display()).into());
    }
    let mut result: Value = serde_json::from_slice(&output.stdout)?;
    let times: Vec<f64> = result["ms"].as_array().into_iter().flatten().filter_map(Value::as_f64).collect();
    result["median_ms"] = json!(median(&times));
    let bytes = std::fs::read(&picture)?;
    let theirs = bytes.as_chunks::<4>().0.iter().map(|&b| f32::from_le_bytes(b));
    if bytes.len() == 4 * ours.features.len() {
        let errors: Vec<f64> = theirs.zip(&ours.features).map(|(a, b)| 255.0 * f64::from((a - b).abs())).collect();
        result["mean_difference_of_255"] = json!(errors.iter().sum::<f64>() / errors.len() as f64);
        result["max_difference_of_255"] = json!(errors.iter().fold(0.0, |a: f64, &b| a.max(b)));
    }
    Ok(result)
}
