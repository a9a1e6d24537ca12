//! Reading 3DGS PLY.

use std::path::Path;

use super::header::{Header, NEEDED, parse_header};
use super::{OutputError, PlyCloud, SH_C0};

/// Quaternions shorter than this have no direction.
const MIN_QUAT_NORM: f32 = 1e-12;

/// What a PLY file holds.
#[derive(Debug, Clone, PartialEq)]
pub struct PlyFile {
    /// The Gaussians; colours of degree 0 only, quaternions unit.
    pub cloud: PlyCloud,
    /// Map-frame place the positions are relative to, metres; zero when the file does not say.
    pub origin_m: [f64; 3],
    /// The other header comments.
    pub comments: Vec<String>,
}

/// Reads a file of Gaussians: the layout [`super::write_ply`] writes, normals optional, any further columns skipped.
///
/// Errors when the header and the file's length disagree (checked before anything is allocated) and when a decoded
/// number is not finite.
pub fn read_ply(path: &Path) -> Result<PlyFile, OutputError> {
    let bytes = std::fs::read(path).map_err(OutputError::io(path))?;
    let format = |reason: String| OutputError::Format { path: path.to_owned(), reason };
    let header = parse_header(&bytes).map_err(format)?;
    let available = (bytes.len() - header.data_start) as u64;
    if header.count.checked_mul(header.stride) != Some(available) {
        return Err(format(format!(
            "its header promises {} rows of {} bytes, but {available} bytes follow; the file is cut short or damaged",
            header.count, header.stride
        )));
    }
    let mut cloud = PlyCloud::default();
    if header.count > 0 {
        for (index, row) in bytes[header.data_start..].chunks_exact(header.stride as usize).enumerate() {
            decode_row(&header, row, &mut cloud).map_err(|(column, value)| {
                if column == "rot" {
                    format(format!("row {index} has a rot quaternion of length {value}; it has no direction"))
                } else {
                    OutputError::NonFinite { what: format!("{} column {column}, row", path.display()), index, value }
                }
            })?;
        }
    }
    Ok(PlyFile { cloud, origin_m: header.origin_m, comments: header.comments })
}

fn decode_row(header: &Header, row: &[u8], cloud: &mut PlyCloud) -> Result<(), (&'static str, f64)> {
    let mut v = [0f32; NEEDED.len()];
    for (k, &offset) in header.offsets.iter().enumerate() {
        // Offsets lie inside the row: each was the stride before its own 4 bytes were added.
        let b = row.get(offset..offset + 4).and_then(|b| b.try_into().ok()).unwrap_or([0; 4]);
        v[k] = f32::from_le_bytes(b);
    }
    let [x, y, z, r, g, b, logit, s0, s1, s2, w, qx, qy, qz] = v;
    let scales = [s0, s1, s2].map(f32::exp);
    let norm = [w, qx, qy, qz].iter().map(|q| q * q).sum::<f32>().sqrt();
    // The norm stands for the last quaternion element: it is not finite when any of the four is not.
    let decoded = [x, y, z, r, g, b, logit, scales[0], scales[1], scales[2], w, qx, qy, norm];
    if let Some(k) = decoded.iter().position(|v| !v.is_finite()) {
        return Err((NEEDED[k], f64::from(decoded[k])));
    }
    if norm > MIN_QUAT_NORM {
        cloud.positions.push([x, y, z]);
        cloud.colors01.push([r, g, b].map(|c| (0.5 + SH_C0 * f64::from(c)) as f32));
        cloud.opacities.push((1.0 / (1.0 + (-f64::from(logit)).exp())) as f32);
        cloud.scales.push(scales);
        cloud.quats.push([w, qx, qy, qz].map(|q| q / norm));
        Ok(())
    } else {
        Err(("rot", f64::from(norm)))
    }
}
