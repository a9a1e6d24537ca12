//! What JPEG leaves of an image.

use std::io::Cursor;

use image::codecs::jpeg::{JpegDecoder, JpegEncoder};
use image::{ExtendedColorType, ImageDecoder, ImageError};

/// Compresses an image (`3 * width * height`, row by row) at a quality of 1 to 100 and puts what comes back in its place.
///
/// # Errors
/// What the encoder or decoder refuses: sides of 0 or over 65,535 pixels.
pub(super) fn compress(rgb: &mut [u8], width: usize, height: usize, quality: u8) -> Result<(), ImageError> {
    let mut file = Vec::with_capacity(rgb.len() / 4);
    // A side that does not fit into 32 bits is refused by the encoder as any other that is too long.
    let side = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    JpegEncoder::new_with_quality(&mut file, quality).encode(
        rgb,
        side(width),
        side(height),
        ExtendedColorType::Rgb8,
    )?;
    JpegDecoder::new(Cursor::new(&file))?.read_image(rgb)
}
