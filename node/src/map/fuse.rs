//! One window into the map.
//!
//! Gaussians are placed by many threads, handed to their tiles in order, and fused tile by tile: a tile is one thread's
//! business and fits its cache, and its samples come in the window's order whatever the number of threads.

use glam::DVec3;
use rayon::prelude::*;
use storm_render::Gaussians;

use crate::rigid::Rigid;

use super::free_space::Carver;
use super::place::{Eye, PlacedChunk, Placement};
use super::tile::{Tile, TileCounts, TileIndex};
use super::{DepthView, MapCounts, StaticMap};

/// Which samples belong to which tile: all of them in one list, tile by tile, in the window's order within each.
///
/// A list of its own for every tile would remember the most any tile ever had at its place in memory, and tiles change
/// places: on long drives that grew without end.
#[derive(Debug, Default)]
pub(super) struct Jobs {
    /// Tile of every sample, in order.
    tile_of: Vec<u32>,
    /// First of every tile's in `samples`, and the end.
    starts: Vec<u32>,
    /// Chunk, and number in it.
    samples: Vec<(u32, u32)>,
}

impl Jobs {
    fn sort(&mut self, placed: &[PlacedChunk], tiles: usize) {
        self.starts.clear();
        self.starts.resize(tiles + 1, 0);
        self.tile_of.iter().for_each(|&t| self.starts[t as usize + 1] += 1);
        for t in 0..tiles {
            self.starts[t + 1] += self.starts[t];
        }
        self.samples.clear();
        self.samples.resize(self.tile_of.len(), (0, 0));
        let chunks = placed.iter().enumerate();
        let names = chunks.flat_map(|(c, chunk)| (0..chunk.samples.len()).map(move |s| (c as u32, s as u32)));
        for (&t, name) in self.tile_of.iter().zip(names) {
            let next = &mut self.starts[t as usize];
            self.samples[*next as usize] = name;
            *next += 1;
        }
        // Every start has become its tile's end: one to the right.
        self.starts.copy_within(..tiles, 1);
        self.starts[0] = 0;
    }

    /// A tile's samples.
    fn of(&self, tile: usize) -> &[(u32, u32)] {
        let at = |i: usize| self.starts.get(i).map_or(self.samples.len(), |&s| s as usize);
        &self.samples[at(tile)..at(tile + 1)]
    }

    pub fn bytes(&self) -> usize {
        (self.tile_of.capacity() + self.starts.capacity()) * size_of::<u32>()
            + self.samples.capacity() * size_of::<(u32, u32)>()
    }
}

/// One window as it is offered to the map.
#[derive(Debug, Clone, Copy)]
pub struct MapWindow<'a> {
    /// Its newest stamp, nanoseconds.
    pub stamp_ns: i64,
    /// Its anchor in the map.
    pub map_from_anchor: &'a Rigid,
    /// Its Gaussians, in the anchor frame.
    pub gaussians: &'a Gaussians,
    /// Where each picture was taken from; picture `k` gave Gaussians `k * pixels..(k + 1) * pixels`. Empty: not known;
    /// then the finest voxels are used and there is no depth gate.
    pub eyes: &'a [Eye],
    /// Gaussians per picture.
    pub pixels: usize,
    /// Gaussians before this one were offered by an earlier window: they refine what is there and start nothing new.
    pub first_new: usize,
    /// What the newest pictures see; rays that pass through the map's surfaces take their support away.
    pub views: &'a [DepthView],
}

impl StaticMap {
    /// Merges one window.
    ///
    /// `select(i)` gives Gaussian `i`'s confidence, or none to leave it out (see [`super::static_weight`]); `color(i)`
    /// its colour, 0 to 1, already corrected for its camera's exposure (see [`super::color01`]). What is not finite is
    /// left out and counted.
    pub fn fuse(
        &mut self,
        window: &MapWindow,
        select: impl Fn(usize) -> Option<f32> + Sync,
        color: impl Fn(usize) -> [f32; 3] + Sync,
    ) -> MapCounts {
        let mut counts = MapCounts::default();
        let g = window.gaussians;
        let n = g.len();
        let whole = g.quats.len() == n && g.scales.len() == n && g.opacities.len() == n;
        if !(whole && window.map_from_anchor.is_finite()) {
            counts.rejected = n as u64;
            self.counts.add(&counts);
            return counts;
        }
        let origin = *self.origin.get_or_insert(window.map_from_anchor.translation);
        if self.revision == 0 {
            self.first_stamp_ns = window.stamp_ns;
        }
        self.revision += 1;
        let sizes = (self.config.tile_m, self.config.voxel_m, self.config.depth_gate);
        let placed = Placement::new(origin, window.map_from_anchor, sizes, g, (window.eyes, window.pixels)).all(
            window.first_new,
            &select,
            &color,
        );
        for chunk in &placed {
            counts.skipped += chunk.skipped;
            counts.rejected += chunk.rejected;
        }
        self.hand_out(&placed, &mut counts);
        let carvers: Vec<Carver> = match self.config.free_space {
            true => window.views.iter().filter_map(Carver::new).collect(),
            false => Vec::new(),
        };
        self.fuse_tiles(&placed, &carvers, window.stamp_ns, &mut counts);
        self.here = window.map_from_anchor.translation - origin;
        self.make_room(&mut counts);
        self.counts.add(&counts);
        counts
    }

    /// Fills `jobs`. Tiles on disk come back, new ones are made.
    fn hand_out(&mut self, placed: &[PlacedChunk], counts: &mut MapCounts) {
        let mut tile_of = std::mem::take(&mut self.jobs.tile_of);
        tile_of.clear();
        // Neighbouring pixels mostly share a tile.
        let mut last: Option<(TileIndex, usize)> = None;
        for (index, _) in placed.iter().flat_map(|chunk| &chunk.samples) {
            let at = match last {
                Some((known, at)) if known == *index => at,
                _ => self.tile_at(index, counts),
            };
            last = Some((*index, at));
            tile_of.push(at as u32);
        }
        self.jobs.tile_of = tile_of;
        self.jobs.sort(placed, self.tiles.len());
    }

    /// Number of the tile in memory, made or brought back if it is not there.
    pub(super) fn tile_at(&mut self, index: &TileIndex, counts: &mut MapCounts) -> usize {
        if let Some(&at) = self.by_index.get(index) {
            return at as usize;
        }
        let voxel_m = self.config.voxel_m;
        let tile = match self.store.as_ref().and_then(|s| s.get(index, voxel_m)) {
            Some(Ok(tile)) => {
                counts.returned += 1;
                tile
            }
            Some(Err(e)) => {
                tracing::warn!("{e}");
                counts.tiles_lost += 1;
                if let Some(store) = &mut self.store {
                    store.discard(index);
                }
                Tile::new(*index, voxel_m)
            }
            None => Tile::new(*index, voxel_m),
        };
        self.insert_tile(tile)
    }

    pub(super) fn insert_tile(&mut self, tile: Tile) -> usize {
        let at = self.tiles.len();
        self.by_index.insert(tile.index, at as u32);
        self.tiles.push(tile);
        at
    }

    fn fuse_tiles(&mut self, placed: &[PlacedChunk], carvers: &[Carver], stamp_ns: i64, counts: &mut MapCounts) {
        let now_ms = (stamp_ns.saturating_sub(self.first_stamp_ns) / 1_000_000).clamp(0, i64::from(u32::MAX)) as u32;
        let (origin, tile_m, reach_m) = (self.origin(), self.config.tile_m, self.config.max_depth_m);
        let revision = self.revision;
        let fuse = |(tile, job): (&mut Tile, &[(u32, u32)])| {
            let mut counts = TileCounts::default();
            for &(c, s) in job {
                tile.add(&placed[c as usize].samples[s as usize].1, now_ms, &mut counts);
            }
            let corner = origin + DVec3::from(tile.index.map(f64::from)) * tile_m;
            for view in carvers.iter().filter_map(|c| c.for_tile(corner, tile_m, reach_m)) {
                tile.contradict(&mut counts, |cell| cell.seen_ms != now_ms && view.passes_through(cell));
            }
            if !job.is_empty() || counts.carved > 0 {
                (tile.revision, tile.stamp_ns) = (revision, stamp_ns);
            }
            tile.tidy();
            counts
        };
        let jobs = &self.jobs;
        let all: Vec<TileCounts> =
            self.tiles.par_iter_mut().enumerate().with_max_len(8).map(|(at, tile)| fuse((tile, jobs.of(at)))).collect();
        for c in all {
            counts.merged += c.merged;
            counts.created += c.created;
            counts.refined += c.refined;
            counts.joined += c.joined;
            counts.carved += c.carved;
            counts.skipped += c.alone;
            counts.rejected += c.no_room;
        }
    }
}
