//! The pipeline for input that does not wait: nothing blocks the sender, memory and latency are bounded, and every message
//! that is given up is counted.
//!
//! ```text
//! messages ──> Inbox ──> decode thread ──> Inbox ──> step thread: Front, newest window, StepMaker ──> Outlet
//! ```
//!
//! Both inboxes hold a few messages per stream and give up the oldest. While a step runs sets gather; the next step takes
//! the newest window, so with a step longer than the input's period the hop grows and latency does not. Knows nothing of
//! ROS; stages are those of a replay.

mod decoder;
mod inbox;
mod map_folder;
mod skew;
mod status;
mod stepper;
#[cfg(test)]
pub(crate) mod tests;
mod watchdog;
mod worker;

pub use inbox::{Inbox, Taken};
pub use status::Status;
pub use watchdog::{Change, Watchdog};
pub use worker::{Command, Live, LiveInput, LiveOptions, Message, Outlet, Reply, inbox};
