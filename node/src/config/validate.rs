//! Which values are accepted.

use storm_model::Precision;
use storm_model::network::{MAX_KV_POOL, MAX_MERGE};

use super::file::check_depth;
use super::{Config, ConfigError};

impl Config {
    /// Checks every value; the error names the key, the value and what is accepted.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let (sync, window) = (&self.sync, &self.window);
        between("sync.slop_sec", sync.slop_sec, 0.0, 10.0)?;
        between("sync.timeout_sec", sync.timeout_sec, 0.0, 60.0)?;
        between("sync.pose_wait_sec", sync.pose_wait_sec, 0.0, 60.0)?;
        between("sync.pose_gap_sec", sync.pose_gap_sec, 1e-6, 60.0)?;
        between("sync.starvation_sec", sync.starvation_sec, 0.1, 3600.0)?;
        count("sync.max_pending", sync.max_pending, 1, 100_000)?;
        between("sync.jump_back_sec", sync.jump_back_sec, 1e-3, 3600.0)?;
        between("sync.jump_forward_sec", sync.jump_forward_sec, 0.1, 86400.0)?;
        count("window.timesteps", window.timesteps, 1, 10)?;
        between("window.stride_sec", window.stride_sec, 1e-3, 60.0)?;
        between("window.hop_sec", window.hop_sec, 0.0, 60.0)?;
        between("window.stride_tolerance", window.stride_tolerance, 0.0, 0.5)?;
        between("window.timespan_sec", window.timespan_sec, 1e-3, 600.0)?;
        between("skip.still_m", self.skip.still_m, 0.0, 1.0)?;
        between("skip.still_deg", self.skip.still_deg, 0.0, 10.0)?;
        between("skip.still_sec", self.skip.still_sec, 0.0, 1.0)?;
        between("skip.still_sigmas", self.skip.still_sigmas, 1.0, 100.0)?;
        between("skip.still_levels", self.skip.still_levels, 0.0, 255.0)?;
        between("skip.predict_sec", self.skip.predict_sec, 0.0, 60.0)?;
        between("skip.predict_m", self.skip.predict_m, 0.0, 1000.0)?;
        between("skip.predict_deg", self.skip.predict_deg, 0.0, 180.0)?;
        between("skip.predict_levels", self.skip.predict_levels, 0.0, 255.0)?;
        between("skip.predict_px", self.skip.predict_px, 0.0, 10.0)?;
        count("skip.check_every", self.skip.check_every, 0, 1_000_000)?;
        between("skip.max_psnr_loss_db", self.skip.max_psnr_loss_db, 0.0, 100.0)?;
        between("skip.max_flow_change", self.skip.max_flow_change, 0.0, 100.0)?;
        between("skip.max_mask_change", self.skip.max_mask_change, 0.0, 1.0)?;
        count("skip.kv_pool", self.skip.kv_pool, 1, MAX_KV_POOL)?;
        between("skip.merge", self.skip.merge, 0.0, f64::from(MAX_MERGE))?;
        between("skip.sky_opacity", self.skip.sky_opacity, 0.0, 1.0)?;
        count("skip.sky_every", self.skip.sky_every, 0, 1_000_000)?;
        count("skip.reuse", self.skip.reuse, 0, 100)?;
        let skip = &self.skip;
        let others = [
            ("skip.kv_pool", skip.kv_pool > 1),
            ("skip.merge", skip.merge > 0.0),
            ("skip.newest_only", skip.newest_only),
            ("skip.sky", skip.sky),
        ];
        if let Some((key, _)) = others.iter().find(|(_, on)| *on && skip.reuse > 0) {
            let expected = format!("wants 0 together with {key}");
            return Err(ConfigError::Value { key: "skip.reuse", value: skip.reuse.to_string(), expected });
        }
        between("overlap.depth_gate", self.overlap.depth_gate, 0.0, 1.0)?;
        between("overlap.max_color_step", self.overlap.max_color_step, 0.0, 1.0)?;
        between("map.tile_m", self.map.tile_m, 1.0, 1000.0)?;
        // A tile's voxels are numbered with so many bits.
        let finest = self.map.tile_m / f64::from(crate::map::MAX_PER_EDGE);
        between("map.voxel_m (with map.tile_m)", self.map.voxel_m, finest.max(0.01), 100.0)?;
        between("map.depth_gate", self.map.depth_gate, 0.0, 1.0)?;
        between("map.moving_group_share", self.map.moving_group_share, 0.0, 1.0)?;
        between("map.save_every_sec", self.map.save_every_sec, 0.0, 86400.0)?;
        count("map.max_mb", self.map.max_mb, 1, 1 << 20)?;
        count("map.max_disk_mb", self.map.max_disk_mb, 0, 1 << 30)?;
        between("map.static_speed_mps", self.map.static_speed_mps, 0.0, 1000.0)?;
        between("map.min_opacity", self.map.min_opacity, 0.0, 1.0)?;
        between("map.max_depth_m", self.map.max_depth_m, 0.1, 1e4)?;
        count("map.max_gaussians", self.map.max_gaussians, 1, 100_000_000)?;
        between("tracks.min_speed_mps", self.tracks.min_speed_mps, 0.0, 1000.0)?;
        between("tracks.min_opacity", self.tracks.min_opacity, 0.0, 1.0)?;
        between("tracks.gate_m", self.tracks.gate_m, 1e-3, 100.0)?;
        between("tracks.gate_per_m", self.tracks.gate_per_m, 0.0, 1.0)?;
        between("tracks.max_gate_m", self.tracks.max_gate_m, 1e-3, 100.0)?;
        between("tracks.max_color_step", self.tracks.max_color_step, 0.0, 1.0)?;
        between("tracks.bridge_sec", self.tracks.bridge_sec, 0.0, 60.0)?;
        between("tracks.spacing_m", self.tracks.spacing_m, 1e-3, 100.0)?;
        count("tracks.min_points", self.tracks.min_points, 1, 1_000_000)?;
        count("tracks.max_active", self.tracks.max_active, 1, 10_000_000)?;
        between("objects.connect_m", self.objects.connect_m, 0.01, 100.0)?;
        between("objects.velocity_step_mps", self.objects.velocity_step_mps, 0.0, 100.0)?;
        between("objects.gate_m", self.objects.gate_m, 0.0, 100.0)?;
        between("objects.velocity_gate_mps", self.objects.velocity_gate_mps, 0.0, 200.0)?;
        between("objects.bridge_sec", self.objects.bridge_sec, 0.0, 60.0)?;
        between("objects.voxel_m", self.objects.voxel_m, 0.01, 10.0)?;
        count("objects.min_points", self.objects.min_points, 1, 1_000_000)?;
        count("objects.confirm_steps", self.objects.confirm_steps, 1, 1_000_000)?;
        count("objects.max_objects", self.objects.max_objects, 1, 1_000_000)?;
        between("output.min_opacity", self.output.min_opacity, 0.0, 1.0)?;
        between("output.map_every_sec", self.output.map_every_sec, 0.0, 3600.0)?;
        between("output.map_max_mb", self.output.map_max_mb, 0.01, 1024.0)?;
        count("output.report_steps", self.output.report_steps, 0, 1000)?;
        count("live.cameras", self.live.cameras, 0, crate::source::topics::MAX_CAMERAS)?;
        count("live.queue", self.live.queue, 1, 1000)?;
        between("live.silence_sec", self.live.silence_sec, 0.05, 3600.0)?;
        between("live.map_every_sec", self.live.map_every_sec, 0.05, 3600.0)?;
        between("live.map_max_mb", self.live.map_max_mb, 0.01, 1024.0)?;
        one_of("live.transport", &self.live.transport, &["auto", "raw", "compressed"])?;
        one_of("live.map", &self.live.map, &["auto", "always", "never"])?;
        one_of("live.reliability", &self.live.reliability, &["sensor_data", "reliable"])?;
        one_of("input.stamps", &self.input.stamps, &["header", "recorded"])?;
        one_of("model.precision", &self.model.precision, &Precision::ALL.map(|(_, name)| name))?;
        between("model.sweep_prior_sec", self.model.sweep_prior_sec, 0.0, 1.0)?;
        one_of("model.device", &self.model.device, &["cpu", "cuda", "metal"])?;
        for entry in &self.input.masks {
            if crate::source::masks::parse(entry).is_err() {
                let expected = "wants CAMERA=FILE, with the camera's number or image topic".to_owned();
                return Err(ConfigError::Value { key: "input.masks", value: format!("`{entry}`"), expected });
            }
        }
        for x in &self.input.image_time_offset_sec {
            between("input.image_time_offset_sec", *x, -4e9, 4e9)?;
        }
        for (i, mount) in self.input.base_from_camera.iter().enumerate() {
            let q: f64 = mount[3..].iter().map(|x| x * x).sum();
            if !(mount.iter().all(|x| x.is_finite()) && (0.99..1.01).contains(&q)) {
                let expected = format!("entry {i} wants seven finite numbers, the last four a unit quaternion w x y z");
                return Err(ConfigError::Value {
                    key: "input.base_from_camera",
                    value: format!("{mount:?}"),
                    expected,
                });
            }
        }
        let cameras = self.input.images.len();
        if self.input.rectified.values() != 1 {
            same_length("input.rectified", self.input.rectified.values(), cameras)?;
        }
        same_length("input.camera_infos", self.input.camera_infos.len(), cameras)?;
        same_length("input.base_from_camera", self.input.base_from_camera.len(), cameras)?;
        same_length("input.image_time_offset_sec", self.input.image_time_offset_sec.len(), cameras)?;
        // Names may hold brackets, and are written in another order than they were read in: what is accepted can be read again.
        check_depth("the configuration as it would be written", &self.to_yaml())
    }
}

fn between(key: &'static str, x: f64, low: f64, high: f64) -> Result<(), ConfigError> {
    // Phrased as what is accepted, so that NaN is refused.
    if x >= low && x <= high {
        return Ok(());
    }
    Err(ConfigError::Value { key, value: x.to_string(), expected: format!("wants {low} to {high}") })
}

fn count(key: &'static str, x: usize, low: usize, high: usize) -> Result<(), ConfigError> {
    if (low..=high).contains(&x) {
        return Ok(());
    }
    Err(ConfigError::Value { key, value: x.to_string(), expected: format!("wants {low} to {high}") })
}

fn one_of(key: &'static str, x: &str, allowed: &[&str]) -> Result<(), ConfigError> {
    if allowed.contains(&x) {
        return Ok(());
    }
    Err(ConfigError::Value { key, value: x.into(), expected: format!("wants one of {}", allowed.join(", ")) })
}

/// A per-camera list must be empty or have one entry per camera; with unnamed cameras any length may fit.
fn same_length(key: &'static str, n: usize, cameras: usize) -> Result<(), ConfigError> {
    if n == 0 || cameras == 0 || n == cameras {
        return Ok(());
    }
    let expected = format!("wants no entry or one per image topic ({cameras})");
    Err(ConfigError::Value { key, value: format!("{n} entries"), expected })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn out_of_range_values_are_named() {
        let mut c = Config::default();
        c.window.stride_sec = f64::NAN;
        let e = c.validate().unwrap_err().to_string();
        assert!(e.contains("window.stride_sec") && e.contains("NaN"), "{e}");
        let mut c = Config::default();
        c.window.timesteps = 11;
        assert!(c.validate().unwrap_err().to_string().contains("11"));
        assert!(Config::default().validate().is_ok());
    }
}
