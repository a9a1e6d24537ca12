//! Lists and their order: splats by depth, then their tiles by tile number.

use super::buffers::Grown;
use super::device::Gpu;
use super::frame::Frame;
use super::params::{Step, depth_passes, tile_passes};
use super::pipelines::Size;
use wgpu::ComputePass;

/// Elements of a block (`BLOCK` of `common.wgsl`).
pub(super) const BLOCK: u32 = 2048;
/// Where the indirect dispatch sizes lie in `args`, bytes: blocks of splats, blocks of tile list entries.
const ARGS_DRAWN: u64 = 0;
const ARGS_PAIRS: u64 = 16;
/// Bytes of both.
pub(super) const ARGS_BYTES: u64 = 32;

/// Keys and slots, twice: a pass reads one and writes the other.
pub(super) struct Lists {
    keys: [Grown; 2],
    slots: [Grown; 2],
}

impl Lists {
    pub(super) fn new(gpu: &Gpu, keys: &'static str, slots: &'static str) -> Self {
        Self {
            keys: std::array::from_fn(|_| Grown::storage(gpu, keys)),
            slots: std::array::from_fn(|_| Grown::storage(gpu, slots)),
        }
    }

    pub(super) fn reserve(&mut self, gpu: &Gpu, entries: u64) -> Result<(), super::GpuError> {
        self.keys.iter_mut().chain(&mut self.slots).try_for_each(|buffer| buffer.reserve(gpu, 4 * entries))
    }

    /// The half that holds the result after so many passes.
    pub(super) fn keys_after(&self, passes: u32) -> &Grown {
        &self.keys[passes as usize % 2]
    }

    pub(super) fn slots_after(&self, passes: u32) -> &Grown {
        &self.slots[passes as usize % 2]
    }
}

impl Frame<'_> {
    /// Lists the splats that have a tile and sorts them by depth.
    pub(super) fn sort_by_depth(&self, pass: &mut ComputePass<'_>) {
        let (gpu, k, work) = (self.gpu, self.kernels, self.work);
        let blocks = self.scene.splats.div_ceil(BLOCK);
        let buffers = [(0, self.view()), (2, work.spans.all()), (4, work.sums.all())];
        k.reduce_drawn.run(pass, &k.reduce_drawn.bind(gpu, &buffers), Size::Groups(blocks, 1));
        self.scan(pass, Step::Drawn);
        let lists = &work.by_depth;
        let buffers = [
            (0, self.view()),
            (2, work.spans.all()),
            (4, work.sums.all()),
            (5, lists.keys_after(0).all()),
            (6, lists.slots_after(0).all()),
        ];
        k.compact.run(pass, &k.compact.bind(gpu, &buffers), Size::Groups(blocks, 1));
        self.sort(pass, lists, depth_passes(self.settings), Step::DepthDigit, ARGS_DRAWN);
    }

    /// Lists the tiles of the sorted splats.
    pub(super) fn list_tiles(&self, pass: &mut ComputePass<'_>) {
        let (gpu, k, work) = (self.gpu, self.kernels, self.work);
        let sorted = work.by_depth.slots_after(depth_passes(self.settings));
        let size = || Size::Counted(work.args.raw(), ARGS_DRAWN);
        let buffers = [(2, work.spans.all()), (3, work.totals.all()), (4, work.sums.all()), (9, sorted.all())];
        k.reduce_tiles.run(pass, &k.reduce_tiles.bind(gpu, &buffers), size());
        self.scan(pass, Step::Tiles);
        let buffers = [
            (0, self.view()),
            (2, work.spans.all()),
            (3, work.totals.all()),
            (4, work.sums.all()),
            (5, work.by_tile.keys_after(0).all()),
            (6, work.by_tile.slots_after(0).all()),
            (7, work.records.all()),
            (9, sorted.all()),
        ];
        k.emit.run(pass, &k.emit.bind(gpu, &buffers), size());
    }

    /// Sorts the tile lists and finds where each tile's begins and ends.
    pub(super) fn sort_by_tile(&self, pass: &mut ComputePass<'_>) {
        let (k, work) = (self.kernels, self.work);
        let passes = tile_passes(self.camera);
        self.sort(pass, &work.by_tile, passes, Step::TileDigit, ARGS_PAIRS);
        let buffers = [
            (0, self.view()),
            (1, work.totals.all()),
            (2, work.by_tile.keys_after(passes).all()),
            (3, work.ranges.all()),
        ];
        let size = Size::Counted(work.args.raw(), ARGS_PAIRS);
        k.find_ranges.run(pass, &k.find_ranges.bind(self.gpu, &buffers), size);
    }

    /// Turns the block sums into where each block starts.
    fn scan(&self, pass: &mut ComputePass<'_>, step: Step) {
        let work = self.work;
        let buffers = [
            (0, self.view()),
            (1, work.step(step)),
            (3, work.totals.all()),
            (4, work.sums.all()),
            (8, work.args.all()),
        ];
        let kernel = &self.kernels.scan_sums;
        kernel.run(pass, &kernel.bind(self.gpu, &buffers), Size::Groups(1, 1));
    }

    fn sort(&self, pass: &mut ComputePass<'_>, lists: &Lists, passes: u32, step: impl Fn(u32) -> Step, args: u64) {
        let (gpu, k, work) = (self.gpu, self.kernels, self.work);
        for digit in 0..passes {
            let step = step(digit);
            let size = || Size::Counted(work.args.raw(), args);
            let (keys, slots) = (lists.keys_after(digit), lists.slots_after(digit));
            let buffers =
                [(0, self.view()), (1, work.step(step)), (2, work.totals.all()), (3, keys.all()), (7, work.sums.all())];
            k.count_digits.run(pass, &k.count_digits.bind(gpu, &buffers), size());
            self.scan(pass, step);
            let buffers = [
                (0, self.view()),
                (1, work.step(step)),
                (2, work.totals.all()),
                (3, keys.all()),
                (4, slots.all()),
                (5, lists.keys_after(digit + 1).all()),
                (6, lists.slots_after(digit + 1).all()),
                (7, work.sums.all()),
            ];
            k.move_keys.run(pass, &k.move_keys.bind(gpu, &buffers), size());
        }
    }
}
