//! Raw images packed without loss, as `zstd_image_transport` sends them in a CompressedImage.

use super::error::DecodeError;
use super::rows::MAX_SIDE;
use crate::bag::{is_zstd, read_bounded, unpack_zstd};
use crate::cdr::decode as cdr;
use crate::msg::{CompressedImage, Image};

/// Height, width, byte order, step and the length of the encoding's name stand before the name, little-endian.
const HEADER_BYTES: usize = 17;
/// Longest name of an encoding.
const MAX_NAME: usize = 64;
/// Bytes per pixel there can be: four samples of 8 bytes, and padding.
const MAX_BYTES_PER_PIXEL: u64 = 64;
/// Unpacked bytes an image may take.
const MAX_IMAGE_BYTES: u64 = 1 << 30;

/// The raw image in a message of the `zstd` transport. Releases differ: the samples after the header are a zlib, gzip or zstd
/// stream; and a whole Image message in one zstd frame is read as well.
///
/// # Errors
/// A header that does not fit its bytes, a stream that cannot be unpacked, or one that unpacks to more than it may.
pub fn unpack_image(message: &CompressedImage) -> Result<Image, DecodeError> {
    let wrong =
        |why: String| DecodeError::Compressed { format: message.format.clone(), bytes: message.data.len(), why };
    if is_zstd(&message.data) {
        let cdr_bytes = unpack(&message.data, MAX_IMAGE_BYTES).map_err(wrong)?;
        let mut image = cdr::image(&cdr_bytes).map_err(|e| wrong(e.to_string()))?;
        image.header = message.header.clone();
        return Ok(image);
    }
    let Some((header, rest)) = message.data.split_first_chunk::<HEADER_BYTES>() else {
        return Err(wrong(format!("its header takes {HEADER_BYTES} bytes")));
    };
    let number = |at: usize| u32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
    let (height, width, step, name_length) = (number(0), number(4), number(9), number(13) as usize);
    if width > MAX_SIDE || height > MAX_SIDE {
        return Err(wrong(format!("it claims {width}x{height} pixels; sides over {MAX_SIDE} are refused")));
    }
    if name_length > MAX_NAME || name_length > rest.len() {
        return Err(wrong(format!("its encoding's name takes {name_length} bytes")));
    }
    let (name, packed) = rest.split_at(name_length);
    let encoding = String::from_utf8_lossy(name).into_owned();
    let limit = (u64::from(width) * u64::from(height)).saturating_mul(MAX_BYTES_PER_PIXEL).min(MAX_IMAGE_BYTES);
    let data = unpack(packed, limit).map_err(wrong)?;
    Ok(Image { header: message.header.clone(), height, width, encoding, is_bigendian: header[8] != 0, step, data })
}

/// Unpacks a stream of at most `limit` bytes by what it begins with.
fn unpack(packed: &[u8], limit: u64) -> Result<Vec<u8>, String> {
    let (out, problem) = match packed {
        _ if is_zstd(packed) => unpack_zstd(packed, limit),
        [0x1f, 0x8b, ..] => read_bounded(flate2::bufread::GzDecoder::new(packed), limit),
        _ => read_bounded(flate2::bufread::ZlibDecoder::new(packed), limit),
    };
    match problem {
        None => Ok(out),
        Some(why) => Err(format!("the packed samples: {why}")),
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::super::{compressed_of_size, compressed_to_rgb};
    use super::*;
    use crate::cdr::encode::encode_image;
    use proptest::prelude::*;

    fn image() -> Image {
        let data = (0..6 * 4 * 2).map(|i| i as u8 * 5).collect();
        Image { encoding: "bgr8".into(), width: 4, height: 2, step: 24, data, ..Image::default() }
    }

    fn message(packed: &[u8]) -> CompressedImage {
        let i = image();
        let mut data = [i.height.to_le_bytes(), i.width.to_le_bytes()].concat();
        data.push(0);
        data.extend([i.step.to_le_bytes(), 4u32.to_le_bytes()].concat());
        data.extend(b"bgr8");
        data.extend(packed);
        CompressedImage { format: "zstd".into(), data, ..CompressedImage::default() }
    }

    fn packings() -> Vec<CompressedImage> {
        let samples = image().data;
        let mut zlib = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
        zlib.write_all(&samples).unwrap();
        let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        gzip.write_all(&samples).unwrap();
        let whole = zstd::encode_all(&encode_image(&image()).unwrap()[..], 1).unwrap();
        vec![
            message(&zlib.finish().unwrap()),
            message(&gzip.finish().unwrap()),
            message(&zstd::encode_all(&samples[..], 1).unwrap()),
            CompressedImage { format: "zstd".into(), data: whole, ..CompressedImage::default() },
        ]
    }

    #[test]
    fn every_packing_gives_the_image_back() {
        for (i, m) in packings().iter().enumerate() {
            assert_eq!(unpack_image(m).unwrap(), image(), "{i}");
            let rgb = compressed_to_rgb(m).unwrap();
            // A step of 24 bytes for 12 of pixels: the second row begins at byte 24.
            assert_eq!(
                (rgb.width, rgb.height, &rgb.data[..3], &rgb.data[12..15]),
                (4, 2, &[10, 5, 0][..], &[130, 125, 120][..])
            );
            assert!(matches!(compressed_of_size(m, Some((2, 4))), Err(DecodeError::Size { .. })));
        }
    }

    #[test]
    fn what_claims_too_much_is_refused() {
        let bomb = zstd::encode_all(&vec![0u8; 1 << 20][..], 1).unwrap();
        let e = unpack_image(&message(&bomb)).unwrap_err().to_string();
        assert!(e.contains("512"), "{e}");
        let mut wide = message(&[]);
        wide.data[4..8].copy_from_slice(&u32::MAX.to_le_bytes());
        assert!(unpack_image(&wide).unwrap_err().to_string().contains("4294967295x2"));
        let mut name = message(&[]);
        name.data[13..17].copy_from_slice(&9999u32.to_le_bytes());
        assert!(unpack_image(&name).unwrap_err().to_string().contains("9999"));
        let short = CompressedImage { format: "zstd".into(), data: vec![1; 9], ..CompressedImage::default() };
        assert!(unpack_image(&short).unwrap_err().to_string().contains("17 bytes"));
    }

    proptest! {
        #[test]
        fn damage_never_panics(which in 0usize..4, flips in proptest::collection::vec((0.0f64..1.0, any::<u8>()), 1..6), keep in 0.0f64..1.3) {
            let mut m = packings().swap_remove(which);
            let n = m.data.len();
            flips.iter().for_each(|(at, value)| m.data[(at * n as f64) as usize] = *value);
            m.data.truncate((keep * n as f64) as usize);
            if let Ok(p) = compressed_to_rgb(&m) {
                prop_assert_eq!(p.data.len(), p.width * p.height * 3);
            }
        }
    }
}
