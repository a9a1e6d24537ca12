//! The CDR writer: primitives with their alignment, little-endian, after the 4-byte encapsulation header.
//!
//! Alignment is counted from the byte after that header, as DDS does it. The writer remembers the first thing it could
//! not represent, so the code that lays out a message reads as the message definition does.

use thiserror::Error;

/// Encapsulation header of plain little-endian CDR.
pub const CDR_LE_HEADER: [u8; 4] = [0x00, 0x01, 0x00, 0x00];

/// Nanoseconds in a second.
const NS_PER_SEC: i64 = 1_000_000_000;

/// Why a message could not be written.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum EncodeError {
    /// `builtin_interfaces/Time` has 32-bit seconds.
    #[error("stamp {stamp_ns} ns does not fit the 32-bit seconds of a ROS stamp; use stamps from 1901 to 2038")]
    Stamp {
        /// The stamp, nanoseconds.
        stamp_ns: i64,
    },
    /// Lengths are 32-bit on the wire.
    #[error("{what} has {len} elements, more than a CDR length can hold (4294967294); publish less at once")]
    Length {
        /// Which string or sequence.
        what: &'static str,
        /// Its length.
        len: usize,
    },
    /// A size field contradicts the data it describes.
    #[error("{what}: {got} bytes of data where the size fields say {expected}; fix the sizes")]
    Size {
        /// Which message.
        what: &'static str,
        /// Bytes the size fields ask for.
        expected: u64,
        /// Bytes there are.
        got: usize,
    },
    /// A string holds a NUL, which ends strings on the wire.
    #[error("the string {text:?} holds a NUL character; remove it")]
    Nul {
        /// The string.
        text: String,
    },
}

/// Lays out one message.
#[derive(Debug)]
pub struct CdrWriter {
    bytes: Vec<u8>,
    error: Option<EncodeError>,
}

impl Default for CdrWriter {
    fn default() -> Self {
        Self::with_capacity(64)
    }
}

impl CdrWriter {
    /// An empty message; `capacity` is a hint for its size in bytes.
    pub fn with_capacity(capacity: usize) -> Self {
        let mut bytes = Vec::with_capacity(capacity.saturating_add(CDR_LE_HEADER.len()));
        bytes.extend_from_slice(&CDR_LE_HEADER);
        Self { bytes, error: None }
    }

    /// The message, or the first thing that could not be represented.
    pub fn finish(self) -> Result<Vec<u8>, EncodeError> {
        match self.error {
            None => Ok(self.bytes),
            Some(error) => Err(error),
        }
    }

    /// Remembers `error` if it is the first.
    pub fn fail(&mut self, error: EncodeError) {
        self.error.get_or_insert(error);
    }

    fn align(&mut self, size: usize) {
        let payload = self.bytes.len() - CDR_LE_HEADER.len();
        self.bytes.resize(CDR_LE_HEADER.len() + payload.next_multiple_of(size), 0);
    }

    /// `bool`, one byte.
    pub fn bool(&mut self, value: bool) {
        self.bytes.push(u8::from(value));
    }

    /// `uint8`.
    pub fn u8(&mut self, value: u8) {
        self.bytes.push(value);
    }

    /// `uint32`.
    pub fn u32(&mut self, value: u32) {
        self.align(4);
        self.bytes.extend_from_slice(&value.to_le_bytes());
    }

    /// `int32`.
    pub fn i32(&mut self, value: i32) {
        self.align(4);
        self.bytes.extend_from_slice(&value.to_le_bytes());
    }

    /// `float32`.
    pub fn f32(&mut self, value: f32) {
        self.u32(value.to_bits());
    }

    /// `float64`.
    pub fn f64(&mut self, value: f64) {
        self.align(8);
        self.bytes.extend_from_slice(&value.to_le_bytes());
    }

    /// `float64[N]`: fixed size, no length in front.
    pub fn f64_array(&mut self, values: &[f64]) {
        for &v in values {
            self.f64(v);
        }
    }

    /// `string`: length with the closing NUL, the bytes, the NUL.
    pub fn string(&mut self, text: &str) {
        if text.contains('\0') {
            self.fail(EncodeError::Nul { text: text.to_owned() });
        }
        // One less than the largest length, because the NUL is counted.
        match u32::try_from(text.len()).ok().and_then(|n| n.checked_add(1)) {
            Some(n) => self.u32(n),
            None => return self.fail(EncodeError::Length { what: "string", len: text.len() }),
        }
        self.bytes.extend_from_slice(text.as_bytes());
        self.bytes.push(0);
    }

    /// Length of a sequence; its elements follow.
    pub fn sequence_len(&mut self, what: &'static str, len: usize) {
        match u32::try_from(len) {
            Ok(n) => self.u32(n),
            Err(_) => self.fail(EncodeError::Length { what, len }),
        }
    }

    /// `uint8[]`.
    pub fn byte_sequence(&mut self, what: &'static str, data: &[u8]) {
        self.sequence_len(what, data.len());
        self.bytes.extend_from_slice(data);
    }

    /// `builtin_interfaces/Time`; nanoseconds are counted up from the floor of the seconds, so negative stamps work.
    pub fn stamp(&mut self, stamp_ns: i64) {
        match i32::try_from(stamp_ns.div_euclid(NS_PER_SEC)) {
            Ok(sec) => {
                self.i32(sec);
                self.u32(stamp_ns.rem_euclid(NS_PER_SEC) as u32);
            }
            Err(_) => self.fail(EncodeError::Stamp { stamp_ns }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn alignment_counts_from_after_the_header() {
        let mut w = CdrWriter::default();
        w.u8(7);
        w.f64(1.0);
        w.u8(9);
        w.u32(5);
        let bytes = w.finish().unwrap();
        assert_eq!(&bytes[..4], &CDR_LE_HEADER);
        assert_eq!(bytes[4], 7);
        assert_eq!(&bytes[5..12], &[0; 7]);
        assert_eq!(&bytes[12..20], &1.0f64.to_le_bytes());
        assert_eq!(&bytes[20..24], &[9, 0, 0, 0]);
        assert_eq!(&bytes[24..], &5u32.to_le_bytes());
    }

    #[test]
    fn strings_carry_their_nul_and_stamps_their_floor() {
        let mut w = CdrWriter::default();
        w.string("ab");
        w.string("");
        w.stamp(-1);
        let bytes = w.finish().unwrap();
        assert_eq!(&bytes[4..11], &[3, 0, 0, 0, b'a', b'b', 0]);
        assert_eq!(&bytes[12..17], &[1, 0, 0, 0, 0]);
        assert_eq!(&bytes[20..24], &(-1i32).to_le_bytes());
        assert_eq!(&bytes[24..28], &999_999_999u32.to_le_bytes());
    }

    #[test]
    fn what_does_not_fit_is_refused_and_the_first_error_kept() {
        let mut w = CdrWriter::default();
        w.stamp(i64::MAX);
        w.string("a\0b");
        assert_eq!(w.finish(), Err(EncodeError::Stamp { stamp_ns: i64::MAX }));
        let mut w = CdrWriter::default();
        w.string("a\0b");
        assert!(matches!(w.finish(), Err(EncodeError::Nul { .. })));
    }
}
