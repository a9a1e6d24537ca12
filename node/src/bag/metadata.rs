//! `metadata.yaml` of a rosbag2 folder: the few fields that matter, every one optional.

use std::path::{Component, Path, PathBuf};

use serde::Deserialize;

use super::error::BagError;
use super::limits::MAX_METADATA_BYTES;
use crate::config::nests_too_deep;

/// File name of the metadata in a bag folder.
pub(crate) const METADATA_FILE: &str = "metadata.yaml";

/// What metadata.yaml says; other fields are ignored, so every version from 1 on reads.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(crate) struct Metadata {
    pub relative_file_paths: Vec<String>,
    pub message_count: Option<u64>,
    pub topics_with_message_count: Vec<TopicCount>,
    pub compression_format: Option<String>,
    pub compression_mode: Option<String>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(crate) struct TopicCount {
    pub topic_metadata: TopicMetadata,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub(crate) struct TopicMetadata {
    pub name: String,
    pub serialization_format: Option<String>,
}

#[derive(Debug, Default, Deserialize)]
struct Document {
    rosbag2_bagfile_information: Metadata,
}

impl Metadata {
    /// Reads it; `Ok(None)` when there is none.
    pub fn read(folder: &Path) -> Result<Option<Self>, BagError> {
        let path = folder.join(METADATA_FILE);
        let size = match std::fs::metadata(&path) {
            Ok(m) if m.is_file() => m.len(),
            Ok(_) => return Ok(None),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(BagError::io(&path)(e)),
        };
        if size > MAX_METADATA_BYTES {
            let what = "metadata".to_owned();
            return Err(BagError::TooLarge { path, what, claimed: size, limit: MAX_METADATA_BYTES });
        }
        let text = std::fs::read(&path).map_err(BagError::io(&path))?;
        if nests_too_deep(&text) {
            return Err(BagError::Damaged {
                path,
                why: "not rosbag2 metadata: its brackets nest without end".to_owned(),
            });
        }
        let document: Document = serde_yaml::from_slice(&text)
            .map_err(|e| BagError::Damaged { path: path.clone(), why: format!("not rosbag2 metadata: {e}") })?;
        Ok(Some(document.rosbag2_bagfile_information))
    }

    /// The compression named, if it is one nobody here can undo.
    pub fn unknown_compression(&self) -> Option<&str> {
        let mode = self.compression_mode.as_deref().unwrap_or("");
        let format = self.compression_format.as_deref().unwrap_or("");
        let none = |s: &str| s.is_empty() || s.eq_ignore_ascii_case("none");
        (!none(mode) && !none(format) && !format.eq_ignore_ascii_case("zstd")).then_some(format)
    }

    /// A topic whose serialization is said to be something other than CDR.
    pub fn other_serialization(&self, topic: &str) -> Option<&str> {
        let topic = self.topics_with_message_count.iter().find(|t| t.topic_metadata.name == topic)?;
        topic.topic_metadata.serialization_format.as_deref().filter(|s| !s.is_empty() && *s != "cdr")
    }
}

/// Where `relative` of metadata.yaml lies in `folder`, or why not. Paths that lead out of the folder and paths with a
/// folder name that is no longer right (bags get renamed) come down to the file of that name in the folder itself.
pub(crate) fn resolve(folder: &Path, relative: &str) -> Option<PathBuf> {
    let relative = Path::new(relative);
    let stays_inside = relative.components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir));
    let named = folder.join(relative);
    if stays_inside && named.is_file() {
        return Some(named);
    }
    let base = folder.join(relative.file_name()?);
    base.is_file().then_some(base)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_cannot_leave_the_folder() {
        let dir = tempfile::tempdir().unwrap();
        let bag = dir.path().join("bag");
        std::fs::create_dir_all(bag.join("sub")).unwrap();
        std::fs::write(dir.path().join("outside.mcap"), b"x").unwrap();
        std::fs::write(bag.join("in.mcap"), b"x").unwrap();
        std::fs::write(bag.join("sub/deep.mcap"), b"x").unwrap();
        assert_eq!(resolve(&bag, "in.mcap"), Some(bag.join("in.mcap")));
        assert_eq!(resolve(&bag, "sub/deep.mcap"), Some(bag.join("sub/deep.mcap")));
        assert_eq!(resolve(&bag, "old_name/in.mcap"), Some(bag.join("in.mcap")));
        assert_eq!(resolve(&bag, "../bag/in.mcap"), Some(bag.join("in.mcap")));
        assert_eq!(resolve(&bag, "../outside.mcap"), None);
        assert_eq!(resolve(&bag, dir.path().join("outside.mcap").to_str().unwrap()), None);
        assert_eq!(resolve(&bag, ".."), None);
        assert_eq!(resolve(&bag, ""), None);
    }

    #[test]
    fn odd_yaml_is_an_error_or_defaults_never_a_panic() {
        let dir = tempfile::tempdir().unwrap();
        assert!(Metadata::read(dir.path()).unwrap().is_none());
        for (text, fine) in [
            ("", false),
            ("[1, 2]", false),
            ("rosbag2_bagfile_information: {}", true),
            ("rosbag2_bagfile_information: {relative_file_paths: [a.db3], custom_data: ~, unknown: 3}", true),
            ("rosbag2_bagfile_information: {relative_file_paths: 7}", false),
            ("\u{0}\u{1}", false),
        ] {
            std::fs::write(dir.path().join(METADATA_FILE), text).unwrap();
            assert_eq!(Metadata::read(dir.path()).is_ok(), fine, "{text:?}");
        }
    }
}
