//! Point clouds that only a live node publishes; the same rules as [`super::cloud`].
//!
//! | cloud | columns (type float32 unless said) | bytes per point |
//! |---|---|---|
//! | tracks | x y z vx vy vz age (s), motion_id uint16, track_id uint32 | 36 |
//! | changed tiles | x y z rgb opacity scale_0..2 rot_0..3, tile_x tile_y tile_z int32 | 60 |

use super::OutputError;
use super::cloud::{BuiltCloud, GEOMETRY, Layout, UINT16, UINT32, finite, pack_rgb, put, unorganised};
use crate::map::{MapCloud, TileIndex};
use crate::msg::Header;

/// Bytes of a point in the topic of changed tiles.
pub const TILE_POINT_BYTES: usize = 60;

/// ROS data type code of int32.
const INT32: u8 = 5;

/// The newest point of a trajectory.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackEnd {
    /// Place, metres.
    pub position: [f32; 3],
    /// Velocity, m/s.
    pub velocity: [f32; 3],
    /// Time since it started, seconds.
    pub age_sec: f32,
    /// Motion group.
    pub motion_id: u16,
    /// Name.
    pub id: u32,
}

/// The tracks topic. Rows with a number that is not finite are left out and counted.
///
/// # Errors
/// More bytes than a message can hold.
pub fn track_cloud(header: Header, tracks: &[TrackEnd]) -> Result<BuiltCloud, OutputError> {
    let layout = Layout::new()
        .floats(&["x", "y", "z", "vx", "vy", "vz", "age"])
        .column("motion_id", UINT16)
        .column("track_id", UINT32);
    let mut data = Vec::with_capacity(tracks.len().saturating_mul(layout.point_step() as usize));
    for t in tracks {
        if finite(&[&t.position, &t.velocity, &[t.age_sec]]) {
            put(&mut data, &t.position);
            put(&mut data, &t.velocity);
            put(&mut data, &[t.age_sec]);
            data.extend_from_slice(&t.motion_id.to_le_bytes());
            data.extend_from_slice(&[0; 2]);
            data.extend_from_slice(&t.id.to_le_bytes());
        }
    }
    unorganised(header, layout, data, tracks.len())
}

/// The topic of changed tiles: each tile is here whole and replaces what was known of it. A tile in which nothing is left
/// is one point of opacity 0 at `corner_of(tile)`. Rows with a number that is not finite are left out and counted.
///
/// # Errors
/// More bytes than a message can hold.
pub fn tile_cloud(
    header: Header,
    tiles: &[(TileIndex, MapCloud)],
    corner_of: impl Fn(&TileIndex) -> [f32; 3],
) -> Result<BuiltCloud, OutputError> {
    let layout = Layout::new()
        .floats(&["x", "y", "z", "rgb"])
        .floats(&GEOMETRY)
        .column("tile_x", INT32)
        .column("tile_y", INT32)
        .column("tile_z", INT32);
    let mut data = Vec::new();
    let mut total = 0;
    for (tile, cloud) in tiles {
        let mut row = |p: &[f32; 3], c: [f32; 3], o: f32, s: &[f32; 3], q: &[f32; 4]| {
            total += 1;
            if finite(&[p, &c, &[o], s, q]) {
                put(&mut data, p);
                put(&mut data, &[pack_rgb(c), o]);
                put(&mut data, s);
                put(&mut data, q);
                tile.iter().for_each(|i| data.extend_from_slice(&i.to_le_bytes()));
            }
        };
        for i in 0..cloud.len() {
            row(&cloud.positions[i], cloud.colors01[i], cloud.opacities[i], &cloud.scales[i], &cloud.quats[i]);
        }
        if cloud.is_empty() {
            row(&corner_of(tile), [0.0; 3], 0.0, &[0.0; 3], &[1.0, 0.0, 0.0, 0.0]);
        }
    }
    unorganised(header, layout, data, total)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tracks_have_their_columns_and_nothing_that_is_not_finite() {
        let good = TrackEnd { position: [1.0; 3], velocity: [2.0; 3], age_sec: 3.0, motion_id: 4, id: 5 };
        let bad = TrackEnd { age_sec: f32::NAN, ..good };
        let built = track_cloud(Header::default(), &[good, bad]).unwrap();
        assert_eq!((built.cloud.width, built.cloud.point_step, built.non_finite), (1, 36, 1));
        assert_eq!(&built.cloud.data[24..], [3.0f32.to_le_bytes().as_slice(), &[4, 0, 0, 0, 5, 0, 0, 0]].concat());
    }

    #[test]
    fn an_empty_tile_is_one_point_that_shows_nothing() {
        let empty = MapCloud::empty(glam::DVec3::ZERO);
        let built = tile_cloud(Header::default(), &[([1, -2, 3], empty)], |_| [7.0; 3]).unwrap();
        assert_eq!((built.cloud.width, built.cloud.point_step, built.non_finite), (1, 60, 0));
        assert_eq!(&built.cloud.data[..4], 7.0f32.to_le_bytes());
        assert_eq!(&built.cloud.data[16..20], 0.0f32.to_le_bytes());
        assert_eq!(&built.cloud.data[52..56], (-2i32).to_le_bytes());
    }
}
