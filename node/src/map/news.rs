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
