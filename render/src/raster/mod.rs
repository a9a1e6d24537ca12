//! Splatting: rasterisation of 3D Gaussians on the CPU and its gradients, by the rules of gsplat (see [`Convention`]).
//!
//! The data's way: `scene` (checked input) or `loaded` (kept between pictures) -> `project` (ellipses of eight Gaussians at a time, for all views) ->
//! `tiles` (each chunk lists its splats by tile) -> `sort` (depth order per tile) -> `blend` (front to back) ->
//! [`Picture`]; and back: [`PictureGradient`] -> `unblend` (back to front) -> `unproject` -> [`SplatGradients`], from
//! there to velocities by [`VelocityGradients`]. [`reference`](mod@reference) is the slow, obvious version all of it is tested against.

mod backward;
mod blend;
mod block;
mod error;
mod grid;
mod loaded;
mod motion;
mod project;
pub mod reference;
mod scene;
mod settings;
mod simd;
mod sort;
mod tile;
mod tiles;
mod unblend;
mod unproject;

#[cfg(test)]
mod tests;

pub use backward::{MAX_PAIR_SUMS, PictureGradient, SplatGradients};
pub use error::RasterError;
pub(crate) use loaded::validate_time;
pub use loaded::{Channels, Loaded};
pub use motion::{Motion, VelocityGradients};
pub use scene::{
    MAX_FEATURES, MAX_PICTURE_VALUES, MAX_SIDE, MAX_SPLATS, MAX_VIEWS, Picture, RasterStats, RasterWork, Splats,
};
use settings::ALPHA_FLOOR;
pub use settings::{ALPHA_MIN, Convention, RasterSettings, TILE_RULE, TRANSMITTANCE_STOP};

use crate::camera::View;
use blend::{RowOut, Scratch, blend_tile};
use block::{Block, LANES};
use grid::{Grid, TILE_H, TILE_W};
use loaded::Stored;
use project::{Camera, Footprints, Rules};
use rayon::prelude::*;
use simd::Isa;
use std::sync::atomic::AtomicUsize;
use tile::{FeatureRows, TileEnd, TileInput};
use tiles::{Chunk, ChunkCounts, ChunkInput, Source, fill_chunk};

/// Most entries of all tile lists together (2 GiB of keys).
pub const MAX_PAIRS: usize = 1 << 28;
/// Fewest Gaussians of a chunk, as a power of two: enough work for a task, little enough to stay in the cache.
const MIN_CHUNK_BITS: u32 = 12;
/// Chunks grow with the number of Gaussians so that there are about this many at most.
const MAX_CHUNKS: usize = 256;

/// The rasteriser; owns its buffers, so that a stream of pictures allocates only once.
pub struct CpuRasterizer {
    settings: RasterSettings,
    isa: Isa,
    chunks: Vec<Chunk>,
    /// Per tile, all views; kept after `render` for a backward pass.
    tiles: Vec<TileMemory>,
    /// What the last successful `render` drew.
    rendered: Option<Rendered>,
    /// The Gaussians of `load` and their name while they may be drawn.
    stored: Stored,
    loaded: Option<Loaded>,
    stats: RasterStats,
    work: RasterWork,
}

/// What is kept of a tile.
#[derive(Default)]
struct TileMemory {
    /// Sorted list.
    keys: Vec<u64>,
    end: TileEnd,
    /// Splats that met an unfinished pixel, and the runs of eight pixels shaded for them.
    blended: usize,
    sweeps: usize,
}

/// The request that the kept lists belong to.
struct Rendered {
    views: Vec<View>,
    splats: usize,
    feature_count: usize,
    chunk_bits: u32,
}

/// A Gaussian as one view sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projection {
    /// Centre in the picture, pixels.
    pub mean: [f32; 2],
    /// Inverse of the blurred 2D covariance `[[a, b], [b, c]]`, as `[a, b, c]`, per square pixel.
    pub conic: [f32; 3],
    /// Camera z, metres.
    pub depth: f32,
    /// Half sides of the convention's rectangle, whole pixels; equal for [`Convention::Pinned`].
    pub radius: [f32; 2],
}

impl CpuRasterizer {
    /// A rasteriser with these settings, refused when they mean nothing.
    pub fn new(settings: RasterSettings) -> Result<Self, RasterError> {
        settings.validate()?;
        let isa = Isa::detect();
        Ok(Self {
            settings,
            isa,
            chunks: Vec::new(),
            tiles: Vec::new(),
            rendered: None,
            stored: Stored::default(),
            loaded: None,
            stats: RasterStats::default(),
            work: RasterWork::default(),
        })
    }

    /// The settings in use.
    pub fn settings(&self) -> &RasterSettings {
        &self.settings
    }

    /// Counts of the last successful `render`.
    pub fn stats(&self) -> RasterStats {
        self.stats
    }

    /// What the last successful `render` or `draw` had to do, and what it could leave.
    pub fn work(&self) -> RasterWork {
        self.work
    }

    /// Renders every view; splats with non-finite numbers are skipped and counted, everything returned is finite.
    ///
    /// # Errors
    /// Arrays that do not fit together, cameras that cannot take a picture, or more than [`MAX_PAIRS`] list entries.
    pub fn render(&mut self, splats: &Splats, views: &[View]) -> Result<Vec<Picture>, RasterError> {
        let mut pictures = Vec::new();
        self.render_into(splats, views, &mut pictures)?;
        Ok(pictures)
    }

    /// [`render`](Self::render) into pictures whose memory is reused; on error they are left as they were.
    ///
    /// # Errors
    /// As `render`.
    pub fn render_into(
        &mut self,
        splats: &Splats,
        views: &[View],
        pictures: &mut Vec<Picture>,
    ) -> Result<(), RasterError> {
        splats.validate()?;
        scene::validate_views(views, splats.feature_count)?;
        self.loaded = None;
        let features = FeatureRows::all(splats.features, splats.feature_count);
        let chunk_bits = self.rasterize(Source::Fresh(*splats), features, views, pictures)?;
        let (n, feature_count) = (splats.len(), splats.feature_count);
        self.rendered = Some(Rendered { views: views.to_vec(), splats: n, feature_count, chunk_bits });
        Ok(())
    }

    /// Keeps Gaussians, with how they move when they do, for [`draw`](Self::draw): their 3D covariances are worked out
    /// here, once for all times and views, and so are the bounds that let a view pass over what it cannot see.
    ///
    /// The name is good until the next `load` or `render`.
    ///
    /// # Errors
    /// Arrays that do not fit together.
    pub fn load(&mut self, splats: &Splats, motion: Option<&Motion>) -> Result<Loaded, RasterError> {
        splats.validate()?;
        motion.map_or(Ok(()), |motion| motion.validate(splats.len()))?;
        self.stored.fill(splats, motion);
        let name = Loaded::new();
        self.loaded = Some(name);
        Ok(name)
    }

    /// Renders loaded Gaussians where they are at `time_sec` (paper eq. 1; any time for those that do not move): the very
    /// pictures that [`render`](Self::render) takes of the moved means and the channels named. No backward pass follows.
    ///
    /// # Errors
    /// Gaussians that are not loaded any more, channels they do not have, a time that is not finite, or as `render`.
    pub fn draw(
        &mut self,
        loaded: Loaded,
        time_sec: f32,
        channels: &Channels,
        views: &[View],
    ) -> Result<Vec<Picture>, RasterError> {
        let mut pictures = Vec::new();
        self.draw_into(loaded, time_sec, channels, views, &mut pictures)?;
        Ok(pictures)
    }

    /// [`draw`](Self::draw) into pictures whose memory is reused; on error they are left as they were.
    ///
    /// # Errors
    /// As `draw`.
    pub fn draw_into(
        &mut self,
        loaded: Loaded,
        time_sec: f32,
        channels: &Channels,
        views: &[View],
        pictures: &mut Vec<Picture>,
    ) -> Result<(), RasterError> {
        if self.loaded != Some(loaded) {
            return Err(RasterError::NotLoaded);
        }
        channels.validate(self.stored.feature_count())?;
        validate_time(time_sec)?;
        scene::validate_views(views, channels.0.len())?;
        let stored = std::mem::take(&mut self.stored);
        let done = self.rasterize(Source::Kept(&stored, time_sec), stored.features(channels), views, pictures);
        self.stored = stored;
        done.map(|_| ())
    }

    /// Renders validated views; returns the chunk size.
    fn rasterize(
        &mut self,
        source: Source,
        features: FeatureRows,
        views: &[View],
        pictures: &mut Vec<Picture>,
    ) -> Result<u32, RasterError> {
        self.rendered = None;
        let grid = Grid::new(views.iter().map(|v| (v.intrinsics.width, v.intrinsics.height)));
        let (chunk_bits, stats, mut work) = self.fill_chunks(source, views, &grid)?;
        pictures.resize_with(views.len(), Picture::default);
        for (picture, view) in pictures.iter_mut().zip(views) {
            picture.resize(view.intrinsics.width, view.intrinsics.height, features.count);
        }
        self.blend(features, &grid, chunk_bits, pictures);
        work.blended = self.tiles.iter().map(|tile| tile.blended).sum();
        work.sweeps = self.tiles.iter().map(|tile| tile.sweeps).sum();
        (self.stats, self.work) = (stats, work);
        Ok(chunk_bits)
    }

    /// Where each Gaussian lands in a view: `None` where it is invalid or culled.
    ///
    /// # Errors
    /// Arrays that do not fit together, or a camera that cannot take a picture.
    pub fn project(&self, splats: &Splats, view: &View) -> Result<Vec<Option<Projection>>, RasterError> {
        splats.validate()?;
        scene::validate_views(std::slice::from_ref(view), splats.feature_count)?;
        let rules = Rules::from(&self.settings);
        let camera = Camera::new(view, self.settings.convention);
        let (mut block, mut prints) = (Block::new(), Footprints::new());
        let mut out = vec![None; splats.len()];
        for (index, slots) in out.chunks_mut(LANES).enumerate() {
            block.load(splats, index * LANES, slots.len(), false);
            if !project::project::<{ simd::TARGET_FMA }>(&block.centers, &block.shapes, &camera, &rules, &mut prints) {
                continue;
            }
            for (l, slot) in slots.iter_mut().enumerate() {
                *slot = prints.visible[l].then(|| prints.projection(l));
            }
        }
        Ok(out)
    }

    /// Projects and bins all Gaussians; returns the chunk size and the counts.
    fn fill_chunks(
        &mut self,
        source: Source,
        views: &[View],
        grid: &Grid,
    ) -> Result<(u32, RasterStats, RasterWork), RasterError> {
        let n = source.len();
        let chunk_bits = n.div_ceil(MAX_CHUNKS).next_power_of_two().ilog2().max(MIN_CHUNK_BITS);
        let chunk_len = 1usize << chunk_bits;
        let cameras: Vec<Camera> = views.iter().map(|v| Camera::new(v, self.settings.convention)).collect();
        let pairs = AtomicUsize::new(0);
        let rules = Rules::from(&self.settings);
        let input = ChunkInput { source, cameras: &cameras, rules, grid, pairs: &pairs };
        let isa = self.isa;
        self.chunks.resize_with(n.div_ceil(chunk_len), Chunk::default);
        self.chunks.par_iter_mut().enumerate().for_each(|(index, chunk)| {
            let start = index * chunk_len;
            fill_chunk(isa, &input, start..(start + chunk_len).min(n), start as u32, chunk);
        });
        let pairs = pairs.into_inner();
        if pairs > MAX_PAIRS {
            return Err(RasterError::TooMany { name: "tile list entries", value: pairs, limit: MAX_PAIRS });
        }
        let sum = |count: fn(&ChunkCounts) -> usize| self.chunks.iter().map(|c| count(&c.counts)).sum::<usize>();
        let never = if let Source::Kept(stored, _) = source { stored.invalid() } else { 0 };
        let (invalid, visible) = (never + sum(|c| c.invalid), sum(|c| c.visible));
        let culled = (n - invalid) * views.len() - visible;
        let work = RasterWork {
            shapes: sum(|c| c.shapes),
            unread: sum(|c| c.unread),
            listed: sum(|c| c.listed),
            ..RasterWork::default()
        };
        Ok((chunk_bits, RasterStats { splats: n, invalid, culled, visible, pairs }, work))
    }

    /// Sorts and blends every tile.
    fn blend(&mut self, features: FeatureRows, grid: &Grid, chunk_bits: u32, pictures: &mut [Picture]) {
        self.tiles.resize_with(grid.tile_count(), TileMemory::default);
        let mut jobs: Vec<TileJob> = Vec::with_capacity(grid.tile_count());
        for (view, picture) in pictures.iter_mut().enumerate() {
            push_jobs(view, picture, &mut jobs);
        }
        let (chunks, isa) = (&self.chunks, self.isa);
        let alpha_cap = self.settings.convention.alpha_cap();
        jobs.par_iter_mut().zip(&mut self.tiles).enumerate().for_each_init(
            Scratch::new,
            |scratch, (tile, (job, memory))| {
                let keys = &mut memory.keys;
                keys.clear();
                for chunk in chunks {
                    keys.extend_from_slice(chunk.tile_keys(tile));
                }
                sort::sort_keys(keys, &mut scratch.spare_keys);
                let input = TileInput {
                    x0: job.x0,
                    y0: job.y0,
                    width: job.rows.first().map_or(0, |row| row.alpha.len()),
                    height: job.rows.len(),
                    keys,
                    chunks,
                    chunk_bits,
                    view: job.view,
                    features,
                    alpha_cap,
                };
                blend_tile(isa, &input, scratch);
                scratch.keep(&mut memory.end);
                (memory.blended, memory.sweeps) = (scratch.blended, scratch.sweeps);
                scratch.write(&mut job.rows, features.count);
            },
        );
    }
}

/// A tile of one view and the picture memory it owns.
struct TileJob<'a> {
    view: usize,
    x0: usize,
    y0: usize,
    rows: Vec<RowOut<'a>>,
}

/// Cuts a picture into its tiles, in the order of the grid.
fn push_jobs<'a>(view: usize, picture: &'a mut Picture, jobs: &mut Vec<TileJob<'a>>) {
    let (width, channels) = (picture.width, picture.feature_count);
    let first = jobs.len();
    let columns = width.div_ceil(TILE_W);
    let mut features = picture.features.as_mut_slice();
    let rows = picture.alpha.chunks_exact_mut(width).zip(picture.depth.chunks_exact_mut(width));
    for (y, (mut alpha, mut depth)) in rows.enumerate() {
        for column in 0..columns {
            if y % TILE_H == 0 {
                jobs.push(TileJob { view, x0: column * TILE_W, y0: y, rows: Vec::with_capacity(TILE_H) });
            }
            let pixels = TILE_W.min(alpha.len());
            let (alpha_part, alpha_rest) = alpha.split_at_mut(pixels);
            let (depth_part, depth_rest) = depth.split_at_mut(pixels);
            let (feature_part, feature_rest) = std::mem::take(&mut features).split_at_mut(pixels * channels);
            (alpha, depth, features) = (alpha_rest, depth_rest, feature_rest);
            let job = &mut jobs[first + (y / TILE_H) * columns + column];
            job.rows.push(RowOut { features: feature_part, alpha: alpha_part, depth: depth_part });
        }
    }
}
