//! Which tiles somebody who follows the map has yet to hear of.

use std::collections::BTreeSet;

use super::{MapCloud, MapError, StaticMap, TileIndex};

/// What was told of a map, and what waits to be told.
#[derive(Debug, Default)]
pub struct TileNews {
    /// Changes up to this revision are told or in `pending`.
    seen: u64,
    pending: BTreeSet<TileIndex>,
    /// Tiles told that hold something.
    known: BTreeSet<TileIndex>,
}

impl TileNews {
    /// Another map took the place of the one so far: all of it is news, and what was told of the old one is gone.
    pub fn forget(&mut self) {
        self.seen = 0;
        self.pending.append(&mut self.known);
    }

    /// Somebody new listens: everything is news.
    pub fn start_over(&mut self) {
        self.seen = 0;
    }

    /// Nobody listens any more.
    pub fn clear(&mut self) {
        self.pending.clear();
        self.known.clear();
    }

    /// Tiles that changed, whole, with at most `most` Gaussians together (one tile is never cut); the others wait. An empty
    /// cloud says that nothing is left in its tile.
    ///
    /// # Errors
    /// A tile on disk that cannot be read.
    pub fn take(&mut self, map: &StaticMap, most: usize) -> Result<Vec<(TileIndex, MapCloud)>, MapError> {
        if map.revision() < self.seen {
            self.forget();
        }
        self.pending.extend(map.changed_tiles(self.seen));
        self.seen = map.revision();
        let (mut tiles, mut rows) = (Vec::new(), 0);
        while let Some(tile) = self.pending.pop_first() {
            let cloud = map.tile_cloud(&tile)?;
            if rows > 0 && rows + cloud.len() > most {
                self.pending.insert(tile);
                break;
            }
            rows += cloud.len().max(1);
            if !cloud.is_empty() {
                self.known.insert(tile);
            }
            tiles.push((tile, cloud));
        }
        Ok(tiles)
    }
}

impl StaticMap {
    /// Tiles that changed after `revision`, by index; all of them for 0. An empty cloud means that nothing is left in
    /// the tile. Tiles on disk are included as they were saved.
    ///
    /// # Errors
    /// A tile on disk that cannot be read.
    pub fn changed_since(&self, revision: u64) -> Result<Vec<(TileIndex, MapCloud)>, MapError> {
        self.changed_tiles(revision).into_iter().map(|index| Ok((index, self.tile_cloud(&index)?))).collect()
    }

    /// Which tiles [`StaticMap::changed_since`] would give.
    pub fn changed_tiles(&self, revision: u64) -> Vec<TileIndex> {
        let here = self.tiles.iter().map(|t| (t.index, t.revision));
        let away = self.away().map(|(index, revision, _)| (index, revision));
        let mut changed: Vec<TileIndex> = here.chain(away).filter(|(_, r)| *r > revision).map(|(i, _)| i).collect();
        changed.sort_unstable();
        changed
    }
}
