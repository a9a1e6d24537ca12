//! What [`super::encode`] writes, [`super::decode`] reads back: every field, for any value.

use glam::{DQuat, DVec3};
use proptest::prelude::*;

use super::{decode, encode};
use crate::msg::{CameraInfo, CompressedImage, Header, Image, PoseStamped, TransformStamped};
use crate::rigid::Rigid;

/// Stamps with 32-bit seconds.
const STAMP_LIMIT_NS: i64 = i32::MAX as i64 * 1_000_000_000;

fn headers() -> impl Strategy<Value = Header> {
    (-STAMP_LIMIT_NS..STAMP_LIMIT_NS, "[a-z_/ü]{0,9}").prop_map(|(stamp_ns, frame_id)| Header { stamp_ns, frame_id })
}

fn rigids() -> impl Strategy<Value = Rigid> {
    let number = prop::num::f64::NORMAL | prop::num::f64::ZERO | prop::num::f64::SUBNORMAL;
    prop::array::uniform7(number)
        .prop_map(|[a, b, c, d, e, f, g]| Rigid::new(DQuat::from_xyzw(a, b, c, d), DVec3::new(e, f, g)))
}

fn poses() -> impl Strategy<Value = PoseStamped> {
    (headers(), "[a-z]{0,9}", rigids()).prop_map(|(header, child_frame_id, pose)| PoseStamped {
        header,
        child_frame_id,
        pose,
    })
}

fn numbers() -> impl Strategy<Value = f64> {
    prop::num::f64::NORMAL | prop::num::f64::ZERO
}

proptest! {
    #[test]
    fn images(header in headers(), encoding in "[a-zA-Z0-9]{0,12}", height in 0u32..5, step in 0u32..7,
              width in any::<u32>(), is_bigendian in any::<bool>(), fill in any::<u8>()) {
        let data = (0..height * step).map(|i| fill.wrapping_add(i as u8)).collect();
        let image = Image { header, height, width, encoding, is_bigendian, step, data };
        prop_assert_eq!(decode::image(&encode::encode_image(&image).unwrap()).unwrap(), image);
    }

    #[test]
    fn compressed_images(header in headers(), format in "[a-z0-9; ]{0,20}", data in prop::collection::vec(any::<u8>(), 0..50)) {
        let image = CompressedImage { header, format, data };
        prop_assert_eq!(decode::compressed_image(&encode::encode_compressed_image(&image).unwrap()).unwrap(), image);
    }

    #[test]
    fn camera_infos(header in headers(), distortion_model in "[a-z_]{0,15}", d in prop::collection::vec(numbers(), 0..15),
                    v in prop::collection::vec(numbers(), 30), size in any::<(u32, u32, u32, u32)>(), roi in any::<[u32; 4]>()) {
        let (height, width, binning_x, binning_y) = size;
        let (k, r, p) = (v[..9].try_into().unwrap(), v[9..18].try_into().unwrap(), v[18..].try_into().unwrap());
        let info = CameraInfo { header, height, width, distortion_model, d, k, r, p, binning_x, binning_y, roi };
        prop_assert_eq!(decode::camera_info(&encode::encode_camera_info(&info).unwrap()).unwrap(), info);
    }

    #[test]
    fn odometries(pose in poses()) {
        prop_assert_eq!(&decode::odometry(&encode::encode_odometry(&pose).unwrap()).unwrap(), &pose);
        let without_child = PoseStamped { child_frame_id: String::new(), ..pose };
        let back = decode::pose_stamped(&encode::encode_pose_stamped(&without_child).unwrap()).unwrap();
        prop_assert_eq!(back, without_child);
    }

    #[test]
    fn transforms(list in prop::collection::vec((headers(), "[a-z]{0,9}", rigids()), 0..5)) {
        let list: Vec<_> = list
            .into_iter()
            .map(|(header, child_frame_id, transform)| TransformStamped { header, child_frame_id, transform })
            .collect();
        prop_assert_eq!(decode::tf_message(&encode::encode_tf_message(&list).unwrap()).unwrap(), list);
    }
}
