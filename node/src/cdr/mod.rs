//! CDR (the wire format of ROS 2 messages) without ROS.
//!
//! [`read`] holds the cursor that knows alignment and byte order, [`decode`] the messages the program consumes;
//! [`write`](mod@write) and [`encode`] are the other direction, [`schema`] the definitions that bags carry.

pub mod decode;
pub mod encode;
pub mod read;
pub mod schema;
pub mod write;

pub use read::CdrError;
