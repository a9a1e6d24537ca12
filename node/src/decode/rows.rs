//! Rows of a raw image, once its sizes are known to fit its data.

use super::error::DecodeError;
use crate::msg::Image;

/// Largest width or height of a picture; beyond it a header is taken to be damaged.
pub const MAX_SIDE: u32 = 32_768;

/// An error that names the layout `image` claims.
pub fn layout_error(image: &Image, why: String) -> DecodeError {
    DecodeError::Layout {
        width: image.width,
        height: image.height,
        step: image.step,
        encoding: image.encoding.clone(),
        bytes: image.data.len(),
        why,
    }
}

/// Bytes from one row to the next; rows of `row_bytes` must fit.
///
/// # Errors
/// No pixels, sides over [`MAX_SIDE`], or a step shorter than a row.
pub fn step(image: &Image, row_bytes: usize) -> Result<usize, DecodeError> {
    if image.width == 0 || image.height == 0 {
        return Err(layout_error(image, "there are no pixels".to_owned()));
    }
    if image.width > MAX_SIDE || image.height > MAX_SIDE {
        return Err(layout_error(image, format!("sides over {MAX_SIDE} are refused")));
    }
    // Some drivers leave the step at zero: rows without padding.
    let step = if image.step == 0 { row_bytes } else { image.step as usize };
    if step < row_bytes {
        return Err(layout_error(image, format!("a row takes {row_bytes} bytes")));
    }
    Ok(step)
}

/// The rows of `image`, each cut to its `row_bytes` pixels.
///
/// # Errors
/// As [`step`], and less data than the rows take.
pub fn rows(image: &Image, row_bytes: usize) -> Result<impl Iterator<Item = &[u8]>, DecodeError> {
    let step = step(image, row_bytes)?;
    let need = step as u64 * (u64::from(image.height) - 1) + row_bytes as u64;
    if need > image.data.len() as u64 {
        return Err(layout_error(image, format!("the rows take {need} bytes")));
    }
    Ok(image.data.chunks(step).take(image.height as usize).map(move |row| row.get(..row_bytes).unwrap_or(row)))
}

/// A 16-bit sample.
pub fn sample16(bytes: [u8; 2], big_endian: bool) -> u16 {
    if big_endian { u16::from_be_bytes(bytes) } else { u16::from_le_bytes(bytes) }
}

/// A 32-bit float sample.
pub fn sample_f32(bytes: [u8; 4], big_endian: bool) -> f32 {
    if big_endian { f32::from_be_bytes(bytes) } else { f32::from_le_bytes(bytes) }
}
