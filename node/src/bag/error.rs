//! What can be wrong with a bag as a whole, or with one message of it.

use std::path::{Path, PathBuf};

/// Why a bag, or one message of it, cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum BagError {
    /// The file system said no.
    #[error("{}: {source}", path.display())]
    Io {
        /// File or folder.
        path: PathBuf,
        /// What the system reported.
        source: std::io::Error,
    },
    /// A file of no bytes.
    #[error("{}: the file is empty (0 bytes); was the recording or the copy interrupted?", path.display())]
    EmptyFile {
        /// The file.
        path: PathBuf,
    },
    /// Neither MCAP nor rosbag2 sqlite3.
    #[error("{}: not a ROS 2 bag: {found}; accepted: MCAP (.mcap), rosbag2 sqlite3 (.db3), both also as .zstd", path.display())]
    NotABag {
        /// The file.
        path: PathBuf,
        /// What it looks like.
        found: String,
    },
    /// A folder without any bag file.
    #[error("{}: no bag in this folder{why}; expected .mcap or .db3 files, with or without metadata.yaml", path.display())]
    NoBagInFolder {
        /// The folder.
        path: PathBuf,
        /// More, when something is known.
        why: String,
    },
    /// A folder with files of both storages and no metadata.yaml that says which are meant.
    #[error("{}: MCAP and sqlite3 files in one folder ({first}, {second}); name one file, or keep one kind", path.display())]
    MixedStorage {
        /// The folder.
        path: PathBuf,
        /// A file of one kind.
        first: String,
        /// A file of the other kind.
        second: String,
    },
    /// Messages in something other than CDR.
    #[error("{}: not ROS 2 messages: found {found}; accepted: message encoding `cdr` (convert with `ros2 bag convert` or rosbags-convert)", path.display())]
    Serialization {
        /// File or folder.
        path: PathBuf,
        /// Profile or encodings found.
        found: String,
    },
    /// A compression nobody here can undo.
    #[error("{}: compression `{found}` is not supported; accepted: zstd, lz4 (MCAP chunks), none", path.display())]
    Compression {
        /// File or folder.
        path: PathBuf,
        /// Name of the compression.
        found: String,
    },
    /// More bytes claimed than are ever read into memory or unpacked to disk.
    #[error("{}: {what} of {claimed} bytes is over the limit of {limit}", path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// What claims to be that large.
        what: String,
        /// Bytes claimed.
        claimed: u64,
        /// Bytes allowed.
        limit: u64,
    },
    /// The storage is damaged where nothing can be read without it.
    #[error("{}: {why}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is damaged.
        why: String,
    },
    /// A topic index that the bag does not have.
    #[error("topic index {index}: the bag has {count} topics")]
    NoSuchTopic {
        /// Index asked for.
        index: usize,
        /// Topics there are.
        count: usize,
    },
    /// A topic whose messages are not CDR.
    #[error("topic {topic}: serialization `{serialization}` cannot be read, only `cdr`")]
    TopicSerialization {
        /// Topic name.
        topic: String,
        /// Its serialization.
        serialization: String,
    },
    /// One message cannot be read; the ones after it can.
    #[error("topic {topic}, logged at {log_time_ns} ns: {why}")]
    Message {
        /// Topic name.
        topic: String,
        /// Log time, nanoseconds.
        log_time_ns: i64,
        /// What is wrong.
        why: String,
    },
}

impl BagError {
    /// Wraps an I/O error with the path it is about.
    pub(crate) fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { path, source }
    }

    /// Wraps an sqlite error with the path it is about.
    pub(crate) fn sqlite(path: &Path) -> impl FnOnce(rusqlite::Error) -> Self {
        let path = path.to_owned();
        move |e| Self::Damaged { path, why: format!("sqlite3 database cannot be read: {e}") }
    }
}
