//! The Gaussians on the device.

use super::buffers::Grown;
use super::device::Gpu;
use super::error::GpuError;
use super::params::{UNIFORM_STRIDE, ViewParams, strided};
use super::pipelines::{Pipelines, Size};
use crate::raster::{Motion, Splats};
use std::borrow::Cow;

/// Invocations of a workgroup.
pub(super) const WORKGROUP: u32 = 256;
/// Bytes of `Part` in `check.wgsl`.
const PART_BYTES: u64 = 16;
/// Channels of all parts but the last are a multiple of this, as blending takes four at a time.
const PART_STEP: u64 = 4;

/// Channels of every Gaussian that fit one binding, row-major.
pub(super) struct Part {
    pub(super) buffer: Grown,
    /// First channel.
    pub(super) first: u32,
    /// How many.
    pub(super) channels: u32,
}

/// Buffers of the motion, and what comes of it.
struct Moving {
    backward: Grown,
    forward: Grown,
    times: Grown,
    means: Grown,
    solid: Grown,
    /// The Gaussians of now move.
    on: bool,
    /// The time that `means` and `solid` are of.
    placed_sec: Option<f32>,
}

/// What was uploaded.
pub(super) struct Scene {
    means: Grown,
    pub(super) quats: Grown,
    pub(super) scales: Grown,
    opacities: Grown,
    /// One or more parts; the buffers of earlier scenes stay behind them.
    features: Vec<Part>,
    parts: usize,
    /// Opacity bits of usable Gaussians (`check.wgsl`).
    solid: Grown,
    /// How many are not usable.
    pub(super) invalid: Grown,
    /// How many of the others have no place at the time drawn.
    pub(super) lost: Grown,
    moving: Moving,
    params: Grown,
    time: Grown,
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
            features: Vec::new(),
            parts: 0,
            solid: storage("bytes of usable opacities"),
            invalid: storage("bytes of counts"),
            lost: storage("bytes of counts"),
            moving: Moving {
                backward: storage("bytes of backward velocities"),
                forward: storage("bytes of forward velocities"),
                times: storage("bytes of times"),
                means: storage("bytes of moved means"),
                solid: storage("bytes of placed opacities"),
                on: false,
                placed_sec: None,
            },
            params: Grown::uniform(gpu, "bytes of scene parameters"),
            time: Grown::uniform(gpu, "bytes of motion parameters"),
            splats: 0,
            channels: 0,
        }
    }

    /// The parts that hold the features.
    pub(super) fn features(&self) -> &[Part] {
        self.features.get(..self.parts).unwrap_or_default()
    }

    /// Centres at the time placed last; as uploaded before that.
    pub(super) fn means_now(&self) -> &Grown {
        if self.moving.placed_sec.is_some() { &self.moving.means } else { &self.means }
    }

    /// Opacities of what can be drawn at that time.
    pub(super) fn solid_now(&self) -> &Grown {
        if self.moving.placed_sec.is_some() { &self.moving.solid } else { &self.solid }
    }

    /// Copies validated splats to the device and finds the usable ones.
    pub(super) fn upload(
        &mut self,
        gpu: &Gpu,
        kernels: &Pipelines,
        splats: &Splats,
        motion: Option<&Motion>,
    ) -> Result<(), GpuError> {
        // Nothing is left to draw should a later step fail.
        (self.splats, self.channels, self.parts) = (0, splats.feature_count as u32, 0);
        let threads = u64::from(gpu.limits.max_compute_workgroups_per_dimension) * u64::from(WORKGROUP);
        gpu.fits("Gaussians", splats.len() as u64, threads)?;
        self.means.upload(gpu, bytemuck::cast_slice(splats.means))?;
        self.quats.upload(gpu, bytemuck::cast_slice(splats.quats))?;
        self.scales.upload(gpu, bytemuck::cast_slice(splats.scales))?;
        self.opacities.upload(gpu, bytemuck::cast_slice(splats.opacities))?;
        self.upload_features(gpu, splats)?;
        self.solid.reserve(gpu, 4 * splats.len() as u64)?;
        let n = splats.len() as u32;
        let parts = self.features().iter().enumerate();
        let words = strided(parts.map(|(index, part)| [n, part.channels, u32::from(index > 0), 0]));
        self.params.upload(gpu, &words)?;
        (self.moving.on, self.moving.placed_sec) = (motion.is_some(), None);
        if let Some(motion) = motion {
            self.moving.backward.upload(gpu, bytemuck::cast_slice(motion.velocity_backward))?;
            self.moving.forward.upload(gpu, bytemuck::cast_slice(motion.velocity_forward))?;
            self.moving.times.upload(gpu, bytemuck::cast_slice(motion.time_sec))?;
            self.moving.means.reserve(gpu, 12 * u64::from(n))?;
            self.moving.solid.reserve(gpu, 4 * u64::from(n))?;
        }

        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.clear_buffer(self.invalid.raw(), 0, None);
        encoder.clear_buffer(self.lost.raw(), 0, None);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        for (index, part) in self.features().iter().enumerate() {
            let buffers = [
                (0, self.params.entry(index as u64 * UNIFORM_STRIDE, PART_BYTES)),
                (1, self.means.all()),
                (2, self.quats.all()),
                (3, self.scales.all()),
                (4, self.opacities.all()),
                (5, part.buffer.all()),
                (6, self.solid.all()),
                (7, self.invalid.all()),
            ];
            let group = kernels.check.bind(gpu, &buffers);
            kernels.check.run(&mut pass, &group, Size::Groups(n.div_ceil(WORKGROUP), 1));
        }
        drop(pass);
        gpu.queue.submit([encoder.finish()]);
        gpu.check()?;
        self.splats = n;
        Ok(())
    }

    /// Features to the device: one buffer where they fit a binding, else several of as many channels as fit.
    fn upload_features(&mut self, gpu: &Gpu, splats: &Splats) -> Result<(), GpuError> {
        let (n, all) = (splats.len(), splats.feature_count);
        let fitting = gpu.largest_binding() / (4 * n.max(1) as u64);
        let step = if all as u64 <= fitting { all } else { (fitting - fitting % PART_STEP) as usize };
        if step == 0 && all > 0 {
            // Not even four channels fit: as any buffer that is too large.
            return gpu.fits("bytes of features", 4 * PART_STEP * n as u64, gpu.largest_binding());
        }
        // Without channels one part without any, so that everything else is looked at.
        for first in (0..all.max(1)).step_by(step.max(1)) {
            let channels = step.min(all - first.min(all));
            if self.features.len() == self.parts {
                let buffer = Grown::storage(gpu, "bytes of features");
                self.features.push(Part { buffer, first: 0, channels: 0 });
            }
            let Some(part) = self.features.get_mut(self.parts) else { break };
            (part.first, part.channels) = (first as u32, channels as u32);
            let values: Cow<[f32]> = if channels == all {
                Cow::Borrowed(splats.features)
            } else {
                splats.features.chunks_exact(all).flat_map(|row| &row[first..first + channels]).copied().collect()
            };
            part.buffer.upload(gpu, bytemuck::cast_slice(&values))?;
            self.parts += 1;
        }
        Ok(())
    }

    /// Moves the Gaussians to where they are at a time, unless they are there.
    pub(super) fn place(&mut self, gpu: &Gpu, kernels: &Pipelines, draw_sec: f32) -> Result<(), GpuError> {
        if !self.moving.on || self.moving.placed_sec == Some(draw_sec) {
            return Ok(());
        }
        self.moving.placed_sec = None;
        self.time.upload(gpu, bytemuck::bytes_of(&ViewParams::of_time(self.splats, draw_sec)))?;
        let moving = &self.moving;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.clear_buffer(self.lost.raw(), 0, None);
        let buffers = [
            (0, self.time.all()),
            (1, self.means.all()),
            (2, moving.backward.all()),
            (3, moving.forward.all()),
            (4, moving.times.all()),
            (5, self.solid.all()),
            (6, moving.means.all()),
            (7, moving.solid.all()),
            (8, self.lost.all()),
        ];
        let group = kernels.move_means.bind(gpu, &buffers);
        let mut pass = encoder.begin_compute_pass(&Default::default());
        kernels.move_means.run(&mut pass, &group, Size::Groups(self.splats.div_ceil(WORKGROUP), 1));
        drop(pass);
        gpu.queue.submit([encoder.finish()]);
        gpu.check()?;
        self.moving.placed_sec = Some(draw_sec);
        Ok(())
    }
}
