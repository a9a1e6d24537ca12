//! The index of an MCAP file: its topics, where its chunks and its messages outside chunks lie.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use super::chunk::{self, ChunkPlace};
use super::records::{
    Channel, ChunkIndex, MESSAGE_HEAD_BYTES, MessageHead, RECORD_HEAD_BYTES, Schema, for_each_record, op, profile,
};
use super::summary::{self, Summary, Tail};
use crate::bag::error::BagError;
use crate::bag::limits::MAX_RECORD_BYTES;
use crate::bag::locate::file_name;
use crate::bag::problems::Problems;
use crate::bag::topics::{FileTopic, FileTopics};
use crate::bag::unpack::MCAP_MAGIC;

/// Read-ahead while walking record heads: most gaps between chunks hold a few small records.
const WALK_BUFFER_BYTES: usize = 8 << 10;

/// A message outside any chunk.
#[derive(Debug, Clone, Copy)]
pub struct LooseMessage {
    pub log_time_ns: i64,
    /// Offset of the message's data in the file.
    pub offset: u64,
    pub len: u64,
    pub channel: u16,
}

/// Everything needed to read an MCAP file's messages in order.
#[derive(Debug, Default)]
pub(crate) struct McapIndex {
    pub path: PathBuf,
    pub file_len: u64,
    /// Topics of the file; several channels may share one.
    pub topics: Vec<FileTopic>,
    /// Channel id to index into `topics`.
    pub topic_of_channel: BTreeMap<u16, usize>,
    /// Chunks in file order.
    pub chunks: Vec<ChunkPlace>,
    /// Messages outside chunks, in file order.
    pub loose: Vec<LooseMessage>,
    /// First and last log time, nanoseconds, when there is a message.
    pub span_ns: Option<(i64, i64)>,
}

impl McapIndex {
    /// Indexes a file: from its summary when that is whole, otherwise by walking (and unpacking) the data.
    pub fn open(path: &Path, problems: &Problems) -> Result<Self, BagError> {
        let mut file = File::open(path).map_err(BagError::io(path))?;
        let file_len = file.metadata().map_err(BagError::io(path))?.len();
        let name = file_name(path);
        let summary = match summary::read(&mut file, path, file_len)? {
            Tail::Summary(s) => Some(s),
            Tail::NoSummary => None,
            Tail::Inconsistent(why) => {
                problems.add(format!("{name}: its summary cannot be relied on ({why}); the data was indexed instead"));
                None
            }
            Tail::Cut => {
                problems.add(format!(
                    "{name}: the file has no end (cut off, or still being recorded); what is there is read"
                ));
                None
            }
        };
        if let Some(summary) = summary
            && let Some(index) = Walk::new(path, file_len, problems, Some(&summary)).run(&mut file)?
        {
            return Ok(index);
        }
        // Without a summary the walk always finishes.
        Ok(Walk::new(path, file_len, problems, None).run(&mut file)?.unwrap_or_default())
    }
}

/// A walk over the records of the data section.
struct Walk<'a> {
    path: &'a Path,
    file_len: u64,
    problems: &'a Problems,
    summary: Option<&'a Summary>,
    schemas: BTreeMap<u16, String>,
    topics: FileTopics,
    channel_keys: BTreeMap<u16, (String, String)>,
    index: McapIndex,
}

impl<'a> Walk<'a> {
    fn new(path: &'a Path, file_len: u64, problems: &'a Problems, summary: Option<&'a Summary>) -> Self {
        let index = McapIndex { path: path.to_owned(), file_len, ..McapIndex::default() };
        let (schemas, channel_keys) = (BTreeMap::new(), BTreeMap::new());
        Self { path, file_len, problems, summary, schemas, topics: FileTopics::default(), channel_keys, index }
    }

    /// `Ok(None)` when the summary does not know a chunk that is there, so that the walk must be done without it.
    fn run(mut self, file: &mut File) -> Result<Option<McapIndex>, BagError> {
        let mut known: BTreeMap<u64, &ChunkIndex> = BTreeMap::new();
        if let Some(s) = self.summary {
            known.extend(s.chunks.iter().map(|c| (c.offset, c)));
            for schema in &s.schemas {
                self.schemas.insert(schema.id, schema.name.clone());
            }
            for c in &s.channels {
                self.channel(c);
            }
        }
        let walker = File::open(self.path).map_err(BagError::io(self.path))?;
        let mut reader = BufReader::with_capacity(WALK_BUFFER_BYTES, walker);
        let mut at = MCAP_MAGIC.len() as u64;
        reader.seek(SeekFrom::Start(at)).map_err(BagError::io(self.path))?;
        while at < self.file_len {
            if let Some(c) = known.get(&at) {
                let channels = Some(c.channels.clone()).filter(|c| !c.is_empty());
                self.index.chunks.push(ChunkPlace { offset: at, start_ns: c.start_ns, channels });
                at = self.skip(&mut reader, at, c.length + c.message_index_length)?;
                continue;
            }
            let mut head = [0u8; RECORD_HEAD_BYTES as usize];
            if reader.read_exact(&mut head).is_err() {
                self.problem(format!("the file ends inside a record head at byte {at}"));
                break;
            }
            let [opcode, len @ ..] = head;
            let len = u64::from_le_bytes(len);
            let body = at + RECORD_HEAD_BYTES;
            if opcode == op::CHUNK {
                if self.summary.is_some() {
                    return Ok(None);
                }
                self.unindexed_chunk(file, at)?;
            } else {
                // What must not be overrun: the next chunk the summary knows, else the end of the file.
                let next_known = known.range(at..).next().map(|(offset, _)| *offset);
                let left = next_known.unwrap_or(self.file_len).saturating_sub(body);
                if opcode == 0 || len > left {
                    let what = format!("record 0x{opcode:02x} at byte {at} claims {len} bytes, {left} follow");
                    let Some(next) = next_known else {
                        self.problem(format!("{what}: nothing after it is read"));
                        break;
                    };
                    self.problem(format!("{what}: skipped to the chunk at byte {next}"));
                    reader.seek(SeekFrom::Start(next)).map_err(BagError::io(self.path))?;
                    at = next;
                    continue;
                }
            }
            let mut pos = body;
            match opcode {
                op::DATA_END | op::FOOTER => break,
                op::MESSAGE => {
                    let mut head = [0u8; MESSAGE_HEAD_BYTES];
                    let whole = len >= MESSAGE_HEAD_BYTES as u64 && reader.read_exact(&mut head).is_ok();
                    match MessageHead::parse(&head).filter(|_| whole) {
                        Some(m) => {
                            pos += MESSAGE_HEAD_BYTES as u64;
                            self.loose(m, pos, len - MESSAGE_HEAD_BYTES as u64);
                        }
                        None => self.problem(format!("message at byte {at} is too short ({len} bytes): skipped")),
                    }
                }
                op::HEADER | op::SCHEMA | op::CHANNEL if len <= MAX_RECORD_BYTES => {
                    let bytes = chunk::read_at(file, self.path, body, len as usize)?;
                    self.small_record(opcode, &bytes)?;
                }
                _ => {}
            }
            at = self.skip(&mut reader, pos, len - (pos - body))?;
        }
        Ok(Some(self.finish(known.len())))
    }

    fn skip(&self, reader: &mut BufReader<File>, at: u64, by: u64) -> Result<u64, BagError> {
        let next = at.saturating_add(by).min(self.file_len);
        let step = i64::try_from(next - at).unwrap_or(i64::MAX);
        reader.seek_relative(step).map_err(BagError::io(self.path))?;
        Ok(next)
    }

    fn finish(mut self, chunks_known: usize) -> McapIndex {
        if let Some(s) = self.summary {
            let (want, have) = (chunks_known, self.index.chunks.len());
            if want != have {
                self.problem(format!("{have} of the {want} chunks in its summary are where it says"));
            }
            for (channel, count) in &s.statistics.per_channel {
                if let Some(topic) = self.index.topic_of_channel.get(channel) {
                    self.topics.count(*topic, *count);
                }
            }
            if s.statistics.message_count > 0 {
                self.index.span_ns = Some((s.statistics.start_ns, s.statistics.end_ns));
            }
        } else {
            for m in &self.index.loose {
                if let Some(topic) = self.index.topic_of_channel.get(&m.channel) {
                    self.topics.count(*topic, 1);
                }
            }
        }
        self.index.topics = self.topics.into_vec();
        self.index
    }

    fn problem(&self, what: String) {
        self.problems.add(format!("{}: {what}", file_name(self.path)));
    }

    fn small_record(&mut self, opcode: u8, body: &[u8]) -> Result<(), BagError> {
        match opcode {
            op::HEADER => {
                let profile = profile(body).unwrap_or_default();
                if profile.eq_ignore_ascii_case("ros1") {
                    let found = "MCAP profile `ros1`".to_owned();
                    return Err(BagError::Serialization { path: self.path.to_owned(), found });
                }
            }
            op::SCHEMA => {
                if let Some(s) = Schema::parse(body) {
                    self.schemas.entry(s.id).or_insert(s.name);
                }
            }
            op::CHANNEL => match Channel::parse(body) {
                Some(c) => self.channel(&c),
                None => self.problem("a channel record is damaged".to_owned()),
            },
            _ => {}
        }
        Ok(())
    }

    fn channel(&mut self, c: &Channel) {
        let key = (c.topic.clone(), c.encoding.clone());
        if let Some(before) = self.channel_keys.get(&c.id) {
            if *before != key {
                let (id, old, new) = (c.id, &before.0, &c.topic);
                self.problem(format!("channel {id} is {old} first and {new} later: taken as {old}"));
            }
            return;
        }
        let type_name = self.schemas.get(&c.schema_id).cloned().unwrap_or_default();
        let topic = self.topics.index(&c.topic, &type_name, &c.encoding);
        self.index.topic_of_channel.insert(c.id, topic);
        self.channel_keys.insert(c.id, key);
    }

    fn loose(&mut self, m: MessageHead, offset: u64, len: u64) {
        self.saw(m.log_time_ns);
        self.index.loose.push(LooseMessage { log_time_ns: m.log_time_ns, offset, len, channel: m.channel });
    }

    fn saw(&mut self, t: i64) {
        let (a, b) = self.index.span_ns.unwrap_or((t, t));
        self.index.span_ns = Some((a.min(t), b.max(t)));
    }

    /// A chunk nothing describes: its channels and messages are found by unpacking it.
    fn unindexed_chunk(&mut self, file: &mut File, offset: u64) -> Result<(), BagError> {
        let content = chunk::load(file, self.path, self.file_len, offset)?;
        if let Some(why) = content.problem {
            self.problem(why);
        }
        let mut counts: BTreeMap<u16, u64> = BTreeMap::new();
        let mut first = Ok(());
        let mut start_ns = i64::MAX;
        for_each_record(&content.records, |opcode, _, body| match opcode {
            op::SCHEMA | op::CHANNEL => {
                if first.is_ok() {
                    first = self.small_record(opcode, body);
                }
            }
            op::MESSAGE => {
                if let Some(m) = MessageHead::parse(body) {
                    *counts.entry(m.channel).or_default() += 1;
                    start_ns = start_ns.min(m.log_time_ns);
                    self.saw(m.log_time_ns);
                }
            }
            _ => {}
        });
        first?;
        let mut undescribed = 0;
        for (channel, count) in &counts {
            match self.index.topic_of_channel.get(channel) {
                Some(topic) => self.topics.count(*topic, *count),
                None => undescribed += count,
            }
        }
        if undescribed > 0 {
            self.problem(chunk::undescribed(offset, undescribed));
        }
        if !counts.is_empty() {
            let channels = Some(counts.into_keys().collect());
            self.index.chunks.push(ChunkPlace { offset, start_ns, channels });
        }
        Ok(())
    }
}
