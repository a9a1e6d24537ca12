//! Pictures that measure instead of show: depth, labels, vectors.

use super::DepthPicture;
use super::error::DecodeError;
use super::rows::{rows, sample_f32, sample16};
use crate::msg::Image;

/// Metres per unit of `16UC1` depth (REP 118: millimetres).
pub(super) const METRES_PER_MM: f32 = 1e-3;

/// A depth in metres, or NaN for what is none (REP 118).
pub(super) fn depth_or_nan(metres: f32) -> f32 {
    if metres.is_finite() && metres > 0.0 { metres } else { f32::NAN }
}

fn refused(image: &Image, wanted: &'static str, accepted: &'static str) -> DecodeError {
    DecodeError::Encoding { found: image.encoding.clone(), wanted, accepted }
}

/// `16UC1` (millimetres, 0 for none) or `32FC1` (metres) as metres, NaN where there is no depth: what is not finite and
/// greater than zero counts as none (REP 118).
///
/// # Errors
/// Another encoding, or sizes that do not fit the data.
pub fn image_to_depth(image: &Image) -> Result<DepthPicture, DecodeError> {
    let (width, height) = (image.width as usize, image.height as usize);
    let big = image.is_bigendian;
    let mut data = Vec::new();
    match image.encoding.to_ascii_lowercase().as_str() {
        "16uc1" | "mono16" => {
            for row in rows(image, width * 2)? {
                let (pixels, _) = row.as_chunks::<2>();
                data.extend(pixels.iter().map(|p| f32::from(sample16(*p, big)) * METRES_PER_MM));
            }
        }
        "32fc1" => {
            for row in rows(image, width * 4)? {
                let (pixels, _) = row.as_chunks::<4>();
                data.extend(pixels.iter().map(|p| sample_f32(*p, big)));
            }
        }
        _ => return Err(refused(image, "depth", "16UC1 (millimetres), 32FC1 (metres)")),
    }
    for d in &mut data {
        *d = depth_or_nan(*d);
    }
    Ok(DepthPicture { width, height, data })
}

/// `32FC3` as one vector per pixel (ground-truth scene flow); NaN stays where there is none.
///
/// # Errors
/// Another encoding, or sizes that do not fit the data.
pub fn image_to_vectors(image: &Image) -> Result<Vec<[f32; 3]>, DecodeError> {
    if !image.encoding.eq_ignore_ascii_case("32FC3") {
        return Err(refused(image, "vectors", "32FC3"));
    }
    let mut out = Vec::new();
    for row in rows(image, image.width as usize * 12)? {
        let (samples, _) = row.as_chunks::<4>();
        let (pixels, _) = samples.as_chunks::<3>();
        out.extend(pixels.iter().map(|p| p.map(|s| sample_f32(s, image.is_bigendian))));
    }
    Ok(out)
}

/// `mono8`, `8UC1`, `mono16` or `16UC1` as labels.
///
/// # Errors
/// Another encoding, or sizes that do not fit the data.
pub fn image_to_labels(image: &Image) -> Result<Vec<u16>, DecodeError> {
    let width = image.width as usize;
    let mut out = Vec::new();
    match image.encoding.to_ascii_lowercase().as_str() {
        "mono8" | "8uc1" => rows(image, width)?.for_each(|row| out.extend(row.iter().map(|v| u16::from(*v)))),
        "mono16" | "16uc1" => {
            for row in rows(image, width * 2)? {
                let (pixels, _) = row.as_chunks::<2>();
                out.extend(pixels.iter().map(|p| sample16(*p, image.is_bigendian)));
            }
        }
        _ => return Err(refused(image, "labels", "mono8, 8UC1, mono16, 16UC1")),
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(encoding: &str, width: u32, height: u32, step: u32, data: Vec<u8>) -> Image {
        Image { encoding: encoding.to_owned(), width, height, step, data, ..Image::default() }
    }

    #[test]
    fn depth_in_both_units_and_byte_orders() {
        let mut mm = image("16UC1", 2, 2, 6, vec![0xd0, 0x07, 0, 0, 9, 9, 1, 0, 0xff, 0xff]);
        let got = image_to_depth(&mm).unwrap().data;
        assert_eq!((got[0], got[2], got[3]), (2.0, 0.001, 65.535));
        assert!(got[1].is_nan());
        mm.is_bigendian = true;
        assert!((image_to_depth(&mm).unwrap().data[0] - 53.255).abs() < 1e-3);
        let values = [1.5f32, f32::NAN, f32::INFINITY, -2.0];
        let m = image("32FC1", 4, 1, 16, values.iter().flat_map(|v| v.to_le_bytes()).collect());
        let got = image_to_depth(&m).unwrap().data;
        assert!(got[0] == 1.5 && got[1..].iter().all(|d| d.is_nan()));
        let e = image_to_depth(&image("rgb8", 1, 1, 3, vec![0; 3])).unwrap_err().to_string();
        assert!(e.contains("`rgb8`") && e.contains("16UC1"), "{e}");
    }

    #[test]
    fn vectors_and_labels() {
        let flow: Vec<u8> = [1.0f32, 2.0, 3.0, f32::NAN, 5.0, 6.0].iter().flat_map(|v| v.to_be_bytes()).collect();
        let mut m = image("32FC3", 1, 2, 12, flow);
        m.is_bigendian = true;
        let got = image_to_vectors(&m).unwrap();
        assert_eq!(got[0], [1.0, 2.0, 3.0]);
        assert!(got[1][0].is_nan() && got[1][1..] == [5.0, 6.0]);
        assert!(image_to_vectors(&image("32FC3", 1, 3, 12, vec![0; 24])).is_err());
        assert!(image_to_vectors(&image("32FC1", 1, 1, 4, vec![0; 4])).is_err());
        assert_eq!(image_to_labels(&image("mono8", 3, 1, 0, vec![1, 2, 255])).unwrap(), [1, 2, 255]);
        assert_eq!(image_to_labels(&image("mono16", 2, 1, 0, vec![1, 2, 3, 4])).unwrap(), [0x0201, 0x0403]);
        assert!(image_to_labels(&image("rgb8", 1, 1, 3, vec![0; 3])).is_err());
    }
}
