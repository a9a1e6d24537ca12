//! Staying within the caps: far tiles go to disk, and when that is not allowed or does not work, the least confident
//! Gaussians go.

use std::collections::HashSet;

use glam::DVec3;
use storm_model::ops::give_back_freed_memory;

use super::format::is_sound;
use super::fuse::Jobs;
use super::tile::Tile;
use super::{MapCounts, StaticMap};

/// Part of a full map that is evicted at once: few enough to be a small loss, enough that finding them is paid for by
/// many insertions.
const EVICTED_PART: usize = 64;

/// A full map is spilled down to this part of its caps, so that not every window spills.
const SPILLED_TO: f64 = 0.875;

/// Windows between two attempts at a disk that refused.
const RETRY_WINDOWS: u64 = 50;

/// Windows between two times that a map that has been at its caps gives freed memory back. Tiles of all sizes come and go among
/// what stays, and glibc keeps what they leave unless it is told: over a drive that spills, resident memory would go on growing
/// though nothing more is in use.
const GIVE_BACK_WINDOWS: u64 = 100;

impl StaticMap {
    /// Brings the map within its caps.
    pub(super) fn make_room(&mut self, counts: &mut MapCounts) {
        let (gaussians, bytes) = (self.loaded(), self.bytes());
        let (most, most_bytes) = (self.config.max_gaussians, self.config.max_mb.saturating_mul(1 << 20));
        if gaussians <= most && bytes <= most_bytes {
            let full_before = self.counts.spilled + self.counts.evicted > 0;
            if full_before && self.revision.is_multiple_of(GIVE_BACK_WINDOWS) {
                give_back_freed_memory();
            }
            return;
        }
        if self.config.spill && self.store.is_some() && self.revision >= self.retry_spill_at {
            let part = |cap: usize| (cap as f64 * SPILLED_TO) as usize;
            let before = counts.spilled;
            self.spill(gaussians.saturating_sub(part(most)), bytes.saturating_sub(part(most_bytes)), counts);
            if counts.spilled > before {
                give_back_freed_memory();
            }
        }
        // Tiles shrink only once a good part of them is gone: a few rounds may be needed to free bytes.
        while self.loaded() > most || (self.bytes() > most_bytes && self.loaded() > 0) {
            counts.evicted += self.evict();
        }
    }

    /// Puts the farthest tiles to disk until so many Gaussians and bytes are gone; tiles the cameras reach stay.
    fn spill(&mut self, mut gaussians: usize, mut bytes: usize, counts: &mut MapCounts) {
        let (tile_m, here) = (self.config.tile_m, self.here);
        let distance = |t: &Tile| (DVec3::from(t.index.map(f64::from)) + 0.5) * tile_m - here;
        let mut far: Vec<(f64, [i32; 3])> = self
            .tiles
            .iter()
            .map(|t| (distance(t).length(), t.index))
            .filter(|(d, _)| *d > self.config.max_depth_m + tile_m)
            .collect();
        far.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        for (_, index) in far {
            if gaussians == 0 && bytes == 0 {
                break;
            }
            let Some(&at) = self.by_index.get(&index) else { continue };
            let Some(store) = &mut self.store else { return };
            let tile = &mut self.tiles[at as usize];
            tile.sweep();
            let full = store.bytes() >= (self.config.max_disk_mb as u64) << 20;
            if tile.cells.is_empty() {
                store.discard(&index);
            } else if full && !store.has(&index) {
                return;
            } else if let Err(e) = store.put(tile) {
                tracing::warn!("a tile of the map stays in memory: {e}");
                counts.spill_failed += 1;
                self.retry_spill_at = self.revision + RETRY_WINDOWS;
                return;
            } else {
                counts.spilled += 1;
            }
            gaussians = gaussians.saturating_sub(tile.len());
            bytes = bytes.saturating_sub(tile.bytes());
            self.take_out(at as usize);
        }
    }

    /// Makes the map whole again after a call that broke off in the middle (a panic that was caught): tables are built anew
    /// from the cells, cells whose numbers are not whole go, and a tile whose cells contradict each other goes back to its
    /// last saved version, or is lost and counted.
    pub fn recover(&mut self) {
        self.jobs = Jobs::default();
        self.by_index.clear();
        for mut old in std::mem::take(&mut self.tiles) {
            let mut keys = HashSet::new();
            old.cells.retain(|c| is_sound(c) && keys.insert(c.key));
            let mut tile = Tile::with_cells(old.index, self.config.voxel_m, old.cells);
            (tile.revision, tile.stamp_ns) = (self.revision, old.stamp_ns);
            if tile.is_consistent() && !self.by_index.contains_key(&tile.index) {
                self.insert_tile(tile);
            } else {
                self.counts.tiles_lost += 1;
            }
        }
    }

    /// Takes a tile out of memory.
    pub(super) fn take_out(&mut self, at: usize) -> Tile {
        let tile = self.tiles.swap_remove(at);
        self.by_index.remove(&tile.index);
        if let Some(moved) = self.tiles.get(at) {
            self.by_index.insert(moved.index, at as u32);
        }
        tile
    }

    /// Gives up the least confident Gaussians in memory; of equals, the ones first in the list. Returns how many.
    fn evict(&mut self) -> u64 {
        let n = (self.loaded() / EVICTED_PART).max(1);
        // Positive floats order as their bits do, so weight and place fit in one number that is quick to compare.
        let mut order: Vec<(u32, u32, u32)> = Vec::with_capacity(self.loaded());
        for (t, tile) in self.tiles.iter().enumerate() {
            let live = tile.cells.iter().enumerate().filter(|(_, c)| c.support > 0.0);
            order.extend(live.map(|(i, c)| (c.weight.to_bits(), t as u32, i as u32)));
        }
        if order.is_empty() {
            return 0;
        }
        let n = n.min(order.len());
        order.select_nth_unstable(n - 1);
        order.truncate(n);
        order.sort_unstable_by_key(|&(_, t, i)| (t, i));
        for cells in order.chunk_by(|a, b| a.1 == b.1) {
            let tile = &mut self.tiles[cells[0].1 as usize];
            tile.give_up(cells.iter().map(|c| c.2 as usize));
            tile.revision = self.revision;
            tile.tidy();
        }
        n as u64
    }
}
