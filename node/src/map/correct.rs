//! Late loop closure: tiles move with the poses they were seen from.

use crate::rigid::Rigid;

use super::cell::turned;
use super::tile::Tile;
use super::{MapCounts, MapError, StaticMap};

/// A pose of the past that is now known better.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseCorrection {
    /// Stamp of the window whose anchor it is, nanoseconds.
    pub stamp_ns: i64,
    /// Where the anchor was believed to be.
    pub old_map_from_anchor: Rigid,
    /// Where it is.
    pub new_map_from_anchor: Rigid,
}

/// Moves shorter than this change nothing that can be seen, metres at the tile's far corner.
const STILL_M: f64 = 1e-4;

impl StaticMap {
    /// Moves every tile as the correction nearest in time to the window that changed it last says, those on disk
    /// included. What comes to lie on other tiles' surfaces merges with them. Returns how many tiles moved.
    ///
    /// Corrections that are not finite are ignored; without any, nothing moves.
    ///
    /// # Errors
    /// A tile on disk that cannot be read; nothing has moved then.
    pub fn correct(&mut self, corrections: &[PoseCorrection]) -> Result<usize, MapError> {
        let mut known: Vec<(i64, Rigid)> = corrections
            .iter()
            .filter(|c| c.old_map_from_anchor.is_finite() && c.new_map_from_anchor.is_finite())
            .map(|c| (c.stamp_ns, c.new_map_from_anchor * c.old_map_from_anchor.inverse()))
            .collect();
        known.sort_by_key(|c| c.0);
        if known.is_empty() {
            return Ok(0);
        }
        // All of them must be at hand before anything changes.
        let mut away: Vec<_> = self.away().map(|a| a.0).collect();
        away.sort_unstable();
        let voxel_m = self.config.voxel_m;
        for index in away {
            if let Some(tile) = self.store.as_ref().and_then(|s| s.get(&index, voxel_m)) {
                self.insert_tile(tile?);
            }
        }
        self.revision += 1;
        let mut moved: Vec<(Tile, Rigid)> = Vec::new();
        for at in (0..self.tiles.len()).rev() {
            let turn = nearest(&known, self.tiles[at].stamp_ns);
            let far_corner = self.origin() + self.corner(&self.tiles[at].index.map(|x| x + 1));
            if (turn.apply(far_corner) - far_corner).length() > STILL_M {
                moved.push((self.take_out(at), turn));
            }
        }
        moved.sort_by_key(|(tile, _)| tile.index);
        let mut counts = MapCounts::default();
        for (tile, _) in &moved {
            // Listeners learn that the place is empty now, and so does the disk.
            let mut left = Tile::new(tile.index, voxel_m);
            left.revision = self.revision;
            self.insert_tile(left);
        }
        for (tile, turn) in &moved {
            self.refile(tile, turn, &mut counts);
        }
        self.make_room(&mut counts);
        self.counts.add(&counts);
        Ok(moved.len())
    }

    /// Files a moved tile's cells where they are now.
    fn refile(&mut self, tile: &Tile, new_from_old: &Rigid, counts: &mut MapCounts) {
        let (origin, corner, tile_m) = (self.origin(), self.corner(&tile.index), self.config.tile_m);
        let turn = new_from_old.matrix3().as_mat3();
        for cell in tile.live() {
            let old = origin + corner + cell.position.as_dvec3();
            let place = (new_from_old.apply(old) - origin) / tile_m;
            let index = place.floor();
            let inside = index.abs().max_element() < f64::from(i32::MAX / 2);
            if !inside {
                counts.rejected += 1;
                continue;
            }
            let mut cell = *cell;
            cell.position = ((place - index) * tile_m).as_vec3();
            cell.cov = turned(&cell.cov, &turn);
            let at = self.tile_at(&index.to_array().map(|x| x as i32), counts);
            let to = &mut self.tiles[at];
            to.adopt(cell);
            to.revision = self.revision;
            to.stamp_ns = to.stamp_ns.max(tile.stamp_ns);
        }
    }
}

/// The correction nearest in time; `known` is sorted and not empty.
fn nearest(known: &[(i64, Rigid)], stamp_ns: i64) -> Rigid {
    let after = known.partition_point(|c| c.0 < stamp_ns).min(known.len() - 1);
    let before = after.saturating_sub(1);
    let apart = |i: usize| known[i].0.abs_diff(stamp_ns);
    known[if apart(before) <= apart(after) { before } else { after }].1
}
