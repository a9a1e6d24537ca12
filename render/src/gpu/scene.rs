//! The Gaussians on the device.

use super::buffers::Grown;
use super::device::Gpu;
use super::error::GpuError;
use super::params::ViewParams;
use super::pipelines::{Pipelines, Size};
use crate::raster::Splats;

/// Invocations of a workgroup.
pub(super) const WORKGROUP: u32 = 256;

/// What was uploaded.
pub(super) struct Scene {
    pub(super) means: Grown,
    pub(super) quats: Grown,
    pub(super) scales: Grown,
    opacities: Grown,
    pub(super) features: Grown,
    /// Opacity bits of usable Gaussians (`check.wgsl`).
    pub(super) solid: Grown,
    /// How many are not usable.
    pub(super) invalid: Grown,
    params: Grown,
    pub(super) splats: u32,
    pub(super) channels: u32,
}

impl Scene {
    pub(super) fn new(gpu: &Gpu) -> Self {
        let storage = |name| Grown::storage(gpu, name);
        Self {
            means: storage("bytes of means"),
            quats: storage("bytes of quaternions"),
            scales: storage("bytes of scales"),
            opacities: storage("bytes of opacities"),
            features: storage("bytes of features"),
            solid: storage("bytes of usable opacities"),
            invalid: storage("bytes of counts"),
            params: Grown::uniform(gpu, "bytes of scene parameters"),
            splats: 0,
            channels: 0,
        }
    }

    /// Copies validated splats to the device and finds the usable ones.
    pub(super) fn upload(&mut self, gpu: &Gpu, kernels: &Pipelines, splats: &Splats) -> Result<(), GpuError> {
        // Nothing is left to draw should a later step fail.
        (self.splats, self.channels) = (0, splats.feature_count as u32);
        let threads = u64::from(gpu.limits.max_compute_workgroups_per_dimension) * u64::from(WORKGROUP);
        gpu.fits("Gaussians", splats.len() as u64, threads)?;
        self.means.upload(gpu, bytemuck::cast_slice(splats.means))?;
        self.quats.upload(gpu, bytemuck::cast_slice(splats.quats))?;
        self.scales.upload(gpu, bytemuck::cast_slice(splats.scales))?;
        self.opacities.upload(gpu, bytemuck::cast_slice(splats.opacities))?;
        self.features.upload(gpu, bytemuck::cast_slice(splats.features))?;
        self.solid.reserve(gpu, 4 * splats.len() as u64)?;
        let n = splats.len() as u32;
        self.params.upload(gpu, bytemuck::bytes_of(&ViewParams::of_scene(n, self.channels)))?;

        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.clear_buffer(self.invalid.raw(), 0, None);
        let group = kernels.check.bind(
            gpu,
            &[
                (0, self.params.all()),
                (1, self.means.all()),
                (2, self.quats.all()),
                (3, self.scales.all()),
                (4, self.opacities.all()),
                (5, self.features.all()),
                (6, self.solid.all()),
                (7, self.invalid.all()),
            ],
        );
        let mut pass = encoder.begin_compute_pass(&Default::default());
        kernels.check.run(&mut pass, &group, Size::Groups(n.div_ceil(WORKGROUP), 1));
        drop(pass);
        gpu.queue.submit([encoder.finish()]);
        gpu.check()?;
        self.splats = n;
        Ok(())
    }
}
