//! The `format` of a CompressedImage, as image_transport's plugins and camera drivers write it.
//!
//! | written by | looks like |
//! |---|---|
//! | `compressed` | `bgr8; jpeg compressed bgr8`, `bayer_rggb8; jpeg compressed `, `16UC1; png compressed ` |
//! | `compressedDepth` | `32FC1; compressedDepth png`, `16UC1; compressedDepth` |
//! | `zstd` | `zstd` |
//! | drivers, converters | `jpeg`, `png`, `mjpeg`, `h264`, nothing |

use super::encoding::{Encoding, Shows};

/// How the data of a CompressedImage are packed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Codec {
    /// An image file, which says itself of what kind it is.
    File,
    /// A header of 12 bytes, then depth as an image file (`compressed_depth_image_transport`).
    Depth,
    /// A raw image, packed without loss (`zstd_image_transport`).
    Zstd,
    /// Nothing that is decoded here: video, or a kind of file of another name.
    Other,
}

/// What a `format` says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Format<'a> {
    /// Encoding of the picture before it was packed; empty where the format does not say.
    pub encoding: &'a str,
    /// How it is packed.
    pub codec: Codec,
    /// The codec's name; empty where the format does not say.
    pub codec_name: &'a str,
    /// Encoding of the pixels in the file; empty where the format does not say.
    pub stored: &'a str,
}

fn codec(name: &str) -> Option<Codec> {
    Some(match name.to_ascii_lowercase().as_str() {
        "" | "jpeg" | "jpg" | "mjpeg" | "mjpg" | "png" | "tiff" | "tif" => Codec::File,
        "compresseddepth" => Codec::Depth,
        "zstd" => Codec::Zstd,
        _ => return None,
    })
}

impl<'a> Format<'a> {
    /// Any text is a format; what is in no table is kept by name.
    pub fn parse(text: &'a str) -> Self {
        let Some((encoding, rest)) = text.split_once(';') else {
            let word = text.trim();
            // Old versions of compressedDepth wrote the encoding alone.
            return match (codec(word), Encoding::named(word).map(Encoding::shows)) {
                (Some(codec), _) => Self { encoding: "", codec, codec_name: word, stored: "" },
                (None, Some(Shows::Depth)) => Self { encoding: word, codec: Codec::Depth, codec_name: "", stored: "" },
                (None, Some(_)) => Self { encoding: word, codec: Codec::File, codec_name: "", stored: "" },
                (None, None) => Self { encoding: "", codec: Codec::Other, codec_name: word, stored: "" },
            };
        };
        let mut words = rest.split_whitespace();
        let codec_name = words.next().unwrap_or("");
        let stored = words.find(|w| *w != "compressed").unwrap_or("");
        Self { encoding: encoding.trim(), codec: codec(codec_name).unwrap_or(Codec::Other), codec_name, stored }
    }

    /// What the pixels mean, as far as the format says.
    pub fn shows(&self) -> Shows {
        if self.codec == Codec::Depth {
            return Shows::Depth;
        }
        Encoding::named(self.encoding).map_or(Shows::Color, Encoding::shows)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn what_the_plugins_write() {
        for (text, encoding, codec, name, stored) in [
            ("bgr8; jpeg compressed bgr8", "bgr8", Codec::File, "jpeg", "bgr8"),
            ("bayer_rggb8; jpeg compressed ", "bayer_rggb8", Codec::File, "jpeg", ""),
            ("rgb8; png compressed", "rgb8", Codec::File, "png", ""),
            ("mono8;jpeg compressed", "mono8", Codec::File, "jpeg", ""),
            ("16UC1; compressedDepth png", "16UC1", Codec::Depth, "compressedDepth", "png"),
            ("32FC1; compressedDepth", "32FC1", Codec::Depth, "compressedDepth", ""),
            ("32FC1", "32FC1", Codec::Depth, "", ""),
            ("jpeg", "", Codec::File, "jpeg", ""),
            (" PNG ", "", Codec::File, "PNG", ""),
            ("mjpeg", "", Codec::File, "mjpeg", ""),
            ("tiff", "", Codec::File, "tiff", ""),
            ("", "", Codec::File, "", ""),
            ("bgr8", "bgr8", Codec::File, "", ""),
            ("zstd", "", Codec::Zstd, "zstd", ""),
            ("h264", "", Codec::Other, "h264", ""),
            ("rgb8; qoi compressed rgb8", "rgb8", Codec::Other, "qoi", "rgb8"),
        ] {
            let want = Format { encoding, codec, codec_name: name, stored };
            assert_eq!(Format::parse(text), want, "{text}");
        }
        for (text, shows) in [
            ("16UC1; png compressed ", Shows::Depth),
            ("32FC1; tiff compressed ", Shows::Depth),
            ("16UC1; compressedDepth rvl", Shows::Depth),
            ("compressedDepth", Shows::Depth),
            ("bayer_gbrg8; jpeg compressed ", Shows::Color),
            ("jpeg", Shows::Color),
        ] {
            assert_eq!(Format::parse(text).shows(), shows, "{text}");
        }
    }

    proptest! {
        #[test]
        fn any_text_is_read(text in any::<String>()) {
            let f = Format::parse(&text);
            prop_assert!([f.encoding, f.codec_name, f.stored].iter().all(|part| text.contains(part)));
            let _ = f.shows();
        }

        #[test]
        fn parts_survive_space_and_capitals(
            encoding in prop::sample::select(vec!["bgr8", "rgb8", "mono8", "bayer_bggr8", "16UC1", "32FC1", "nv12", "other"]),
            codec in prop::sample::select(vec![("jpeg", Codec::File), ("PNG", Codec::File), ("tiff", Codec::File),
                ("compressedDepth", Codec::Depth), ("zstd", Codec::Zstd), ("av1", Codec::Other)]),
            stored in prop::sample::select(vec!["", "bgr8", "bgr16"]),
            space in "[ \t]{0,3}",
        ) {
            let text = format!("{space}{encoding}{space};{space}{} compressed {stored}{space}", codec.0);
            let want = Format { encoding, codec: codec.1, codec_name: codec.0, stored };
            prop_assert_eq!(Format::parse(&text), want);
        }
    }
}
