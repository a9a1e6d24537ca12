//! The compute pipelines, one per entry point, made once.

use super::device::Gpu;
use super::error::GpuError;
use super::shaders::{self, Shader};
use wgpu::{BindGroup, BindGroupEntry, BindingResource, ComputePass, ComputePipeline};

/// A pipeline and the layout of its group 0.
pub(super) struct Kernel {
    pipeline: ComputePipeline,
    layout: wgpu::BindGroupLayout,
}

/// How many workgroups.
pub(super) enum Size<'a> {
    Groups(u32, u32),
    /// From a buffer the device has written, at this offset.
    Counted(&'a wgpu::Buffer, u64),
}

impl Kernel {
    fn new(gpu: &Gpu, module: &wgpu::ShaderModule, entry: &str) -> Self {
        let pipeline = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(entry),
            layout: None,
            module,
            entry_point: Some(entry),
            // Every shader writes its workgroup memory before it reads it.
            compilation_options: wgpu::PipelineCompilationOptions {
                zero_initialize_workgroup_memory: false,
                ..Default::default()
            },
            cache: None,
        });
        let layout = pipeline.get_bind_group_layout(0);
        Self { pipeline, layout }
    }

    /// The buffers of one dispatch, `(binding, buffer)`.
    pub(super) fn bind(&self, gpu: &Gpu, buffers: &[(u32, BindingResource<'_>)]) -> BindGroup {
        let entries: Vec<BindGroupEntry> =
            buffers.iter().map(|(binding, r)| BindGroupEntry { binding: *binding, resource: r.clone() }).collect();
        gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &self.layout,
            entries: &entries,
        })
    }

    pub(super) fn run(&self, pass: &mut ComputePass<'_>, group: &BindGroup, size: Size<'_>) {
        pass.set_pipeline(&self.pipeline);
        pass.set_bind_group(0, group, &[]);
        match size {
            Size::Groups(x, y) => pass.dispatch_workgroups(x, y, 1),
            Size::Counted(buffer, offset) => pass.dispatch_workgroups_indirect(buffer, offset),
        }
    }
}

/// All of them.
pub(super) struct Pipelines {
    pub(super) check: Kernel,
    pub(super) move_means: Kernel,
    pub(super) project: Kernel,
    pub(super) reduce_drawn: Kernel,
    pub(super) reduce_tiles: Kernel,
    pub(super) scan_sums: Kernel,
    pub(super) compact: Kernel,
    pub(super) emit: Kernel,
    pub(super) count_digits: Kernel,
    pub(super) move_keys: Kernel,
    pub(super) find_ranges: Kernel,
    pub(super) blend: Kernel,
}

impl Pipelines {
    pub(super) fn new(gpu: &Gpu) -> Result<Self, GpuError> {
        let module = |shader: &Shader| {
            gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(shader.file),
                source: wgpu::ShaderSource::Wgsl(shader.source.into()),
            })
        };
        let (scan, sort) = (module(&shaders::SCAN), module(&shaders::SORT));
        let kernel = |module: &wgpu::ShaderModule, entry: &str| Kernel::new(gpu, module, entry);
        let pipelines = Self {
            check: kernel(&module(&shaders::CHECK), "check"),
            move_means: kernel(&module(&shaders::MOTION), "move_means"),
            project: kernel(&module(&shaders::PROJECT), "project"),
            reduce_drawn: kernel(&scan, "reduce_drawn"),
            reduce_tiles: kernel(&scan, "reduce_tiles"),
            scan_sums: kernel(&scan, "scan_sums"),
            compact: kernel(&scan, "compact"),
            emit: kernel(&scan, "emit"),
            count_digits: kernel(&sort, "count_digits"),
            move_keys: kernel(&sort, "move_keys"),
            find_ranges: kernel(&module(&shaders::RANGES), "find_ranges"),
            blend: kernel(&module(&shaders::BLEND), "blend"),
        };
        gpu.check()?;
        Ok(pipelines)
    }
}
