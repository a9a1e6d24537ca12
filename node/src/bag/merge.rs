//! One ordered stream over all files of a bag.

use std::collections::VecDeque;
use std::sync::Arc;

use super::error::BagError;
use super::mcap::McapStream;
use super::sqlite::SqliteStream;
use super::unpack::{is_zstd, unpack_message};
use super::{BagInner, FileMessage, RawMessage, Storage};

enum Stream {
    Mcap(Box<McapStream>),
    Sqlite(Box<SqliteStream>),
}

impl Stream {
    fn next_message(&mut self) -> Option<Result<FileMessage, BagError>> {
        match self {
            Self::Mcap(s) => s.next_message(),
            Self::Sqlite(s) => s.next_message(),
        }
    }
}

/// A file being read, with its next message taken out.
struct Open {
    file: usize,
    stream: Stream,
    head: FileMessage,
}

/// Messages of a bag in log-time order, ties in the order of the files and inside them. Owns all it needs, so it can be
/// moved to a reading thread. An `Err` is about one message or one file; what follows it is still read.
pub struct Messages {
    bag: Arc<BagInner>,
    wanted: Vec<bool>,
    /// Files not begun, by start time.
    waiting: VecDeque<(i64, usize)>,
    open: Vec<Open>,
    failed: VecDeque<BagError>,
    read: Vec<u64>,
    finished: bool,
}

impl Messages {
    pub(super) fn new(bag: Arc<BagInner>, wanted: Vec<bool>) -> Self {
        let mut waiting: Vec<(i64, usize)> =
            bag.files.iter().enumerate().filter_map(|(i, f)| Some((f.storage.span_ns()?.0, i))).collect();
        waiting.sort_unstable();
        let read = vec![0; bag.topics.len()];
        Self { bag, wanted, waiting: waiting.into(), open: Vec::new(), failed: VecDeque::new(), read, finished: false }
    }

    /// Opens every file that may hold the next message.
    fn open_due(&mut self) {
        loop {
            let next = self.open.iter().map(|o| o.head.log_time_ns).min();
            match self.waiting.front() {
                Some((start, file)) if next.is_none_or(|t| *start <= t) => {
                    let file = *file;
                    self.waiting.pop_front();
                    match self.stream(file) {
                        Ok(stream) => self.pull(file, stream),
                        Err(e) => self.failed.push_back(e),
                    }
                }
                _ => return,
            }
        }
    }

    fn stream(&self, file: usize) -> Result<Stream, BagError> {
        let f = self.bag.files.get(file).ok_or(BagError::NoSuchTopic { index: file, count: self.bag.files.len() })?;
        let wanted: Vec<bool> =
            f.topic_of_local.iter().map(|t| self.wanted.get(*t).copied().unwrap_or(false)).collect();
        let problems = &self.bag.problems;
        Ok(match &f.storage {
            Storage::Mcap(i) => Stream::Mcap(Box::new(McapStream::open(Arc::clone(i), wanted, problems.clone())?)),
            Storage::Sqlite(i) => Stream::Sqlite(Box::new(SqliteStream::open(Arc::clone(i), &wanted, problems)?)),
        })
    }

    /// Takes the next message out of a stream and keeps both; errors on the way are handed out first.
    fn pull(&mut self, file: usize, mut stream: Stream) {
        loop {
            match stream.next_message() {
                Some(Ok(head)) => {
                    self.open.push(Open { file, stream, head });
                    return;
                }
                Some(Err(e)) => self.failed.push_back(e),
                None => return,
            }
        }
    }

    fn finish(&mut self) {
        if self.finished {
            return;
        }
        self.finished = true;
        for ((topic, wanted), read) in self.bag.topics.iter().zip(&self.wanted).zip(&self.read) {
            if *wanted && *read != topic.count {
                let (name, promised) = (&topic.name, topic.count);
                self.bag.problems.add(format!("topic {name}: {read} of {promised} messages could be read"));
            }
        }
    }
}

impl Iterator for Messages {
    type Item = Result<RawMessage, BagError>;

    fn next(&mut self) -> Option<Self::Item> {
        if let Some(e) = self.failed.pop_front() {
            return Some(Err(e));
        }
        self.open_due();
        if let Some(e) = self.failed.pop_front() {
            return Some(Err(e));
        }
        let earliest = self.open.iter().enumerate().min_by_key(|(_, o)| (o.head.log_time_ns, o.file)).map(|(i, _)| i);
        let Some(earliest) = earliest else {
            self.finish();
            return None;
        };
        let Open { file, stream, head } = self.open.swap_remove(earliest);
        self.pull(file, stream);
        let topic = self.bag.files.get(file).and_then(|f| f.topic_of_local.get(head.topic)).copied()?;
        let data = if is_zstd(&head.data) {
            match unpack_message(&head.data) {
                Ok(data) => data,
                Err(why) => {
                    let topic = self.bag.topics.get(topic).map(|t| t.name.clone()).unwrap_or_default();
                    return Some(Err(BagError::Message { topic, log_time_ns: head.log_time_ns, why }));
                }
            }
        } else {
            head.data
        };
        if let Some(n) = self.read.get_mut(topic) {
            *n += 1;
        }
        Some(Ok(RawMessage { topic, log_time_ns: head.log_time_ns, data }))
    }
}
