//! Which network can be grown into which.

use serde_json::Value;

use crate::config::{ModelConfig, VelocityBases};
use crate::error::ModelError;

/// Keys that growing changes.
const GROWN: [&str; 14] = [
    "patch_size",
    "embed_dim",
    "depth",
    "num_heads",
    "mlp_ratio",
    "image_height",
    "image_width",
    "num_cams",
    "num_motion_tokens",
    "projected_motion_dim",
    "upsampler_widths",
    "key_hidden",
    "basis_hidden",
    "sweep_after_block",
];

/// Keys that weights do not depend on: what is done with the network's results.
const FREE: [&str; 4] = ["flow_gate_mps", "time_fade_sec", "screen_blur_px2", "gsplat"];

/// Refuses a growth that no step leads to, naming the key and both values.
pub(super) fn check(from: &ModelConfig, to: &ModelConfig) -> Result<(), ModelError> {
    sizes(from, to)?;
    doublings(from, to)?;
    let (a, b) = (from.sweep_after_block, to.sweep_after_block);
    if a > 0 && a != b {
        return Err(refuse("sweep_after_block", a, b, format!("a trained sweep stays where it is; use {a}")));
    }
    motion_tokens(from, to)?;
    meanings(from, to)
}

fn refuse<T: std::fmt::Debug>(field: &str, from: T, to: T, fix: impl Into<String>) -> ModelError {
    ModelError::Growth { field: field.into(), from: format!("{from:?}"), to: format!("{to:?}"), fix: fix.into() }
}

fn sizes(from: &ModelConfig, to: &ModelConfig) -> Result<(), ModelError> {
    let larger = [
        ("patch_size", from.patch_size, to.patch_size),
        ("embed_dim", from.embed_dim, to.embed_dim),
        ("depth", from.depth, to.depth),
        ("mlp_ratio", from.mlp_ratio, to.mlp_ratio),
        ("num_cams", from.num_cams, to.num_cams),
        ("num_motion_tokens", from.num_motion_tokens, to.num_motion_tokens),
        ("projected_motion_dim", from.projected_motion_dim, to.projected_motion_dim),
        ("key_hidden", from.key_hidden, to.key_hidden),
        ("basis_hidden", from.basis_hidden, to.basis_hidden),
    ];
    if let Some((field, a, b)) = larger.into_iter().find(|(_, a, b)| b < a) {
        return Err(refuse(field, a, b, format!("use {a} or more")));
    }
    let head = |c: &ModelConfig| c.embed_dim / c.num_heads.max(1);
    if head(from) != head(to) {
        let fix = format!("heads {} wide cannot become {}; use embed_dim / {}", head(from), head(to), head(from));
        return Err(refuse("num_heads", from.num_heads, to.num_heads, fix));
    }
    let (a, b) = (from.grid(), to.grid());
    if b.0 < a.0 || b.1 < a.1 {
        let least = format!("at least {}x{}", a.1 * to.patch_size, a.0 * to.patch_size);
        let size = |c: &ModelConfig| [c.image_width, c.image_height];
        let fix = format!("{}x{} patches cannot become {}x{}; use {least}", a.1, a.0, b.1, b.0);
        return Err(refuse("image size", size(from), size(to), fix));
    }
    Ok(())
}

fn doublings(from: &ModelConfig, to: &ModelConfig) -> Result<(), ModelError> {
    let (a, b) = (&from.upsampler_widths, &to.upsampler_widths);
    if a.len() != b.len() {
        let fix = format!("norms between doublings allow no further one; use {} widths", a.len());
        return Err(refuse("upsampler_widths", a, b, fix));
    }
    if a.iter().zip(b).any(|(a, b)| b < a) {
        return Err(refuse("upsampler_widths", a, b, "use none smaller than it was"));
    }
    Ok(())
}

fn motion_tokens(from: &ModelConfig, to: &ModelConfig) -> Result<(), ModelError> {
    let (a, b) = (from.num_motion_tokens, to.num_motion_tokens);
    if a == b {
        return Ok(());
    }
    let wrong = |fix: String| Err(refuse("num_motion_tokens", a, b, fix));
    if a == 0 {
        return wrong("velocities straight from the pixels have no bases to go on from; use 0".into());
    }
    if to.projected_motion_dim == from.projected_motion_dim {
        return wrong(format!(
            "their queries need a channel of their own; use projected_motion_dim {} or more",
            from.projected_motion_dim + 1
        ));
    }
    if from.velocity_bases == VelocityBases::Spread && a.is_multiple_of(2) && !b.is_multiple_of(2) {
        return wrong("the last of an even number of spread bases stands still; use an even number".into());
    }
    Ok(())
}

/// All other keys mean something to trained weights.
fn meanings(from: &ModelConfig, to: &ModelConfig) -> Result<(), ModelError> {
    let object = |config: &ModelConfig| match serde_json::to_value(config) {
        Ok(Value::Object(all)) => Ok(all),
        Ok(_) => Err(ModelError::Input("a configuration is not an object".into())),
        Err(e) => Err(ModelError::Input(e.to_string())),
    };
    let (a, b) = (object(from)?, object(to)?);
    for (key, was) in &a {
        let kept = b.get(key).is_some_and(|is| is == was);
        if !kept && !GROWN.contains(&key.as_str()) && !FREE.contains(&key.as_str()) {
            let is = b.get(key).map_or_else(|| "nothing".to_owned(), Value::to_string);
            return Err(ModelError::Growth {
                field: key.clone(),
                from: was.to_string(),
                to: is,
                fix: format!("the weights were trained for {was}; keep it"),
            });
        }
    }
    Ok(())
}
