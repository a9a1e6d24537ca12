//! The map's changed tiles at intervals of message time, for a replay's results.

use anyhow::Result;

use crate::map::{MapCloud, StaticMap, TileIndex, TileNews};
use crate::output::cloud_live::TILE_POINT_BYTES;

/// Tiles that changed, whole, at a stamp.
pub struct MapUpdate {
    /// Stamp of the newest window in them, nanoseconds.
    pub stamp_ns: i64,
    /// Edge of a tile, metres.
    pub tile_m: f64,
    /// The map's origin, map frame, metres.
    pub origin: glam::DVec3,
    /// The tiles.
    pub tiles: Vec<(TileIndex, MapCloud)>,
}

/// Says when, and which.
pub struct MapUpdates {
    every_ns: i64,
    most: usize,
    last_ns: Option<i64>,
    news: TileNews,
}

impl MapUpdates {
    /// Every `every_sec` (0: never), of at most `max_mb` MiB.
    pub fn new(every_sec: f64, max_mb: f64) -> Self {
        let most = (max_mb * f64::from(1 << 20) / TILE_POINT_BYTES as f64) as usize;
        Self { every_ns: (every_sec * 1e9) as i64, most: most.max(1), last_ns: None, news: TileNews::default() }
    }

    /// What is due after the window at `stamp_ns` went into the map. A stamp that goes back starts the interval anew.
    ///
    /// # Errors
    /// A tile on disk that cannot be read.
    pub fn offer(&mut self, map: &StaticMap, stamp_ns: i64) -> Result<Option<MapUpdate>> {
        let waits = |last: i64| (0..self.every_ns).contains(&stamp_ns.saturating_sub(last));
        if self.every_ns == 0 || self.last_ns.is_some_and(waits) {
            return Ok(None);
        }
        self.last_ns = Some(stamp_ns);
        self.next(map, stamp_ns)
    }

    /// What has not been told yet, message after message until there is none: for the end of a run.
    ///
    /// # Errors
    /// As [`MapUpdates::offer`].
    pub fn rest(&mut self, map: &StaticMap) -> Result<Option<MapUpdate>> {
        match self.last_ns {
            Some(stamp_ns) => self.next(map, stamp_ns),
            None => Ok(None),
        }
    }

    fn next(&mut self, map: &StaticMap, stamp_ns: i64) -> Result<Option<MapUpdate>> {
        let tiles = self.news.take(map, self.most)?;
        let update = MapUpdate { stamp_ns, tile_m: map.config().tile_m, origin: map.origin(), tiles };
        Ok((!update.tiles.is_empty()).then_some(update))
    }
}
