//! Which configurations a network can be built from.

use super::ModelConfig;
use crate::error::ModelError;

/// Most timesteps in a window.
pub const MAX_TIMESTEPS: usize = 10;

/// Most cameras in a window.
pub const MAX_CAMERAS: usize = 6;

/// Largest picture side, pixels: past it a window's Gaussians do not fit a vehicle computer.
const MAX_SIDE: usize = 4096;

/// Largest layer width; four times the largest published model, and small enough that no product of two overflows.
const MAX_WIDTH: usize = 8192;

/// Most variance added to a splat, square pixels: past two pixels of standard deviation nothing sharp is left.
const MAX_BLUR_PX2: f64 = 4.0;

/// A sweep divides a patch into four cells a side.
const LEAST_SWEPT_PATCH: usize = 4;

fn in_range(field: &'static str, value: usize, low: usize, high: usize) -> Result<(), ModelError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(ModelError::Config { field, value: value.to_string(), fix: format!("use {low} to {high}") })
}

fn number(field: &'static str, value: f64, ok: bool, fix: &str) -> Result<(), ModelError> {
    if value.is_finite() && ok {
        return Ok(());
    }
    Err(ModelError::Config { field, value: value.to_string(), fix: fix.to_owned() })
}

impl ModelConfig {
    /// Checks every field; the error names the first one that cannot work and what would.
    pub fn validate(&self) -> Result<(), ModelError> {
        self.validate_sizes()?;
        self.validate_numbers()
    }

    fn validate_sizes(&self) -> Result<(), ModelError> {
        in_range("patch_size", self.patch_size, 2, 32)?;
        if !self.patch_size.is_power_of_two() {
            let value = self.patch_size.to_string();
            return Err(ModelError::Config { field: "patch_size", value, fix: "use a power of two".into() });
        }
        in_range("embed_dim", self.embed_dim, 1, MAX_WIDTH)?;
        in_range("depth", self.depth, 1, 64)?;
        in_range("num_heads", self.num_heads, 1, MAX_WIDTH)?;
        if !self.embed_dim.is_multiple_of(self.num_heads) {
            return Err(ModelError::Config {
                field: "num_heads",
                value: self.num_heads.to_string(),
                fix: format!("use a divisor of embed_dim {}", self.embed_dim),
            });
        }
        in_range("mlp_ratio", self.mlp_ratio, 1, 16)?;
        for (field, side) in [("image_height", self.image_height), ("image_width", self.image_width)] {
            in_range(field, side, self.patch_size, MAX_SIDE)?;
            if !side.is_multiple_of(self.patch_size) {
                let fix = format!("use a multiple of patch_size {}", self.patch_size);
                return Err(ModelError::Config { field, value: side.to_string(), fix });
            }
        }
        if self.sweep_after_block >= self.depth {
            let value = self.sweep_after_block.to_string();
            let fix = format!("use 0 (no sweep) to {}: at least one block must follow", self.depth - 1);
            return Err(ModelError::Config { field: "sweep_after_block", value, fix });
        }
        if self.sweep_after_block > 0 && self.patch_size < LEAST_SWEPT_PATCH {
            let fix = format!("use {LEAST_SWEPT_PATCH} or more with sweep_after_block, or sweep_after_block 0");
            return Err(ModelError::Config { field: "patch_size", value: self.patch_size.to_string(), fix });
        }
        in_range("num_cams", self.num_cams, 1, MAX_CAMERAS)?;
        in_range("num_motion_tokens", self.num_motion_tokens, 0, 256)?;
        in_range("projected_motion_dim", self.projected_motion_dim, 1, MAX_WIDTH)?;
        in_range("key_hidden", self.key_hidden, 1, MAX_WIDTH)?;
        in_range("basis_hidden", self.basis_hidden, 1, MAX_WIDTH)?;
        let stages = self.patch_size.trailing_zeros() as usize;
        if !(1..=stages).contains(&self.upsampler_widths.len()) {
            return Err(ModelError::Config {
                field: "upsampler_widths",
                value: format!("{:?}", self.upsampler_widths),
                fix: format!("use 1 to {stages} widths: patch_size {} is doubled back {stages} times", self.patch_size),
            });
        }
        self.upsampler_widths.iter().try_for_each(|&width| in_range("upsampler_widths", width, 1, MAX_WIDTH))
    }

    fn validate_numbers(&self) -> Result<(), ModelError> {
        number("tau", self.tau, self.tau > 0.0, "use a positive number")?;
        number("velocity_scale", self.velocity_scale, self.velocity_scale > 0.0, "use a positive number")?;
        number("near", self.near, self.near > 0.0, "use a positive number of metres")?;
        number("far", self.far, self.far > self.near, "use a number of metres greater than near")?;
        number("ray_moment_scale", self.ray_moment_scale, self.ray_moment_scale > 0.0, "use a positive number")?;
        number("scale_offset", self.scale_offset, true, "use a finite number")?;
        number("max_scale", self.max_scale, self.max_scale > 0.0, "use a positive number of metres")?;
        number("opacity_offset", self.opacity_offset, true, "use a finite number")?;
        number("flow_gate_mps", self.flow_gate_mps, self.flow_gate_mps >= 0.0, "use 0 (off) or more, m/s")?;
        number("time_fade_sec", self.time_fade_sec, self.time_fade_sec >= 0.0, "use 0 (off) or more, seconds")?;
        let blur = self.screen_blur_px2;
        number("screen_blur_px2", blur, (0.0..=MAX_BLUR_PX2).contains(&blur), "use 0 to 4 square pixels")
    }
}
