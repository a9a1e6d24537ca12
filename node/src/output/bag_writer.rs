//! Bags: MCAP with the profile `ros2`, zstd chunks and the channel metadata rosbag2 looks for.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;

use super::OutputError;
use super::atomic::write_bytes;
use super::bag_metadata::{BagSummary, TopicSummary, metadata_yaml};
use super::qos::Qos;
use crate::cdr::schema::{MessageType, SCHEMA_ENCODING};

/// Uncompressed bytes per chunk: large enough for pictures to share one, small enough to seek in.
const CHUNK_BYTES: u64 = 4 * 1024 * 1024;

/// A topic of one [`BagWriter`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct TopicId(usize);

struct Topic {
    summary: TopicSummary,
    channel_id: u16,
}

/// Writes one bag; without [`BagWriter::finish`] the file has its messages but no index (readers can recover it).
pub struct BagWriter {
    path: PathBuf,
    /// Folder that gets a `metadata.yaml`; `None` for a single file.
    folder: Option<PathBuf>,
    writer: mcap::Writer<BufWriter<File>>,
    topics: Vec<Topic>,
    bounds_ns: Option<(u64, u64)>,
}

impl BagWriter {
    /// A single MCAP file at `path`, replaced if it is there.
    pub fn create(path: &Path) -> Result<Self, OutputError> {
        let file = File::create(path).map_err(OutputError::io(path))?;
        // Compression on the calling thread: chunk bytes then depend on the input alone.
        let writer = mcap::WriteOptions::new()
            .profile("ros2")
            .library(concat!("storm ", env!("CARGO_PKG_VERSION")))
            .compression(Some(mcap::Compression::Zstd))
            .compression_threads(0)
            .chunk_size(Some(CHUNK_BYTES))
            .create(BufWriter::new(file))
            .map_err(OutputError::mcap(path))?;
        Ok(Self { path: path.to_owned(), folder: None, writer, topics: Vec::new(), bounds_ns: None })
    }

    /// A bag folder as rosbag2 makes it: `<folder>/<name>_0.mcap` and, once finished, `metadata.yaml`.
    ///
    /// The folder is made when missing; in an existing one only these two files are replaced.
    pub fn create_folder(folder: &Path) -> Result<Self, OutputError> {
        std::fs::create_dir_all(folder).map_err(OutputError::io(folder))?;
        let metadata = folder.join("metadata.yaml");
        // Stale metadata would describe the new file wrongly if this run is cut short.
        match std::fs::remove_file(&metadata) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(OutputError::io(&metadata)(e)),
            _ => {}
        }
        // `canonicalize` gives `.` and `..` their real name.
        let real = folder.canonicalize().map_err(OutputError::io(folder))?;
        let name = real.file_name().map_or("bag".into(), |n| n.to_string_lossy().into_owned());
        let mut bag = Self::create(&folder.join(format!("{name}_0.mcap")))?;
        bag.folder = Some(folder.to_owned());
        Ok(bag)
    }

    /// The MCAP file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Declares a topic; the same name and type again give the same topic.
    pub fn topic(&mut self, name: &str, message_type: MessageType, qos: Qos) -> Result<TopicId, OutputError> {
        let same = |t: &Topic| t.summary.name == name && t.summary.message_type == message_type;
        if let Some(i) = self.topics.iter().position(same) {
            return Ok(TopicId(i));
        }
        let mcap_error = |source| OutputError::Mcap { path: self.path.clone(), source };
        let schema_id = self
            .writer
            .add_schema(&message_type.name(), SCHEMA_ENCODING, message_type.schema_text().as_bytes())
            .map_err(mcap_error)?;
        let metadata = BTreeMap::from([
            ("offered_qos_profiles".to_owned(), qos.yaml_names()),
            ("topic_type_hash".to_owned(), message_type.type_hash().to_owned()),
        ]);
        let channel_id = self.writer.add_channel(schema_id, name, "cdr", &metadata).map_err(mcap_error)?;
        let summary = TopicSummary { name: name.to_owned(), message_type, qos, message_count: 0 };
        self.topics.push(Topic { summary, channel_id });
        Ok(TopicId(self.topics.len() - 1))
    }

    /// Writes one CDR message; `stamp_ns` becomes both log and publish time, so replaying a bag gives the same bytes.
    pub fn write(&mut self, topic: TopicId, stamp_ns: i64, cdr: &[u8]) -> Result<(), OutputError> {
        let entry = self.topics.get_mut(topic.0).ok_or(OutputError::UnknownTopic(topic.0))?;
        let time = u64::try_from(stamp_ns)
            .map_err(|_| OutputError::NegativeStamp { topic: entry.summary.name.clone(), stamp_ns })?;
        let header = MessageHeader {
            channel_id: entry.channel_id,
            // Sequence numbers wrap, as the 32-bit field says.
            sequence: entry.summary.message_count as u32,
            log_time: time,
            publish_time: time,
        };
        self.writer.write_to_known_channel(&header, cdr).map_err(OutputError::mcap(&self.path))?;
        entry.summary.message_count += 1;
        self.bounds_ns = Some(self.bounds_ns.map_or((time, time), |(a, b)| (a.min(time), b.max(time))));
        Ok(())
    }

    /// Writes the index (and `metadata.yaml` of a folder); returns what the bag holds.
    pub fn finish(mut self) -> Result<BagSummary, OutputError> {
        self.writer.finish().map_err(OutputError::mcap(&self.path))?;
        self.writer.into_inner().flush().map_err(OutputError::io(&self.path))?;
        let (start_ns, end_ns) = self.bounds_ns.unwrap_or((0, 0));
        let file_name = self.path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let topics = self.topics.into_iter().map(|t| t.summary).collect();
        let summary = BagSummary { file_name, start_ns, end_ns, topics };
        if let Some(folder) = self.folder {
            let path = folder.join("metadata.yaml");
            let text = metadata_yaml(&summary)
                .map_err(|e| OutputError::Format { path: path.clone(), reason: format!("YAML writing failed: {e}") })?;
            write_bytes(&path, text.as_bytes())?;
        }
        Ok(summary)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cdr::encode::encode_float64;

    #[test]
    fn what_is_written_is_read_back_by_the_mcap_reader() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.mcap");
        let mut bag = BagWriter::create(&path).unwrap();
        let a = bag.topic("/a", MessageType::Float64, Qos::Reliable).unwrap();
        let b = bag.topic("/b", MessageType::Float64, Qos::Latched).unwrap();
        assert_eq!(bag.topic("/a", MessageType::Float64, Qos::Reliable).unwrap(), a);
        for i in 0..5i64 {
            bag.write(if i == 3 { b } else { a }, 1000 + i, &encode_float64(i as f64).unwrap()).unwrap();
        }
        let summary = bag.finish().unwrap();
        assert_eq!((summary.start_ns, summary.end_ns), (1000, 1004));
        assert_eq!(summary.topics.iter().map(|t| t.message_count).collect::<Vec<_>>(), [4, 1]);
        let bytes = std::fs::read(&path).unwrap();
        let messages: Vec<_> = mcap::MessageStream::new(&bytes).unwrap().collect::<Result<_, _>>().unwrap();
        assert_eq!(messages.len(), 5);
        assert_eq!(messages[3].channel.topic, "/b");
        assert_eq!(messages[3].log_time, 1003);
        assert_eq!(messages[3].data.as_ref(), encode_float64(3.0).unwrap());
        let schema = messages[3].channel.schema.as_ref().unwrap();
        assert_eq!((schema.name.as_str(), schema.encoding.as_str()), ("std_msgs/msg/Float64", "ros2msg"));
        assert!(messages[3].channel.metadata["offered_qos_profiles"].contains("transient_local"));
        assert!(matches!(BagWriter::create(&dir.path().join("no/a.mcap")), Err(OutputError::Io { .. })));
    }

    #[test]
    fn a_folder_has_metadata_that_counts_its_messages() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("drive");
        let write = || {
            let mut bag = BagWriter::create_folder(&folder).unwrap();
            let a = bag.topic("/a", MessageType::Float64, Qos::SensorData).unwrap();
            bag.topic("/silent", MessageType::Image, Qos::SensorData).unwrap();
            bag.write(a, 7, &encode_float64(1.0).unwrap()).unwrap();
            bag.write(a, 9, &encode_float64(2.0).unwrap()).unwrap();
            assert!(matches!(bag.write(a, -1, &[0; 4]), Err(OutputError::NegativeStamp { stamp_ns: -1, .. })));
            bag.finish().unwrap();
            std::fs::read(folder.join("drive_0.mcap")).unwrap()
        };
        assert_eq!(write(), write(), "two runs differ");
        let text = std::fs::read_to_string(folder.join("metadata.yaml")).unwrap();
        let root: serde_yaml::Value = serde_yaml::from_str(&text).unwrap();
        let info = &root["rosbag2_bagfile_information"];
        assert_eq!(info["message_count"].as_u64(), Some(2));
        assert_eq!(info["duration"]["nanoseconds"].as_u64(), Some(2));
        assert_eq!(info["relative_file_paths"][0].as_str(), Some("drive_0.mcap"));
        assert_eq!(info["topics_with_message_count"][1]["message_count"].as_u64(), Some(0));
    }

    #[test]
    fn our_own_reader_finds_the_same_messages_in_file_and_folder() {
        let dir = tempfile::tempdir().unwrap();
        let message = encode_float64(4.5).unwrap();
        for mut bag in [
            BagWriter::create(&dir.path().join("a.mcap")).unwrap(),
            BagWriter::create_folder(&dir.path().join("b")).unwrap(),
        ] {
            let a = bag.topic("/a", MessageType::Float64, Qos::Reliable).unwrap();
            (0..1000).for_each(|i| bag.write(a, 5 + i, &message).unwrap());
            bag.finish().unwrap();
        }
        for name in ["a.mcap", "b"] {
            let bag = crate::bag::Bag::open(&dir.path().join(name)).unwrap();
            assert_eq!(bag.problems(), [""; 0]);
            let a = bag.topic("/a").unwrap();
            let read: Vec<_> = bag.messages(&[a]).unwrap().collect::<Result<_, _>>().unwrap();
            assert_eq!(read.len(), 1000);
            assert!(read.iter().enumerate().all(|(i, m)| m.log_time_ns == 5 + i as i64 && m.data == message));
        }
    }
}
