//! Pictures of results: depth, flow and masks in colour, set side by side, as PNG files or inside a page.

mod colormap;
mod depth;
mod draw;
mod flow;
mod font;
mod hatch;
mod layout;
mod mask;
mod top_view;

pub use colormap::{hsv, turbo};
pub use depth::{DepthScale, depth_picture, with_depth_bar};
pub use flow::{flow_color, flow_picture, flow_wheel, with_flow_wheel};
pub use hatch::hatched;
pub use layout::{beside, grid};
pub use mask::{mask_overlay, mask_picture, palette};
pub use top_view::{TopView, top_view_picture};

use std::path::Path;

use base64::Engine as _;
use image::ImageEncoder as _;

use super::OutputError;
use super::atomic::write_bytes;

/// An 8-bit sRGB colour.
pub type Rgb = [u8; 3];

/// Background of legend strips: dark, so that they sit quietly on light and dark pages alike.
const STRIP: Rgb = [26, 28, 36];
/// Text and ticks on legend strips.
const STRIP_TEXT: Rgb = [214, 221, 232];

/// An 8-bit RGB picture, rows from the top.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    width: usize,
    height: usize,
    pixels: Vec<Rgb>,
}

impl Picture {
    /// A picture of one colour.
    pub fn filled(width: usize, height: usize, color: Rgb) -> Self {
        Self { width, height, pixels: vec![color; width.saturating_mul(height)] }
    }

    /// From row-major `rgb` bytes, 3 per pixel.
    pub fn from_rgb8(width: usize, height: usize, rgb: &[u8]) -> Result<Self, OutputError> {
        let expected = width.saturating_mul(height).saturating_mul(3);
        if rgb.len() != expected {
            return Err(OutputError::Length { what: "rgb bytes", expected, got: rgb.len() });
        }
        Ok(Self { width, height, pixels: rgb.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect() })
    }

    /// From row-major colours 0 to 1, 3 per pixel; values outside are clamped, NaN is black.
    pub fn from_rgb01(width: usize, height: usize, rgb: &[f32]) -> Result<Self, OutputError> {
        // `as u8` saturates and takes NaN to 0.
        let bytes: Vec<u8> = rgb.iter().map(|v| (v * 255.0).round() as u8).collect();
        Self::from_rgb8(width, height, &bytes)
    }

    /// A picture from the colour of each pixel `(col, row)`.
    pub fn from_fn(width: usize, height: usize, mut color: impl FnMut(usize, usize) -> Rgb) -> Self {
        let mut picture = Self::filled(width, height, [0; 3]);
        for row in 0..height {
            for col in 0..width {
                picture.pixels[row * width + col] = color(col, row);
            }
        }
        picture
    }

    /// Width, pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height, pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Colour at a pixel; `None` outside.
    pub fn get(&self, col: usize, row: usize) -> Option<Rgb> {
        (col < self.width).then(|| self.pixels.get(row * self.width + col).copied()).flatten()
    }

    /// Row-major bytes, 3 per pixel.
    pub fn as_bytes(&self) -> &[u8] {
        bytemuck::cast_slice(&self.pixels)
    }

    /// As a PNG file. Errors on a picture without pixels, which PNG cannot hold.
    pub fn png(&self) -> Result<Vec<u8>, OutputError> {
        let length = |what, got| OutputError::Length { what, expected: u32::MAX as usize, got };
        let width = u32::try_from(self.width).map_err(|_| length("picture width", self.width))?;
        let height = u32::try_from(self.height).map_err(|_| length("picture height", self.height))?;
        let mut out = Vec::new();
        image::codecs::png::PngEncoder::new(&mut out).write_image(
            self.as_bytes(),
            width,
            height,
            image::ExtendedColorType::Rgb8,
        )?;
        Ok(out)
    }

    /// As a `data:` address with the PNG inside.
    pub fn data_uri(&self) -> Result<String, OutputError> {
        Ok(png_data_uri(&self.png()?))
    }

    /// Writes a PNG file, whole or not at all.
    pub fn write_png(&self, path: &Path) -> Result<(), OutputError> {
        write_bytes(path, &self.png()?)
    }
}

/// The `data:` address of a PNG file.
pub fn png_data_uri(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", base64::engine::general_purpose::STANDARD.encode(png))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn png_reads_back_and_wrong_sizes_are_refused() {
        let picture = Picture::from_fn(5, 3, |col, row| [col as u8, row as u8, 200]);
        let back = image::load_from_memory(&picture.png().unwrap()).unwrap().to_rgb8();
        assert_eq!((back.width(), back.height()), (5, 3));
        assert_eq!(back.as_raw().as_slice(), picture.as_bytes());
        assert!(picture.data_uri().unwrap().starts_with("data:image/png;base64,iVBOR"));
        assert!(Picture::from_rgb8(2, 2, &[0; 11]).is_err());
        assert!(Picture::from_rgb8(usize::MAX, 2, &[0; 11]).is_err());
        assert!(Picture::filled(0, 3, [0; 3]).png().is_err());
        let clamped = Picture::from_rgb01(1, 1, &[-1.0, f32::NAN, 7.0]).unwrap();
        assert_eq!(clamped.get(0, 0), Some([0, 0, 255]));
        assert_eq!(clamped.get(1, 0), None);
    }
}
