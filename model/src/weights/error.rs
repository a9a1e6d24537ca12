//! What is wrong with a weight file.

use std::path::{Path, PathBuf};

/// How many names an error lists before it says how many more there are.
const NAMES_SHOWN: usize = 8;

/// Errors of reading and writing weights; each names the file or the tensor.
#[derive(Debug, thiserror::Error)]
pub enum WeightsError {
    /// The file cannot be opened, read or written.
    #[error("weights '{}': {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is not of a kind we read, or is damaged.
    #[error("weights '{}': {reason}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What is wrong and what would help.
        reason: String,
    },
    /// The tensors are not those of the network.
    #[error("weights do not fit the network: {0}")]
    Mismatch(Mismatch),
    /// A tensor that cannot be read.
    #[error("tensor '{name}': {reason}")]
    Tensor {
        /// Its name.
        name: String,
        /// What is wrong.
        reason: String,
    },
}

impl WeightsError {
    pub(crate) fn missing(name: &str) -> Self {
        Self::Mismatch(Mismatch { missing: vec![name.to_owned()], ..Mismatch::default() })
    }

    pub(crate) fn format(path: &Path, reason: impl Into<String>) -> Self {
        Self::Format { path: path.to_owned(), reason: reason.into() }
    }

    pub(crate) fn io(path: &Path, source: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), source }
    }

    pub(crate) fn tensor(name: &str, reason: impl Into<String>) -> Self {
        Self::Tensor { name: name.to_owned(), reason: reason.into() }
    }
}

/// Differences between the tensors of a file and those of a network.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mismatch {
    /// Tensors the network has and the file lacks.
    pub missing: Vec<String>,
    /// Tensors the file has and the network lacks.
    pub extra: Vec<String>,
    /// Name, shape in the file, shape in the network.
    pub shapes: Vec<(String, Vec<usize>, Vec<usize>)>,
}

impl Mismatch {
    /// True when there is no difference.
    pub fn is_empty(&self) -> bool {
        self.missing.is_empty() && self.extra.is_empty() && self.shapes.is_empty()
    }
}

impl std::fmt::Display for Mismatch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let shapes = self.shapes.iter().map(|(name, have, want)| format!("{name} is {have:?}, expected {want:?}"));
        let groups = [
            ("wrong shape", shapes.collect::<Vec<_>>()),
            ("missing", self.missing.clone()),
            ("not in the network", self.extra.clone()),
        ];
        let mut first = true;
        for (what, names) in groups.iter().filter(|(_, names)| !names.is_empty()) {
            let more = names.len().saturating_sub(NAMES_SHOWN);
            let listed = names.iter().take(NAMES_SHOWN).cloned().collect::<Vec<_>>().join(", ");
            let separator = if first { "" } else { "; " };
            write!(f, "{separator}{what}: {listed}")?;
            if more > 0 {
                write!(f, " and {more} more")?;
            }
            first = false;
        }
        Ok(())
    }
}
