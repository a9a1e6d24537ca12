//! The summary section at the end of an MCAP file, believed only when it is consistent with itself and with the file.

use std::collections::BTreeSet;
use std::fs::File;
use std::path::Path;

use super::chunk::read_at;
use super::records::{Channel, ChunkIndex, Fields, RECORD_HEAD_BYTES, Schema, Statistics, for_each_record, op};
use crate::bag::error::BagError;
use crate::bag::limits::MAX_SUMMARY_BYTES;
use crate::bag::unpack::MCAP_MAGIC;

/// Body of a Footer record.
const FOOTER_BODY_BYTES: u64 = 8 + 8 + 4;
/// Footer record and the magic that ends the file.
const TAIL_BYTES: u64 = RECORD_HEAD_BYTES + FOOTER_BODY_BYTES + MCAP_MAGIC.len() as u64;

/// What the end of the file says.
pub enum Tail {
    /// No footer where it belongs: cut off, or still being written.
    Cut,
    /// A whole file whose writer made no (complete) summary.
    NoSummary,
    /// A summary that contradicts itself or the file.
    Inconsistent(String),
    /// A summary to rely on.
    Summary(Summary),
}

/// An index of the whole file.
pub struct Summary {
    pub schemas: Vec<Schema>,
    pub channels: Vec<Channel>,
    pub chunks: Vec<ChunkIndex>,
    pub statistics: Statistics,
}

/// Reads the footer and the summary.
pub fn read(file: &mut File, path: &Path, file_len: u64) -> Result<Tail, BagError> {
    let Some(footer_at) = file_len.checked_sub(TAIL_BYTES) else { return Ok(Tail::Cut) };
    let tail = read_at(file, path, footer_at, TAIL_BYTES as usize)?;
    let mut f = Fields(&tail);
    let footer = (|| {
        (f.u8()? == op::FOOTER && f.u64()? == FOOTER_BODY_BYTES).then_some(())?;
        let fields = (f.u64()?, f.u64()?, f.u32()?);
        (f.0 == MCAP_MAGIC).then_some(fields)
    })();
    let Some((start, _, crc)) = footer else { return Ok(Tail::Cut) };
    if start == 0 {
        return Ok(Tail::NoSummary);
    }
    let wrong = |why: String| Ok(Tail::Inconsistent(why));
    let Some(len) = footer_at.checked_sub(start) else {
        return wrong(format!("the footer puts it at byte {start}, past the footer at {footer_at}"));
    };
    if len > MAX_SUMMARY_BYTES {
        return wrong(format!("{len} bytes, over the limit of {MAX_SUMMARY_BYTES}"));
    }
    let bytes = read_at(file, path, start, len as usize)?;
    if crc != 0 {
        // The checksum covers the summary and the footer up to the checksum itself.
        let mut hasher = crc32fast::Hasher::new();
        hasher.update(&bytes);
        hasher.update(tail.get(..(RECORD_HEAD_BYTES + 16) as usize).unwrap_or(&[]));
        let found = hasher.finalize();
        if found != crc {
            return wrong(format!("checksum {found:08x} instead of {crc:08x}"));
        }
    }
    parse(&bytes, start)
}

fn parse(bytes: &[u8], summary_start: u64) -> Result<Tail, BagError> {
    let (mut schemas, mut channels, mut chunks, mut statistics) = (Vec::new(), Vec::new(), Vec::new(), None);
    let mut damaged = false;
    let partial = for_each_record(bytes, |opcode, _, body| match opcode {
        op::SCHEMA => keep(Schema::parse(body), &mut schemas, &mut damaged),
        op::CHANNEL => keep(Channel::parse(body), &mut channels, &mut damaged),
        op::CHUNK_INDEX => keep(ChunkIndex::parse(body), &mut chunks, &mut damaged),
        op::STATISTICS => statistics = Statistics::parse(body),
        _ => {}
    });
    if damaged || partial.is_some() {
        return Ok(Tail::Inconsistent("a record in it is cut off".to_owned()));
    }
    let Some(statistics) = statistics else { return Ok(Tail::NoSummary) };

    // Writers may leave out chunk indexes or channels; then the data itself is the index.
    let ids: BTreeSet<u16> = channels.iter().map(|c| c.id).collect();
    let counted: u64 = statistics.per_channel.iter().fold(0, |n, (_, c)| n.saturating_add(*c));
    let complete = chunks.len() as u64 == u64::from(statistics.chunk_count)
        && counted == statistics.message_count
        && statistics.per_channel.iter().all(|(id, _)| ids.contains(id));
    if !complete {
        return Ok(Tail::NoSummary);
    }
    chunks.sort_by_key(|c| c.offset);
    let mut end = MCAP_MAGIC.len() as u64;
    for c in &chunks {
        let next = c.offset.checked_add(c.length).and_then(|e| e.checked_add(c.message_index_length));
        match next {
            Some(next) if c.offset >= end && next <= summary_start && c.length >= RECORD_HEAD_BYTES => end = next,
            _ => return Ok(Tail::Inconsistent(format!("its chunk at byte {} does not fit the file", c.offset))),
        }
    }
    Ok(Tail::Summary(Summary { schemas, channels, chunks, statistics }))
}

fn keep<T>(parsed: Option<T>, out: &mut Vec<T>, damaged: &mut bool) {
    match parsed {
        Some(t) => out.push(t),
        None => *damaged = true,
    }
}
