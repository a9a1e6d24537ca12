//! How long each stage took on the device, where the adapter can tell.

use super::buffers::Grown;
use super::device::Gpu;
use wgpu::{BufferUsages, ComputePassTimestampWrites};

/// A stage of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Stage {
    Project,
    SortByDepth,
    ListTiles,
    SortByTile,
    Blend,
}

const STAGES: [Stage; 5] = [Stage::Project, Stage::SortByDepth, Stage::ListTiles, Stage::SortByTile, Stage::Blend];
/// Timestamps of a view: begin and end of each stage.
const PER_VIEW: usize = 2 * STAGES.len();
/// Bytes of a timestamp.
const TIMESTAMP_BYTES: u64 = 8;

impl Stage {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Project => "project",
            Self::SortByDepth => "sort by depth",
            Self::ListTiles => "list tiles",
            Self::SortByTile => "sort by tile",
            Self::Blend => "blend",
        }
    }
}

/// Device time of the last `render`, all views together, milliseconds.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct GpuTimings {
    /// Gaussians to ellipses.
    pub project_ms: f64,
    /// Listing and sorting the visible ones by depth.
    pub sort_by_depth_ms: f64,
    /// Listing their tiles.
    pub list_tiles_ms: f64,
    /// Sorting the lists by tile.
    pub sort_by_tile_ms: f64,
    /// Blending all channels.
    pub blend_ms: f64,
}

impl GpuTimings {
    /// All stages.
    pub fn total_ms(&self) -> f64 {
        self.project_ms + self.sort_by_depth_ms + self.list_tiles_ms + self.sort_by_tile_ms + self.blend_ms
    }

    fn of(&mut self, stage: Stage) -> &mut f64 {
        match stage {
            Stage::Project => &mut self.project_ms,
            Stage::SortByDepth => &mut self.sort_by_depth_ms,
            Stage::ListTiles => &mut self.list_tiles_ms,
            Stage::SortByTile => &mut self.sort_by_tile_ms,
            Stage::Blend => &mut self.blend_ms,
        }
    }

    /// Adds the timestamps of some views.
    pub(super) fn add(&mut self, timestamps: &[u64], tick_ns: f32) {
        for view in timestamps.chunks_exact(PER_VIEW) {
            for (stage, ends) in STAGES.into_iter().zip(view.as_chunks::<2>().0) {
                let ticks = ends[1].saturating_sub(ends[0]);
                *self.of(stage) += ticks as f64 * f64::from(tick_ns) * 1e-6;
            }
        }
    }
}

/// The timestamps of a batch of views.
pub(super) struct Clock {
    queries: wgpu::QuerySet,
    resolved: Grown,
}

impl Clock {
    /// For up to `views` views; `None` where the adapter has no timestamps.
    pub(super) fn new(gpu: &Gpu, views: usize) -> Option<Self> {
        gpu.tick_ns?;
        let queries = gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
            label: Some("stages"),
            ty: wgpu::QueryType::Timestamp,
            count: (views * PER_VIEW) as u32,
        });
        let usage = BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC;
        let mut resolved = Grown::new(gpu, "bytes of timestamps", usage);
        resolved.reserve(gpu, Self::bytes(views)).ok()?;
        Some(Self { queries, resolved })
    }

    /// Bytes of the timestamps of so many views.
    pub(super) fn bytes(views: usize) -> u64 {
        (views * PER_VIEW) as u64 * TIMESTAMP_BYTES
    }

    pub(super) fn writes(&self, view: usize, stage: Stage) -> ComputePassTimestampWrites<'_> {
        let first = view * PER_VIEW + 2 * stage as usize;
        ComputePassTimestampWrites {
            query_set: &self.queries,
            beginning_of_pass_write_index: Some(first as u32),
            end_of_pass_write_index: Some(first as u32 + 1),
        }
    }

    /// Copies the timestamps of the first `views` views to `target`.
    pub(super) fn copy(&self, encoder: &mut wgpu::CommandEncoder, views: usize, target: &wgpu::Buffer, offset: u64) {
        encoder.resolve_query_set(&self.queries, 0..(views * PER_VIEW) as u32, self.resolved.raw(), 0);
        encoder.copy_buffer_to_buffer(self.resolved.raw(), 0, target, offset, Self::bytes(views));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timestamps_become_milliseconds_per_stage() {
        let mut timings = GpuTimings::default();
        let one: Vec<u64> = (0..5u64).flat_map(|stage| [1000, 1000 + (stage + 1) * 1_000_000]).collect();
        let two: Vec<u64> = one.iter().chain(&one).copied().collect();
        timings.add(&two, 0.5);
        assert_eq!((timings.project_ms, timings.blend_ms, timings.total_ms()), (1.0, 5.0, 15.0));
    }

    #[test]
    fn clocks_that_run_backwards_give_zero() {
        let mut timings = GpuTimings::default();
        timings.add(&[5; 10], 1.0);
        timings.add(&[9, 8, 7, 6, 5, 4, 3, 2, 1, 0], 1.0);
        assert_eq!(timings.total_ms(), 0.0);
    }
}
