//! MCAP records as slices: little-endian fields, every length checked against the bytes there are.

/// Opcodes used here.
pub mod op {
    pub const HEADER: u8 = 0x01;
    pub const FOOTER: u8 = 0x02;
    pub const SCHEMA: u8 = 0x03;
    pub const CHANNEL: u8 = 0x04;
    pub const MESSAGE: u8 = 0x05;
    pub const CHUNK: u8 = 0x06;
    pub const CHUNK_INDEX: u8 = 0x08;
    pub const STATISTICS: u8 = 0x0b;
    pub const DATA_END: u8 = 0x0f;
}

/// Opcode and length in front of every record.
pub const RECORD_HEAD_BYTES: u64 = 9;
/// Fixed part of a Message record.
pub const MESSAGE_HEAD_BYTES: usize = 2 + 4 + 8 + 8;
/// Most bytes of a Chunk record in front of its data: fixed fields and a compression name of up to 32 bytes.
pub const CHUNK_HEAD_BYTES_MAX: usize = 8 + 8 + 8 + 4 + 4 + 32 + 8;

/// Takes fields off the front of a record body; `None` when the body is too short.
#[derive(Clone, Copy)]
pub struct Fields<'a>(pub &'a [u8]);

impl<'a> Fields<'a> {
    pub fn take(&mut self, n: usize) -> Option<&'a [u8]> {
        let (head, rest) = self.0.split_at_checked(n)?;
        self.0 = rest;
        Some(head)
    }
    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (head, rest) = self.0.split_first_chunk()?;
        self.0 = rest;
        Some(*head)
    }
    pub fn u8(&mut self) -> Option<u8> {
        self.array().map(u8::from_le_bytes)
    }
    pub fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }
    pub fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }
    pub fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }
    /// Length-prefixed bytes.
    pub fn blob(&mut self) -> Option<&'a [u8]> {
        let n = self.u32()?;
        self.take(usize::try_from(n).ok()?)
    }
    pub fn string(&mut self) -> Option<String> {
        self.blob().map(|b| String::from_utf8_lossy(b).into_owned())
    }
}

/// Profile of a Header record.
pub fn profile(body: &[u8]) -> Option<String> {
    Fields(body).string()
}

/// Name of a schema (its text is not needed: messages are decoded by type name).
pub struct Schema {
    pub id: u16,
    pub name: String,
}

impl Schema {
    pub fn parse(body: &[u8]) -> Option<Self> {
        let mut f = Fields(body);
        Some(Self { id: f.u16()?, name: f.string()? })
    }
}

/// A channel: topic, encoding and schema.
pub struct Channel {
    pub id: u16,
    pub schema_id: u16,
    pub topic: String,
    pub encoding: String,
}

impl Channel {
    pub fn parse(body: &[u8]) -> Option<Self> {
        let mut f = Fields(body);
        Some(Self { id: f.u16()?, schema_id: f.u16()?, topic: f.string()?, encoding: f.string()? })
    }
}

/// The fixed part of a message.
#[derive(Clone, Copy)]
pub struct MessageHead {
    pub channel: u16,
    pub log_time_ns: i64,
}

impl MessageHead {
    pub fn parse(body: &[u8]) -> Option<Self> {
        let mut f = Fields(body);
        let channel = f.u16()?;
        f.u32()?;
        let log_time_ns = saturating_ns(f.u64()?);
        f.u64()?;
        Some(Self { channel, log_time_ns })
    }
}

/// MCAP times are unsigned; everything after the year 2262 is the end of time here.
pub fn saturating_ns(t: u64) -> i64 {
    i64::try_from(t).unwrap_or(i64::MAX)
}

/// Fixed part of a Chunk record.
pub struct ChunkHead {
    pub uncompressed_size: u64,
    pub uncompressed_crc: u32,
    pub compression: String,
    pub compressed_size: u64,
    /// Bytes from the start of the record body to the data.
    pub data_offset: u64,
}

impl ChunkHead {
    pub fn parse(body: &[u8]) -> Option<Self> {
        let mut f = Fields(body);
        f.u64()?; // start and end time: messages have their own
        f.u64()?;
        let uncompressed_size = f.u64()?;
        let uncompressed_crc = f.u32()?;
        let compression = f.string()?;
        let compressed_size = f.u64()?;
        let data_offset = (body.len() - f.0.len()) as u64;
        Some(Self { uncompressed_size, uncompressed_crc, compression, compressed_size, data_offset })
    }
}

/// Where a chunk lies, as the summary says.
#[derive(Debug, Clone)]
pub struct ChunkIndex {
    pub start_ns: i64,
    pub offset: u64,
    pub length: u64,
    pub channels: Vec<u16>,
    pub message_index_length: u64,
}

impl ChunkIndex {
    pub fn parse(body: &[u8]) -> Option<Self> {
        let mut f = Fields(body);
        let start_ns = saturating_ns(f.u64()?);
        f.u64()?;
        let (offset, length) = (f.u64()?, f.u64()?);
        let mut map = Fields(f.blob()?);
        let mut channels = Vec::new();
        while let (Some(id), Some(_)) = (map.u16(), map.u64()) {
            channels.push(id);
        }
        Some(Self { start_ns, offset, length, channels, message_index_length: f.u64()? })
    }
}

/// The counts of a Statistics record.
pub struct Statistics {
    pub message_count: u64,
    pub chunk_count: u32,
    pub per_channel: Vec<(u16, u64)>,
    pub start_ns: i64,
    pub end_ns: i64,
}

impl Statistics {
    pub fn parse(body: &[u8]) -> Option<Self> {
        let mut f = Fields(body);
        let message_count = f.u64()?;
        f.u16()?; // schemas
        f.u32()?; // channels
        f.u32()?; // attachments
        f.u32()?; // metadata
        let chunk_count = f.u32()?;
        let (start_ns, end_ns) = (saturating_ns(f.u64()?), saturating_ns(f.u64()?));
        let mut map = Fields(f.blob()?);
        let mut per_channel = Vec::new();
        while let (Some(id), Some(count)) = (map.u16(), map.u64()) {
            per_channel.push((id, count));
        }
        Some(Self { message_count, chunk_count, per_channel, start_ns, end_ns })
    }
}

/// Calls `each` with opcode, offset of the body and body of every whole record; returns the offset where a partial one
/// begins, if the bytes end inside a record.
pub fn for_each_record<'a>(bytes: &'a [u8], mut each: impl FnMut(u8, usize, &'a [u8])) -> Option<usize> {
    let mut f = Fields(bytes);
    while !f.0.is_empty() {
        let start = bytes.len() - f.0.len();
        let record = (|| {
            let opcode = f.u8()?;
            let len = usize::try_from(f.u64()?).ok()?;
            Some((opcode, bytes.len() - f.0.len(), f.take(len)?))
        })();
        match record {
            Some((opcode, offset, body)) => each(opcode, offset, body),
            None => return Some(start),
        }
    }
    None
}
