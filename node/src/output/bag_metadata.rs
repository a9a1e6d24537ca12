//! `metadata.yaml` of a bag folder, as rosbag2 writes it beside the storage file.
//!
//! Version 5 is the newest that every ROS 2 distribution from Humble on reads, newer ones included: version 9 turned the
//! QoS text into structure, which Humble cannot parse.

use serde::Serialize;

use super::qos::Qos;
use crate::cdr::schema::MessageType;

/// Version of the metadata format.
const METADATA_VERSION: u32 = 5;

/// One topic of the bag.
#[derive(Debug, Clone)]
pub struct TopicSummary {
    /// Topic name.
    pub name: String,
    /// Its type.
    pub message_type: MessageType,
    /// How it was offered.
    pub qos: Qos,
    /// Messages written.
    pub message_count: u64,
}

/// What the metadata is about.
#[derive(Debug, Clone)]
pub struct BagSummary {
    /// File name of the storage file inside the folder.
    pub file_name: String,
    /// First log time, nanoseconds; 0 without messages.
    pub start_ns: u64,
    /// Last log time, nanoseconds; 0 without messages.
    pub end_ns: u64,
    /// Topics in the order they were created.
    pub topics: Vec<TopicSummary>,
}

#[derive(Serialize)]
struct Root {
    rosbag2_bagfile_information: Information,
}

#[derive(Serialize)]
struct Information {
    version: u32,
    storage_identifier: &'static str,
    duration: Nanoseconds,
    starting_time: SinceEpoch,
    message_count: u64,
    topics_with_message_count: Vec<TopicCount>,
    compression_format: &'static str,
    compression_mode: &'static str,
    relative_file_paths: Vec<String>,
    files: Vec<FileInformation>,
}

#[derive(Serialize)]
struct Nanoseconds {
    nanoseconds: u64,
}

#[derive(Serialize)]
struct SinceEpoch {
    nanoseconds_since_epoch: u64,
}

#[derive(Serialize)]
struct TopicCount {
    topic_metadata: TopicMetadata,
    message_count: u64,
}

#[derive(Serialize)]
struct TopicMetadata {
    name: String,
    r#type: String,
    serialization_format: &'static str,
    offered_qos_profiles: String,
}

#[derive(Serialize)]
struct FileInformation {
    path: String,
    starting_time: SinceEpoch,
    duration: Nanoseconds,
    message_count: u64,
}

/// The text of `metadata.yaml`.
pub fn metadata_yaml(bag: &BagSummary) -> Result<String, serde_yaml::Error> {
    let message_count = bag.topics.iter().map(|t| t.message_count).sum();
    let duration_ns = bag.end_ns.saturating_sub(bag.start_ns);
    let topics = bag.topics.iter().map(|t| TopicCount {
        topic_metadata: TopicMetadata {
            name: t.name.clone(),
            r#type: t.message_type.name(),
            serialization_format: "cdr",
            offered_qos_profiles: t.qos.yaml_numbers(),
        },
        message_count: t.message_count,
    });
    serde_yaml::to_string(&Root {
        rosbag2_bagfile_information: Information {
            version: METADATA_VERSION,
            storage_identifier: "mcap",
            duration: Nanoseconds { nanoseconds: duration_ns },
            starting_time: SinceEpoch { nanoseconds_since_epoch: bag.start_ns },
            message_count,
            topics_with_message_count: topics.collect(),
            // Chunks are compressed inside the MCAP file, which rosbag2 does not count as compression.
            compression_format: "",
            compression_mode: "",
            relative_file_paths: vec![bag.file_name.clone()],
            files: vec![FileInformation {
                path: bag.file_name.clone(),
                starting_time: SinceEpoch { nanoseconds_since_epoch: bag.start_ns },
                duration: Nanoseconds { nanoseconds: duration_ns },
                message_count,
            }],
        },
    })
}
