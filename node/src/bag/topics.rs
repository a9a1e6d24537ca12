//! Topics: their names, their types in one spelling, their counts.

use std::collections::HashMap;

/// A topic of a bag.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topic {
    /// Topic name.
    pub name: String,
    /// Message type, in the form `sensor_msgs/msg/Image`; empty when the bag does not say.
    pub type_name: String,
    /// Serialization of its messages; only `cdr` can be read.
    pub serialization: String,
    /// Messages in all files of the bag.
    pub count: u64,
}

impl Topic {
    /// True when its messages can be read.
    pub fn is_readable(&self) -> bool {
        self.serialization == "cdr"
    }
}

/// A topic of one file of a bag.
pub(crate) type FileTopic = Topic;

/// Collects topics, one per name, type and serialization.
#[derive(Debug, Default)]
pub(crate) struct FileTopics {
    topics: Vec<Topic>,
    /// A file decides how many there are.
    known: HashMap<[String; 3], usize>,
}

impl FileTopics {
    /// Index of a topic, added when it is new.
    pub fn index(&mut self, name: &str, type_name: &str, serialization: &str) -> usize {
        let key = [name.to_owned(), normalized_type(type_name), serialization.to_owned()];
        *self.known.entry(key).or_insert_with_key(|[name, type_name, serialization]| {
            let (name, type_name, serialization) = (name.clone(), type_name.clone(), serialization.clone());
            self.topics.push(Topic { name, type_name, serialization, count: 0 });
            self.topics.len() - 1
        })
    }

    /// Adds messages to a topic.
    pub fn count(&mut self, index: usize, messages: u64) {
        if let Some(t) = self.topics.get_mut(index) {
            t.count = t.count.saturating_add(messages);
        }
    }

    pub fn into_vec(self) -> Vec<Topic> {
        self.topics
    }
}

/// One spelling for a type: `pkg/Name` (ROS 1 and early ROS 2) and `pkg::msg::dds_::Name_` (DDS) become `pkg/msg/Name`.
pub fn normalized_type(name: &str) -> String {
    if name.contains("::") {
        let parts: Vec<&str> = name.split("::").filter(|p| *p != "dds_").collect();
        return parts.join("/").trim_end_matches('_').to_owned();
    }
    match name.split_once('/') {
        Some((package, rest)) if !rest.contains('/') => format!("{package}/msg/{rest}"),
        _ => name.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn types_have_one_spelling() {
        for from in ["sensor_msgs/Image", "sensor_msgs/msg/Image", "sensor_msgs::msg::dds_::Image_"] {
            assert_eq!(normalized_type(from), "sensor_msgs/msg/Image");
        }
        assert_eq!(normalized_type("test_msgs/srv/BasicTypes_Event"), "test_msgs/srv/BasicTypes_Event");
        assert_eq!(normalized_type(""), "");
    }
}
