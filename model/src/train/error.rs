//! What can end a training run, with the offending name, value and the fix in one line.

use std::path::{Path, PathBuf};

use storm_render::world::WorldError;

use crate::error::ModelError;

/// Errors of training.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// A loss, gradient or weight that is no longer a number; the weights of the step before are in the last checkpoint.
    #[error(
        "step {step}: {count} non-finite value(s) in {tensor} (batch seed {batch_seed}); lower --lr, or raise the velocity regulariser, and resume from the last checkpoint"
    )]
    NonFinite {
        /// The step, counted from 0.
        step: u64,
        /// Which tensor: `loss NAME`, `gradient of NAME` or `weight NAME`.
        tensor: String,
        /// Reproduces the batch together with its sizes.
        batch_seed: u64,
        /// How many values.
        count: usize,
    },
    /// An option outside its range.
    #[error("training option `{name}` is {value}; use {allowed}")]
    Option {
        /// The option.
        name: &'static str,
        /// What was given.
        value: String,
        /// What is allowed.
        allowed: &'static str,
    },
    /// A checkpoint that cannot be used.
    #[error("checkpoint {}: {reason}", path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A recording, or a file a loss needs, that cannot be used.
    #[error("{0}")]
    Source(String),
    /// A thread that made samples is gone.
    #[error("the threads that make training clips have stopped")]
    Loader,
    /// A drive that cannot be made.
    #[error(transparent)]
    World(#[from] WorldError),
    /// The network, its weights or an error figure.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The tensor library.
    #[error("tensor operation: {0}")]
    Tensor(#[from] candle_core::Error),
}

impl TrainError {
    pub(crate) fn checkpoint(path: &Path, reason: impl ToString) -> Self {
        Self::Checkpoint { path: path.to_owned(), reason: reason.to_string() }
    }
}
