//! CDR (the wire format of ROS 2 messages) without ROS.
//!
//! [`read`] holds the cursor that knows alignment and byte order, [`decode`] the messages the program consumes;
//! [`write`](mod@write) and [`encode`] are their counterparts, [`schema`] the definitions that go into a bag beside them.

pub mod decode;
pub mod encode;
pub mod encode_live;
pub mod read;
pub mod schema;
pub mod write;

pub use read::CdrError;

#[cfg(test)]
mod round_trip;
