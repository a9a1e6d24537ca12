//! Tiles on disk: where far ones go when memory is full, and what a saved map is.
//!
//! Every tile version is a file of its own, written whole under a temporary name first; the index file names the
//! versions that belong together and is replaced last. So whenever the process dies, the last index is complete; files
//! it names are only removed once a newer index is in place.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use crate::output::atomic::{sync_files, write_bytes, write_bytes_synced};

use super::error::MapError;
use super::format::{IndexEntry, MapIndex, decode_index, decode_tile, encode_index, encode_tile};
use super::hash::VoxelHash;
use super::tile::{Tile, TileIndex};

/// Name of the index file.
const INDEX_FILE: &str = "map.index";
/// Ending of the tiles' files.
const TILE_ENDING: &str = "tile";

/// The newest saved version of a tile.
///
/// There is one of them for every tile ever seen, so they are small.
#[derive(Debug, Clone, Copy)]
struct Saved {
    revision: u64,
    cells: u32,
    crc: u32,
    /// Of its file.
    bytes: u32,
    /// The index file on disk names this version.
    listed: bool,
}

impl Saved {
    fn entry(&self, index: TileIndex) -> IndexEntry {
        IndexEntry { index, revision: self.revision, cells: self.cells, crc: self.crc }
    }
}

/// A folder of tiles.
#[derive(Debug)]
pub(super) struct Store {
    dir: PathBuf,
    saved: HashMap<TileIndex, Saved, VoxelHash>,
    /// Files that go once a newer index is in place.
    stale: Vec<PathBuf>,
    /// Whether to wait for the disk before an index names them.
    sync: bool,
    bytes: u64,
}

impl Store {
    /// An empty folder of tiles; what an earlier run left in it goes.
    pub fn create(dir: &Path) -> Result<Self, MapError> {
        std::fs::create_dir_all(dir).map_err(MapError::io(dir))?;
        let index = dir.join(INDEX_FILE);
        if index.exists() {
            std::fs::remove_file(&index).map_err(MapError::io(&index))?;
        }
        for entry in std::fs::read_dir(dir).map_err(MapError::io(dir))? {
            let path = entry.map_err(MapError::io(dir))?.path();
            if path.extension().is_some_and(|e| e == TILE_ENDING) {
                std::fs::remove_file(&path).map_err(MapError::io(&path))?;
            }
        }
        Ok(Self::empty(dir))
    }

    fn empty(dir: &Path) -> Self {
        Self { dir: dir.to_owned(), saved: HashMap::default(), stale: Vec::new(), sync: false, bytes: 0 }
    }

    /// A saved map. Every tile is read once; damaged ones are an error, or left out and named when `salvage` is set.
    pub fn open(dir: &Path, salvage: bool) -> Result<(Self, MapIndex, Vec<MapError>), MapError> {
        let index = decode_index(&dir.join(INDEX_FILE))?;
        let (mut store, mut problems) = (Self::empty(dir), Vec::new());
        for entry in &index.entries {
            let path = store.path(entry);
            match decode_tile(&path, entry, index.voxel_m) {
                Ok(_) => {
                    let size = std::fs::metadata(&path).map_or(0, |m| m.len());
                    store.insert(entry, size, true);
                }
                Err(e) if salvage => problems.push(e),
                Err(e) => return Err(e),
            }
        }
        Ok((store, index, problems))
    }

    fn insert(&mut self, entry: &IndexEntry, size: u64, listed: bool) {
        // No tile's file is that large (`MAX_CELLS`).
        let bytes = u32::try_from(size).unwrap_or(u32::MAX);
        self.bytes += u64::from(bytes);
        let saved = Saved { revision: entry.revision, cells: entry.cells, crc: entry.crc, bytes, listed };
        self.saved.insert(entry.index, saved);
    }

    /// Whether every index waits until its tiles and itself are on the disk.
    pub fn set_sync(&mut self, sync: bool) {
        self.sync = sync;
    }

    pub fn dir(&self) -> &Path {
        &self.dir
    }

    fn path(&self, e: &IndexEntry) -> PathBuf {
        let [x, y, z] = e.index;
        self.dir.join(format!("{x}_{y}_{z}.{}.{TILE_ENDING}", e.revision))
    }

    /// Bytes of the newest versions of all tiles.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Memory held, bytes.
    pub fn memory_bytes(&self) -> usize {
        self.saved.capacity() * (size_of::<(TileIndex, Saved)>() + 1) + self.stale.capacity() * size_of::<PathBuf>()
    }

    pub fn has(&self, index: &TileIndex) -> bool {
        self.saved.contains_key(index)
    }

    /// Tiles saved, with their cells, in no order.
    pub fn tiles(&self) -> impl Iterator<Item = (TileIndex, u64, u32)> + '_ {
        self.saved.iter().map(|(index, s)| (*index, s.revision, s.cells))
    }

    /// Whether this version of a tile is there.
    pub fn is_current(&self, tile: &Tile) -> bool {
        self.saved.get(&tile.index).is_some_and(|s| s.revision == tile.revision)
    }

    /// Writes a tile unless this version is there already. On error nothing has changed.
    pub fn put(&mut self, tile: &Tile) -> Result<(), MapError> {
        if self.is_current(tile) {
            return Ok(());
        }
        let (bytes, crc) = encode_tile(tile).map_err(MapError::io(&self.dir))?;
        let cells = tile.cells.len() as u32;
        let entry = IndexEntry { index: tile.index, revision: tile.revision, cells, crc };
        let path = self.path(&entry);
        write_bytes(&path, &bytes)?;
        self.discard(&tile.index);
        self.insert(&entry, bytes.len() as u64, false);
        Ok(())
    }

    /// Forgets a tile; its file goes now, or with the next index if the present one names it.
    pub fn discard(&mut self, index: &TileIndex) {
        let Some(old) = self.saved.remove(index) else { return };
        self.bytes -= u64::from(old.bytes);
        let path = self.path(&old.entry(*index));
        if old.listed {
            self.stale.push(path);
        } else {
            // A file that stays behind is only a little space.
            let _ = std::fs::remove_file(path);
        }
    }

    /// Reads a tile back; none when there is none.
    pub fn get(&self, index: &TileIndex, voxel_m: f64) -> Option<Result<Tile, MapError>> {
        let saved = self.saved.get(index)?;
        let entry = saved.entry(*index);
        Some(decode_tile(&self.path(&entry), &entry, voxel_m))
    }

    /// Puts an index of all saved tiles in place of the last one, then removes what nobody names any more.
    pub fn commit(&mut self, mut index: MapIndex) -> Result<(), MapError> {
        index.entries = self.saved.iter().map(|(at, s)| s.entry(*at)).collect();
        index.entries.sort_unstable_by_key(|e| e.index);
        let (path, bytes) = (self.dir.join(INDEX_FILE), encode_index(&index));
        if self.sync {
            // First the tiles that no index names yet, and may not be on the disk itself, then the index that names them.
            let new = self.saved.iter().filter(|(_, s)| !s.listed).map(|(at, s)| self.path(&s.entry(*at)));
            sync_files(&self.dir, new)?;
            write_bytes_synced(&path, &bytes)?;
        } else {
            write_bytes(&path, &bytes)?;
        }
        self.saved.values_mut().for_each(|s| s.listed = true);
        for path in self.stale.drain(..) {
            let _ = std::fs::remove_file(path);
        }
        Ok(())
    }
}

/// True when there is an index.
pub(super) fn is_saved_in(dir: &Path) -> bool {
    dir.join(INDEX_FILE).is_file()
}

/// Tile and voxel size of a saved map, metres.
pub(super) fn sizes(dir: &Path) -> Result<(f64, f64), MapError> {
    let index = decode_index(&dir.join(INDEX_FILE))?;
    Ok((index.tile_m, index.voxel_m))
}

/// Copies the files of a saved map, the index last.
pub(super) fn copy(from: &Path, to: &Path) -> Result<(), MapError> {
    let index = decode_index(&from.join(INDEX_FILE))?;
    let (source, target) = (Store::empty(from), Store::empty(to));
    for entry in &index.entries {
        let path = source.path(entry);
        std::fs::copy(&path, target.path(entry)).map_err(MapError::io(&path))?;
    }
    let path = from.join(INDEX_FILE);
    std::fs::copy(&path, to.join(INDEX_FILE)).map_err(MapError::io(&path))?;
    Ok(())
}
