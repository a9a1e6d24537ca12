//! What the work would take if memory or arithmetic alone set the pace.

use super::measure::Peaks;
use serde_json::{Value, json};
use storm_render::raster::{RasterStats, RasterWork};

/// Bytes of a splat in a tile's list and beside it, written once and read once: record, depth, index.
const RECORD_BYTES: f64 = 2.0 * 40.0;
/// Bytes of a list entry's ways: to its chunk's list, to the tile's, through three passes of the sort.
const KEY_BYTES: f64 = 8.0 * 10.0;
/// Operations of a Gaussian's first look in a view and of its ellipse, in f64, which takes twice the room of f32.
const LOOK_FLOPS: f64 = 2.0 * 40.0;
const ELLIPSE_FLOPS: f64 = 2.0 * 260.0;
/// Operations of one pixel: falloff, exponential, alpha, weight; and of each channel.
const PIXEL_FLOPS: f64 = 34.0;
const CHANNEL_FLOPS: f64 = 2.0;
/// The same backward, on top.
const BACK_PIXEL_FLOPS: f64 = 60.0;
const BACK_CHANNEL_FLOPS: f64 = 4.0;
/// Sums of a pair besides the channels.
const MOMENTS: f64 = 7.0;

/// Lower bounds of one call, milliseconds on all cores.
pub struct Floor {
    pub memory_ms: f64,
    pub arithmetic_ms: Option<f64>,
}

impl Floor {
    pub fn new(
        peaks: &Peaks,
        stats: &RasterStats,
        work: &RasterWork,
        channels: usize,
        pixels: usize,
        backward: bool,
    ) -> Self {
        let (n, c) = (stats.splats as f64, channels as f64);
        let (listed, pairs, pixels) = (work.listed as f64, stats.pairs as f64, pixels as f64);
        let mut bytes = n * (44.0 + 4.0 * c) + listed * RECORD_BYTES + pairs * KEY_BYTES + pixels * 4.0 * (c + 2.0);
        let looks = (stats.visible + stats.culled) as f64;
        let shaded = 8.0 * work.sweeps as f64;
        let mut flops = looks * LOOK_FLOPS
            + stats.visible as f64 * ELLIPSE_FLOPS
            + shaded * (PIXEL_FLOPS + CHANNEL_FLOPS * (c + 2.0));
        if backward {
            bytes += pairs * 2.0 * 4.0 * (MOMENTS + c) + n * 2.0 * (44.0 + 4.0 * c) + pixels * 8.0 * (c + 3.0);
            flops += shaded * (BACK_PIXEL_FLOPS + BACK_CHANNEL_FLOPS * c) + listed * ELLIPSE_FLOPS;
        }
        let arithmetic_ms = peaks.flops_per_ms.map(|rate| flops / rate);
        Self { memory_ms: bytes / peaks.bytes_per_ms, arithmetic_ms }
    }

    pub fn json(&self) -> Value {
        json!({"memory_ms": self.memory_ms, "arithmetic_ms": self.arithmetic_ms})
    }
}

impl std::fmt::Display for Floor {
    fn fmt(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
        let arithmetic = self.arithmetic_ms.map_or("-".into(), |ms| format!("{ms:.1}"));
        write!(f, "floor: memory {:.1} ms, arithmetic {arithmetic} ms", self.memory_ms)
    }
}
