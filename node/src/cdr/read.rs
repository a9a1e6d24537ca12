//! A cursor over CDR bytes: encapsulation header, byte order, alignment, and lengths checked before anything is allocated.
//!
//! Plain XCDR version 1 as ROS 2 middlewares write it: every primitive is aligned to its own size, counted from the first
//! byte after the 4-byte encapsulation header.

/// Bytes of the encapsulation header (representation identifier and options).
const ENCAPSULATION_BYTES: usize = 4;

/// Why bytes are not the message they were said to be.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CdrError {
    /// Fewer bytes than the encapsulation header.
    #[error("{message}: {have} bytes are too few for a CDR header (4 bytes)")]
    NoHeader {
        /// Message type being read.
        message: &'static str,
        /// Bytes there are.
        have: usize,
    },
    /// A representation other than plain CDR.
    #[error("{message}: CDR representation 0x{id:04x} ({name}) is not supported, only plain CDR 0x0000 and 0x0001")]
    Representation {
        /// Message type being read.
        message: &'static str,
        /// Representation identifier found.
        id: u16,
        /// What that identifier means.
        name: &'static str,
    },
    /// A field reaches past the end.
    #[error("{message}.{field}: needs {need} bytes at offset {offset}, {have} are left")]
    Short {
        /// Message type being read.
        message: &'static str,
        /// Field being read.
        field: &'static str,
        /// Offset in the message, encapsulation header included.
        offset: usize,
        /// Bytes the field claims.
        need: u64,
        /// Bytes left.
        have: usize,
    },
    /// The dispatcher does not know the type.
    #[error("`{type_name}` is not a pose type; accepted: {accepted}")]
    NotAPose {
        /// Type asked for.
        type_name: String,
        /// Types the dispatcher reads.
        accepted: &'static str,
    },
}

/// Reads one message's fields in order.
#[derive(Debug, Clone)]
pub struct CdrReader<'a> {
    message: &'static str,
    bytes: &'a [u8],
    pos: usize,
    big_endian: bool,
}

/// A primitive of CDR: fixed size, aligned to that size.
trait Primitive: Sized {
    const SIZE: usize;
    fn from_bytes(bytes: &[u8], big_endian: bool) -> Self;
}

macro_rules! primitive {
    ($($t:ty),*) => {$(
        impl Primitive for $t {
            const SIZE: usize = size_of::<$t>();
            fn from_bytes(bytes: &[u8], big_endian: bool) -> Self {
                let mut raw = [0u8; size_of::<$t>()];
                raw.copy_from_slice(bytes);
                if big_endian { <$t>::from_be_bytes(raw) } else { <$t>::from_le_bytes(raw) }
            }
        }
    )*};
}
primitive!(u8, u32, i32, f64);

impl<'a> CdrReader<'a> {
    /// Starts on `bytes` (encapsulation header included); `message` is the type's name, for errors.
    ///
    /// # Errors
    /// Too few bytes, or a representation other than plain CDR.
    pub fn new(message: &'static str, bytes: &'a [u8]) -> Result<Self, CdrError> {
        let [hi, lo, _, _, ..] = *bytes else { return Err(CdrError::NoHeader { message, have: bytes.len() }) };
        let id = u16::from_be_bytes([hi, lo]);
        let big_endian = match id {
            0x0000 => true,
            0x0001 => false,
            _ => return Err(CdrError::Representation { message, id, name: representation_name(id) }),
        };
        Ok(Self { message, bytes, pos: ENCAPSULATION_BYTES, big_endian })
    }

    /// Bytes not read yet.
    pub fn remaining(&self) -> usize {
        self.bytes.len().saturating_sub(self.pos)
    }

    fn align(&mut self, size: usize) {
        let from_origin = self.pos - ENCAPSULATION_BYTES;
        self.pos += (size - from_origin % size) % size;
    }

    /// The next `count` bytes, unaligned.
    ///
    /// # Errors
    /// Fewer bytes are left.
    pub fn take(&mut self, field: &'static str, count: usize) -> Result<&'a [u8], CdrError> {
        let rest = self.bytes.get(self.pos..).unwrap_or(&[]);
        match rest.get(..count) {
            Some(taken) => {
                self.pos += count;
                Ok(taken)
            }
            None => Err(self.short(field, count as u64)),
        }
    }

    fn short(&self, field: &'static str, need: u64) -> CdrError {
        CdrError::Short { message: self.message, field, offset: self.pos, need, have: self.remaining() }
    }

    fn primitive<T: Primitive>(&mut self, field: &'static str) -> Result<T, CdrError> {
        self.align(T::SIZE);
        let big_endian = self.big_endian;
        Ok(T::from_bytes(self.take(field, T::SIZE)?, big_endian))
    }

    /// One byte.
    ///
    /// # Errors
    /// No byte is left.
    pub fn u8(&mut self, field: &'static str) -> Result<u8, CdrError> {
        self.primitive(field)
    }

    /// A 32-bit unsigned integer.
    ///
    /// # Errors
    /// Fewer bytes are left.
    pub fn u32(&mut self, field: &'static str) -> Result<u32, CdrError> {
        self.primitive(field)
    }

    /// A 32-bit signed integer.
    ///
    /// # Errors
    /// Fewer bytes are left.
    pub fn i32(&mut self, field: &'static str) -> Result<i32, CdrError> {
        self.primitive(field)
    }

    /// A double.
    ///
    /// # Errors
    /// Fewer bytes are left.
    pub fn f64(&mut self, field: &'static str) -> Result<f64, CdrError> {
        self.primitive(field)
    }

    /// `N` doubles in a row (a CDR array: no length in front).
    ///
    /// # Errors
    /// Fewer bytes are left.
    pub fn f64_array<const N: usize>(&mut self, field: &'static str) -> Result<[f64; N], CdrError> {
        let mut out = [0.0; N];
        for x in &mut out {
            *x = self.f64(field)?;
        }
        Ok(out)
    }

    /// Length of a sequence whose elements take at least `min_bytes` each, refused when the rest cannot hold it.
    ///
    /// # Errors
    /// The claimed elements do not fit the bytes that are left.
    pub fn sequence_len(&mut self, field: &'static str, min_bytes: usize) -> Result<usize, CdrError> {
        let len = self.u32(field)?;
        let need = u64::from(len) * min_bytes as u64;
        if need <= self.remaining() as u64 { Ok(len as usize) } else { Err(self.short(field, need)) }
    }

    /// A sequence of bytes.
    ///
    /// # Errors
    /// The claimed length does not fit.
    pub fn bytes(&mut self, field: &'static str) -> Result<&'a [u8], CdrError> {
        let len = self.sequence_len(field, 1)?;
        self.take(field, len)
    }

    /// A sequence of doubles.
    ///
    /// # Errors
    /// The claimed length does not fit.
    pub fn f64_sequence(&mut self, field: &'static str) -> Result<Vec<f64>, CdrError> {
        let len = self.sequence_len(field, size_of::<f64>())?;
        (0..len).map(|_| self.f64(field)).collect()
    }

    /// A string: its length counts the terminating NUL; a missing NUL is tolerated, bytes that are not UTF-8 are replaced.
    ///
    /// # Errors
    /// The claimed length does not fit.
    pub fn string(&mut self, field: &'static str) -> Result<String, CdrError> {
        let raw = self.bytes(field)?;
        let text = raw.strip_suffix(&[0]).unwrap_or(raw);
        Ok(String::from_utf8_lossy(text).into_owned())
    }
}

fn representation_name(id: u16) -> &'static str {
    match id {
        0x0002 | 0x0003 => "parameter list, PL_CDR",
        0x0006 | 0x0007 => "XCDR2",
        0x0008 | 0x0009 => "delimited XCDR2",
        0x000a | 0x000b => "parameter list XCDR2",
        _ => "unknown; is the message compressed or in another serialization?",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn alignment_counts_from_after_the_header() {
        // u8, then a double at the next multiple of 8 after the header, i.e. file offset 12.
        let mut bytes = vec![0, 1, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0];
        bytes.extend_from_slice(&2.5f64.to_le_bytes());
        let mut r = CdrReader::new("t", &bytes).unwrap();
        assert_eq!(r.u8("a").unwrap(), 7);
        assert_eq!(r.f64("b").unwrap(), 2.5);
        assert_eq!(r.remaining(), 0);
    }

    #[test]
    fn both_byte_orders_and_refused_representations() {
        assert_eq!(CdrReader::new("t", &[0, 0, 0, 0, 0, 0, 1, 2]).unwrap().u32("x").unwrap(), 258);
        assert_eq!(CdrReader::new("t", &[0, 1, 0, 0, 2, 1, 0, 0]).unwrap().u32("x").unwrap(), 258);
        let e = CdrReader::new("t", &[0, 3, 0, 0, 0, 0]).unwrap_err().to_string();
        assert!(e.contains("PL_CDR") && e.contains("0x0003"), "{e}");
        assert_eq!(CdrReader::new("t", &[0, 1]).unwrap_err(), CdrError::NoHeader { message: "t", have: 2 });
    }

    #[test]
    fn strings_with_and_without_nul() {
        for (raw, want) in
            [(&[4, 0, 0, 0, b'a', b'b', b'c', 0][..], "abc"), (&[3, 0, 0, 0, b'a', b'b', b'c'], "abc"), (&[0; 4], "")]
        {
            let bytes = [&[0, 1, 0, 0], raw].concat();
            assert_eq!(CdrReader::new("t", &bytes).unwrap().string("s").unwrap(), want);
        }
    }

    #[test]
    fn claimed_lengths_are_checked_before_allocating() {
        let bytes = [0, 1, 0, 0, 0xff, 0xff, 0xff, 0xff, 1, 2];
        let e = CdrReader::new("t", &bytes).unwrap().f64_sequence("d").unwrap_err();
        assert_eq!(e, CdrError::Short { message: "t", field: "d", offset: 8, need: 0xffff_ffff * 8, have: 2 });
    }
}
