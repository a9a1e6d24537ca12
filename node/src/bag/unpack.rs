//! zstd files and messages, with the size known or bounded before it is believed; and what a file is by its first bytes.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::Path;

use tempfile::NamedTempFile;

use super::error::BagError;
use super::limits::{FIRST_RESERVATION_BYTES, MAX_MESSAGE_BYTES, MAX_UNPACK_RATIO, UNPACK_ALLOWANCE_BYTES};

/// First bytes of a zstd frame. A CDR message starts with a zero byte, so the two cannot be confused.
const ZSTD_MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];
/// First bytes of an MCAP file.
pub(crate) const MCAP_MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', 0x30, b'\r', b'\n'];
const SQLITE_MAGIC: &[u8] = b"SQLite format 3\0";
const ROS1_MAGIC: &[u8] = b"#ROSBAG V";

/// What a file is by its first bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FileKind {
    Mcap,
    Sqlite,
    Zstd,
}

/// Looks at the first bytes of a file.
pub(crate) fn sniff(path: &Path) -> Result<FileKind, BagError> {
    let mut head = Vec::with_capacity(16);
    let file = File::open(path).map_err(BagError::io(path))?;
    file.take(16).read_to_end(&mut head).map_err(BagError::io(path))?;
    let not_a_bag = |found: String| Err(BagError::NotABag { path: path.to_owned(), found });
    if head.is_empty() {
        Err(BagError::EmptyFile { path: path.to_owned() })
    } else if head.starts_with(&MCAP_MAGIC) {
        Ok(FileKind::Mcap)
    } else if head.starts_with(SQLITE_MAGIC) {
        Ok(FileKind::Sqlite)
    } else if head.starts_with(&ZSTD_MAGIC) {
        Ok(FileKind::Zstd)
    } else if head.starts_with(ROS1_MAGIC) {
        not_a_bag("it is a ROS 1 bag (convert it with rosbags-convert)".to_owned())
    } else if MCAP_MAGIC.starts_with(&head) || SQLITE_MAGIC.starts_with(&head) {
        not_a_bag(format!("the file is cut off after {} bytes", head.len()))
    } else if head.starts_with(&MCAP_MAGIC[..5]) {
        not_a_bag("it is an MCAP of an unknown version".to_owned())
    } else {
        not_a_bag(format!("it begins with bytes {}", hex(&head)))
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect::<Vec<_>>().join(" ")
}

/// Unpacks a zstd file beside the system's temporary files; it is removed when the handle goes.
/// The second value says when the compressed file broke off: what came before is kept.
pub(crate) fn unpack_file(path: &Path) -> Result<(NamedTempFile, Option<String>), BagError> {
    let file = File::open(path).map_err(BagError::io(path))?;
    let packed = file.metadata().map_err(BagError::io(path))?.len();
    let limit = packed.saturating_mul(MAX_UNPACK_RATIO).saturating_add(UNPACK_ALLOWANCE_BYTES);
    let too_large = |claimed| BagError::TooLarge {
        path: path.to_owned(),
        what: format!("zstd file of {packed} bytes: content"),
        claimed,
        limit,
    };
    let mut head = Vec::new();
    (&file).take(18).read_to_end(&mut head).map_err(BagError::io(path))?;
    if let Ok(Some(claimed)) = zstd::zstd_safe::get_frame_content_size(&head)
        && claimed > limit
    {
        return Err(too_large(claimed));
    }
    (&file).seek(SeekFrom::Start(0)).map_err(BagError::io(path))?;

    let mut reader = zstd::stream::read::Decoder::new(&file).map_err(BagError::io(path))?;
    let mut out = NamedTempFile::new().map_err(BagError::io(&std::env::temp_dir()))?;
    let mut buffer = vec![0u8; 1 << 20];
    let mut written = 0u64;
    let mut problem = None;
    loop {
        let n = match reader.read(&mut buffer) {
            Ok(0) => break,
            Ok(n) => n,
            Err(e) => {
                problem = Some(format!("zstd data is damaged after {written} unpacked bytes: {e}"));
                break;
            }
        };
        written += n as u64;
        if written > limit {
            return Err(too_large(written));
        }
        out.write_all(buffer.get(..n).unwrap_or(&[])).map_err(BagError::io(out.path()))?;
    }
    out.flush().map_err(BagError::io(out.path()))?;
    Ok((out, problem))
}

/// True when a message is a zstd frame instead of CDR (rosbag2's `compression_mode: message`).
pub(crate) fn is_zstd(message: &[u8]) -> bool {
    message.starts_with(&ZSTD_MAGIC)
}

/// Decompresses one message.
pub(crate) fn unpack_message(data: &[u8]) -> Result<Vec<u8>, String> {
    let claimed = zstd::zstd_safe::get_frame_content_size(data).ok().flatten();
    if let Some(claimed) = claimed.filter(|c| *c > MAX_MESSAGE_BYTES) {
        return Err(format!("compressed message claims {claimed} bytes, over the limit of {MAX_MESSAGE_BYTES}"));
    }
    let (out, problem) = unpack_zstd(data, claimed.unwrap_or(MAX_MESSAGE_BYTES));
    match problem {
        None => Ok(out),
        Some(why) => Err(format!("compressed message: {why}")),
    }
}

/// Decompresses one zstd frame of at most `limit` bytes; on damage, what came before it and why it ended.
pub(crate) fn unpack_zstd(data: &[u8], limit: u64) -> (Vec<u8>, Option<String>) {
    match zstd::stream::read::Decoder::with_buffer(data) {
        Ok(decoder) => read_bounded(decoder.single_frame(), limit),
        Err(e) => (Vec::new(), Some(e.to_string())),
    }
}

/// Reads to the end, at most `limit` bytes, growing with the data and not with the claim.
pub(crate) fn read_bounded(reader: impl Read, limit: u64) -> (Vec<u8>, Option<String>) {
    let mut out = Vec::with_capacity(limit.min(FIRST_RESERVATION_BYTES) as usize);
    match reader.take(limit.saturating_add(1)).read_to_end(&mut out) {
        Ok(_) if out.len() as u64 > limit => {
            out.truncate(limit as usize);
            (out, Some(format!("more than the {limit} bytes it should be")))
        }
        Ok(_) => (out, None),
        Err(e) => (out, Some(e.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_round_trip_and_bombs_are_refused() {
        let data: Vec<u8> = (0..100_000u32).map(|i| (i % 251) as u8).collect();
        let packed = zstd::bulk::compress(&data, 3).unwrap();
        assert!(is_zstd(&packed) && !is_zstd(&[0, 1, 0, 0, 5]));
        assert_eq!(unpack_message(&packed).unwrap(), data);
        assert!(unpack_message(&packed[..packed.len() / 2]).is_err());
        let (part, why) = unpack_zstd(&packed, 1000);
        assert_eq!(part, data[..1000]);
        assert!(why.unwrap().contains("1000"));
        // A frame header that claims 2^40 bytes: magic, descriptor (8-byte size, single segment), size.
        let claim = [&ZSTD_MAGIC[..], &[0xe0], &(1u64 << 40).to_le_bytes(), &[0; 16]].concat();
        assert!(unpack_message(&claim).unwrap_err().contains("1099511627776"));
    }

    #[test]
    fn files_are_told_apart_by_their_first_bytes() {
        let d = tempfile::tempdir().unwrap();
        let f = d.path().join("f");
        let say = |bytes: &[u8]| {
            std::fs::write(&f, bytes).unwrap();
            sniff(&f).map_err(|e| e.to_string())
        };
        assert_eq!(say(&MCAP_MAGIC), Ok(FileKind::Mcap));
        assert_eq!(say(b"SQLite format 3\0...."), Ok(FileKind::Sqlite));
        assert_eq!(say(&ZSTD_MAGIC), Ok(FileKind::Zstd));
        assert!(say(b"").unwrap_err().contains("0 bytes"));
        assert!(say(b"#ROSBAG V2.0\n").unwrap_err().contains("ROS 1"));
        assert!(say(b"\x89MCA").unwrap_err().contains("cut off after 4"));
        assert!(say(b"hello").unwrap_err().contains("68 65 6c 6c 6f"));
    }
}
