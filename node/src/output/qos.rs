//! Quality of service as rosbag2 records it: YAML beside each topic.

/// The profiles the program publishes with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Qos {
    /// Sensor data: best effort, volatile, depth 5.
    SensorData,
    /// Results: reliable, volatile, depth 10.
    Reliable,
    /// Maps and static transforms: reliable, kept for late subscribers, depth 1.
    Latched,
}

/// A policy's name, as rosbag2 writes it since metadata version 9, and its rmw number, as it did before.
struct Policy(&'static str, u8);

impl Qos {
    fn policies(self) -> (u32, Policy, Policy) {
        let reliable = Policy("reliable", 1);
        let volatile = Policy("volatile", 2);
        match self {
            Self::SensorData => (5, Policy("best_effort", 2), volatile),
            Self::Reliable => (10, reliable, volatile),
            Self::Latched => (1, reliable, Policy("transient_local", 1)),
        }
    }

    /// With policies by name: for the channel metadata of an MCAP file.
    pub fn yaml_names(self) -> String {
        self.yaml(|p| p.0.to_owned())
    }

    /// With policies by number: for a `metadata.yaml` of version 8 or less.
    pub fn yaml_numbers(self) -> String {
        self.yaml(|p| p.1.to_string())
    }

    fn yaml(self, text: impl Fn(&Policy) -> String) -> String {
        let (depth, reliability, durability) = self.policies();
        // The largest time rmw knows: no deadline, no lifespan, no lease.
        let forever = "\n    sec: 9223372036\n    nsec: 854775807";
        format!(
            "- history: {}\n  depth: {depth}\n  reliability: {}\n  durability: {}\n  deadline:{forever}\n  \
             lifespan:{forever}\n  liveliness: {}\n  liveliness_lease_duration:{forever}\n  \
             avoid_ros_namespace_conventions: false",
            text(&Policy("keep_last", 1)),
            text(&reliability),
            text(&durability),
            text(&Policy("automatic", 1)),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_forms_are_yaml_with_every_field() {
        for qos in [Qos::SensorData, Qos::Reliable, Qos::Latched] {
            for text in [qos.yaml_names(), qos.yaml_numbers()] {
                let parsed: serde_yaml::Value = serde_yaml::from_str(&text).unwrap();
                assert_eq!(parsed[0].as_mapping().unwrap().len(), 9, "{text}");
                assert_eq!(parsed[0]["deadline"]["nsec"].as_u64(), Some(854_775_807));
            }
        }
        assert!(Qos::Latched.yaml_names().contains("durability: transient_local"));
        assert!(Qos::SensorData.yaml_numbers().contains("reliability: 2"));
    }
}
