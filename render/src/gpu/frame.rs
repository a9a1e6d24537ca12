//! One view as commands: project, sort, list, sort, blend.

use super::blend::{Plan, parts_of};
use super::buffers::Grown;
use super::device::Gpu;
use super::error::GpuError;
use super::params::{Step, UNIFORM_STRIDE, ViewParams, strided, tiles_of};
use super::pipelines::{Pipelines, Size};
use super::scene::{Scene, WORKGROUP};
use super::sort::{ARGS_BYTES, BLOCK, Lists};
use super::timings::{Clock, Stage};
use crate::camera::View;
use crate::raster::{MAX_PAIRS, RasterSettings};
use std::ops::Range;
use wgpu::{BufferUsages, CommandEncoder, ComputePass};

/// Bytes of `Record` and of a span in the shaders.
const RECORD_BYTES: u64 = 32;
const SPAN_BYTES: u64 = 16;
/// Counts of a view (`VISIBLE`, `DRAWN`, `PAIRS` of `common.wgsl`) with padding, bytes.
pub(super) const TOTALS_BYTES: u64 = 16;
/// Entries of tile lists there is room for at first, and per Gaussian.
const FIRST_CAPACITY: u64 = 1 << 16;
const CAPACITY_PER_SPLAT: u64 = 2;

/// Memory all views share, one after the other.
pub(super) struct Work {
    views: Grown,
    steps: Grown,
    pub(super) chunks: Grown,
    pub(super) records: Grown,
    pub(super) spans: Grown,
    pub(super) sums: Grown,
    pub(super) totals: Grown,
    pub(super) args: Grown,
    pub(super) by_depth: Lists,
    pub(super) by_tile: Lists,
    pub(super) ranges: Grown,
    /// One buffer or, where a binding cannot hold all channels, more.
    pub(super) out_features: Vec<Grown>,
    pub(super) out_planes: Grown,
    /// How the channels of the batch at hand go through the buffers.
    pub(super) plan: Plan,
    /// Entries the tile lists have room for.
    pub(super) capacity: u32,
}

impl Work {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let storage = |name| Grown::storage(gpu, name);
        let mut args = Grown::new(
            gpu,
            "bytes of dispatch sizes",
            BufferUsages::STORAGE | BufferUsages::INDIRECT | BufferUsages::COPY_DST,
        );
        args.reserve(gpu, ARGS_BYTES)?;
        let mut steps = Grown::uniform(gpu, "bytes of sort steps");
        steps.upload(gpu, &strided(Step::all().map(Step::words)))?;
        Ok(Self {
            views: Grown::uniform(gpu, "bytes of view parameters"),
            steps,
            chunks: Grown::uniform(gpu, "bytes of channel parameters"),
            records: storage("bytes of projected splats"),
            spans: storage("bytes of tile spans"),
            sums: storage("bytes of prefix sums"),
            totals: storage("bytes of counts"),
            args,
            by_depth: Lists::new(gpu, "bytes of depth keys", "bytes of depth order"),
            by_tile: Lists::new(gpu, "bytes of tile keys", "bytes of tile lists"),
            ranges: storage("bytes of tile ranges"),
            out_features: Vec::new(),
            out_planes: storage("bytes of a picture's alpha and depth"),
            plan: Plan::default(),
            capacity: 0,
        })
    }

    /// Makes room for these views of the scene, with at least `pairs` entries in the tile lists.
    pub(super) fn reserve(
        &mut self,
        gpu: &Gpu,
        scene: &Scene,
        channels: &Range<usize>,
        views: &[View],
        pairs: u64,
    ) -> Result<(), GpuError> {
        let n = u64::from(scene.splats);
        let largest = views.iter().map(pixels_of).max().unwrap_or(0);
        self.plan = Plan::new(gpu, &parts_of(scene), channels, largest)?;
        let buffers = self.plan.outs.len().max(1);
        while self.out_features.len() < buffers {
            self.out_features.push(Grown::storage(gpu, "bytes of a picture's features"));
        }
        for (buffer, &channels) in self.out_features.iter_mut().zip(&self.plan.outs) {
            buffer.reserve(gpu, (4 * largest).saturating_mul(u64::from(channels)))?;
        }
        self.out_planes.reserve(gpu, 8 * largest)?;
        self.records.reserve(gpu, RECORD_BYTES * n)?;
        self.spans.reserve(gpu, SPAN_BYTES * n)?;
        self.by_depth.reserve(gpu, n)?;
        let most = most_pairs(gpu);
        gpu.fits("entries of tile lists", pairs, most)?;
        let least = pairs.max(FIRST_CAPACITY.max(CAPACITY_PER_SPLAT * n).min(most));
        if least > u64::from(self.capacity) {
            // The next view may need a little more than this one.
            let wanted = (least + least / 4).min(most);
            self.capacity = 0;
            self.by_tile.reserve(gpu, wanted)?;
            self.capacity = wanted as u32;
        }
        let blocks = n.max(u64::from(self.capacity)).div_ceil(u64::from(BLOCK));
        self.sums.reserve(gpu, 4 * 16 * blocks)?;
        for view in views {
            let tiles = tiles_of(view).iter().map(|&side| u64::from(side)).product::<u64>();
            self.ranges.reserve(gpu, 8 * tiles)?;
        }
        Ok(())
    }

    /// Writes the parameters of these views.
    pub(super) fn write_params(
        &mut self,
        gpu: &Gpu,
        settings: &RasterSettings,
        scene: &Scene,
        views: &[View],
    ) -> Result<(), GpuError> {
        let params = views.iter().map(|v| ViewParams::new(v, settings, scene.splats, self.capacity));
        self.views.upload(gpu, &strided(params))?;
        self.chunks.upload(gpu, &strided(self.plan.words()))
    }

    pub(super) fn step(&self, step: Step) -> wgpu::BindingResource<'_> {
        self.steps.entry(step.offset(), size_of::<[u32; 4]>() as u64)
    }
}

/// Pixels of a view's picture.
pub(super) fn pixels_of(view: &View) -> u64 {
    (view.intrinsics.width * view.intrinsics.height) as u64
}

/// Most entries of tile lists on this device.
fn most_pairs(gpu: &Gpu) -> u64 {
    let dispatched = u64::from(gpu.limits.max_compute_workgroups_per_dimension) * u64::from(BLOCK);
    (gpu.largest_binding() / 4).min(dispatched).min(MAX_PAIRS as u64)
}

/// A view of the scene about to be rendered.
pub(super) struct Frame<'a> {
    pub(super) gpu: &'a Gpu,
    pub(super) kernels: &'a Pipelines,
    pub(super) settings: &'a RasterSettings,
    pub(super) scene: &'a Scene,
    pub(super) work: &'a Work,
    pub(super) camera: &'a View,
    /// Position among the views whose parameters were written.
    pub(super) index: usize,
}

impl Frame<'_> {
    /// Records the commands; the picture is in `out_features` and `out_planes` afterwards, the counts in `totals`.
    pub(super) fn encode(&self, encoder: &mut CommandEncoder, clock: Option<&Clock>) {
        encoder.clear_buffer(self.work.totals.raw(), 0, None);
        encoder.clear_buffer(self.work.ranges.raw(), 0, None);
        let mut stage = |stage: Stage, run: &dyn Fn(&mut ComputePass<'_>)| {
            let timestamp_writes = clock.map(|clock| clock.writes(self.index, stage));
            let mut pass = encoder
                .begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(stage.name()), timestamp_writes });
            run(&mut pass);
        };
        stage(Stage::Project, &|pass| self.project(pass));
        stage(Stage::SortByDepth, &|pass| self.sort_by_depth(pass));
        stage(Stage::ListTiles, &|pass| self.list_tiles(pass));
        stage(Stage::SortByTile, &|pass| self.sort_by_tile(pass));
        stage(Stage::Blend, &|pass| self.blend(pass));
    }

    /// This view's parameters.
    pub(super) fn view(&self) -> wgpu::BindingResource<'_> {
        self.work.views.entry(self.index as u64 * UNIFORM_STRIDE, size_of::<ViewParams>() as u64)
    }

    fn project(&self, pass: &mut ComputePass<'_>) {
        let (kernel, scene, work) = (&self.kernels.project, self.scene, self.work);
        let buffers = [
            (0, self.view()),
            (1, scene.means_now().all()),
            (2, scene.quats.all()),
            (3, scene.scales.all()),
            (4, scene.solid_now().all()),
            (5, work.records.all()),
            (6, work.spans.all()),
            (7, work.totals.all()),
        ];
        kernel.run(pass, &kernel.bind(self.gpu, &buffers), Size::Groups(scene.splats.div_ceil(WORKGROUP), 1));
    }
}
