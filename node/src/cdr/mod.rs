//! CDR, the wire format of ROS 2 messages, without ROS.
