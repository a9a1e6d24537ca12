//! One chunk: read, decompressed, checked.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use super::records::{CHUNK_HEAD_BYTES_MAX, ChunkHead, RECORD_HEAD_BYTES};
use crate::bag::error::BagError;
use crate::bag::limits::MAX_CHUNK_BYTES;
use crate::bag::unpack::{read_bounded, unpack_zstd};

/// Where a chunk lies in the file and what it is for.
#[derive(Debug, Clone)]
pub struct ChunkPlace {
    /// Offset of the record (its opcode).
    pub offset: u64,
    /// Earliest log time, nanoseconds.
    pub start_ns: i64,
    /// Channels with messages in it, where an index says so.
    pub channels: Option<Vec<u16>>,
}

/// A chunk's records, and what is wrong with them, if anything.
pub struct ChunkContent {
    /// Decompressed records; when `problem` is set, those before the damage.
    pub records: Vec<u8>,
    /// What is wrong.
    pub problem: Option<String>,
}

/// The line about messages whose channel is nowhere described: the same at indexing and at reading.
pub fn undescribed(chunk_offset: u64, messages: u64) -> String {
    format!("chunk at byte {chunk_offset}: {messages} messages on channels nothing describes: skipped")
}

/// Reads `len` bytes at `offset`, fewer when the file ends before.
pub fn read_at(file: &mut File, path: &Path, offset: u64, len: usize) -> Result<Vec<u8>, BagError> {
    file.seek(SeekFrom::Start(offset)).map_err(BagError::io(path))?;
    let mut out = Vec::with_capacity(len);
    file.take(len as u64).read_to_end(&mut out).map_err(BagError::io(path))?;
    Ok(out)
}

/// Reads and decompresses the chunk whose record starts at `offset` in a file of `file_len` bytes.
///
/// A chunk that is cut off or damaged gives the records before the damage; one whose checksum is wrong gives none, since
/// no telling which byte is.
pub fn load(file: &mut File, path: &Path, file_len: u64, offset: u64) -> Result<ChunkContent, BagError> {
    let body = offset.saturating_add(RECORD_HEAD_BYTES);
    let left = file_len.saturating_sub(body);
    let head = read_at(file, path, body, CHUNK_HEAD_BYTES_MAX.min(usize::try_from(left).unwrap_or(usize::MAX)))?;
    let broken =
        |why: String| ChunkContent { records: Vec::new(), problem: Some(format!("chunk at byte {offset}: {why}")) };
    let Some(head) = ChunkHead::parse(&head) else {
        return Ok(broken(format!("its head is cut off or damaged ({left} bytes follow)")));
    };
    // Writers put all-ones where the sizes will go; a recorder that dies before leaves them.
    let never_closed = head.compressed_size == u64::MAX && head.uncompressed_size == u64::MAX;
    let mut there = left.saturating_sub(head.data_offset).min(head.compressed_size);
    let mut unpacked_limit = head.uncompressed_size;
    if never_closed {
        (there, unpacked_limit) = (there.min(MAX_CHUNK_BYTES), MAX_CHUNK_BYTES);
    } else if head.uncompressed_size > MAX_CHUNK_BYTES || there > MAX_CHUNK_BYTES {
        let (claimed, packed) = (head.uncompressed_size, head.compressed_size);
        let why = format!("claims {claimed} bytes ({packed} compressed), over the limit of {MAX_CHUNK_BYTES}: skipped");
        return Ok(broken(why));
    }
    // Within MAX_CHUNK_BYTES and within the file, so it fits memory.
    let data = read_at(file, path, body + head.data_offset, there as usize)?;
    let cut = (data.len() as u64) < head.compressed_size;

    let (records, mut why) = match head.compression.as_str() {
        "" => (data, None),
        "zstd" => unpack_zstd(&data, unpacked_limit),
        "lz4" => match lz4::Decoder::new(data.as_slice()) {
            Ok(d) => read_bounded(d, unpacked_limit),
            Err(e) => (Vec::new(), Some(e.to_string())),
        },
        other => return Ok(broken(format!("compression `{other}` is not supported (zstd, lz4, none): skipped"))),
    };
    if never_closed {
        why = Some(format!("never closed by its writer; messages in the {there} bytes that follow are read"));
    } else if cut {
        let packed = head.compressed_size;
        why = Some(format!("the file ends {there} bytes into its {packed}; messages up to there are read"));
    } else if records.len() as u64 != head.uncompressed_size {
        let detail = why.map(|w| format!(" ({w})")).unwrap_or_default();
        why = Some(format!("{} of {} bytes could be unpacked{detail}", records.len(), head.uncompressed_size));
    } else if head.uncompressed_crc != 0 {
        let found = crc32fast::hash(&records);
        if found != head.uncompressed_crc {
            let want = head.uncompressed_crc;
            return Ok(broken(format!("checksum {found:08x} instead of {want:08x}: skipped")));
        }
    }
    let problem = why.map(|w| format!("chunk at byte {offset}: {w}"));
    Ok(ChunkContent { records, problem })
}
