//! Rectifies pictures as the program does, for checks against other libraries (`tests/python/opencv_rectify.py`).
//!
//! `cargo run --release -p storm-node --example rectify -- FOLDER`: for every `NAME.json` in FOLDER (the fields of a
//! CameraInfo, `already` and the output's `out_width`, `out_height`) reads the picture `NAME.rgb` (8-bit RGB, rows from the
//! top) and writes `NAME.out` alike.

use std::path::Path;

use anyhow::{Context, Result, anyhow};
use serde_json::Value;
use storm_node::decode::{Rectifier, RgbPicture};
use storm_node::msg::CameraInfo;

fn main() -> Result<()> {
    let folder = std::env::args().nth(1).context("usage: rectify FOLDER")?;
    for entry in std::fs::read_dir(&folder).with_context(|| folder.clone())? {
        let path = entry?.path();
        if path.extension().is_some_and(|e| e == "json") {
            rectify(&path).with_context(|| path.display().to_string())?;
        }
    }
    Ok(())
}

fn rectify(path: &Path) -> Result<()> {
    let case: Value = serde_json::from_str(&std::fs::read_to_string(path)?)?;
    let numbers = |name: &str| -> Result<Vec<f64>> {
        let list = case[name].as_array().with_context(|| format!("{name} is no list"))?;
        list.iter().map(|x| x.as_f64().with_context(|| format!("{name} holds {x}"))).collect()
    };
    let whole = |name: &str| case[name].as_u64().and_then(|n| u32::try_from(n).ok()).with_context(|| name.to_owned());
    let wrong = |name: &'static str| move |_: Vec<f64>| anyhow!("{name} has another length");
    let roi: Vec<u32> = numbers("roi")?.into_iter().map(|x| x as u32).collect();
    let info = CameraInfo {
        width: whole("width")?,
        height: whole("height")?,
        distortion_model: case["model"].as_str().unwrap_or_default().to_owned(),
        d: numbers("d")?,
        k: numbers("k")?.try_into().map_err(wrong("k"))?,
        r: numbers("r")?.try_into().map_err(wrong("r"))?,
        p: numbers("p")?.try_into().map_err(wrong("p"))?,
        binning_x: whole("binning_x")?,
        binning_y: whole("binning_y")?,
        roi: roi.try_into().map_err(|_| anyhow!("roi has another length"))?,
        ..CameraInfo::default()
    };
    let (out_width, out_height) = (whole("out_width")? as usize, whole("out_height")? as usize);
    let already = case["already"].as_bool().unwrap_or(false);
    let rectifier = Rectifier::new(&info, already, out_width, out_height)?;
    let (width, height) = rectifier.source_size();
    let data = std::fs::read(path.with_extension("rgb"))?;
    let out = rectifier.apply(&RgbPicture { width, height, data })?;
    Ok(std::fs::write(path.with_extension("out"), &out.data)?)
}
