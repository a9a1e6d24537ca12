//! Camera messages to pictures: raw encodings, compressed files, rectification.
//!
//! [`image_to_rgb`] and [`compressed_to_rgb`] give 8-bit RGB, [`Rectifier`] takes it to the network's size and removes the
//! lens. [`image_to_depth`], [`compressed_to_depth`], [`image_to_vectors`] and [`image_to_labels`] read ground truth.
//! [`Encoding`] and [`Format`] are the tables of what can be read, and say what is colour.

mod bayer;
mod black_frame;
mod color;
mod compressed;
mod compressed_depth;
mod encoding;
mod error;
mod format;
mod lens;
mod measure;
mod mjpeg;
mod packed;
mod rectify;
mod resample;
mod rows;
mod validity;
mod warp;
mod yuv;

pub use black_frame::{BlackFrame, FrameFinder};
pub use color::image_to_rgb;
pub use compressed::{compressed_of_size, compressed_to_rgb};
pub use compressed_depth::compressed_to_depth;
pub use encoding::{Encoding, Shows};
pub use error::DecodeError;
pub use format::{Codec, Format};
pub use lens::Lens;
pub use measure::{image_to_depth, image_to_labels, image_to_vectors};
pub use rectify::Rectifier;
pub use validity::{NothingLeft, Validity, sampled_mask};

/// An 8-bit RGB picture, rows from the top.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RgbPicture {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `height * width * 3` bytes.
    pub data: Vec<u8>,
}

/// A depth picture, rows from the top.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthPicture {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `height * width` depths in metres; NaN where there is none.
    pub data: Vec<f32>,
}
