//! Writing 3DGS PLY.

use std::io::Write;
use std::path::Path;

use super::header::COLUMNS;
use super::{MIN_SCALE_M, OPACITY_MARGIN, OutputError, PlyCloud, SH_C0};
use crate::output::atomic::write_atomic;

/// Columns of a row.
type Row = [f32; COLUMNS.len()];

/// Writes `cloud`, whole or not at all. `origin_m` is the map-frame place the positions are relative to; `notes` become
/// header comments, one each (line breaks turn into spaces). Errors on arrays of different lengths and on numbers that
/// are not finite.
pub fn write_ply(path: &Path, cloud: &PlyCloud, origin_m: [f64; 3], notes: &[String]) -> Result<(), OutputError> {
    cloud.check_lengths()?;
    if let Some(value) = origin_m.into_iter().find(|v| !v.is_finite()) {
        return Err(OutputError::NonFinite { what: "map origin".into(), index: 0, value });
    }
    write_atomic(path, |out| {
        let mut put = |bytes: &[u8]| out.write_all(bytes).map_err(OutputError::io(path));
        put(header_text(cloud.len(), origin_m, notes).as_bytes())?;
        for index in 0..cloud.len() {
            let row = encode_row(cloud, index);
            if let Some(k) = row.iter().position(|v| !v.is_finite()) {
                let what = format!("Gaussian column {}, row", COLUMNS[k]);
                return Err(OutputError::NonFinite { what, index, value: f64::from(row[k]) });
            }
            put(bytemuck::bytes_of(&row.map(f32::to_le_bytes)))?;
        }
        Ok(())
    })
}

fn header_text(count: usize, [x, y, z]: [f64; 3], notes: &[String]) -> String {
    let mut text = format!("ply\nformat binary_little_endian 1.0\ncomment origin_m {x} {y} {z}\n");
    for note in notes {
        let line: String = note.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        text.push_str(&format!("comment {line}\n"));
    }
    text.push_str(&format!("element vertex {count}\n"));
    for name in COLUMNS {
        text.push_str(&format!("property float {name}\n"));
    }
    text + "end_header\n"
}

fn encode_row(cloud: &PlyCloud, i: usize) -> Row {
    let [x, y, z] = cloud.positions[i];
    let [r, g, b] = cloud.colors01[i].map(|c| ((f64::from(c) - 0.5) / SH_C0) as f32);
    // Clamping would turn infinities into numbers; they are passed on so that the caller sees and refuses them.
    let opacity = cloud.opacities[i];
    let o = f64::from(if opacity.is_finite() { opacity.clamp(OPACITY_MARGIN, 1.0 - OPACITY_MARGIN) } else { f32::NAN });
    let logit = (o / (1.0 - o)).ln() as f32;
    let [s0, s1, s2] = cloud.scales[i].map(|s| if s.is_finite() { s.max(MIN_SCALE_M).ln() } else { s });
    let [qw, qx, qy, qz] = cloud.quats[i];
    [x, y, z, 0.0, 0.0, 0.0, r, g, b, logit, s0, s1, s2, qw, qx, qy, qz]
}
