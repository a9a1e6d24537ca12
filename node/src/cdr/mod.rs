//! CDR (the wire format of ROS 2 messages) without ROS.
//!
//! [`read`] holds the cursor that knows alignment and byte order, [`decode`] the messages the program consumes.

pub mod decode;
pub mod read;

pub use read::CdrError;
