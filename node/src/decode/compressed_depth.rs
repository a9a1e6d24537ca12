//! Depth as `compressed_depth_image_transport` packs it.

use image::{DynamicImage, ImageFormat};

use super::DepthPicture;
use super::compressed::decode_file;
use super::encoding::{Encoding, Shows};
use super::error::DecodeError;
use super::format::{Codec, Format};
use super::measure::{METRES_PER_MM, depth_or_nan};
use crate::msg::CompressedImage;

/// What [`compressed_to_depth`] reads, as errors list it.
const DEPTH_FORMATS: &str = "16UC1 or 32FC1 as compressedDepth png, 16UC1 as png or tiff";
/// Before the file: a number that says how depth was packed, and the two parameters of inverse depth as floats.
const HEADER_BYTES: usize = 12;

/// A `compressedDepth` message, or a 16-bit grey file declared as `16UC1`, as metres; NaN where there is no depth.
///
/// `32FC1` was packed as whole numbers of inverse depth: a sample s stands for `a / (s - b)` metres, with a and b of the
/// header, 0 for none. `16UC1` is millimetres.
///
/// # Errors
/// Another format, a file that is no 16-bit grey PNG or TIFF, or one that is damaged.
pub fn compressed_to_depth(message: &CompressedImage) -> Result<DepthPicture, DecodeError> {
    let format = Format::parse(&message.format);
    let refused = || DecodeError::Encoding { found: message.format.clone(), wanted: "depth", accepted: DEPTH_FORMATS };
    let wrong =
        |why: String| DecodeError::Compressed { format: message.format.clone(), bytes: message.data.len(), why };
    if format.shows() != Shows::Depth || format.stored.eq_ignore_ascii_case("rvl") {
        return Err(refused());
    }
    let inverse = matches!(Encoding::named(format.encoding), Some(Encoding::Depth { bytes: 4 }));
    let (header, file) = match format.codec {
        Codec::Depth => message
            .data
            .split_first_chunk::<HEADER_BYTES>()
            .ok_or_else(|| wrong(format!("its header takes {HEADER_BYTES} bytes")))?,
        Codec::File if !inverse => (&[0; HEADER_BYTES], message.data.as_slice()),
        _ => return Err(refused()),
    };
    let kind = match image::guess_format(file) {
        Ok(kind @ (ImageFormat::Png | ImageFormat::Tiff)) => kind,
        _ => return Err(wrong("depth is read from PNG or TIFF".to_owned())),
    };
    let file = CompressedImage { data: file.to_vec(), format: message.format.clone(), ..CompressedImage::default() };
    let DynamicImage::ImageLuma16(samples) = decode_file(&file, kind, None)? else {
        return Err(wrong("depth is read from 16-bit grey files".to_owned()));
    };
    let float = |at: usize| f32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
    let (a, b) = (float(4), float(8));
    let metres = |sample: u16| match (sample, inverse) {
        (0, _) => f32::NAN,
        (sample, true) => depth_or_nan(a / (f32::from(sample) - b)),
        (sample, false) => f32::from(sample) * METRES_PER_MM,
    };
    let (width, height) = (samples.width() as usize, samples.height() as usize);
    Ok(DepthPicture { width, height, data: samples.into_raw().into_iter().map(metres).collect() })
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;
    use proptest::prelude::*;

    fn message(format: &str, header: &[u8], samples: &[u16]) -> CompressedImage {
        let picture = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(samples.len() as u32, 1, samples.to_vec());
        let mut file = Vec::new();
        DynamicImage::ImageLuma16(picture.unwrap()).write_to(&mut Cursor::new(&mut file), ImageFormat::Png).unwrap();
        CompressedImage { format: format.into(), data: [header, &file].concat(), ..CompressedImage::default() }
    }

    /// The header of a quantisation of `z0` up to `most` metres.
    fn header(z0: f32, most: f32) -> (Vec<u8>, f32, f32) {
        let a = z0 * (z0 + 1.0);
        let b = 1.0 - a / most;
        ([0u32.to_le_bytes(), a.to_le_bytes(), b.to_le_bytes()].concat(), a, b)
    }

    #[test]
    fn inverse_depth_and_millimetres() {
        let (head, a, b) = header(100.0, 10.0);
        let depths = [0.5f32, 2.0, 9.5];
        let mut samples: Vec<u16> = depths.iter().map(|d| (a / d + b) as u16).collect();
        samples.push(0);
        for format in ["32FC1; compressedDepth png", "32FC1; compressedDepth"] {
            let got = compressed_to_depth(&message(format, &head, &samples)).unwrap().data;
            for (got, want) in got.iter().zip(depths) {
                // A sample is at most 1 off in a / d.
                assert!((got - want).abs() <= want * want / a * 1.01, "{got} {want}");
            }
            assert!(got[3].is_nan());
        }
        for (format, head) in
            [("16UC1; compressedDepth png", &head[..]), ("16UC1", &head), ("16UC1; png compressed ", &[])]
        {
            let got = compressed_to_depth(&message(format, head, &[1500, 0, 65535])).unwrap().data;
            assert!(
                (got[0] - 1.5).abs() < 1e-6 && got[1].is_nan() && (got[2] - 65.535).abs() < 1e-4,
                "{format} {got:?}"
            );
        }
    }

    #[test]
    fn what_is_no_depth_is_refused() {
        let (head, ..) = header(100.0, 10.0);
        for format in ["16UC1; compressedDepth rvl", "bgr8; png compressed bgr8", "32FC1; png compressed ", "jpeg"] {
            let e = compressed_to_depth(&message(format, &head, &[1])).unwrap_err();
            assert!(matches!(e, DecodeError::Encoding { wanted: "depth", .. }), "{format}: {e}");
        }
        let mut short = message("16UC1; compressedDepth png", &head, &[1]);
        short.data.truncate(11);
        assert!(compressed_to_depth(&short).unwrap_err().to_string().contains("12 bytes"));
    }

    proptest! {
        #[test]
        fn damage_gives_an_error_or_sound_depths(
            float in any::<bool>(), flips in proptest::collection::vec((0.0f64..1.0, any::<u8>()), 1..6), keep in 0.0f64..1.2,
        ) {
            let (head, ..) = header(100.0, 10.0);
            let format = if float { "32FC1; compressedDepth png" } else { "16UC1; compressedDepth png" };
            let mut m = message(format, &head, &[1, 2, 3, 9000, 65535]);
            let n = m.data.len();
            flips.iter().for_each(|(at, value)| m.data[(at * n as f64) as usize] = *value);
            m.data.truncate((keep * n as f64) as usize);
            if let Ok(d) = compressed_to_depth(&m) {
                prop_assert_eq!(d.data.len(), d.width * d.height);
                prop_assert!(d.data.iter().all(|z| z.is_nan() || (z.is_finite() && *z > 0.0)));
            }
        }
    }
}
