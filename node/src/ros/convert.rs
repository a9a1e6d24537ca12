//! Trajectories and objects as messages.

use glam::{DVec3, Vec3};

use crate::msg::{Detection, Header, Marker, MarkerShape};
use crate::objects::MovingObject;
use crate::output::cloud_live::TrackEnd;
use crate::rigid::Rigid;
use crate::tracks::LiveTrack;

/// What all objects are called: nothing says more of them than that they move.
const CLASS: &str = "moving";
/// A box that is not renewed for so long goes, nanoseconds.
const MARKER_LIFE_NS: i64 = 1_000_000_000;
/// Diameters of the velocity arrow's shaft and head, metres.
const ARROW_M: [f64; 3] = [0.15, 0.35, 0.0];
/// Thinnest box drawn, metres.
const MIN_SIZE_M: f64 = 0.05;

/// The newest points of trajectories, relative to `origin` with the map's axes.
pub fn track_ends(tracks: &[LiveTrack], origin: DVec3) -> Vec<TrackEnd> {
    let end = |t: &LiveTrack| {
        let last = t.end();
        TrackEnd {
            position: (last.position_map - origin).as_vec3().to_array(),
            velocity: last.velocity_map_mps.as_vec3().to_array(),
            age_sec: (last.stamp_ns.saturating_sub(t.born_ns()) as f64 * 1e-9) as f32,
            motion_id: last.motion_id,
            id: t.id,
        }
    };
    tracks.iter().map(end).collect()
}

/// The box of an object: centre and size.
fn body(object: &MovingObject) -> Option<(Rigid, DVec3)> {
    let state = object.states().back()?;
    let center = state.map_from_object.apply(object.box_center());
    let size = object.size_m().max(DVec3::splat(MIN_SIZE_M));
    let pose = Rigid::new(state.map_from_object.rotation, center);
    (pose.is_finite() && size.is_finite()).then_some((pose, size))
}

/// A box and a velocity arrow (as long as a second's way) per object, in the frame of `header`.
pub fn markers<'a>(objects: impl Iterator<Item = &'a MovingObject>, header: &Header) -> Vec<Marker> {
    let mut markers = Vec::new();
    for object in objects {
        let Some((pose, size)) = body(object) else { continue };
        let velocity = object.velocity_mps();
        let id = object.id as i32;
        let [r, g, b] = color(object.id);
        let boxed = Marker {
            header: header.clone(),
            namespace: "objects".into(),
            id,
            shape: MarkerShape::Cube,
            pose,
            scale: size.to_array(),
            color: [r, g, b, 0.5],
            lifetime_ns: MARKER_LIFE_NS,
        };
        let ends = [pose.translation, pose.translation + velocity].map(|p| p.to_array());
        let arrow = Marker {
            namespace: "velocity".into(),
            shape: MarkerShape::Arrow(ends),
            pose: Rigid::IDENTITY,
            scale: ARROW_M,
            color: [r, g, b, 1.0],
            ..boxed.clone()
        };
        markers.push(boxed);
        if velocity.is_finite() {
            markers.push(arrow);
        }
    }
    markers
}

/// One detection per object, in the frame of `header`.
pub fn detections<'a>(objects: impl Iterator<Item = &'a MovingObject>, header: &Header) -> Vec<Detection> {
    objects
        .filter_map(|object| {
            let (pose, size) = body(object)?;
            let (header, id, class_id) = (header.clone(), object.id.to_string(), CLASS.into());
            Some(Detection { header, id, class_id, score: 1.0, pose, size: size.to_array() })
        })
        .collect()
}

/// A colour per name, far from its neighbours' (the golden angle on the colour wheel).
fn color(id: u32) -> [f32; 3] {
    let turn = (f64::from(id) * 0.618_033_988_75).fract() as f32 * std::f32::consts::TAU;
    let third = std::f32::consts::TAU / 3.0;
    Vec3::new(turn.cos(), (turn - third).cos(), (turn + third).cos()).to_array().map(|c| 0.5 + 0.45 * c)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{ObjectsConfig, TracksConfig};
    use crate::objects::{ObjectPoint, ObjectTracker};
    use crate::tracks::{TrackPoint, Tracker};

    const STEP_NS: i64 = 100_000_000;

    #[test]
    fn a_trajectory_is_where_it_ended_relative_to_the_origin() {
        let mut tracker = Tracker::new(&TracksConfig::default());
        let origin = DVec3::new(5e5, 5e6, 100.0);
        for i in 0..3 {
            let point = TrackPoint {
                position_map: origin + DVec3::new(10.0 + 0.5 * f64::from(i), 0.0, 0.0),
                velocity_map_mps: DVec3::new(5.0, 0.0, 0.0),
                opacity: 1.0,
                motion_id: 3,
                color01: [0.5; 3],
                distance_m: 10.0,
                may_start: true,
            };
            tracker.step(i64::from(i) * STEP_NS, 0, &[point]);
        }
        let ends = track_ends(tracker.live(), origin);
        assert_eq!(ends.len(), 1);
        assert!((ends[0].position[0] - 11.0).abs() < 1e-4 && (ends[0].age_sec - 0.2).abs() < 1e-6, "{ends:?}");
        assert_eq!((ends[0].velocity, ends[0].motion_id), ([5.0, 0.0, 0.0], 3));
    }

    #[test]
    fn an_object_is_a_box_an_arrow_and_a_detection() {
        let config = ObjectsConfig::default();
        let mut tracker = ObjectTracker::new(&config);
        for i in 0..4 {
            let points: Vec<ObjectPoint> = (0..20)
                .map(|k| ObjectPoint {
                    position_map: DVec3::new(0.8 * f64::from(i) + 0.2 * f64::from(k % 5), 0.2 * f64::from(k / 5), 0.5),
                    velocity_map_mps: DVec3::new(8.0, 0.0, 0.0),
                    opacity: 1.0,
                    motion_id: 1,
                    color01: [0.5; 3],
                    distance_m: 10.0,
                    rotation: glam::Quat::IDENTITY,
                    scale: Vec3::splat(0.1),
                })
                .collect();
            tracker.step(i64::from(i) * STEP_NS, 0, &points);
        }
        let header = Header { stamp_ns: 3 * STEP_NS, frame_id: "map".into() };
        let objects = || tracker.live().iter();
        let (markers, found) = (markers(objects(), &header), detections(objects(), &header));
        assert_eq!((markers.len(), found.len()), (2, 1));
        assert!(found[0].size[0] > 0.5, "{:?}", found[0].size);
        let MarkerShape::Arrow([from, to]) = markers[1].shape else { panic!("{:?}", markers[1]) };
        assert!((to[0] - from[0] - 8.0).abs() < 0.5, "{from:?} {to:?}");
    }
}
