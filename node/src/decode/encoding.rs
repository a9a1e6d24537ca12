//! What an encoding's name says: the one table that raw images, compressed ones and the search for cameras go by.

use super::bayer::Pattern;

/// Raw encodings that become colour, as errors list them.
pub const COLOR_ENCODINGS: &str = "rgb8, bgr8, rgba8, bgra8, rgb16, bgr16, rgba16, bgra16, mono8, mono16, 8UC1, \
     8UC3 and 16UC3 (as bgr), 8UC4 and 16UC4 (as bgra), yuv422/uyvy, yuv422_yuy2/yuyv, yvyu, vyuy, nv12, nv21, nv24, \
     i420, yv12, bayer_{rggb,bggr,gbrg,grbg}{8,16}";

/// What the pixels of an image mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shows {
    /// Colours or grey values.
    Color,
    /// Distances.
    Depth,
    /// Vectors, or other numbers that are no colours.
    Numbers,
}

/// How chroma lies behind the luma of a YUV picture in planes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Planes {
    /// Pixels per chroma sample along each side: 1 or 2.
    pub spacing: usize,
    /// U and V alternate in one plane; otherwise each has its own.
    pub interleaved: bool,
    /// V comes before U.
    pub v_first: bool,
}

/// How the bytes of a raw image lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoding {
    /// Whole pixels one after the other.
    Packed {
        /// Samples per pixel.
        samples: usize,
        /// Bytes per sample, 1 or 2.
        bytes: usize,
        /// Which sample is red, which green, which blue.
        rgb: [usize; 3],
    },
    /// One sample per pixel behind a mosaic of colour filters.
    Bayer {
        /// Which sample has which colour.
        pattern: Pattern,
        /// Bytes per sample, 1 or 2.
        bytes: usize,
    },
    /// Two pixels in four bytes: the places of both lumas, of U and of V.
    Yuv422([usize; 4]),
    /// A plane of luma, then chroma.
    Planar(Planes),
    /// One depth per pixel: millimetres in 2 bytes, or metres as a float in 4.
    Depth {
        /// Bytes per pixel, 2 or 4.
        bytes: usize,
    },
    /// Three floats per pixel.
    Vectors,
}

/// Names as ROS spells them, in lower case (`sensor_msgs/image_encodings.hpp`, `cv_bridge`), and those of V4L2 for what
/// drivers pass on as it is.
const TABLE: [(&str, Encoding); 30] = [
    ("rgb8", packed(3, 1, [0, 1, 2])),
    ("bgr8", packed(3, 1, [2, 1, 0])),
    ("8uc3", packed(3, 1, [2, 1, 0])),
    ("rgba8", packed(4, 1, [0, 1, 2])),
    ("bgra8", packed(4, 1, [2, 1, 0])),
    ("8uc4", packed(4, 1, [2, 1, 0])),
    ("rgb16", packed(3, 2, [0, 1, 2])),
    ("bgr16", packed(3, 2, [2, 1, 0])),
    ("16uc3", packed(3, 2, [2, 1, 0])),
    ("rgba16", packed(4, 2, [0, 1, 2])),
    ("bgra16", packed(4, 2, [2, 1, 0])),
    ("16uc4", packed(4, 2, [2, 1, 0])),
    ("mono8", packed(1, 1, [0; 3])),
    ("8uc1", packed(1, 1, [0; 3])),
    ("mono16", packed(1, 2, [0; 3])),
    ("yuv422", Encoding::Yuv422([1, 3, 0, 2])),
    ("uyvy", Encoding::Yuv422([1, 3, 0, 2])),
    ("vyuy", Encoding::Yuv422([1, 3, 2, 0])),
    ("yuv422_yuy2", Encoding::Yuv422([0, 2, 1, 3])),
    ("yuyv", Encoding::Yuv422([0, 2, 1, 3])),
    ("yvyu", Encoding::Yuv422([0, 2, 3, 1])),
    ("nv12", planar(2, true, false)),
    ("nv21", planar(2, true, true)),
    ("nv24", planar(1, true, false)),
    ("i420", planar(2, false, false)),
    ("yuv420", planar(2, false, false)),
    ("yv12", planar(2, false, true)),
    ("16uc1", Encoding::Depth { bytes: 2 }),
    ("32fc1", Encoding::Depth { bytes: 4 }),
    ("32fc3", Encoding::Vectors),
];

const fn packed(samples: usize, bytes: usize, rgb: [usize; 3]) -> Encoding {
    Encoding::Packed { samples, bytes, rgb }
}

const fn planar(spacing: usize, interleaved: bool, v_first: bool) -> Encoding {
    Encoding::Planar(Planes { spacing, interleaved, v_first })
}

impl Encoding {
    /// The encoding of that name; capitals and space around it do not count.
    pub fn named(name: &str) -> Option<Self> {
        let name = name.trim().to_ascii_lowercase();
        let of_table = TABLE.iter().find(|(n, _)| *n == name).map(|(_, encoding)| *encoding);
        of_table.or_else(|| {
            let (pattern, bytes) = Pattern::of_encoding(&name)?;
            Some(Self::Bayer { pattern, bytes })
        })
    }

    /// What its pixels mean.
    pub fn shows(self) -> Shows {
        match self {
            Self::Packed { .. } | Self::Bayer { .. } | Self::Yuv422(_) | Self::Planar(_) => Shows::Color,
            Self::Depth { .. } => Shows::Depth,
            Self::Vectors => Shows::Numbers,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_of_the_table_is_found_and_every_colour_is_listed() {
        for (name, encoding) in TABLE {
            assert_eq!(Encoding::named(&format!(" {}", name.to_ascii_uppercase())), Some(encoding));
            let listed = COLOR_ENCODINGS.to_ascii_lowercase().contains(name) || name == "yuv420";
            assert_eq!(listed, encoding.shows() == Shows::Color, "{name}");
        }
        let rggb = Encoding::named("BAYER_rggb16").unwrap();
        assert!(matches!(rggb, Encoding::Bayer { bytes: 2, .. }) && rggb.shows() == Shows::Color);
        for name in ["", "rgb", "bayer_rggb12", "nv99", "64FC1", "h264"] {
            assert_eq!(Encoding::named(name), None, "{name}");
        }
    }
}
