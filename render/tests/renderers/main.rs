//! One suite over every renderer: goldens, the reference, random scenes, hostile input; and what only a device can do.
//!
//! The device's part runs with `--features wgpu`. Without an adapter it prints `SKIPPED: ...`, or fails where
//! `REQUIRE_GPU_ADAPTER=1` is set.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

mod agreement;
mod backends;
mod degenerate;
#[cfg(feature = "wgpu")]
mod device;
mod goldens;
mod motion;
mod requests;
mod rules;
mod scenes;
