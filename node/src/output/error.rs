//! Why an output could not be written or read back.

use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::cdr::write::EncodeError;

/// Errors of everything under `output`.
#[derive(Debug, Error)]
pub enum OutputError {
    /// The file system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// Which file.
        path: PathBuf,
        /// What it said.
        source: std::io::Error,
    },
    /// The MCAP writer refused.
    #[error("{}: MCAP writing failed: {source}", path.display())]
    Mcap {
        /// Which file.
        path: PathBuf,
        /// What it said.
        source: mcap::McapError,
    },
    /// A message could not be represented.
    #[error(transparent)]
    Encode(#[from] EncodeError),
    /// A picture could not be encoded.
    #[error("picture encoding failed: {0}")]
    Picture(#[from] image::ImageError),
    /// A number that must be finite is not.
    #[error("{what} {index} is not finite ({value}); nothing non-finite is written or accepted")]
    NonFinite {
        /// Which column.
        what: String,
        /// Which row.
        index: usize,
        /// The value.
        value: f64,
    },
    /// Arrays that belong together differ in length.
    #[error("{what} has {got} elements where {expected} belong; give arrays of one length")]
    Length {
        /// Which array.
        what: &'static str,
        /// Elements it should have.
        expected: usize,
        /// Elements it has.
        got: usize,
    },
    /// A file is not what it should be.
    #[error("{}: {reason}", path.display())]
    Format {
        /// Which file.
        path: PathBuf,
        /// What is wrong, and what to do.
        reason: String,
    },
    /// MCAP log times are unsigned.
    #[error("message on {topic} has stamp {stamp_ns} ns; MCAP needs stamps of 0 or later")]
    NegativeStamp {
        /// Which topic.
        topic: String,
        /// The stamp, nanoseconds.
        stamp_ns: i64,
    },
    /// A topic was used that this writer did not hand out.
    #[error("topic number {0} is not of this bag; use the TopicId that topic() gave")]
    UnknownTopic(usize),
}

impl OutputError {
    /// For `map_err`: an I/O error with the file it is about.
    pub fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { path, source }
    }

    /// For `map_err`: an MCAP error with the file it is about.
    pub fn mcap(path: &Path) -> impl FnOnce(mcap::McapError) -> Self {
        let path = path.to_owned();
        move |source| Self::Mcap { path, source }
    }
}
