//! The picture from the sorted lists.

use super::frame::Frame;
use super::params::{CHUNK_CHANNELS, UNIFORM_STRIDE, tile_passes, tiles_of};
use super::pipelines::Size;
use wgpu::ComputePass;

/// Bytes of `Chunk` in `blend.wgsl`.
const CHUNK_BYTES: u64 = 16;

impl Frame<'_> {
    /// Blends all channels, a few per dispatch; the first dispatch gives alpha and depth too.
    pub(super) fn blend(&self, pass: &mut ComputePass<'_>) {
        let (kernel, work) = (&self.kernels.blend, self.work);
        let slots = work.by_tile.slots_after(tile_passes(self.camera));
        let [columns, rows] = tiles_of(self.camera);
        for chunk in 0..chunk_count(self.scene.channels as usize) {
            let buffers = [
                (0, self.view()),
                (1, work.chunks.entry(chunk as u64 * UNIFORM_STRIDE, CHUNK_BYTES)),
                (2, work.records.all()),
                (3, slots.all()),
                (4, work.ranges.all()),
                (5, self.scene.features.all()),
                (6, work.out_features.all()),
                (7, work.out_planes.all()),
            ];
            kernel.run(pass, &kernel.bind(self.gpu, &buffers), Size::Groups(columns, rows));
        }
    }
}

/// Dispatches for so many channels; one when there are none.
pub(super) fn chunk_count(channels: usize) -> usize {
    channels.div_ceil(CHUNK_CHANNELS).max(1)
}

/// `Chunk` of `blend.wgsl`: the first channel of each dispatch.
pub(super) fn chunk_words(channels: usize) -> impl Iterator<Item = [u32; 4]> {
    (0..chunk_count(channels)).map(|chunk| [(chunk * CHUNK_CHANNELS) as u32, 0, 0, 0])
}
