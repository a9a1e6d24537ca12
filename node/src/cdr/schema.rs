//! The message types the program writes: names, definitions and type hashes, as rosbag2's MCAP storage records them.
//!
//! A `ros2msg` schema is the definition of the type followed by those of every type it refers to, each under a line of
//! 80 `=` and a `MSG: package/Type` line. Definitions here are the fields only: comments carry no data, and the hash
//! (REP 2016, over the type description) does not cover them either.

/// Name of the schema encoding in MCAP.
pub const SCHEMA_ENCODING: &str = "ros2msg";

/// The line rosbag2 puts between two definitions.
const SEPARATOR: &str = "================================================================================";

/// One interface definition: its `package/Type` name, its fields, and the types it refers to directly.
struct Definition {
    name: &'static str,
    fields: &'static str,
    uses: &'static [&'static Definition],
}

static TIME: Definition =
    Definition { name: "builtin_interfaces/Time", fields: "int32 sec\nuint32 nanosec\n", uses: &[] };
static HEADER: Definition =
    Definition { name: "std_msgs/Header", fields: "builtin_interfaces/Time stamp\nstring frame_id\n", uses: &[&TIME] };
static POINT: Definition =
    Definition { name: "geometry_msgs/Point", fields: "float64 x\nfloat64 y\nfloat64 z\n", uses: &[] };
static VECTOR3: Definition =
    Definition { name: "geometry_msgs/Vector3", fields: "float64 x\nfloat64 y\nfloat64 z\n", uses: &[] };
static QUATERNION: Definition = Definition {
    name: "geometry_msgs/Quaternion",
    fields: "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
    uses: &[],
};
static POSE: Definition = Definition {
    name: "geometry_msgs/Pose",
    fields: "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    uses: &[&POINT, &QUATERNION],
};
static TWIST: Definition = Definition {
    name: "geometry_msgs/Twist",
    fields: "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    uses: &[&VECTOR3],
};
static POSE_WITH_COVARIANCE: Definition = Definition {
    name: "geometry_msgs/PoseWithCovariance",
    fields: "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    uses: &[&POSE],
};
static TWIST_WITH_COVARIANCE: Definition = Definition {
    name: "geometry_msgs/TwistWithCovariance",
    fields: "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
    uses: &[&TWIST],
};
static TRANSFORM: Definition = Definition {
    name: "geometry_msgs/Transform",
    fields: "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    uses: &[&VECTOR3, &QUATERNION],
};
static TRANSFORM_STAMPED: Definition = Definition {
    name: "geometry_msgs/TransformStamped",
    fields: "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
    uses: &[&HEADER, &TRANSFORM],
};
static POSE_STAMPED: Definition = Definition {
    name: "geometry_msgs/PoseStamped",
    fields: "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
    uses: &[&HEADER, &POSE],
};
static REGION_OF_INTEREST: Definition = Definition {
    name: "sensor_msgs/RegionOfInterest",
    fields: "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n",
    uses: &[],
};
static POINT_FIELD: Definition = Definition {
    name: "sensor_msgs/PointField",
    fields: "uint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\nuint8 UINT32=6\n\
             uint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count\n",
    uses: &[],
};
static IMAGE: Definition = Definition {
    name: "sensor_msgs/Image",
    fields: "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n\
             uint8[] data\n",
    uses: &[&HEADER],
};
static COMPRESSED_IMAGE: Definition = Definition {
    name: "sensor_msgs/CompressedImage",
    fields: "std_msgs/Header header\nstring format\nuint8[] data\n",
    uses: &[&HEADER],
};
static CAMERA_INFO: Definition = Definition {
    name: "sensor_msgs/CameraInfo",
    fields: "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n\
             float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n",
    uses: &[&HEADER, &REGION_OF_INTEREST],
};
static ODOMETRY: Definition = Definition {
    name: "nav_msgs/Odometry",
    fields: "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n\
             geometry_msgs/TwistWithCovariance twist\n",
    uses: &[&HEADER, &POSE_WITH_COVARIANCE, &TWIST_WITH_COVARIANCE],
};
static TF_MESSAGE: Definition = Definition {
    name: "tf2_msgs/TFMessage",
    fields: "geometry_msgs/TransformStamped[] transforms\n",
    uses: &[&TRANSFORM_STAMPED],
};
static POINT_CLOUD2: Definition = Definition {
    name: "sensor_msgs/PointCloud2",
    fields: "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n\
             uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n",
    uses: &[&HEADER, &POINT_FIELD],
};
static PATH: Definition = Definition {
    name: "nav_msgs/Path",
    fields: "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses\n",
    uses: &[&HEADER, &POSE_STAMPED],
};
static FLOAT64: Definition = Definition { name: "std_msgs/Float64", fields: "float64 data\n", uses: &[] };

/// A message type the program writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum MessageType {
    /// `sensor_msgs/msg/Image`
    Image,
    /// `sensor_msgs/msg/CompressedImage`
    CompressedImage,
    /// `sensor_msgs/msg/CameraInfo`
    CameraInfo,
    /// `geometry_msgs/msg/PoseStamped`
    PoseStamped,
    /// `nav_msgs/msg/Odometry`
    Odometry,
    /// `tf2_msgs/msg/TFMessage`
    TfMessage,
    /// `sensor_msgs/msg/PointCloud2`
    PointCloud2,
    /// `nav_msgs/msg/Path`
    Path,
    /// `std_msgs/msg/Float64`
    Float64,
}

impl MessageType {
    /// Every type.
    pub const ALL: [Self; 9] = [
        Self::Image,
        Self::CompressedImage,
        Self::CameraInfo,
        Self::PoseStamped,
        Self::Odometry,
        Self::TfMessage,
        Self::PointCloud2,
        Self::Path,
        Self::Float64,
    ];

    fn definition(self) -> &'static Definition {
        match self {
            Self::Image => &IMAGE,
            Self::CompressedImage => &COMPRESSED_IMAGE,
            Self::CameraInfo => &CAMERA_INFO,
            Self::PoseStamped => &POSE_STAMPED,
            Self::Odometry => &ODOMETRY,
            Self::TfMessage => &TF_MESSAGE,
            Self::PointCloud2 => &POINT_CLOUD2,
            Self::Path => &PATH,
            Self::Float64 => &FLOAT64,
        }
    }

    /// Full name, `package/msg/Type`.
    pub fn name(self) -> String {
        self.definition().name.replacen('/', "/msg/", 1)
    }

    /// Hash of the type description (REP 2016), as ROS 2 Jazzy states it for these interfaces.
    pub fn type_hash(self) -> &'static str {
        match self {
            Self::Image => "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
            Self::CompressedImage => "RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
            Self::CameraInfo => "RIHS01_b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
            Self::PoseStamped => "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
            Self::Odometry => "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
            Self::TfMessage => "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
            Self::PointCloud2 => "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
            Self::Path => "RIHS01_1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b",
            Self::Float64 => "RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a",
        }
    }

    /// The `ros2msg` schema: this definition, then each type it refers to once, in the order they are first met.
    pub fn schema_text(self) -> String {
        let root = self.definition();
        let mut order: Vec<&'static Definition> = Vec::new();
        collect(root, &mut order);
        let mut text = root.fields.to_owned();
        for d in order {
            text.push_str(&format!("{SEPARATOR}\nMSG: {}\n{}", d.name, d.fields));
        }
        text
    }
}

fn collect(definition: &'static Definition, order: &mut Vec<&'static Definition>) {
    for d in definition.uses {
        if !order.iter().any(|o| o.name == d.name) {
            order.push(d);
            collect(d, order);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_referenced_type_is_defined_exactly_once() {
        for t in MessageType::ALL {
            let text = t.schema_text();
            let mut defined: Vec<&str> = text.lines().filter_map(|l| l.strip_prefix("MSG: ")).collect();
            let count = defined.len();
            defined.sort_unstable();
            defined.dedup();
            assert_eq!(defined.len(), count, "{t:?} defines a type twice");
            for line in text.lines().filter(|l| l.contains('/') && !l.starts_with("MSG: ")) {
                let used = line.split([' ', '[']).next().unwrap_or_default();
                assert!(defined.contains(&used), "{t:?} uses {used} without defining it");
            }
            let separators = text.lines().filter(|l| l.len() == 80 && l.bytes().all(|b| b == b'=')).count();
            assert_eq!(separators, count);
        }
    }

    #[test]
    fn names_and_hashes_have_their_form() {
        assert_eq!(MessageType::TfMessage.name(), "tf2_msgs/msg/TFMessage");
        for t in MessageType::ALL {
            let digest = t.type_hash().strip_prefix("RIHS01_").unwrap();
            assert!(digest.len() == 64 && digest.bytes().all(|b| b.is_ascii_hexdigit()));
        }
    }
}
