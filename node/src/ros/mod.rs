//! The live node: ROS 2 messages in and out. Translates and nothing more; what happens between is [`crate::pipeline::live`].
//!
//! One thread spins ROS and never waits for a step. r2r hands messages over in channels of ten and loses the newest when
//! one is full, so every stream is emptied after every spin, into rings of our own that lose the oldest and count it.

//! What needs no ROS to be compiled is always there, and tested everywhere; the rest is behind the feature `ros`.

pub mod convert;
pub mod describe;
pub mod diagnostics;
pub mod names;
pub mod topics;

#[cfg(feature = "ros")]
mod map_output;
#[cfg(feature = "ros")]
mod node;
#[cfg(feature = "ros")]
mod outputs;
#[cfg(feature = "ros")]
pub mod parameters;
#[cfg(feature = "ros")]
mod publisher;
#[cfg(feature = "ros")]
pub mod qos;
#[cfg(feature = "ros")]
mod services;
#[cfg(feature = "ros")]
mod streams;

#[cfg(feature = "ros")]
pub use node::run;
