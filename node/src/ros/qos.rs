//! Quality of service: what the node asks for and offers, and why a publisher's offer does not match.

use r2r::QosProfile;
use r2r::qos::{DurabilityPolicy, ReliabilityPolicy};

use crate::config::LiveConfig;
use crate::output::qos::Qos;

/// Poses, transforms and CameraInfo that the middleware may keep for us; they are small.
const MESSAGES_KEPT: usize = 200;

/// What pictures are asked for with.
pub fn pictures(config: &LiveConfig) -> QosProfile {
    reliability(config, QosProfile::sensor_data().keep_last(config.queue))
}

/// What poses and moving transforms are asked for with.
pub fn poses(config: &LiveConfig) -> QosProfile {
    reliability(config, QosProfile::sensor_data().keep_last(MESSAGES_KEPT))
}

/// What CameraInfo is asked for with: it is sent again and again, so every publisher will do.
pub fn infos() -> QosProfile {
    QosProfile::sensor_data()
}

/// What /tf_static is asked for with.
pub fn statics() -> QosProfile {
    QosProfile::default().keep_last(MESSAGES_KEPT).reliable().transient_local()
}

/// What outputs are offered with: as `outputs.mcap` records it.
pub fn offered(qos: Qos) -> QosProfile {
    match qos {
        Qos::SensorData => QosProfile::sensor_data(),
        Qos::Reliable => QosProfile::default().keep_last(10).reliable(),
        Qos::Latched => QosProfile::default().keep_last(1).reliable().transient_local(),
    }
}

fn reliability(config: &LiveConfig, profile: QosProfile) -> QosProfile {
    if config.reliability == "reliable" { profile.reliable() } else { profile.best_effort() }
}

/// Why nothing from a publisher that offers `offered` arrives where `asked` is asked for, and what to do; none when it
/// does.
pub fn mismatch(asked: &QosProfile, offered: &QosProfile) -> Option<&'static str> {
    if asked.reliability == ReliabilityPolicy::Reliable && offered.reliability == ReliabilityPolicy::BestEffort {
        return Some(
            "offers reliability best_effort where live.reliability asks for reliable; set live.reliability: sensor_data, \
             or make the publisher reliable",
        );
    }
    if asked.durability == DurabilityPolicy::TransientLocal && offered.durability == DurabilityPolicy::Volatile {
        return Some(
            "offers durability volatile where transient_local is asked for; publish static transforms with a \
             StaticTransformBroadcaster (transient_local)",
        );
    }
    None
}
