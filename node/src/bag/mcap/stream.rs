//! Messages of an MCAP file in log-time order, ties in file order, with a bounded number of chunks in memory.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap, VecDeque};
use std::fs::File;
use std::sync::Arc;

use super::chunk::{self, ChunkPlace, read_at};
use super::index::{LooseMessage, McapIndex};
use super::records::{MESSAGE_HEAD_BYTES, MessageHead, for_each_record, op};
use crate::bag::FileMessage;
use crate::bag::error::BagError;
use crate::bag::limits::{CHUNK_CACHE_BYTES, MAX_MESSAGE_BYTES};
use crate::bag::locate::file_name;
use crate::bag::problems::Problems;

/// Where a message of an unpacked chunk lies; ordered as messages come out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Place {
    log_time_ns: i64,
    chunk_offset: u64,
    start: usize,
    len: usize,
    topic: usize,
}

/// An unpacked chunk: `None` when it was dropped to stay within the cache and must be read again.
#[derive(Debug)]
struct Unpacked {
    records: Option<Vec<u8>>,
    messages_left: usize,
    start_ns: i64,
}

/// Reads an MCAP file's messages on the wanted topics.
pub(crate) struct McapStream {
    index: Arc<McapIndex>,
    file: File,
    problems: Problems,
    wanted: Vec<bool>,
    chunks: VecDeque<ChunkPlace>,
    loose: VecDeque<LooseMessage>,
    unpacked: BTreeMap<u64, Unpacked>,
    unpacked_bytes: usize,
    cache_bytes: usize,
    heap: BinaryHeap<Reverse<Place>>,
}

impl McapStream {
    /// Starts reading; `wanted` says for each topic of the file whether its messages are.
    pub fn open(index: Arc<McapIndex>, wanted: Vec<bool>, problems: Problems) -> Result<Self, BagError> {
        let file = File::open(&index.path).map_err(BagError::io(&index.path))?;
        let is_wanted = |channel: &u16| match index.topic_of_channel.get(channel) {
            Some(topic) => wanted.get(*topic).copied().unwrap_or(false),
            // Possibly described inside the chunk only.
            None => true,
        };
        let holds_wanted = |c: &&ChunkPlace| c.channels.as_ref().is_none_or(|c| c.iter().any(is_wanted));
        let mut chunks: Vec<ChunkPlace> = index.chunks.iter().filter(holds_wanted).cloned().collect();
        chunks.sort_by_key(|c| (c.start_ns, c.offset));
        let mut loose: Vec<LooseMessage> = index.loose.iter().filter(|m| is_wanted(&m.channel)).copied().collect();
        loose.sort_by_key(|m| (m.log_time_ns, m.offset));
        Ok(Self {
            file,
            problems,
            wanted,
            chunks: chunks.into(),
            loose: loose.into(),
            unpacked: BTreeMap::new(),
            unpacked_bytes: 0,
            cache_bytes: CHUNK_CACHE_BYTES,
            heap: BinaryHeap::new(),
            index,
        })
    }

    #[cfg(test)]
    pub fn with_cache_bytes(mut self, bytes: usize) -> Self {
        self.cache_bytes = bytes;
        self
    }

    /// The next message, or `None` at the end.
    pub fn next_message(&mut self) -> Option<Result<FileMessage, BagError>> {
        loop {
            let next_time = match (self.heap.peek(), self.loose.front()) {
                (Some(Reverse(p)), Some(l)) => Some(p.log_time_ns.min(l.log_time_ns)),
                (Some(Reverse(p)), None) => Some(p.log_time_ns),
                (None, l) => l.map(|l| l.log_time_ns),
            };
            // A chunk that starts at the same time may hold a message that comes first in the file.
            if let Some(c) = self.chunks.front()
                && next_time.is_none_or(|t| c.start_ns <= t)
            {
                let (offset, start_ns) = (c.offset, c.start_ns);
                self.chunks.pop_front();
                if let Err(e) = self.unpack(offset, start_ns) {
                    return Some(Err(e));
                }
                continue;
            }
            let from_chunk = match (self.heap.peek(), self.loose.front()) {
                (None, None) => return None,
                (Some(Reverse(p)), Some(l)) => (p.log_time_ns, p.chunk_offset) <= (l.log_time_ns, l.offset),
                (Some(_), None) => true,
                (None, Some(_)) => false,
            };
            let message = if from_chunk { self.take_from_chunk() } else { self.take_loose() };
            match message {
                Ok(None) => {}
                Ok(Some(m)) => return Some(Ok(m)),
                Err(e) => return Some(Err(e)),
            }
        }
    }

    fn topic(&self, channel: u16) -> Option<usize> {
        let topic = *self.index.topic_of_channel.get(&channel)?;
        self.wanted.get(topic).copied().unwrap_or(false).then_some(topic)
    }

    fn problem(&self, what: &str) {
        self.problems.add(format!("{}: {what}", file_name(&self.index.path)));
    }

    fn unpack(&mut self, offset: u64, start_ns: i64) -> Result<(), BagError> {
        let content = chunk::load(&mut self.file, &self.index.path, self.index.file_len, offset)?;
        if let Some(why) = &content.problem {
            self.problem(why);
        }
        let mut places = Vec::new();
        let mut undescribed = 0u64;
        for_each_record(&content.records, |opcode, body_at, body| {
            if opcode != op::MESSAGE {
                return;
            }
            let Some(head) = MessageHead::parse(body) else { return };
            if !self.index.topic_of_channel.contains_key(&head.channel) {
                undescribed += 1;
            }
            let Some(topic) = self.topic(head.channel) else { return };
            let (start, len) = (body_at + MESSAGE_HEAD_BYTES, body.len() - MESSAGE_HEAD_BYTES);
            places.push(Place { log_time_ns: head.log_time_ns, chunk_offset: offset, start, len, topic });
        });
        if undescribed > 0 {
            self.problem(&chunk::undescribed(offset, undescribed));
        }
        if places.is_empty() {
            return Ok(());
        }
        if let Some(first_ns) = places.iter().map(|p| p.log_time_ns).min().filter(|first_ns| *first_ns < start_ns) {
            self.problem(&format!(
                "chunk at byte {offset}: its first message is of {first_ns} ns, its index says {start_ns}; messages may come \
                 out of order"
            ));
        }
        let messages_left = places.len();
        self.heap.extend(places.into_iter().map(Reverse));
        self.unpacked_bytes += content.records.len();
        self.unpacked.insert(offset, Unpacked { records: Some(content.records), messages_left, start_ns });
        self.shrink(offset);
        Ok(())
    }

    /// Drops the records of chunks that are needed last, except those of `keep`, until the cache is within bounds.
    fn shrink(&mut self, keep: u64) {
        while self.unpacked_bytes > self.cache_bytes {
            let last = self
                .unpacked
                .iter_mut()
                .filter(|(offset, u)| **offset != keep && u.records.is_some())
                .max_by_key(|(offset, u)| (u.start_ns, **offset));
            let Some((_, last)) = last else { return };
            self.unpacked_bytes -= last.records.take().map_or(0, |r| r.len());
        }
    }

    fn take_from_chunk(&mut self) -> Result<Option<FileMessage>, BagError> {
        let Some(Reverse(place)) = self.heap.pop() else { return Ok(None) };
        let dropped = self.unpacked.get(&place.chunk_offset).is_some_and(|u| u.records.is_none());
        if dropped {
            let content = chunk::load(&mut self.file, &self.index.path, self.index.file_len, place.chunk_offset)?;
            self.unpacked_bytes += content.records.len();
            if let Some(u) = self.unpacked.get_mut(&place.chunk_offset) {
                u.records = Some(content.records);
            }
            self.shrink(place.chunk_offset);
        }
        let Some(u) = self.unpacked.get_mut(&place.chunk_offset) else { return Ok(None) };
        let bytes = u.records.as_ref().and_then(|r| r.get(place.start..place.start + place.len));
        // The file may have changed underneath since the chunk was first read.
        let data = bytes.map(<[u8]>::to_vec);
        u.messages_left = u.messages_left.saturating_sub(1);
        if u.messages_left == 0
            && let Some(u) = self.unpacked.remove(&place.chunk_offset)
        {
            self.unpacked_bytes -= u.records.map_or(0, |r| r.len());
        }
        Ok(data.map(|data| FileMessage { topic: place.topic, log_time_ns: place.log_time_ns, data }))
    }

    fn take_loose(&mut self) -> Result<Option<FileMessage>, BagError> {
        let Some(m) = self.loose.pop_front() else { return Ok(None) };
        let Some(topic) = self.topic(m.channel) else {
            let channel = m.channel;
            self.problem(&format!("messages on channel {channel}, which nothing describes: skipped"));
            return Ok(None);
        };
        if m.len > MAX_MESSAGE_BYTES {
            let path = self.index.path.clone();
            let what = format!("message at byte {}", m.offset);
            return Err(BagError::TooLarge { path, what, claimed: m.len, limit: MAX_MESSAGE_BYTES });
        }
        let data = read_at(&mut self.file, &self.index.path, m.offset, m.len as usize)?;
        Ok(Some(FileMessage { topic, log_time_ns: m.log_time_ns, data }))
    }
}
