//! What could not be read but did not stop us: one line each, shared by everything that reads a bag.

use std::sync::{Arc, Mutex, PoisonError};

use super::limits::MAX_PROBLEMS;

/// Problem lines of a bag, without repeats, in the order they were found.
#[derive(Debug, Clone, Default)]
pub(crate) struct Problems(Arc<Mutex<Lines>>);

#[derive(Debug, Default)]
struct Lines {
    kept: Vec<String>,
    more: usize,
}

impl Problems {
    /// Adds a line unless it is there already.
    pub fn add(&self, line: impl Into<String>) {
        let line = line.into();
        let mut lines = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if lines.kept.contains(&line) {
        } else if lines.kept.len() < MAX_PROBLEMS {
            lines.kept.push(line);
        } else {
            lines.more += 1;
        }
    }

    /// All lines so far, with a last one that counts those left out.
    pub fn lines(&self) -> Vec<String> {
        let lines = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut out = lines.kept.clone();
        if lines.more > 0 {
            out.push(format!("and {} more problems", lines.more));
        }
        out
    }
}
