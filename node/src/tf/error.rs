//! What can be wrong with a transform, or with asking for one. Every message names the frames.

use thiserror::Error;

use crate::poses::PoseReject;

/// Why a transform was refused.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum TfError {
    /// A frame name is empty.
    #[error("transform from `{child}` to `{parent}` has an empty frame name")]
    EmptyName {
        /// Parent frame.
        parent: String,
        /// Child frame.
        child: String,
    },
    /// Parent and child are one.
    #[error("frame `{frame}` is given as its own parent")]
    OwnParent {
        /// The frame.
        frame: String,
    },
    /// The transform would close a loop.
    #[error("transform would close the loop {path}; each frame may have one parent")]
    Loop {
        /// The frames along it, `a -> b -> a`, child before parent.
        path: String,
    },
    /// More frames than are kept.
    #[error("frame `{frame}` is one more than the {limit} that are kept")]
    TooManyFrames {
        /// The frame refused.
        frame: String,
        /// The limit.
        limit: usize,
    },
    /// Its numbers are no rigid transform.
    #[error("transform from `{child}` to `{parent}`: {reason}")]
    Numbers {
        /// Parent frame.
        parent: String,
        /// Child frame.
        child: String,
        /// What is wrong.
        reason: PoseReject,
    },
}

/// Why a transform cannot be given.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum TfProblem {
    /// Nothing was ever heard of a frame.
    #[error("frame `{frame}` is unknown; known: {known}")]
    UnknownFrame {
        /// The frame.
        frame: String,
        /// Some of those that are known.
        known: String,
    },
    /// The frames are in separate trees.
    #[error(
        "frames `{target_frame}` and `{source_frame}` are not connected (roots `{target_root}` and `{source_root}`)"
    )]
    NotConnected {
        /// Asked for.
        target_frame: String,
        /// Its topmost parent.
        target_root: String,
        /// Asked from.
        source_frame: String,
        /// Its topmost parent.
        source_root: String,
    },
    /// A transform on the way has nothing that new.
    #[error("transform from `{child}` to `{parent}` ends {behind_sec:.3} s before the stamp")]
    NotYet {
        /// Parent frame.
        parent: String,
        /// Child frame.
        child: String,
        /// How far it ends before the stamp asked for, seconds.
        behind_sec: f64,
    },
    /// A transform on the way begins later.
    #[error("transform from `{child}` to `{parent}` begins {after_sec:.3} s after the stamp")]
    BeforeFirst {
        /// Parent frame.
        parent: String,
        /// Child frame.
        child: String,
        /// How far it begins after the stamp asked for, seconds.
        after_sec: f64,
        /// Its first stamp, nanoseconds.
        first_ns: i64,
    },
    /// A transform on the way has a hole there.
    #[error(
        "transform from `{child}` to `{parent}` has a gap of {gap_sec:.3} s at the stamp, wider than sync.pose_gap_sec"
    )]
    GapTooWide {
        /// Parent frame.
        parent: String,
        /// Child frame.
        child: String,
        /// Width of the hole, seconds.
        gap_sec: f64,
    },
}
