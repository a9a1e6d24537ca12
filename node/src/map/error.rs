//! Why a saved map could not be written or read.

use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::output::OutputError;

/// Errors of the map's files.
#[derive(Debug, Error)]
pub enum MapError {
    /// The file system refused.
    #[error("{}: {source}", path.display())]
    Io {
        /// Which file.
        path: PathBuf,
        /// What it said.
        source: std::io::Error,
    },
    /// A file is not what it should be.
    #[error("{}: {reason}", path.display())]
    Damaged {
        /// Which file; a tile's file carries the tile's index in its name.
        path: PathBuf,
        /// What is wrong, and what to do.
        reason: String,
    },
    /// The saved map was made with other sizes than the configuration asks for.
    #[error("{}: the map has {name} {saved}, the configuration {wanted}; set {name} to {saved} or save elsewhere", path.display())]
    OtherSizes {
        /// The index file.
        path: PathBuf,
        /// Which key.
        name: &'static str,
        /// What the map has.
        saved: f64,
        /// What was asked for.
        wanted: f64,
    },
    /// The save broke off.
    #[error("saving the map panicked: {0}; the last save stays whole")]
    Panicked(String),
    /// An output around it failed.
    #[error(transparent)]
    Output(#[from] OutputError),
}

impl MapError {
    /// For `map_err`: an I/O error with the file it is about.
    pub fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { path, source }
    }
}
