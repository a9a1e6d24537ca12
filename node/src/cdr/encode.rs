//! Messages to CDR: one function per message type, fields in the order of the ROS 2 interface definition.

use glam::DQuat;

use crate::cdr::write::{CdrWriter, EncodeError};
use crate::msg::{CameraInfo, CompressedImage, Header, Image, Path, PointCloud2, PoseStamped, TransformStamped};
use crate::rigid::Rigid;

/// Elements of a 6x6 covariance.
pub(super) const COVARIANCE_LEN: usize = 36;

pub(super) fn header(w: &mut CdrWriter, h: &Header) {
    w.stamp(h.stamp_ns);
    w.string(&h.frame_id);
}

fn quaternion(w: &mut CdrWriter, q: DQuat) {
    w.f64_array(&[q.x, q.y, q.z, q.w]);
}

/// Position (or translation) then rotation: `Pose` and `Transform` have the same layout.
pub(super) fn rigid(w: &mut CdrWriter, t: &Rigid) {
    w.f64_array(&t.translation.to_array());
    quaternion(w, t.rotation);
}

fn check_size(w: &mut CdrWriter, what: &'static str, rows: u32, row_bytes: u32, got: usize) {
    let expected = u64::from(rows) * u64::from(row_bytes);
    if expected != got as u64 {
        w.fail(EncodeError::Size { what, expected, got });
    }
}

/// `sensor_msgs/Image`. Errors when `data` is not `step * height` bytes.
pub fn encode_image(m: &Image) -> Result<Vec<u8>, EncodeError> {
    let mut w = CdrWriter::with_capacity(m.data.len() + 128);
    check_size(&mut w, "Image", m.height, m.step, m.data.len());
    header(&mut w, &m.header);
    w.u32(m.height);
    w.u32(m.width);
    w.string(&m.encoding);
    w.u8(u8::from(m.is_bigendian));
    w.u32(m.step);
    w.byte_sequence("Image.data", &m.data);
    w.finish()
}

/// `sensor_msgs/CompressedImage`.
pub fn encode_compressed_image(m: &CompressedImage) -> Result<Vec<u8>, EncodeError> {
    let mut w = CdrWriter::with_capacity(m.data.len() + 128);
    header(&mut w, &m.header);
    w.string(&m.format);
    w.byte_sequence("CompressedImage.data", &m.data);
    w.finish()
}

/// `sensor_msgs/CameraInfo`; `roi.do_rectify` is written false.
pub fn encode_camera_info(m: &CameraInfo) -> Result<Vec<u8>, EncodeError> {
    let mut w = CdrWriter::with_capacity(512);
    header(&mut w, &m.header);
    w.u32(m.height);
    w.u32(m.width);
    w.string(&m.distortion_model);
    w.sequence_len("CameraInfo.d", m.d.len());
    w.f64_array(&m.d);
    w.f64_array(&m.k);
    w.f64_array(&m.r);
    w.f64_array(&m.p);
    w.u32(m.binning_x);
    w.u32(m.binning_y);
    m.roi.iter().for_each(|&v| w.u32(v));
    w.bool(false);
    w.finish()
}

fn pose_stamped(w: &mut CdrWriter, m: &PoseStamped) {
    header(w, &m.header);
    rigid(w, &m.pose);
}

/// `geometry_msgs/PoseStamped`; the child frame has no place in it and is left out.
pub fn encode_pose_stamped(m: &PoseStamped) -> Result<Vec<u8>, EncodeError> {
    let mut w = CdrWriter::with_capacity(128);
    pose_stamped(&mut w, m);
    w.finish()
}

/// `nav_msgs/Odometry`: pose and child frame; covariances and twist are zero.
pub fn encode_odometry(m: &PoseStamped) -> Result<Vec<u8>, EncodeError> {
    let mut w = CdrWriter::with_capacity(768);
    header(&mut w, &m.header);
    w.string(&m.child_frame_id);
    rigid(&mut w, &m.pose);
    w.f64_array(&[0.0; COVARIANCE_LEN]);
    w.f64_array(&[0.0; 6]);
    w.f64_array(&[0.0; COVARIANCE_LEN]);
    w.finish()
}

/// `tf2_msgs/TFMessage`.
pub fn encode_tf_message(transforms: &[TransformStamped]) -> Result<Vec<u8>, EncodeError> {
    let mut w = CdrWriter::with_capacity(128 * transforms.len() + 16);
    w.sequence_len("TFMessage.transforms", transforms.len());
    for t in transforms {
        header(&mut w, &t.header);
        w.string(&t.child_frame_id);
        rigid(&mut w, &t.transform);
    }
    w.finish()
}

/// `sensor_msgs/PointCloud2`, little-endian. Errors when `data` is not `row_step * height` bytes.
pub fn encode_point_cloud2(m: &PointCloud2) -> Result<Vec<u8>, EncodeError> {
    let mut w = CdrWriter::with_capacity(m.data.len() + 1024);
    check_size(&mut w, "PointCloud2", m.height, m.row_step, m.data.len());
    header(&mut w, &m.header);
    w.u32(m.height);
    w.u32(m.width);
    w.sequence_len("PointCloud2.fields", m.fields.len());
    for f in &m.fields {
        w.string(&f.name);
        w.u32(f.offset);
        w.u8(f.datatype);
        w.u32(f.count);
    }
    w.bool(false);
    w.u32(m.point_step);
    w.u32(m.row_step);
    w.byte_sequence("PointCloud2.data", &m.data);
    w.bool(m.is_dense);
    w.finish()
}

/// `nav_msgs/Path`.
pub fn encode_path(m: &Path) -> Result<Vec<u8>, EncodeError> {
    let mut w = CdrWriter::with_capacity(96 * m.poses.len() + 64);
    header(&mut w, &m.header);
    w.sequence_len("Path.poses", m.poses.len());
    m.poses.iter().for_each(|p| pose_stamped(&mut w, p));
    w.finish()
}

/// `std_msgs/Float64`.
pub fn encode_float64(value: f64) -> Result<Vec<u8>, EncodeError> {
    let mut w = CdrWriter::with_capacity(8);
    w.f64(value);
    w.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_is_laid_out_as_the_definition_says() {
        let m = Image {
            header: Header { stamp_ns: 5_000_000_007, frame_id: "cam".into() },
            height: 1,
            width: 2,
            encoding: "mono8".into(),
            is_bigendian: false,
            step: 2,
            data: vec![0xAA, 0xBB],
        };
        let mut expected = vec![0, 1, 0, 0];
        expected.extend(5i32.to_le_bytes());
        expected.extend(7u32.to_le_bytes());
        expected.extend([4, 0, 0, 0, b'c', b'a', b'm', 0]);
        expected.extend([1, 0, 0, 0, 2, 0, 0, 0]);
        expected.extend([6, 0, 0, 0, b'm', b'o', b'n', b'o', b'8', 0]);
        expected.push(0); // is_bigendian
        expected.push(0); // padding to 4
        expected.extend([2, 0, 0, 0, 2, 0, 0, 0, 0xAA, 0xBB]);
        assert_eq!(encode_image(&m).unwrap(), expected);
    }

    #[test]
    fn sizes_that_contradict_the_data_are_refused() {
        let m = Image { height: 2, width: 2, step: 2, data: vec![0; 3], ..Image::default() };
        assert_eq!(encode_image(&m), Err(EncodeError::Size { what: "Image", expected: 4, got: 3 }));
        let c = PointCloud2 { height: 1, row_step: 8, data: vec![0; 9], ..PointCloud2::default() };
        assert!(matches!(encode_point_cloud2(&c), Err(EncodeError::Size { expected: 8, got: 9, .. })));
    }

    #[test]
    fn an_odometry_has_its_fixed_size() {
        let m = PoseStamped {
            header: Header { stamp_ns: 0, frame_id: "map".into() },
            child_frame_id: "base_link".into(),
            pose: Rigid::IDENTITY,
        };
        // stamp 8, "map" 8, "base_link" 14, pad to 32, 7 + 36 + 6 + 36 doubles.
        assert_eq!(encode_odometry(&m).unwrap().len(), 4 + 32 + 85 * 8);
    }
}
