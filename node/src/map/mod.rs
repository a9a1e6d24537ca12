//! The long-horizon map: what stands still, in tiles.
//!
//! A tile is a cube with f64 corners in the map frame that holds the Gaussians in it in f32: one per occupied voxel, by
//! confidence-weighted moment matching of all that was seen there. Voxels are as fine as the nearest look was: what is
//! seen from close up replaces what was seen from afar. A surface that later rays pass clearly through goes; what
//! nobody looks at stays as it is. When memory is full, far tiles go to disk and come back with the vehicle.

mod cell;
mod cloud;
mod correct;
mod eigen;
mod error;
mod format;
mod free_space;
mod fuse;
mod gather;
mod hash;
mod model;
mod news;
mod place;
mod room;
mod select;
mod store;
mod tile;
mod voxel;

use std::collections::HashMap;
use std::path::Path;

use glam::DVec3;
use serde::Serialize;

use crate::config::MapConfig;
pub use cloud::MapCloud;
pub use correct::PoseCorrection;
pub use error::MapError;
use format::MapIndex;
pub use free_space::DepthView;
use fuse::Jobs;
pub use fuse::MapWindow;
pub use gather::SceneLook;
use hash::VoxelHash;
pub use model::{ObjectModel, ObjectSample};
pub use news::TileNews;
pub use place::Eye;
pub use select::{color01, confidence, static_weight};
use store::Store;
use tile::Tile;
pub use tile::TileIndex;
pub use voxel::MAX_PER_EDGE;

/// What became of the Gaussians.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct MapCounts {
    /// Merged into a surface that was there.
    pub merged: u64,
    /// First of their voxel.
    pub created: u64,
    /// Not selected by the caller.
    pub skipped: u64,
    /// Refused: a number not finite or out of range, or a tile that is full.
    pub rejected: u64,
    /// Coarse voxels given up for finer ones.
    pub refined: u64,
    /// Voxels that joined another of the same surface.
    pub joined: u64,
    /// Voxels gone because later rays passed through them.
    pub carved: u64,
    /// Voxels given up because the map was full, the least confident first.
    pub evicted: u64,
    /// Tiles put to disk to make room.
    pub spilled: u64,
    /// Tiles brought back from disk.
    pub returned: u64,
    /// Tiles that could not be put to disk; they stayed in memory.
    pub spill_failed: u64,
    /// Tiles on disk that could not be read back; their place starts anew.
    pub tiles_lost: u64,
}

impl MapCounts {
    fn add(&mut self, o: &Self) {
        for (sum, x) in [
            (&mut self.merged, o.merged),
            (&mut self.created, o.created),
            (&mut self.skipped, o.skipped),
            (&mut self.rejected, o.rejected),
            (&mut self.refined, o.refined),
            (&mut self.joined, o.joined),
            (&mut self.carved, o.carved),
            (&mut self.evicted, o.evicted),
            (&mut self.spilled, o.spilled),
            (&mut self.returned, o.returned),
            (&mut self.spill_failed, o.spill_failed),
            (&mut self.tiles_lost, o.tiles_lost),
        ] {
            *sum += x;
        }
    }
}

/// What is known about a place of the map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StaticEvidence {
    /// Sum of the confidences merged there.
    pub confidence: f32,
    /// Time between the first and the last look, seconds.
    pub seen_for_sec: f32,
}

/// The map. Its content depends on what was fused in which order, and on nothing else: not on threads, and not on
/// which tiles were on disk meanwhile.
#[derive(Debug)]
pub struct StaticMap {
    config: MapConfig,
    origin: Option<DVec3>,
    first_stamp_ns: i64,
    /// Where the vehicle was last, relative to the origin.
    here: DVec3,
    /// Windows fused.
    revision: u64,
    tiles: Vec<Tile>,
    by_index: HashMap<TileIndex, u32, VoxelHash>,
    /// Which samples of the window being fused belong to which tile; kept for its memory.
    jobs: Jobs,
    store: Option<Store>,
    /// Putting tiles to disk is not tried again before this revision.
    retry_spill_at: u64,
    counts: MapCounts,
}

impl StaticMap {
    /// An empty map that lives in memory alone: when it is full, the least confident Gaussians go.
    pub fn new(config: &MapConfig) -> Self {
        Self {
            config: config.clone(),
            origin: None,
            first_stamp_ns: 0,
            here: DVec3::ZERO,
            revision: 0,
            tiles: Vec::new(),
            by_index: HashMap::default(),
            jobs: Jobs::default(),
            store: None,
            retry_spill_at: 0,
            counts: MapCounts::default(),
        }
    }

    /// An empty map that may put tiles into the folder `dir`, and can be saved there. A map that was saved there goes.
    ///
    /// # Errors
    /// A folder that cannot be made or emptied.
    pub fn in_folder(config: &MapConfig, dir: &Path) -> Result<Self, MapError> {
        let mut store = Store::create(dir)?;
        store.set_sync(config.sync);
        Ok(Self { store: Some(store), ..Self::new(config) })
    }

    /// A map saved in `dir`, ready to grow. Its tiles stay on disk until they are needed.
    ///
    /// Second: what could not be read, one error per tile, each naming it; never anything unless `salvage` is set.
    ///
    /// # Errors
    /// No index, a damaged index, other tile or voxel sizes than `config` asks for, and without `salvage` any damaged
    /// tile.
    pub fn load(config: &MapConfig, dir: &Path, salvage: bool) -> Result<(Self, Vec<MapError>), MapError> {
        let (mut store, index, problems) = Store::open(dir, salvage)?;
        store.set_sync(config.sync);
        for (name, saved, wanted) in
            [("map.tile_m", index.tile_m, config.tile_m), ("map.voxel_m", index.voxel_m, config.voxel_m)]
        {
            if saved != wanted {
                return Err(MapError::OtherSizes { path: dir.to_owned(), name, saved, wanted });
            }
        }
        let mut map = Self::new(config);
        (map.origin, map.revision) = (Some(index.origin), index.revision);
        map.first_stamp_ns = index.first_stamp_ns;
        map.counts.tiles_lost = problems.len() as u64;
        map.store = Some(store);
        Ok((map, problems))
    }

    /// A map saved in `dir`, with the tile and voxel sizes it was made with and otherwise the defaults.
    ///
    /// # Errors
    /// As [`StaticMap::load`].
    pub fn open(dir: &Path, salvage: bool) -> Result<(Self, Vec<MapError>), MapError> {
        let (tile_m, voxel_m) = store::sizes(dir)?;
        Self::load(&MapConfig { tile_m, voxel_m, max_written: 0, ..MapConfig::default() }, dir, salvage)
    }

    /// True when a map is saved in the folder.
    pub fn is_saved_in(dir: &Path) -> bool {
        store::is_saved_in(dir)
    }

    /// A copy of the map saved in `from`, kept in `dir` from now on; `from` is not changed.
    ///
    /// # Errors
    /// As [`StaticMap::load`], and what cannot be copied.
    pub fn copied(config: &MapConfig, from: &Path, dir: &Path) -> Result<Self, MapError> {
        // The index last, as ever.
        drop(Store::create(dir)?);
        store::copy(from, dir)?;
        Ok(Self::load(config, dir, false)?.0)
    }

    /// A map of finished Gaussians in the folder `dir`, each in the finest voxel around its centre: what a later drive sees
    /// of the place refines nothing finer. Gaussians that share a voxel are merged; what is not finite is left out and
    /// counted (`rejected`). A map that was saved there goes.
    ///
    /// # Errors
    /// As [`StaticMap::in_folder`].
    pub fn of_cloud(config: &MapConfig, dir: &Path, cloud: &MapCloud) -> Result<Self, MapError> {
        let mut map = Self::in_folder(config, dir)?;
        map.set_origin(cloud.origin);
        map.revision = 1;
        let mut counts = MapCounts::default();
        for i in 0..cloud.len() {
            let Some((index, cell)) = cloud.cell(i, config.tile_m, config.voxel_m) else {
                counts.rejected += 1;
                continue;
            };
            let at = map.tile_at(&index, &mut counts);
            let tile = &mut map.tiles[at];
            tile.adopt(cell);
            tile.revision = map.revision;
        }
        counts.created = map.loaded() as u64;
        map.counts.add(&counts);
        Ok(map)
    }

    /// Writes what has changed since the last save, then an index of everything: a process that dies at any moment
    /// leaves the last complete save.
    ///
    /// # Errors
    /// A map without a folder, or a file that cannot be written; the last save stays whole.
    pub fn save(&mut self) -> Result<(), MapError> {
        let index = MapIndex {
            tile_m: self.config.tile_m,
            voxel_m: self.config.voxel_m,
            origin: self.origin(),
            revision: self.revision,
            first_stamp_ns: self.first_stamp_ns,
            entries: Vec::new(),
        };
        let Some(store) = &mut self.store else {
            return Err(MapError::Damaged { path: "map".into(), reason: "this map was made without a folder".into() });
        };
        for tile in &self.tiles {
            if tile.len() == 0 {
                store.discard(&tile.index);
            } else if !store.is_current(tile) {
                // A copy without its dead cells: when somebody saves must change nothing in the map, and where dead cells
                // are taken out new ones are filed a little differently.
                let mut copy = tile.clone();
                copy.sweep();
                store.put(&copy)?;
            }
        }
        store.commit(index)
    }

    /// Places the origin (map frame, metres) before the first window; false, and nothing done, after it.
    pub fn set_origin(&mut self, origin: DVec3) -> bool {
        let free = self.origin.is_none() && origin.is_finite();
        if free {
            self.origin = Some(origin);
        }
        free
    }

    /// What positions of [`StaticMap::cloud`] are relative to, in the map frame, metres; zero before the first window.
    pub fn origin(&self) -> DVec3 {
        self.origin.unwrap_or(DVec3::ZERO)
    }

    /// Folder of the map's files, if it has one.
    pub fn folder(&self) -> Option<&Path> {
        self.store.as_ref().map(Store::dir)
    }

    /// Gaussians in the map, those on disk included.
    pub fn len(&self) -> usize {
        self.loaded() + self.away().map(|(_, _, cells)| cells as usize).sum::<usize>()
    }

    /// The configuration.
    pub fn config(&self) -> &MapConfig {
        &self.config
    }

    /// Tiles, those on disk included.
    pub fn tile_count(&self) -> usize {
        self.tiles.len() + self.away().count()
    }

    /// Gaussians in memory.
    pub fn loaded(&self) -> usize {
        self.tiles.iter().map(Tile::len).sum()
    }

    /// True when there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Memory held, bytes.
    pub fn bytes(&self) -> usize {
        self.tiles.iter().map(Tile::bytes).sum()
    }

    /// Memory held beside the tiles: their index, and what fusing a window needs, bytes.
    pub fn side_bytes(&self) -> usize {
        let index = self.by_index.capacity() * (size_of::<(TileIndex, u32)>() + 1);
        index + self.jobs.bytes() + self.store.as_ref().map_or(0, Store::memory_bytes)
    }

    /// Space taken on disk by the newest version of every saved tile, bytes.
    pub fn disk_bytes(&self) -> u64 {
        self.store.as_ref().map_or(0, Store::bytes)
    }

    /// What became of everything so far.
    pub fn counts(&self) -> MapCounts {
        self.counts
    }

    /// Number of windows fused; what changes from now on has a greater one.
    pub fn revision(&self) -> u64 {
        self.revision
    }

    /// What the map knows of a place (map frame, metres); none where it has nothing, or nothing in memory.
    pub fn evidence(&self, position_map: DVec3) -> Option<StaticEvidence> {
        let place = (position_map - self.origin?) / self.config.tile_m;
        let index = place.floor();
        let tile = self.by_index.get(&index.to_array().map(|x| x as i32))?;
        let local = ((place - index) * self.config.tile_m).as_vec3();
        let cell = self.tiles.get(*tile as usize)?.around(local)?;
        let seen_for_sec = cell.seen_ms.saturating_sub(cell.born_ms) as f32 * 1e-3;
        Some(StaticEvidence { confidence: cell.weight, seen_for_sec })
    }

    /// Calls for every tile that holds something, by index; its corner is relative to the origin.
    fn each_tile(&self, mut visit: impl FnMut(DVec3, &Tile)) -> Result<(), MapError> {
        let mut all: Vec<TileIndex> = self.tiles.iter().map(|t| t.index).chain(self.away().map(|a| a.0)).collect();
        all.sort_unstable();
        all.iter().try_for_each(|index| self.with_tile(index, &mut visit))
    }

    fn with_tile(&self, index: &TileIndex, visit: impl FnOnce(DVec3, &Tile)) -> Result<(), MapError> {
        let corner = self.corner(index);
        if let Some(tile) = self.by_index.get(index).and_then(|&i| self.tiles.get(i as usize)) {
            visit(corner, tile);
        } else if let Some(tile) = self.store.as_ref().and_then(|s| s.get(index, self.config.voxel_m)) {
            visit(corner, &tile?);
        }
        Ok(())
    }

    /// A tile's corner relative to the origin, metres.
    fn corner(&self, index: &TileIndex) -> DVec3 {
        DVec3::from(index.map(f64::from)) * self.config.tile_m
    }

    /// Tiles that are on disk and not in memory, in no order.
    fn away(&self) -> impl Iterator<Item = (TileIndex, u64, u32)> + '_ {
        self.store.iter().flat_map(Store::tiles).filter(|(index, ..)| !self.by_index.contains_key(index))
    }
}

#[cfg(test)]
mod tests;
