//! The ROS 2 messages the program consumes, from CDR bytes to the plain values of [`crate::msg`].
//!
//! Values are taken as they are (a NaN position or a non-unit quaternion decodes): judging them needs the topic and the
//! stamp, which the caller has. Field order follows the ROS 2 interface definitions; bytes past the last field are ignored.

use glam::{DQuat, DVec3};

use super::read::{CdrError, CdrReader};
use crate::msg::{CameraInfo, CompressedImage, Header, Image, PointCloud2, PointField, PoseStamped, TransformStamped};
use crate::rigid::Rigid;

/// Nanoseconds in a second.
const NS_PER_SEC: i64 = 1_000_000_000;

/// Least bytes a TransformStamped can take: stamp, two empty strings, seven doubles.
const TRANSFORM_STAMPED_MIN_BYTES: usize = 8 + 4 + 4 + 7 * 8;

/// The message types [`pose`] reads.
pub const POSE_TYPES: [&str; 4] = [
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/TransformStamped",
];

fn read_header(r: &mut CdrReader<'_>) -> Result<Header, CdrError> {
    let sec = r.i32("header.stamp.sec")?;
    let nanosec = r.u32("header.stamp.nanosec")?;
    // |i32| * 1e9 + u32 stays well inside i64.
    let stamp_ns = i64::from(sec) * NS_PER_SEC + i64::from(nanosec);
    Ok(Header { stamp_ns, frame_id: r.string("header.frame_id")? })
}

fn read_pose(r: &mut CdrReader<'_>, field: &'static str) -> Result<Rigid, CdrError> {
    let [x, y, z] = r.f64_array(field)?;
    let [qx, qy, qz, qw] = r.f64_array(field)?;
    Ok(Rigid::new(DQuat::from_xyzw(qx, qy, qz, qw), DVec3::new(x, y, z)))
}

/// The header of any message that begins with one (all those below but TFMessage); the rest is not looked at.
///
/// # Errors
/// Not plain CDR, or too short.
pub fn header(data: &[u8]) -> Result<Header, CdrError> {
    read_header(&mut CdrReader::new("std_msgs/msg/Header", data)?)
}

/// `sensor_msgs/msg/Image`. That `step * height` fits the data is checked where pixels are read.
///
/// # Errors
/// Not plain CDR, or a field reaches past the end.
pub fn image(data: &[u8]) -> Result<Image, CdrError> {
    let r = &mut CdrReader::new("sensor_msgs/msg/Image", data)?;
    Ok(Image {
        header: read_header(r)?,
        height: r.u32("height")?,
        width: r.u32("width")?,
        encoding: r.string("encoding")?,
        is_bigendian: r.u8("is_bigendian")? != 0,
        step: r.u32("step")?,
        data: r.bytes("data")?.to_vec(),
    })
}

/// `sensor_msgs/msg/CompressedImage`.
///
/// # Errors
/// Not plain CDR, or a field reaches past the end.
pub fn compressed_image(data: &[u8]) -> Result<CompressedImage, CdrError> {
    let r = &mut CdrReader::new("sensor_msgs/msg/CompressedImage", data)?;
    Ok(CompressedImage { header: read_header(r)?, format: r.string("format")?, data: r.bytes("data")?.to_vec() })
}

/// `sensor_msgs/msg/PointCloud2`.
///
/// # Errors
/// Not plain CDR, or a field reaches past the end.
pub fn point_cloud2(data: &[u8]) -> Result<PointCloud2, CdrError> {
    // A field is at least its name's length word, two integers and a byte.
    const FIELD_MIN_BYTES: usize = 13;
    let r = &mut CdrReader::new("sensor_msgs/msg/PointCloud2", data)?;
    let (header, height, width) = (read_header(r)?, r.u32("height")?, r.u32("width")?);
    let count = r.sequence_len("fields", FIELD_MIN_BYTES)?;
    let mut fields = Vec::with_capacity(count);
    for _ in 0..count {
        fields.push(PointField {
            name: r.string("fields.name")?,
            offset: r.u32("fields.offset")?,
            datatype: r.u8("fields.datatype")?,
            count: r.u32("fields.count")?,
        });
    }
    r.u8("is_bigendian")?;
    Ok(PointCloud2 {
        header,
        height,
        width,
        fields,
        point_step: r.u32("point_step")?,
        row_step: r.u32("row_step")?,
        data: r.bytes("data")?.to_vec(),
        is_dense: r.u8("is_dense")? != 0,
    })
}

/// `sensor_msgs/msg/CameraInfo`.
///
/// # Errors
/// Not plain CDR, or a field reaches past the end.
pub fn camera_info(data: &[u8]) -> Result<CameraInfo, CdrError> {
    let r = &mut CdrReader::new("sensor_msgs/msg/CameraInfo", data)?;
    let mut info = CameraInfo {
        header: read_header(r)?,
        height: r.u32("height")?,
        width: r.u32("width")?,
        distortion_model: r.string("distortion_model")?,
        d: r.f64_sequence("d")?,
        k: r.f64_array("k")?,
        r: r.f64_array("r")?,
        p: r.f64_array("p")?,
        binning_x: r.u32("binning_x")?,
        binning_y: r.u32("binning_y")?,
        roi: [0; 4],
    };
    for (value, field) in info.roi.iter_mut().zip(["roi.x_offset", "roi.y_offset", "roi.height", "roi.width"]) {
        *value = r.u32(field)?;
    }
    r.u8("roi.do_rectify")?;
    Ok(info)
}

/// `geometry_msgs/msg/PoseStamped`.
///
/// # Errors
/// Not plain CDR, or a field reaches past the end.
pub fn pose_stamped(data: &[u8]) -> Result<PoseStamped, CdrError> {
    let r = &mut CdrReader::new("geometry_msgs/msg/PoseStamped", data)?;
    Ok(PoseStamped { header: read_header(r)?, child_frame_id: String::new(), pose: read_pose(r, "pose")? })
}

/// `geometry_msgs/msg/PoseWithCovarianceStamped`; the covariance is not kept.
///
/// # Errors
/// Not plain CDR, or a field reaches past the end.
pub fn pose_with_covariance_stamped(data: &[u8]) -> Result<PoseStamped, CdrError> {
    let r = &mut CdrReader::new("geometry_msgs/msg/PoseWithCovarianceStamped", data)?;
    let out = PoseStamped { header: read_header(r)?, child_frame_id: String::new(), pose: read_pose(r, "pose.pose")? };
    r.f64_array::<36>("pose.covariance")?;
    Ok(out)
}

/// `nav_msgs/msg/Odometry`; covariances and the twist are not kept.
///
/// # Errors
/// Not plain CDR, or a field reaches past the end.
pub fn odometry(data: &[u8]) -> Result<PoseStamped, CdrError> {
    let r = &mut CdrReader::new("nav_msgs/msg/Odometry", data)?;
    let out = PoseStamped {
        header: read_header(r)?,
        child_frame_id: r.string("child_frame_id")?,
        pose: read_pose(r, "pose.pose")?,
    };
    r.f64_array::<36>("pose.covariance")?;
    r.f64_array::<6>("twist.twist")?;
    r.f64_array::<36>("twist.covariance")?;
    Ok(out)
}

fn read_transform_stamped(r: &mut CdrReader<'_>) -> Result<TransformStamped, CdrError> {
    Ok(TransformStamped {
        header: read_header(r)?,
        child_frame_id: r.string("child_frame_id")?,
        transform: read_pose(r, "transform")?,
    })
}

/// `geometry_msgs/msg/TransformStamped`.
///
/// # Errors
/// Not plain CDR, or a field reaches past the end.
pub fn transform_stamped(data: &[u8]) -> Result<TransformStamped, CdrError> {
    read_transform_stamped(&mut CdrReader::new("geometry_msgs/msg/TransformStamped", data)?)
}

/// `tf2_msgs/msg/TFMessage`.
///
/// # Errors
/// Not plain CDR, or a field reaches past the end.
pub fn tf_message(data: &[u8]) -> Result<Vec<TransformStamped>, CdrError> {
    let r = &mut CdrReader::new("tf2_msgs/msg/TFMessage", data)?;
    let len = r.sequence_len("transforms", TRANSFORM_STAMPED_MIN_BYTES)?;
    (0..len).map(|_| read_transform_stamped(r)).collect()
}

/// Any of [`POSE_TYPES`] as a pose; `type_name` in the form `nav_msgs/msg/Odometry`.
///
/// # Errors
/// Another type, not plain CDR, or a field reaches past the end.
pub fn pose(type_name: &str, data: &[u8]) -> Result<PoseStamped, CdrError> {
    match type_name {
        "geometry_msgs/msg/PoseStamped" => pose_stamped(data),
        "geometry_msgs/msg/PoseWithCovarianceStamped" => pose_with_covariance_stamped(data),
        "nav_msgs/msg/Odometry" => odometry(data),
        "geometry_msgs/msg/TransformStamped" => transform_stamped(data).map(|t| PoseStamped {
            header: t.header,
            child_frame_id: t.child_frame_id,
            pose: t.transform,
        }),
        _ => Err(CdrError::NotAPose {
            type_name: type_name.to_owned(),
            accepted: "geometry_msgs/msg/{PoseStamped, PoseWithCovarianceStamped, TransformStamped}, nav_msgs/msg/Odometry",
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Writes CDR by hand, in either byte order: the test's own, deliberately plain, encoder.
    struct Writer {
        bytes: Vec<u8>,
        big: bool,
    }

    impl Writer {
        fn new(big: bool) -> Self {
            Self { bytes: vec![0, u8::from(!big), 0, 0], big }
        }
        fn raw(mut self, size: usize, le: &[u8]) -> Self {
            while !(self.bytes.len() - 4).is_multiple_of(size) {
                self.bytes.push(0);
            }
            let mut b = le.to_vec();
            if self.big {
                b.reverse();
            }
            self.bytes.extend(b);
            self
        }
        fn u32(self, v: u32) -> Self {
            self.raw(4, &v.to_le_bytes())
        }
        fn f64s(self, v: &[f64]) -> Self {
            v.iter().fold(self, |w, x| w.raw(8, &x.to_le_bytes()))
        }
        fn u8(mut self, v: u8) -> Self {
            self.bytes.push(v);
            self
        }
        fn string(mut self, s: &str) -> Self {
            self = self.u32(s.len() as u32 + 1);
            self.bytes.extend(s.bytes());
            self.bytes.push(0);
            self
        }
        fn blob(mut self, b: &[u8]) -> Self {
            self = self.u32(b.len() as u32);
            self.bytes.extend(b);
            self
        }
        fn header(self, frame: &str) -> Self {
            self.u32(17).u32(250_000_000).string(frame)
        }
    }

    const STAMP_NS: i64 = 17_250_000_000;
    const POSE: [f64; 7] = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3, 0.9];

    #[test]
    fn every_message_in_both_byte_orders() {
        for big in [false, true] {
            let w = || Writer::new(big);
            let img =
                image(&w().header("cam").u32(2).u32(3).string("mono8").u8(1).u32(3).blob(&[1, 2, 3, 4, 5, 6]).bytes)
                    .unwrap();
            assert_eq!((img.height, img.width, img.step, img.is_bigendian), (2, 3, 3, true));
            assert_eq!((img.encoding.as_str(), img.data.as_slice()), ("mono8", &[1, 2, 3, 4, 5, 6][..]));
            assert_eq!((img.header.stamp_ns, img.header.frame_id.as_str()), (STAMP_NS, "cam"));

            let comp = compressed_image(&w().header("c").string("jpeg").blob(&[9, 8]).bytes).unwrap();
            assert_eq!((comp.format.as_str(), comp.data.as_slice()), ("jpeg", &[9, 8][..]));

            let k: Vec<f64> = (0..9).map(f64::from).collect();
            let p: Vec<f64> = (100..112).map(f64::from).collect();
            let info = w().header("c").u32(480).u32(640).string("plumb_bob").u32(5).f64s(&[0.1, 0.2, 0.3, 0.4, 0.5]);
            let info = info.f64s(&k).f64s(&k).f64s(&p).u32(2).u32(4).u32(10).u32(20).u32(30).u32(40).u8(1);
            let info = camera_info(&info.bytes).unwrap();
            assert_eq!((info.height, info.width, info.d.len(), info.d[4]), (480, 640, 5, 0.5));
            assert_eq!((info.k[8], info.r[1], info.p[11]), (8.0, 1.0, 111.0));
            assert_eq!((info.binning_x, info.binning_y, info.roi), (2, 4, [10, 20, 30, 40]));

            let cov = [0.5; 36];
            let ps = w().header("map").f64s(&POSE).bytes;
            let pc = w().header("map").f64s(&POSE).f64s(&cov).bytes;
            let od = w().header("map").string("base").f64s(&POSE).f64s(&cov).f64s(&[0.0; 6]).f64s(&cov).bytes;
            let ts = w().header("map").string("base").f64s(&POSE).bytes;
            for (type_name, bytes) in POSE_TYPES.iter().zip([ps, pc, od, ts]) {
                let got = pose(type_name, &bytes).unwrap();
                assert_eq!(got.pose.translation, DVec3::new(1.0, 2.0, 3.0), "{type_name}");
                assert_eq!(got.pose.rotation, DQuat::from_xyzw(0.1, 0.2, 0.3, 0.9));
                assert_eq!((got.header.stamp_ns, got.header.frame_id.as_str()), (STAMP_NS, "map"));
                let child = if type_name.contains("Pose") { "" } else { "base" };
                assert_eq!(got.child_frame_id, child);
                assert_eq!(header(&bytes).unwrap(), got.header);
                for cut in 0..bytes.len() {
                    assert!(pose(type_name, &bytes[..cut]).is_err(), "{type_name} cut at {cut}");
                }
            }

            let tf = w().u32(2).header("a").string("b").f64s(&POSE).header("b").string("cc").f64s(&POSE);
            let tf = tf_message(&tf.bytes).unwrap();
            assert_eq!((tf.len(), tf[1].header.frame_id.as_str(), tf[1].child_frame_id.as_str()), (2, "b", "cc"));
        }
    }

    #[test]
    fn a_hundred_bytes_claiming_a_hundred_gigabytes_are_refused() {
        let huge = Writer::new(false).header("c").u32(200_000).u32(200_000).string("rgb8").u8(0).u32(600_000);
        let e = image(&huge.u32(u32::MAX).bytes).unwrap_err();
        assert!(matches!(e, CdrError::Short { field: "data", need: 4_294_967_295, have: 0, .. }), "{e}");
        let e = tf_message(&Writer::new(false).u32(u32::MAX).bytes).unwrap_err();
        assert!(matches!(e, CdrError::Short { field: "transforms", .. }), "{e}");
    }

    #[test]
    fn negative_seconds_and_unknown_pose_types() {
        let bytes = Writer::new(false).raw(4, &(-1i32).to_le_bytes()).u32(5).string("").bytes;
        assert_eq!(header(&bytes).unwrap().stamp_ns, -999_999_995);
        let e = pose("sensor_msgs/msg/Imu", &[]).unwrap_err().to_string();
        assert!(e.contains("sensor_msgs/msg/Imu") && e.contains("Odometry"), "{e}");
    }

    proptest! {
        #[test]
        fn random_bytes_never_panic(mut bytes in proptest::collection::vec(any::<u8>(), 0..400), le in any::<bool>()) {
            for forced in [false, true] {
                if forced && bytes.len() >= 4 {
                    bytes[0] = 0;
                    bytes[1] = u8::from(le);
                }
                let _ = (header(&bytes), image(&bytes), compressed_image(&bytes), camera_info(&bytes), tf_message(&bytes));
                for t in POSE_TYPES {
                    let _ = pose(t, &bytes);
                }
            }
        }
    }
}
