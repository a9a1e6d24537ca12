//! Messages that only a live node sends, to CDR; fields in the order of the ROS 2 interface definitions.

use super::encode::{COVARIANCE_LEN, header, rigid};
use super::write::{CdrWriter, EncodeError};
use crate::msg::{Detection, DiagnosticStatus, Header, Marker, MarkerShape};

/// Nanoseconds in a second.
const NS_PER_SEC: i64 = 1_000_000_000;
/// `visualization_msgs/Marker` type numbers.
const ARROW: i32 = 0;
const CUBE: i32 = 1;

/// `diagnostic_msgs/DiagnosticArray`.
pub fn encode_diagnostics(stamp_ns: i64, statuses: &[DiagnosticStatus]) -> Result<Vec<u8>, EncodeError> {
    let mut w = CdrWriter::with_capacity(4096);
    header(&mut w, &Header { stamp_ns, frame_id: String::new() });
    w.sequence_len("DiagnosticArray.status", statuses.len());
    for s in statuses {
        w.u8(s.level);
        w.string(&s.name);
        w.string(&s.message);
        w.string(&s.hardware_id);
        w.sequence_len("DiagnosticStatus.values", s.values.len());
        for (key, value) in &s.values {
            w.string(key);
            w.string(value);
        }
    }
    w.finish()
}

/// `visualization_msgs/MarkerArray`; every marker is added (or changed).
pub fn encode_markers(markers: &[Marker]) -> Result<Vec<u8>, EncodeError> {
    let mut w = CdrWriter::with_capacity(256 * markers.len() + 16);
    w.sequence_len("MarkerArray.markers", markers.len());
    for m in markers {
        header(&mut w, &m.header);
        w.string(&m.namespace);
        w.i32(m.id);
        w.i32(if m.shape == MarkerShape::Cube { CUBE } else { ARROW });
        w.i32(0);
        rigid(&mut w, &m.pose);
        w.f64_array(&m.scale);
        m.color.iter().for_each(|&c| w.f32(c));
        let ns = m.lifetime_ns.max(0);
        w.i32(i32::try_from(ns / NS_PER_SEC).unwrap_or(i32::MAX));
        w.u32((ns % NS_PER_SEC) as u32);
        w.bool(false);
        let points: &[[f64; 3]] = if let MarkerShape::Arrow(ends) = &m.shape { ends } else { &[] };
        w.sequence_len("Marker.points", points.len());
        points.iter().for_each(|p| w.f64_array(p));
        w.sequence_len("Marker.colors", 0);
        w.string("");
        // The texture: an empty CompressedImage.
        header(&mut w, &Header::default());
        w.string("");
        w.byte_sequence("Marker.texture", &[]);
        w.sequence_len("Marker.uv_coordinates", 0);
        w.string("");
        // No mesh: resource, file name, file, materials.
        w.string("");
        w.string("");
        w.byte_sequence("Marker.mesh_file", &[]);
        w.bool(false);
    }
    w.finish()
}

/// `vision_msgs/Detection3DArray`.
pub fn encode_detections(array: &Header, detections: &[Detection]) -> Result<Vec<u8>, EncodeError> {
    let mut w = CdrWriter::with_capacity(512 * detections.len() + 64);
    header(&mut w, array);
    w.sequence_len("Detection3DArray.detections", detections.len());
    for d in detections {
        header(&mut w, &d.header);
        w.sequence_len("Detection3D.results", 1);
        w.string(&d.class_id);
        w.f64(d.score);
        rigid(&mut w, &d.pose);
        w.f64_array(&[0.0; COVARIANCE_LEN]);
        rigid(&mut w, &d.pose);
        w.f64_array(&d.size);
        w.string(&d.id);
    }
    w.finish()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rigid::Rigid;

    /// Lengths worked out by hand from the definitions; that ROS reads every field is tested against ROS.
    #[test]
    fn lengths_are_those_of_the_definitions() {
        let status = DiagnosticStatus { values: vec![("k".into(), "v".into())], ..Default::default() };
        let bytes = encode_diagnostics(5, &[status]).unwrap();
        // header 8+4+1, pad, count, level, pad, three empty strings (5 and pad), count, "k" (6, pad), "v" (6).
        assert_eq!(bytes.len(), 4 + 16 + 4 + 4 + 3 * 8 + 4 + 8 + 6);
        assert_eq!(encode_markers(&[]).unwrap().len(), 4 + 4);
        assert_eq!(encode_detections(&Header::default(), &[]).unwrap().len(), 4 + 16 + 4);
        let marker = Marker {
            header: Header::default(),
            namespace: "n".into(),
            id: 1,
            shape: MarkerShape::Cube,
            pose: Rigid::IDENTITY,
            scale: [1.0; 3],
            color: [0.5; 4],
            lifetime_ns: 1_500_000_000,
        };
        let cube = encode_markers(std::slice::from_ref(&marker)).unwrap();
        let arrow = encode_markers(&[Marker { shape: MarkerShape::Arrow([[0.0; 3]; 2]), ..marker }]).unwrap();
        // Two points of three doubles; where the list's length ends here they are aligned already.
        assert_eq!(arrow.len(), cube.len() + 48);
    }
}
