//! The control drive as messages that a quirk changes before they are written as a bag.

use std::path::Path;
use std::sync::OnceLock;

use storm_node::bag::Bag;
use storm_node::cdr::schema::MessageType;
use storm_node::cdr::{decode, encode};
use storm_node::msg::{CameraInfo, CompressedImage, Image, PoseStamped, TransformStamped};
use storm_node::output::bag_writer::BagWriter;
use storm_node::output::qos::Qos;
use storm_node::synth::{SynthOptions, write_drive};
use storm_render::world::{Drive, DriveOptions};

/// Topics of the control drive.
pub const IMAGE: &str = "/camera0/image";
pub const INFO: &str = "/camera0/camera_info";
pub const POSE: &str = "/odometry";
pub const STATICS: &str = "/tf_static";
/// Picture size.
pub const SIZE: (usize, usize) = (72, 48);

/// One message as it is recorded.
#[derive(Clone)]
pub struct Message {
    pub topic: String,
    pub kind: MessageType,
    /// When it was recorded, nanoseconds.
    pub log_ns: i64,
    /// CDR.
    pub data: Vec<u8>,
}

/// A recording, open to change. Methods take and give it, so that quirks can be chained.
#[derive(Clone)]
pub struct Recording(pub Vec<Message>);

/// Colours of an rgb8 image, row by row.
pub fn pixels(image: &Image) -> impl Iterator<Item = [u8; 3]> {
    image.data.as_chunks::<3>().0.iter().copied()
}

fn kind_of(type_name: &str) -> MessageType {
    *MessageType::ALL.iter().find(|k| k.name() == type_name).unwrap()
}

/// A drive of `cameras` cameras, 2.2 s at 10 Hz, without ground truth.
fn drive(cameras: usize) -> Recording {
    let (width, height) = SIZE;
    let options = DriveOptions { seed: 7, seconds: 2.2, cameras, width, height, ..DriveOptions::default() };
    let dir = tempfile::tempdir().unwrap();
    let synth = SynthOptions { ground_truth: false, ..SynthOptions::default() };
    write_drive(&Drive::new(&options).unwrap(), &dir.path().join("bag"), &synth, &mut |_, _| {}).unwrap();
    let bag = Bag::open(&dir.path().join("bag")).unwrap();
    let all: Vec<usize> = (0..bag.topics().len()).collect();
    let message = |m: storm_node::bag::RawMessage| {
        let topic = &bag.topics()[m.topic];
        let (name, kind) = (topic.name.clone(), kind_of(&topic.type_name));
        Message { topic: name, kind, log_ns: m.log_time_ns, data: m.data }
    };
    Recording(bag.messages(&all).unwrap().map(|m| message(m.unwrap())).collect())
}

impl Recording {
    /// The control drive: one camera.
    pub fn control() -> Self {
        static DRIVE: OnceLock<Recording> = OnceLock::new();
        DRIVE.get_or_init(|| drive(1)).clone()
    }

    /// The same drive with a stereo pair.
    pub fn pair() -> Self {
        static DRIVE: OnceLock<Recording> = OnceLock::new();
        DRIVE.get_or_init(|| drive(2)).clone()
    }

    /// Every message of `topic` becomes what `with` makes of it: none, one, or several.
    pub fn each(self, topic: &str, mut with: impl FnMut(Message) -> Vec<Message>) -> Self {
        let change = |m: Message| if m.topic == topic { with(m) } else { vec![m] };
        Self(self.0.into_iter().flat_map(change).collect())
    }

    /// Changes the raw images of `topic`.
    pub fn images(self, topic: &str, mut with: impl FnMut(&mut Image)) -> Self {
        self.each(topic, |mut m| {
            let mut image = decode::image(&m.data).unwrap();
            with(&mut image);
            m.data = encode::encode_image(&image).unwrap();
            vec![m]
        })
    }

    /// Puts compressed images on `to` in place of the raw ones on `topic`; `with` gives `format` and data.
    pub fn compressed(self, topic: &str, to: &str, mut with: impl FnMut(&Image) -> (String, Vec<u8>)) -> Self {
        self.each(topic, |m| {
            let image = decode::image(&m.data).unwrap();
            let (format, data) = with(&image);
            let packed = CompressedImage { header: image.header, format, data };
            let data = encode::encode_compressed_image(&packed).unwrap();
            vec![Message { topic: to.into(), kind: MessageType::CompressedImage, log_ns: m.log_ns, data }]
        })
    }

    /// Changes the CameraInfos of `topic`.
    pub fn infos(self, topic: &str, mut with: impl FnMut(&mut CameraInfo)) -> Self {
        self.each(topic, |mut m| {
            let mut info = decode::camera_info(&m.data).unwrap();
            with(&mut info);
            m.data = encode::encode_camera_info(&info).unwrap();
            vec![m]
        })
    }

    /// Changes the vehicle's poses.
    pub fn poses(self, mut with: impl FnMut(&mut PoseStamped)) -> Self {
        self.each(POSE, |mut m| {
            let mut pose = decode::odometry(&m.data).unwrap();
            with(&mut pose);
            m.data = encode::encode_odometry(&pose).unwrap();
            vec![m]
        })
    }

    /// Changes what is on /tf_static.
    pub fn statics(self, mut with: impl FnMut(&mut Vec<TransformStamped>)) -> Self {
        self.each(STATICS, |mut m| {
            let mut list = decode::tf_message(&m.data).unwrap();
            with(&mut list);
            m.data = encode::encode_tf_message(&list).unwrap();
            vec![m]
        })
    }

    /// Gives `topic` another name.
    pub fn renamed(self, topic: &str, to: &str) -> Self {
        self.each(topic, |m| vec![Message { topic: to.into(), ..m }])
    }

    /// Adds the messages of `more`.
    pub fn and(mut self, more: Self) -> Self {
        self.0.extend(more.0);
        self
    }

    /// Only the messages of `topic`.
    pub fn only(self, topic: &str) -> Self {
        Self(self.0.into_iter().filter(|m| m.topic == topic).collect())
    }

    /// Without the messages of `topic`.
    pub fn without(self, topic: &str) -> Self {
        self.each(topic, |_| Vec::new())
    }

    /// The messages of `topic` are recorded `by_ns` later; their stamps stay.
    pub fn recorded_later(self, topic: &str, by_ns: i64) -> Self {
        self.each(topic, |m| vec![Message { log_ns: m.log_ns + by_ns, ..m }])
    }

    /// Writes the bag as one MCAP file, in the order of log times.
    pub fn write(mut self, path: &Path) {
        self.0.sort_by_key(|m| m.log_ns);
        let mut bag = BagWriter::create(path).unwrap();
        for m in &self.0 {
            let qos = if m.topic.ends_with("tf_static") { Qos::Latched } else { Qos::Reliable };
            let topic = bag.topic(&m.topic, m.kind, qos).unwrap();
            bag.write(topic, m.log_ns, &m.data).unwrap();
        }
        bag.finish().unwrap();
    }
}
