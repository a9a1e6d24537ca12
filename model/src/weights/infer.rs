//! The configuration of a checkpoint that does not state it, from its tensors' shapes.

use std::collections::BTreeMap;

use super::error::WeightsError;
use super::names::sky_widths;
use crate::config::{MaskDecoder, ModelConfig, SkyKind, VelocityKind};

/// Width over height of the authors' pictures, for grids that several pictures could have.
const USUAL_ASPECT: f64 = 1.5;

/// Head widths of the authors' models other than 64: embed_dim, heads.
const KNOWN_HEADS: [(usize, usize); 2] = [(1152, 16), (1280, 16)];

/// Channels of a head where the width is not a known model's.
const HEAD_WIDTH: usize = 64;

/// What shapes cannot tell (depth meaning, near and far planes, ...) is as in the authors' program.
///
/// `columns` is the buffer `plucker_embedder.x`, if the file has it: the picture's width is its largest value rounded up.
///
/// # Errors
/// Names the tensor that is missing or has a shape that no STORM has.
pub fn infer_config(
    shapes: &BTreeMap<String, Vec<usize>>,
    columns: Option<&[f32]>,
) -> Result<ModelConfig, WeightsError> {
    let shape = |name: &str| shapes.get(name).map(Vec::as_slice);
    let need = |name: &str| shape(name).ok_or_else(|| WeightsError::missing(name));
    let odd = |name: &str| WeightsError::tensor(name, format!("has shape {:?}, which no STORM has", shape(name)));
    let mut config = ModelConfig::default();

    let proj = "patch_embed.proj.weight";
    let &[embed_dim, ModelConfig::INPUT_CHANNELS, patch, other] = need(proj)? else { return Err(odd(proj)) };
    if patch != other || !patch.is_power_of_two() {
        return Err(odd(proj));
    }
    config.embed_dim = embed_dim;
    config.patch_size = patch;
    let known = KNOWN_HEADS.iter().find(|(d, _)| *d == embed_dim).map(|(_, heads)| *heads);
    config.num_heads = known.unwrap_or((embed_dim / HEAD_WIDTH).max(1));
    config.depth =
        (0..).take_while(|k| shapes.contains_key(&format!("transformer.blocks.{k}.attn.qkv.weight"))).count();
    let fc1 = "transformer.blocks.0.mlp.fc1.weight";
    let &[hidden, _] = need(fc1)? else { return Err(odd(fc1)) };
    config.mlp_ratio = hidden / embed_dim.max(1);

    config.disable_pos_embed = shape("pos_embed").is_none();
    if let Some(position) = shape("pos_embed") {
        let &[1, patches, _] = position else { return Err(odd("pos_embed")) };
        let (rows, cols) = grid(patches, patch, columns).ok_or_else(|| odd("pos_embed"))?;
        (config.image_height, config.image_width) = (rows.saturating_mul(patch), cols.saturating_mul(patch));
    } else {
        // No grid to keep: any size that is a multiple of the patch will do.
        (config.image_height, config.image_width) = (patch.saturating_mul(20), patch.saturating_mul(30));
    }
    config.use_sky_token = shape("sky_token").is_some();
    config.use_affine_token = shape("affine_token").is_some();
    let middle = |name: &str| match shape(name) {
        Some(&[1, count, _]) => Ok(Some(count)),
        Some(_) => Err(odd(name)),
        None => Ok(None),
    };
    config.num_cams = middle("affine_token")?.unwrap_or(config.num_cams);
    config.num_motion_tokens = middle("motion_tokens")?.unwrap_or(0);
    if let Some(sky) = shape("sky_head.linear.weight") {
        let (inputs, hidden) = sky_widths(SkyKind::Frequency64);
        config.sky = if sky == [hidden, inputs] { SkyKind::Frequency64 } else { SkyKind::Raw512 };
    }
    mask_decoder(&mut config, shapes)?;
    Ok(config)
}

fn mask_decoder(config: &mut ModelConfig, shapes: &BTreeMap<String, Vec<usize>>) -> Result<(), WeightsError> {
    let shape = |name: &str| shapes.get(name).map(Vec::as_slice);
    let first = |name: &str| match shape(name) {
        Some(&[rows, _]) => Ok(rows),
        Some(other) => Err(WeightsError::tensor(name, format!("has shape {other:?}, expected a matrix"))),
        None => Err(WeightsError::missing(name)),
    };
    config.upsampler_widths.clear();
    for stage in 0..config.patch_size.trailing_zeros() {
        let name = format!("output_upscaling.{}.weight", 3 * stage);
        match shape(&name) {
            Some(&[_, width, 2, 2]) => config.upsampler_widths.push(width),
            Some(other) => {
                let reason = format!("has shape {other:?}, expected (in, out, 2, 2); Latent-STORM is not supported");
                return Err(WeightsError::tensor(&name, reason));
            }
            None => return Err(WeightsError::missing(&name)),
        }
    }
    let paper = shape("motion_key_head.fc2.weight").is_none();
    config.mask_decoder = if paper { MaskDecoder::Paper } else { MaskDecoder::Authors };
    if paper {
        config.projected_motion_dim = first("motion_key_head.fc1.weight")?;
    } else {
        config.key_hidden = first("motion_key_head.fc1.weight")?;
        config.projected_motion_dim = first("motion_key_head.fc2.weight")?;
    }
    let basis = if paper && config.num_motion_tokens > 0 { "motion_basis_decoders.0" } else { "motion_basis_decoder" };
    config.basis_hidden = first(&format!("{basis}.fc1.weight"))?;
    config.velocity = match first(&format!("{basis}.fc2.weight"))? {
        6 => VelocityKind::ForwardBackward,
        _ => VelocityKind::One,
    };
    Ok(())
}

/// Rows and columns of a patch grid with `patches` patches.
fn grid(patches: usize, patch: usize, columns: Option<&[f32]>) -> Option<(usize, usize)> {
    let width = columns.and_then(|x| x.iter().copied().filter(|x| x.is_finite()).reduce(f32::max));
    if let Some(width) = width {
        // Values are column + 0.5.
        let cols = width.ceil() as usize / patch;
        if cols > 0 && patches.is_multiple_of(cols) {
            return Some((patches / cols, cols));
        }
    }
    // Every divisor pair; at most MAX_SIDE rows matter, so the search is short whatever the file claims.
    let off = |rows: usize| ((patches as f64 / rows as f64 / rows as f64) / USUAL_ASPECT).ln().abs();
    let rows = (1..=2048.min(patches))
        .filter(|rows| patches.is_multiple_of(*rows))
        .min_by(|&a, &b| off(a).total_cmp(&off(b)))?;
    Some((rows, patches / rows))
}
