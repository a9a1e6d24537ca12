//! Pictures and counts from the device to the host, for a batch of views at once.

use super::blend::Plan;
use super::buffers::Grown;
use super::device::Gpu;
use super::error::GpuError;
use super::frame::{TOTALS_BYTES, Work, pixels_of};
use super::timings::{Clock, GpuTimings};
use crate::camera::View;
use crate::raster::Picture;
use std::ops::Range;
use std::sync::mpsc;
use wgpu::{BufferUsages, CommandEncoder, MapMode, PollType};

/// Most bytes that wait to be read, unless one picture alone is larger.
const BATCH_BYTES: u64 = 64 << 20;
/// Most views whose commands are recorded before the device is asked to run them.
pub(super) const BATCH_VIEWS: usize = 16;

/// Where a view's results lie in the staging buffer.
struct Place {
    totals: u64,
    planes: u64,
    features: u64,
    end: u64,
}

/// What came back of one view.
pub(super) struct Outcome {
    pub(super) visible: u32,
    pub(super) pairs: u32,
    pub(super) picture: Picture,
}

/// The buffer the host reads.
pub(super) struct Staging {
    buffer: Grown,
}

fn place(view: &View, channels: u32, start: u64) -> Place {
    let pixels = pixels_of(view);
    let planes = start + TOTALS_BYTES;
    let features = planes + 8 * pixels;
    // Timestamps follow somewhere: eight bytes each.
    Place { totals: start, planes, features, end: (features + 4 * pixels * u64::from(channels)).next_multiple_of(8) }
}

/// How many of the views, one at least, fit a batch.
pub(super) fn batch_len(views: &[View], channels: u32) -> usize {
    let mut end = 0;
    let fits = |view: &&View| {
        end = place(view, channels, end).end;
        end <= BATCH_BYTES
    };
    views.iter().take(BATCH_VIEWS).take_while(fits).count().max(1)
}

impl Staging {
    pub(super) fn new(gpu: &Gpu) -> Self {
        let usage = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        Self { buffer: Grown::new(gpu, "bytes of results", usage) }
    }

    /// Makes room for the results of a batch.
    pub(super) fn reserve(&mut self, gpu: &Gpu, views: &[View], channels: u32) -> Result<(), GpuError> {
        let end = views.iter().fold(0, |end, view| place(view, channels, end).end);
        self.buffer.reserve(gpu, end + TOTALS_BYTES + Clock::bytes(views.len()))
    }

    /// Records the copy of one view's results; returns where the next begins.
    pub(super) fn copy(&self, encoder: &mut CommandEncoder, work: &Work, view: &View, start: u64) -> u64 {
        let to = self.buffer.raw();
        let at = place(view, work.plan.channels(), start);
        let pixels = pixels_of(view);
        encoder.copy_buffer_to_buffer(work.totals.raw(), 0, to, at.totals, TOTALS_BYTES);
        encoder.copy_buffer_to_buffer(work.out_planes.raw(), 0, to, at.planes, 8 * pixels);
        let mut offset = at.features;
        for (buffer, &channels) in work.out_features.iter().zip(&work.plan.outs) {
            let bytes = 4 * pixels * u64::from(channels);
            encoder.copy_buffer_to_buffer(buffer.raw(), 0, to, offset, bytes);
            offset += bytes;
        }
        at.end
    }

    /// Records the copy of what the batch shares: the counts of Gaussians that are not drawn and the timestamps.
    pub(super) fn copy_shared(
        &self,
        encoder: &mut CommandEncoder,
        counts: [&Grown; 2],
        clock: Option<&Clock>,
        views: usize,
        start: u64,
    ) {
        let each = TOTALS_BYTES / 2;
        for (index, count) in counts.into_iter().enumerate() {
            encoder.copy_buffer_to_buffer(count.raw(), 0, self.buffer.raw(), start + index as u64 * each, each);
        }
        if let Some(clock) = clock {
            clock.copy(encoder, views, self.buffer.raw(), start + TOTALS_BYTES);
        }
    }

    /// Waits for the device and takes the batch's results and the count of unusable Gaussians.
    pub(super) fn read(
        &self,
        gpu: &Gpu,
        views: &[View],
        plan: &Plan,
        timings: &mut GpuTimings,
    ) -> Result<(Vec<Outcome>, u32), GpuError> {
        let results = self.map(gpu).and_then(|()| {
            let bytes = self.buffer.raw().get_mapped_range(..).map_err(|e| gpu.failed(e))?;
            let mut start = 0;
            let mut outcomes = Vec::with_capacity(views.len());
            for view in views {
                let at = place(view, plan.channels(), start);
                outcomes.push(take(gpu, &bytes, view, plan, &at)?);
                start = at.end;
            }
            let counts = words::<u32>(gpu, &bytes, start..start + TOTALS_BYTES)?;
            if let Some(tick_ns) = gpu.tick_ns {
                let first = start + TOTALS_BYTES;
                timings.add(&words(gpu, &bytes, first..first + Clock::bytes(views.len()))?, tick_ns);
            }
            Ok((outcomes, counts.iter().step_by(2).fold(0u32, |sum, &count| sum.saturating_add(count))))
        });
        // Also after an error: a buffer that is still waiting to be mapped could not be used again.
        self.buffer.raw().unmap();
        results
    }

    /// Waits until the host sees the buffer.
    fn map(&self, gpu: &Gpu) -> Result<(), GpuError> {
        let (sender, receiver) = mpsc::channel();
        self.buffer.raw().map_async(MapMode::Read, .., move |result| {
            // The receiver is gone only when an error has been reported already.
            let _ = sender.send(result);
        });
        let polled = gpu.device.poll(PollType::wait_indefinitely());
        gpu.check()?;
        polled.map_err(|e| gpu.failed(e))?;
        match receiver.try_recv() {
            Ok(mapped) => mapped.map_err(|e| gpu.failed(e)),
            Err(_) => Err(gpu.failed("the results were never mapped")),
        }
    }
}

fn take(gpu: &Gpu, bytes: &[u8], view: &View, plan: &Plan, at: &Place) -> Result<Outcome, GpuError> {
    let (width, height) = (view.intrinsics.width, view.intrinsics.height);
    let pixels = (width * height) as u64;
    let totals = words::<u32>(gpu, bytes, at.totals..at.planes)?;
    let [visible, _drawn, pairs, ..] = totals.as_slice() else { return Err(gpu.failed("counts are missing")) };
    let middle = at.planes + 4 * pixels;
    let picture = Picture {
        width,
        height,
        feature_count: plan.channels() as usize,
        features: features(gpu, bytes, plan, at.features, pixels)?,
        alpha: words(gpu, bytes, at.planes..middle)?,
        depth: words(gpu, bytes, middle..at.features)?,
    };
    Ok(Outcome { visible: *visible, pairs: *pairs, picture })
}

/// A picture's features; the buffers they were in, one after the other, become rows of all channels.
fn features(gpu: &Gpu, bytes: &[u8], plan: &Plan, start: u64, pixels: u64) -> Result<Vec<f32>, GpuError> {
    let channels = plan.channels() as usize;
    let all: Vec<f32> = words(gpu, bytes, start..start + 4 * pixels * channels as u64)?;
    if plan.outs.len() < 2 {
        return Ok(all);
    }
    let mut rows = vec![0.0; all.len()];
    let (mut rest, mut first) = (all.as_slice(), 0);
    for &width in &plan.outs {
        let width = width as usize;
        let (part, after) = rest.split_at(width * pixels as usize);
        for (row, values) in rows.chunks_exact_mut(channels).zip(part.chunks_exact(width)) {
            row[first..first + width].copy_from_slice(values);
        }
        (rest, first) = (after, first + width);
    }
    Ok(rows)
}

/// A part of the mapped bytes as numbers.
fn words<T: bytemuck::Pod>(gpu: &Gpu, bytes: &[u8], range: Range<u64>) -> Result<Vec<T>, GpuError> {
    let part = bytes
        .get(range.start as usize..range.end as usize)
        .ok_or_else(|| gpu.failed(format!("{range:?} of {} result bytes", bytes.len())))?;
    Ok(bytemuck::pod_collect_to_vec(part))
}
