//! CDR, the wire format of ROS 2 messages, without ROS.

pub mod encode;
pub mod schema;
pub mod write;
