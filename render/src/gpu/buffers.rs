//! Device memory: buffers that stay between frames and grow when a frame needs more.

use super::device::Gpu;
use super::error::GpuError;
use wgpu::{Buffer, BufferUsages};

/// Least bytes of a buffer: bindings may not be empty.
const SMALLEST: u64 = 256;
/// A buffer that grows, grows by this share beyond what is needed, so that growing ends.
const HEADROOM: f64 = 1.25;

/// A buffer and how it may be used.
pub(super) struct Grown {
    name: &'static str,
    usage: BufferUsages,
    buffer: Buffer,
}

impl Grown {
    pub(super) fn new(gpu: &Gpu, name: &'static str, usage: BufferUsages) -> Self {
        Self { name, usage, buffer: create(gpu, name, usage, SMALLEST) }
    }

    /// Storage that shaders read and write.
    pub(super) fn storage(gpu: &Gpu, name: &'static str) -> Self {
        Self::new(gpu, name, BufferUsages::STORAGE | BufferUsages::COPY_DST | BufferUsages::COPY_SRC)
    }

    /// Small numbers that shaders read.
    pub(super) fn uniform(gpu: &Gpu, name: &'static str) -> Self {
        Self::new(gpu, name, BufferUsages::UNIFORM | BufferUsages::COPY_DST)
    }

    /// Makes room for `bytes`; what was inside is lost when the buffer grows.
    pub(super) fn reserve(&mut self, gpu: &Gpu, bytes: u64) -> Result<(), GpuError> {
        if bytes <= self.buffer.size() {
            return Ok(());
        }
        let shader_sees = self.usage.contains(BufferUsages::STORAGE);
        let limit = if shader_sees { gpu.largest_binding() } else { gpu.limits.max_buffer_size };
        gpu.fits(self.name, bytes, limit)?;
        let roomy = (bytes as f64 * HEADROOM) as u64;
        // Given back first: old and new together may not fit.
        self.buffer.destroy();
        self.buffer = create(gpu, self.name, self.usage, roomy.next_multiple_of(SMALLEST).min(limit & !3).max(bytes));
        gpu.check()
    }

    /// Makes room for `data` and copies it in.
    pub(super) fn upload(&mut self, gpu: &Gpu, data: &[u8]) -> Result<(), GpuError> {
        self.reserve(gpu, data.len() as u64)?;
        if !data.is_empty() {
            gpu.queue.write_buffer(&self.buffer, 0, data);
        }
        Ok(())
    }

    pub(super) fn raw(&self) -> &Buffer {
        &self.buffer
    }

    /// The whole buffer.
    pub(super) fn all(&self) -> wgpu::BindingResource<'_> {
        self.buffer.as_entire_binding()
    }

    /// One entry of a uniform buffer.
    pub(super) fn entry(&self, offset: u64, bytes: u64) -> wgpu::BindingResource<'_> {
        wgpu::BindingResource::Buffer(wgpu::BufferBinding {
            buffer: &self.buffer,
            offset,
            size: std::num::NonZeroU64::new(bytes),
        })
    }
}

fn create(gpu: &Gpu, name: &'static str, usage: BufferUsages, size: u64) -> Buffer {
    gpu.device.create_buffer(&wgpu::BufferDescriptor { label: Some(name), size, usage, mapped_at_creation: false })
}
