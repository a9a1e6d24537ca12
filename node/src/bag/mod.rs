//! Recorded bags: MCAP and rosbag2 sqlite3, one file or a folder.
//!
//! [`Bag::open`] finds the files (`locate`, `metadata`), unpacks `.zstd` ones, and indexes each by its storage (`mcap`,
//! `sqlite`); [`Bag::messages`] merges them into one stream in log-time order (`merge`). Whatever is damaged but did not
//! stop us becomes a line of [`Bag::problems`]. Nothing is ever written beside a bag.

mod error;
mod limits;
mod locate;
mod mcap;
mod merge;
mod metadata;
mod problems;
mod sqlite;
#[cfg(test)]
mod tests;
mod topics;
mod unpack;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use tempfile::NamedTempFile;

pub use error::BagError;
pub use merge::Messages;
pub use topics::{Topic, normalized_type};

use locate::{Located, file_name};
use mcap::McapIndex;
use problems::Problems;
use sqlite::SqliteIndex;
use topics::{FileTopic, FileTopics};
use unpack::FileKind;
pub(crate) use unpack::{is_zstd, read_bounded, unpack_zstd};

/// Serializations that an error lists.
const MOST_NAMED: usize = 8;

/// One message as recorded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RawMessage {
    /// Index into [`Bag::topics`].
    pub topic: usize,
    /// When it was recorded, nanoseconds (not the header's stamp).
    pub log_time_ns: i64,
    /// CDR bytes, encapsulation header included.
    pub data: Vec<u8>,
}

/// One message of one file, its topic counted in that file.
#[derive(Debug)]
pub(crate) struct FileMessage {
    pub topic: usize,
    pub log_time_ns: i64,
    pub data: Vec<u8>,
}

#[derive(Debug)]
enum Storage {
    Mcap(Arc<McapIndex>),
    Sqlite(Arc<SqliteIndex>),
}

impl Storage {
    fn topics(&self) -> &[FileTopic] {
        match self {
            Self::Mcap(i) => &i.topics,
            Self::Sqlite(i) => &i.topics,
        }
    }

    fn span_ns(&self) -> Option<(i64, i64)> {
        match self {
            Self::Mcap(i) => i.span_ns,
            Self::Sqlite(i) => i.span_ns,
        }
    }
}

#[derive(Debug)]
struct BagFile {
    path: PathBuf,
    storage: Storage,
    /// Index in the file's topics to index in the bag's.
    topic_of_local: Vec<usize>,
    /// Keeps an unpacked copy alive.
    _unpacked: Option<NamedTempFile>,
}

#[derive(Debug)]
struct BagInner {
    files: Vec<BagFile>,
    topics: Vec<Topic>,
    problems: Problems,
}

/// A bag that is open for reading.
#[derive(Debug, Clone)]
pub struct Bag {
    inner: Arc<BagInner>,
}

impl Bag {
    /// Opens a bag file, or a folder with the files of one bag. Files of a bag that cannot be read are left out with a
    /// problem line, as long as one can.
    ///
    /// # Errors
    /// Nothing there can be read, or nothing in it is CDR; the error says what was found and what is accepted.
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let problems = Problems::default();
        let Located { files: paths, metadata } = locate::locate(path, &problems)?;
        let mut files = Vec::new();
        let mut topics = FileTopics::default();
        let mut first_error = None;
        for file_path in paths {
            match open_file(&file_path, &problems) {
                Ok((storage, unpacked)) => {
                    let mut topic_of_local = Vec::new();
                    for t in storage.topics() {
                        let said = metadata.as_ref().and_then(|m| m.other_serialization(&t.name));
                        let index = topics.index(&t.name, &t.type_name, said.unwrap_or(&t.serialization));
                        topics.count(index, t.count);
                        topic_of_local.push(index);
                    }
                    files.push(BagFile { path: file_path, storage, topic_of_local, _unpacked: unpacked });
                }
                Err(e) => {
                    problems.add(format!("left out: {e}"));
                    first_error.get_or_insert(e);
                }
            }
        }
        if let (true, Some(e)) = (files.is_empty(), first_error) {
            return Err(e);
        }
        let topics = topics.into_vec();
        refuse_other_serializations(path, &topics, &problems)?;
        let bag = Self { inner: Arc::new(BagInner { files, topics, problems }) };
        bag.note_counts(metadata.and_then(|m| m.message_count));
        Ok(bag)
    }

    fn note_counts(&self, promised: Option<u64>) {
        let have = self.message_count();
        let problems = &self.inner.problems;
        if let Some(promised) = promised.filter(|p| *p != have) {
            problems.add(format!("metadata.yaml promises {promised} messages, the files hold {have}"));
        }
        if have == 0 {
            problems.add("the bag holds no message".to_owned());
        }
    }

    /// Topics in the order they were found; those whose serialization is not `cdr` are listed but cannot be read.
    pub fn topics(&self) -> &[Topic] {
        &self.inner.topics
    }

    /// Index of the first topic of that name that can be read.
    pub fn topic(&self, name: &str) -> Option<usize> {
        self.inner.topics.iter().position(|t| t.name == name && t.is_readable())
    }

    /// Messages in all files, those of unreadable topics included.
    pub fn message_count(&self) -> u64 {
        self.inner.topics.iter().fold(0, |n, t| n.saturating_add(t.count))
    }

    /// Files of the bag, in order.
    pub fn files(&self) -> impl Iterator<Item = &Path> {
        self.inner.files.iter().map(|f| f.path.as_path())
    }

    /// Log time of the first message, nanoseconds; `None` in an empty bag.
    pub fn start_ns(&self) -> Option<i64> {
        self.inner.files.iter().filter_map(|f| Some(f.storage.span_ns()?.0)).min()
    }

    /// Log time of the last message, nanoseconds; `None` in an empty bag.
    pub fn end_ns(&self) -> Option<i64> {
        self.inner.files.iter().filter_map(|f| Some(f.storage.span_ns()?.1)).max()
    }

    /// Messages of the topics with the indices `wanted`, in log-time order over all files, ties in file order (where the index
    /// of an MCAP file says when its chunks begin as it is; else there is a problem line). Streams:
    /// memory holds a bounded number of MCAP chunks and, for sqlite3, 24 bytes per message beside the message at hand.
    ///
    /// # Errors
    /// An index out of range, or a topic that is not CDR.
    pub fn messages(&self, wanted: &[usize]) -> Result<Messages, BagError> {
        let topics = &self.inner.topics;
        let mut mask = vec![false; topics.len()];
        for &index in wanted {
            let no_such = BagError::NoSuchTopic { index, count: topics.len() };
            let (Some(slot), Some(topic)) = (mask.get_mut(index), topics.get(index)) else { return Err(no_such) };
            if !topic.is_readable() {
                let (topic, serialization) = (topic.name.clone(), topic.serialization.clone());
                return Err(BagError::TopicSerialization { topic, serialization });
            }
            *slot = true;
        }
        Ok(Messages::new(Arc::clone(&self.inner), mask))
    }

    /// What could not be read but did not stop us, one line each; complete once the messages have been read.
    pub fn problems(&self) -> Vec<String> {
        self.inner.problems.lines()
    }
}

/// Opens one file, unpacking it first when it is a zstd file.
fn open_file(path: &Path, problems: &Problems) -> Result<(Storage, Option<NamedTempFile>), BagError> {
    let (inner, unpacked) = match unpack::sniff(path)? {
        FileKind::Zstd => {
            let (file, problem) = unpack::unpack_file(path)?;
            if let Some(why) = problem {
                problems.add(format!("{}: {why}", file_name(path)));
            }
            (file.path().to_owned(), Some(file))
        }
        _ => (path.to_owned(), None),
    };
    let renamed = |e: BagError| match (e, &unpacked) {
        (BagError::NotABag { found, .. }, Some(_)) => {
            BagError::NotABag { path: path.to_owned(), found: format!("inside the zstd file: {found}") }
        }
        (BagError::EmptyFile { .. }, Some(_)) => {
            BagError::NotABag { path: path.to_owned(), found: "the zstd file holds nothing".to_owned() }
        }
        (e, _) => e,
    };
    let storage = match unpack::sniff(&inner).map_err(renamed)? {
        FileKind::Mcap => Storage::Mcap(Arc::new(McapIndex::open(&inner, problems)?)),
        FileKind::Sqlite => Storage::Sqlite(Arc::new(SqliteIndex::open(&inner, problems).map_err(renamed)?)),
        FileKind::Zstd => {
            let found = "a zstd file inside a zstd file".to_owned();
            return Err(BagError::NotABag { path: path.to_owned(), found });
        }
    };
    Ok((storage, unpacked))
}

/// Refuses a bag in which nothing can be read; notes the topics that cannot otherwise.
fn refuse_other_serializations(path: &Path, topics: &[Topic], problems: &Problems) -> Result<(), BagError> {
    let unreadable = topics.iter().filter(|t| !t.is_readable()).map(|t| t.serialization.as_str());
    let others: BTreeSet<&str> = unreadable.collect();
    if others.is_empty() {
        return Ok(());
    }
    if topics.iter().all(|t| !t.is_readable()) {
        let mut named: Vec<String> = others.iter().take(MOST_NAMED).map(|s| format!("`{s}`")).collect();
        if others.len() > MOST_NAMED {
            named.push("...".to_owned());
        }
        let found = format!("serialization {} on all {} topics", named.join(", "), topics.len());
        return Err(BagError::Serialization { path: path.to_owned(), found });
    }
    for t in topics.iter().filter(|t| !t.is_readable()) {
        problems.add(format!("topic {}: serialization `{}` cannot be read, only `cdr`", t.name, t.serialization));
    }
    Ok(())
}
