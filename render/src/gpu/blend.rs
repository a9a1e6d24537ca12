//! The picture from the sorted lists.

use super::buffers::Grown;
use super::device::Gpu;
use super::error::GpuError;
use super::frame::Frame;
use super::params::{CHUNK_CHANNELS, UNIFORM_STRIDE, tile_passes, tiles_of};
use super::pipelines::Size;
use super::scene::Scene;
use std::ops::Range;
use wgpu::ComputePass;

/// Bytes of `Chunk` in `blend.wgsl`.
const CHUNK_BYTES: u64 = 32;

/// Up to four channels: where they come from and where they go.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Dispatch {
    /// Part of the scene's features, and the first channel in it.
    part: usize,
    source_first: u32,
    source_stride: u32,
    channels: u32,
    /// Buffer of the picture's features, and the first channel in it.
    pub(super) out: usize,
    out_first: u32,
    out_stride: u32,
}

/// How the channels drawn go through bindings of a limited size.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Plan {
    pub(super) dispatches: Vec<Dispatch>,
    /// Channels of each buffer of the picture's features.
    pub(super) outs: Vec<u32>,
}

impl Plan {
    /// For channels `drawn` of a scene whose parts hold `(first, channels)` each, and pictures of up to `pixels`.
    pub(super) fn new(gpu: &Gpu, parts: &[(u32, u32)], drawn: &Range<usize>, pixels: u64) -> Result<Self, GpuError> {
        let total = drawn.len() as u32;
        let fitting = gpu.largest_binding() / (4 * pixels.max(1));
        if fitting == 0 && total > 0 {
            gpu.fits("bytes of a picture's features", 4 * pixels, gpu.largest_binding())?;
        }
        Ok(Self::cut(parts, drawn.start as u32, total, fitting.min(u64::from(u32::MAX)).max(1) as u32))
    }

    /// Cuts `total` channels from `first` on at the ends of parts and of buffers of `fitting` channels.
    fn cut(parts: &[(u32, u32)], first: u32, total: u32, fitting: u32) -> Self {
        let outs: Vec<u32> = (0..total).step_by(fitting as usize).map(|at| fitting.min(total - at)).collect();
        let mut dispatches = Vec::new();
        let mut done = 0;
        while done < total {
            let channel = first + done;
            let holds = |&(start, count): &(u32, u32)| start <= channel && channel - start < count;
            let Some(part) = parts.iter().position(holds) else { break };
            let (start, stride) = parts[part];
            let (out, out_first) = ((done / fitting) as usize, done % fitting);
            let left_in_part = start + stride - channel;
            let channels = (CHUNK_CHANNELS as u32).min(total - done).min(left_in_part).min(fitting - out_first);
            let out_stride = outs[out];
            let source_first = channel - start;
            dispatches.push(Dispatch {
                part,
                source_first,
                source_stride: stride,
                channels,
                out,
                out_first,
                out_stride,
            });
            done += channels;
        }
        if dispatches.is_empty() {
            // Alpha and depth are asked for even so.
            dispatches.push(Dispatch {
                part: 0,
                source_first: 0,
                source_stride: 0,
                channels: 0,
                out: 0,
                out_first: 0,
                out_stride: 0,
            });
        }
        Self { dispatches, outs }
    }

    /// `Chunk` of `blend.wgsl` for each dispatch; the first one gives alpha and depth.
    pub(super) fn words(&self) -> impl Iterator<Item = [u32; 8]> {
        self.dispatches.iter().enumerate().map(|(index, d)| {
            let planes = u32::from(index == 0);
            [d.source_first, d.source_stride, d.channels, d.out_first, d.out_stride, planes, 0, 0]
        })
    }

    /// Channels drawn.
    pub(super) fn channels(&self) -> u32 {
        self.outs.iter().sum()
    }
}

/// Where the parts of a scene begin and how many channels each has.
pub(super) fn parts_of(scene: &Scene) -> Vec<(u32, u32)> {
    scene.features().iter().map(|part| (part.first, part.channels)).collect()
}

impl Frame<'_> {
    /// Blends all channels, a few per dispatch; the first dispatch gives alpha and depth too.
    pub(super) fn blend(&self, pass: &mut ComputePass<'_>) {
        let (kernel, work) = (&self.kernels.blend, self.work);
        let slots = work.by_tile.slots_after(tile_passes(self.camera));
        let [columns, rows] = tiles_of(self.camera);
        for (index, dispatch) in work.plan.dispatches.iter().enumerate() {
            let features = self.scene.features().get(dispatch.part).map(|part| &part.buffer);
            let out: Option<&Grown> = work.out_features.get(dispatch.out);
            let (Some(features), Some(out)) = (features, out) else { continue };
            let buffers = [
                (0, self.view()),
                (1, work.chunks.entry(index as u64 * UNIFORM_STRIDE, CHUNK_BYTES)),
                (2, work.records.all()),
                (3, slots.all()),
                (4, work.ranges.all()),
                (5, features.all()),
                (6, out.all()),
                (7, work.out_planes.all()),
            ];
            kernel.run(pass, &kernel.bind(self.gpu, &buffers), Size::Groups(columns, rows));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Where each drawn channel comes from and goes to.
    fn routes(plan: &Plan) -> Vec<(usize, u32, usize, u32)> {
        let each = |d: &Dispatch| {
            let d = *d;
            (0..d.channels).map(move |k| (d.part, d.source_first + k, d.out, d.out_first + k))
        };
        plan.dispatches.iter().flat_map(each).collect()
    }

    #[test]
    fn one_part_and_one_buffer_take_four_channels_at_a_time() {
        let plan = Plan::cut(&[(0, 22)], 0, 22, 1000);
        assert_eq!((plan.dispatches.len(), plan.outs.as_slice()), (6, [22].as_slice()));
        assert_eq!(routes(&plan), (0..22).map(|c| (0, c, 0, c)).collect::<Vec<_>>());
        // Flow alone: one dispatch instead of six.
        let flow = Plan::cut(&[(0, 22)], 3, 3, 1000);
        assert_eq!((flow.dispatches.len(), routes(&flow)), (1, vec![(0, 3, 0, 0), (0, 4, 0, 1), (0, 5, 0, 2)]));
    }

    #[test]
    fn no_channels_still_give_alpha_and_depth() {
        let plan = Plan::cut(&[(0, 22)], 5, 0, 1000);
        assert_eq!((plan.dispatches.len(), plan.channels()), (1, 0));
        assert_eq!(plan.words().next(), Some([0, 0, 0, 0, 0, 1, 0, 0]));
    }

    #[test]
    fn cuts_at_parts_and_buffers_lose_no_channel() {
        for (part, fitting) in [(4, 3), (4, 1), (8, 5), (4, 100), (22, 7)] {
            let parts: Vec<(u32, u32)> = (0..22u32).step_by(part).map(|f| (f, (part as u32).min(22 - f))).collect();
            for (first, total) in [(0, 22), (3, 3), (7, 11), (21, 1)] {
                let plan = Plan::cut(&parts, first, total, fitting);
                assert_eq!(plan.channels(), total);
                let wanted: Vec<_> = (0..total)
                    .map(|k| {
                        let c = first + k;
                        let p = part as u32;
                        ((c / p) as usize, c % p, (k / fitting) as usize, k % fitting)
                    })
                    .collect();
                assert_eq!(routes(&plan), wanted, "{part} {fitting} {first} {total}");
                assert!(plan.dispatches.iter().all(|d| d.out_stride == plan.outs[d.out]));
            }
        }
    }
}
