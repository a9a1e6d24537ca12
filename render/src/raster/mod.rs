//! Splatting: rasterisation of 3D Gaussians on the CPU and its gradients, by the rules of gsplat (see [`Convention`]).
//!
//! The data's way: `scene` (checked input) -> `project` (ellipses of eight Gaussians at a time, for all views) ->
//! `tiles` (each chunk lists its splats by tile) -> `sort` (depth order per tile) -> `blend` (front to back) ->
//! [`Picture`]; and back: [`PictureGradient`] -> `unblend` (back to front) -> `unproject` -> [`SplatGradients`], from
//! there to velocities by [`VelocityGradients`]. [`reference`](mod@reference) is the slow, obvious version all of it is tested against.

mod backward;
mod blend;
mod error;
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
pub use motion::VelocityGradients;
pub use scene::{MAX_FEATURES, MAX_PICTURE_VALUES, MAX_SIDE, MAX_SPLATS, MAX_VIEWS, Picture, RasterStats, Splats};
use settings::ALPHA_FLOOR;
pub use settings::{ALPHA_MIN, Convention, RasterSettings, TILE_RULE, TRANSMITTANCE_STOP};

use crate::camera::View;
use blend::{RowOut, Scratch, blend_tile};
use project::{Block, Camera, Footprints, LANES, Rules};
use rayon::prelude::*;
use simd::Isa;
use std::sync::atomic::AtomicUsize;
use tile::{TileEnd, TileInput};
use tiles::{Chunk, ChunkInput, Grid, TILE_H, TILE_W, fill_chunk};

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
    stats: RasterStats,
}

/// What is kept of a tile.
#[derive(Default)]
struct TileMemory {
    /// Sorted list.
    keys: Vec<u64>,
    end: TileEnd,
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
        Ok(Self { settings, isa, chunks: Vec::new(), tiles: Vec::new(), rendered: None, stats: RasterStats::default() })
    }

    /// The settings in use.
    pub fn settings(&self) -> &RasterSettings {
        &self.settings
    }

    /// Counts of the last successful `render`.
    pub fn stats(&self) -> RasterStats {
        self.stats
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
        self.rendered = None;
        let grid = Grid::new(views.iter().map(|v| (v.intrinsics.width, v.intrinsics.height)));
        let (chunk_bits, stats) = self.fill_chunks(splats, views, &grid)?;
        self.stats = stats;
        pictures.resize_with(views.len(), Picture::default);
        for (picture, view) in pictures.iter_mut().zip(views) {
            picture.resize(view.intrinsics.width, view.intrinsics.height, splats.feature_count);
        }
        self.blend(splats, &grid, chunk_bits, pictures);
        let (n, feature_count) = (splats.len(), splats.feature_count);
        self.rendered = Some(Rendered { views: views.to_vec(), splats: n, feature_count, chunk_bits });
        Ok(())
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
            if !project::project::<{ simd::TARGET_FMA }>(&block, &camera, &rules, &mut prints) {
                continue;
            }
            for (l, slot) in slots.iter_mut().enumerate() {
                *slot = prints.visible[l].then(|| prints.projection(l));
            }
        }
        Ok(out)
    }

    /// Projects and bins all Gaussians; returns the chunk size and the counts.
    fn fill_chunks(&mut self, splats: &Splats, views: &[View], grid: &Grid) -> Result<(u32, RasterStats), RasterError> {
        let n = splats.len();
        let chunk_bits = n.div_ceil(MAX_CHUNKS).next_power_of_two().ilog2().max(MIN_CHUNK_BITS);
        let chunk_len = 1usize << chunk_bits;
        let cameras: Vec<Camera> = views.iter().map(|v| Camera::new(v, self.settings.convention)).collect();
        let pairs = AtomicUsize::new(0);
        let rules = Rules::from(&self.settings);
        let input = ChunkInput { splats: *splats, cameras: &cameras, rules, grid, pairs: &pairs };
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
        let invalid = self.chunks.iter().map(|c| c.invalid).sum();
        let visible = self.chunks.iter().map(|c| c.visible).sum();
        let culled = (n - invalid) * views.len() - visible;
        Ok((chunk_bits, RasterStats { splats: n, invalid, culled, visible, pairs }))
    }

    /// Sorts and blends every tile.
    fn blend(&mut self, splats: &Splats, grid: &Grid, chunk_bits: u32, pictures: &mut [Picture]) {
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
                    features: splats.features,
                    feature_count: splats.feature_count,
                    alpha_cap,
                };
                blend_tile(isa, &input, scratch);
                scratch.keep(&mut memory.end);
                scratch.write(&mut job.rows, splats.feature_count);
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
