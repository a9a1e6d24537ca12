//! JPEG files of USB cameras: frames of motion JPEG leave out the Huffman tables, which are always the same.

use std::borrow::Cow;

/// The tables of ITU-T T.81, K.3 (typical for 8-bit pictures), as one DHT segment: DC and AC of luma, DC and AC of chroma.
#[rustfmt::skip]
const STANDARD_TABLES: [u8; 420] = [
    0xff, 0xc4, 0x01, 0xa2,
    // DC, luma: how many codes there are of 1 to 16 bits, then their values.
    0x00, 0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0,
    0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11,
    // AC, luma.
    0x10, 0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 0x7d,
    0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51, 0x61, 0x07, 0x22, 0x71,
    0x14, 0x32, 0x81, 0x91, 0xa1, 0x08, 0x23, 0x42, 0xb1, 0xc1, 0x15, 0x52, 0xd1, 0xf0, 0x24, 0x33, 0x62, 0x72,
    0x82, 0x09, 0x0a, 0x16, 0x17, 0x18, 0x19, 0x1a, 0x25, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x34, 0x35, 0x36, 0x37,
    0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59,
    0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a, 0x83,
    0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a, 0xa2, 0xa3,
    0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba, 0xc2, 0xc3,
    0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda, 0xe1, 0xe2,
    0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf1, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
    // DC, chroma.
    0x01, 0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0,
    0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11,
    // AC, chroma.
    0x11, 0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 0x77,
    0x00, 0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61, 0x71, 0x13, 0x22,
    0x32, 0x81, 0x08, 0x14, 0x42, 0x91, 0xa1, 0xb1, 0xc1, 0x09, 0x23, 0x33, 0x52, 0xf0, 0x15, 0x62, 0x72, 0xd1,
    0x0a, 0x16, 0x24, 0x34, 0xe1, 0x25, 0xf1, 0x17, 0x18, 0x19, 0x1a, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x35, 0x36,
    0x37, 0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58,
    0x59, 0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a,
    0x82, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a,
    0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba,
    0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda,
    0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
];

const START_OF_IMAGE: u8 = 0xd8;
const HUFFMAN_TABLES: u8 = 0xc4;
const START_OF_SCAN: u8 = 0xda;
/// Frames coded with Huffman tables line by line: baseline and extended sequential.
const SEQUENTIAL: [u8; 2] = [0xc0, 0xc1];

/// The same file with the standard Huffman tables in it where a sequential JPEG brings none; any other bytes as they are.
pub fn with_huffman_tables(file: &[u8]) -> Cow<'_, [u8]> {
    if !needs_tables(file) {
        return Cow::Borrowed(file);
    }
    let (start, rest) = file.split_at(2);
    Cow::Owned([start, &STANDARD_TABLES, rest].concat())
}

/// True for a sequential JPEG without any table before its first scan.
fn needs_tables(file: &[u8]) -> bool {
    let Some(mut rest) = file.strip_prefix(&[0xff, START_OF_IMAGE]) else { return false };
    let mut sequential = false;
    loop {
        // Any number of 0xff may stand before a marker.
        let fill = rest.iter().take_while(|b| **b == 0xff).count();
        let [marker, high, low, ..] = *rest.get(fill..).unwrap_or(&[]) else { return false };
        if fill == 0 || marker == HUFFMAN_TABLES {
            return false;
        }
        if marker == START_OF_SCAN {
            return sequential;
        }
        sequential |= SEQUENTIAL.contains(&marker);
        let length = usize::from(u16::from_be_bytes([high, low]));
        let Some(after) = rest.get(fill + 1 + length.max(2)..) else { return false };
        rest = after;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{ImageFormat, RgbImage};
    use proptest::prelude::*;
    use std::io::Cursor;

    fn jpeg() -> Vec<u8> {
        let picture = RgbImage::from_fn(40, 24, |x, y| image::Rgb([x as u8 * 6, y as u8 * 10, (x + y) as u8 * 3]));
        let mut file = Vec::new();
        picture.write_to(&mut Cursor::new(&mut file), ImageFormat::Jpeg).unwrap();
        file
    }

    /// The file without its DHT segments.
    fn without_tables(file: &[u8]) -> Vec<u8> {
        let (mut out, mut at) = (file[..2].to_vec(), 2);
        loop {
            let (marker, length) = (file[at + 1], 2 + usize::from(u16::from_be_bytes([file[at + 2], file[at + 3]])));
            if marker == START_OF_SCAN {
                out.extend(&file[at..]);
                return out;
            }
            if marker != HUFFMAN_TABLES {
                out.extend(&file[at..at + length]);
            }
            at += length;
        }
    }

    #[test]
    fn the_segment_is_as_long_as_it_says() {
        assert_eq!(
            usize::from(u16::from_be_bytes([STANDARD_TABLES[2], STANDARD_TABLES[3]])) + 2,
            STANDARD_TABLES.len()
        );
        let mut at = 4;
        for class in [0x00, 0x10, 0x01, 0x11] {
            assert_eq!(STANDARD_TABLES[at], class);
            let values: usize = STANDARD_TABLES[at + 1..at + 17].iter().map(|n| usize::from(*n)).sum();
            let mut seen: Vec<u8> = STANDARD_TABLES[at + 17..at + 17 + values].to_vec();
            seen.sort_unstable();
            seen.dedup();
            assert_eq!(seen.len(), values, "a value stands twice");
            at += 17 + values;
        }
        assert_eq!(at, STANDARD_TABLES.len());
    }

    #[test]
    fn tables_are_given_where_there_are_none_and_nowhere_else() {
        let whole = jpeg();
        assert!(matches!(with_huffman_tables(&whole), Cow::Borrowed(_)));
        let bare = without_tables(&whole);
        assert!(bare.len() < whole.len());
        let mended = with_huffman_tables(&bare);
        let decode = |file: &[u8]| image::load_from_memory_with_format(file, ImageFormat::Jpeg).unwrap().into_rgb8();
        // The encoder writes the standard tables, so the pictures are equal to the last bit.
        assert_eq!(decode(&mended), decode(&whole));
        // Fill bytes before a marker are allowed.
        let filled = [&bare[..2], &[0xff, 0xff], &bare[2..]].concat();
        assert_eq!(with_huffman_tables(&filled).len(), filled.len() + STANDARD_TABLES.len());
        // A progressive frame has tables of its own, always.
        let mut progressive = bare.clone();
        let sof = progressive.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
        progressive[sof + 1] = 0xc2;
        assert!(matches!(with_huffman_tables(&progressive), Cow::Borrowed(_)));
    }

    proptest! {
        #[test]
        fn any_bytes_are_passed_on(mut data in proptest::collection::vec(any::<u8>(), 0..200), cut in 0usize..700) {
            prop_assert!(matches!(with_huffman_tables(&data), Cow::Borrowed(_)) || data.starts_with(&[0xff, 0xd8]));
            let bare = without_tables(&jpeg());
            data.splice(0..0, bare[..cut.min(bare.len())].iter().copied());
            let _ = with_huffman_tables(&data);
        }
    }
}
