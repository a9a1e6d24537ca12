//! Recorded bags: MCAP and rosbag2 sqlite3, one file or a folder.
