//! The ground-truth topics of one camera.

use storm_render::world::WorldFrame;

use super::SynthError;
use crate::cdr::encode::encode_image;
use crate::cdr::schema::MessageType;
use crate::msg::{Header, Image};
use crate::output::OutputError;
use crate::output::bag_writer::{BagWriter, TopicId};
use crate::output::qos::Qos;

/// Below this every ground-truth topic lies.
pub const TRUTH_PREFIX: &str = "/ground_truth";

pub(super) struct TruthTopics {
    depth: TopicId,
    flow: TopicId,
    instance: TopicId,
    sky: TopicId,
    moving: TopicId,
}

/// 0 and 255, which image viewers tell apart, for 0 and anything else.
fn mask(values: &[u8]) -> Vec<u8> {
    values.iter().map(|&v| if v == 0 { 0 } else { 255 }).collect()
}

impl TruthTopics {
    pub fn new(bag: &mut BagWriter, camera: usize) -> Result<Self, OutputError> {
        let mut topic = |name: &str| {
            bag.topic(&format!("{TRUTH_PREFIX}/camera{camera}/{name}"), MessageType::Image, Qos::SensorData)
        };
        Ok(Self {
            depth: topic("depth")?,
            flow: topic("flow")?,
            instance: topic("instance")?,
            sky: topic("sky")?,
            moving: topic("moving")?,
        })
    }

    pub fn write(&self, bag: &mut BagWriter, header: &Header, frame: &WorldFrame) -> Result<(), SynthError> {
        let depth = frame.depth.iter().flat_map(|v| v.to_le_bytes()).collect();
        let flow = frame.flow.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        let instance = frame.instance.iter().flat_map(|v| v.to_le_bytes()).collect();
        let images: [(TopicId, &str, u32, Vec<u8>); 5] = [
            (self.depth, "32FC1", 4, depth),
            (self.flow, "32FC3", 12, flow),
            (self.instance, "mono16", 2, instance),
            (self.sky, "mono8", 1, mask(&frame.sky)),
            (self.moving, "mono8", 1, mask(&frame.moving)),
        ];
        for (topic, encoding, pixel_bytes, data) in images {
            let image = Image {
                header: header.clone(),
                height: frame.height as u32,
                width: frame.width as u32,
                encoding: encoding.into(),
                is_bigendian: false,
                step: pixel_bytes * frame.width as u32,
                data,
            };
            bag.write(topic, header.stamp_ns, &encode_image(&image)?)?;
        }
        Ok(())
    }
}
