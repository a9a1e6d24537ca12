//! The ROS 2 messages the program reads and writes, as plain values with our names.
//!
//! Field meaning follows the ROS 2 interface definitions; stamps are nanoseconds since the epoch of whatever clock wrote
//! them (wall or simulated), so they can be anything from 0 up.

use storm_render::Intrinsics;

use crate::rigid::Rigid;

/// `std_msgs/Header`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Header {
    /// Stamp, nanoseconds.
    pub stamp_ns: i64,
    /// Coordinate frame the data is in.
    pub frame_id: String,
}

/// `sensor_msgs/Image`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Image {
    /// Stamp and optical frame.
    pub header: Header,
    /// Rows.
    pub height: u32,
    /// Columns.
    pub width: u32,
    /// ROS encoding name (`rgb8`, `bayer_rggb8`, `32FC1`, ...).
    pub encoding: String,
    /// True when multi-byte samples are big-endian.
    pub is_bigendian: bool,
    /// Bytes per row.
    pub step: u32,
    /// Pixel data, `step * height` bytes.
    pub data: Vec<u8>,
}

/// `sensor_msgs/CompressedImage`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CompressedImage {
    /// Stamp and optical frame.
    pub header: Header,
    /// `jpeg`, `png`, or the image_transport form (`rgb8; jpeg compressed bgr8`).
    pub format: String,
    /// The encoded file.
    pub data: Vec<u8>,
}

/// `sensor_msgs/CameraInfo` (region of interest and binning included, since they change the intrinsics).
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CameraInfo {
    /// Stamp and optical frame.
    pub header: Header,
    /// Rows of the full picture.
    pub height: u32,
    /// Columns of the full picture.
    pub width: u32,
    /// `plumb_bob`, `rational_polynomial`, `equidistant`, ...
    pub distortion_model: String,
    /// Distortion coefficients, as many as the model has.
    pub d: Vec<f64>,
    /// Intrinsics of the raw picture, row-major 3x3.
    pub k: [f64; 9],
    /// Rectification rotation, row-major 3x3.
    pub r: [f64; 9],
    /// Projection of the rectified picture, row-major 3x4.
    pub p: [f64; 12],
    /// Binning along x; 0 and 1 mean none.
    pub binning_x: u32,
    /// Binning along y; 0 and 1 mean none.
    pub binning_y: u32,
    /// Region of interest: x offset, y offset, height, width (all 0: the whole picture).
    pub roi: [u32; 4],
}

impl CameraInfo {
    /// True when `K` holds no focal length: the camera is not calibrated, or `P` alone describes it.
    pub fn k_is_unset(&self) -> bool {
        self.k[0] == 0.0 && self.k[4] == 0.0
    }

    /// True when `P` holds no focal length (some drivers write nothing but its last 1).
    pub fn p_is_unset(&self) -> bool {
        self.p[0] == 0.0 && self.p[5] == 0.0
    }

    /// Of an undistorted picture.
    ///
    /// ROS follows OpenCV, where the centre of the first pixel is 0.0; ours puts it at 0.5, so the principal point moves by
    /// half a pixel.
    pub fn pinhole(intrinsics: &Intrinsics, header: Header) -> Self {
        let (fx, fy) = (f64::from(intrinsics.fx), f64::from(intrinsics.fy));
        let (cx, cy) = (f64::from(intrinsics.cx) - 0.5, f64::from(intrinsics.cy) - 0.5);
        Self {
            header,
            height: intrinsics.height as u32,
            width: intrinsics.width as u32,
            distortion_model: "plumb_bob".into(),
            d: vec![0.0; 5],
            k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            p: [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
            ..Self::default()
        }
    }
}

/// `geometry_msgs/TransformStamped`, also the element of `tf2_msgs/TFMessage`.
#[derive(Debug, Clone, PartialEq)]
pub struct TransformStamped {
    /// Stamp and the parent frame.
    pub header: Header,
    /// The child frame.
    pub child_frame_id: String,
    /// `parent_from_child`, as read: the quaternion need not be unit yet.
    pub transform: Rigid,
}

/// A vehicle pose, whichever message it came in (PoseStamped, PoseWithCovarianceStamped, Odometry, TransformStamped).
#[derive(Debug, Clone, PartialEq)]
pub struct PoseStamped {
    /// Stamp and the frame the pose is given in.
    pub header: Header,
    /// The frame the pose is of, when the message names it (Odometry, TransformStamped); else empty.
    pub child_frame_id: String,
    /// `frame_from_child`, as read: the quaternion need not be unit yet.
    pub pose: Rigid,
}

/// `sensor_msgs/PointField`: one column of a point cloud.
#[derive(Debug, Clone, PartialEq)]
pub struct PointField {
    /// Column name.
    pub name: String,
    /// Byte offset inside a point.
    pub offset: u32,
    /// ROS data type code (1 int8, 2 uint8, 3 int16, 4 uint16, 5 int32, 6 uint32, 7 float32, 8 float64).
    pub datatype: u8,
    /// Elements of the column.
    pub count: u32,
}

/// `sensor_msgs/PointCloud2`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud2 {
    /// Stamp and frame.
    pub header: Header,
    /// Rows; 1 for an unorganised cloud.
    pub height: u32,
    /// Points per row.
    pub width: u32,
    /// Columns.
    pub fields: Vec<PointField>,
    /// Bytes per point.
    pub point_step: u32,
    /// Bytes per row.
    pub row_step: u32,
    /// Points, `row_step * height` bytes, little-endian.
    pub data: Vec<u8>,
    /// True when no point is invalid.
    pub is_dense: bool,
}

/// `nav_msgs/Path`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Path {
    /// Stamp and frame.
    pub header: Header,
    /// Poses along the path.
    pub poses: Vec<PoseStamped>,
}

/// `diagnostic_msgs/DiagnosticStatus`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct DiagnosticStatus {
    /// 0 fine, 1 warning, 2 error, 3 stale.
    pub level: u8,
    /// What it is of.
    pub name: String,
    /// One line.
    pub message: String,
    /// Device or program.
    pub hardware_id: String,
    /// Key and value.
    pub values: Vec<(String, String)>,
}

/// `visualization_msgs/Marker`, as far as it is used: a box or an arrow.
#[derive(Debug, Clone, PartialEq)]
pub struct Marker {
    /// Stamp and frame.
    pub header: Header,
    /// Names are unique within a namespace.
    pub namespace: String,
    /// Name.
    pub id: i32,
    /// What is drawn.
    pub shape: MarkerShape,
    /// Standing of the shape in the frame.
    pub pose: Rigid,
    /// Size of a box, or diameters of an arrow's shaft and head (and 0: head length as it comes), metres.
    pub scale: [f64; 3],
    /// Red, green, blue, opacity, 0 to 1.
    pub color: [f32; 4],
    /// When it goes by itself, nanoseconds.
    pub lifetime_ns: i64,
}

/// What a [`Marker`] draws.
#[derive(Debug, Clone, PartialEq)]
pub enum MarkerShape {
    /// A box.
    Cube,
    /// An arrow between two points of the marker's frame, metres.
    Arrow([[f64; 3]; 2]),
}

/// `vision_msgs/Detection3D`, one hypothesis each.
#[derive(Debug, Clone, PartialEq)]
pub struct Detection {
    /// Stamp and frame.
    pub header: Header,
    /// Name that stays the same over time.
    pub id: String,
    /// What it is.
    pub class_id: String,
    /// How sure that is, 0 to 1.
    pub score: f64,
    /// Centre of the box.
    pub pose: Rigid,
    /// Size of the box along its own axes, metres.
    pub size: [f64; 3],
}
