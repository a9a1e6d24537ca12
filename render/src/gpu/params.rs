//! The small numbers the shaders read: one view, one pass of the sort, one chunk of channels.

use crate::camera::View;
use crate::raster::{Convention, RasterSettings, TILE_RULE};
use bytemuck::{Pod, Zeroable};

/// Distance between the entries of a uniform buffer, bytes: the portable alignment of an offset.
pub(super) const UNIFORM_STRIDE: u64 = 256;
/// Bits per pass of the sort.
const DIGIT_BITS: u32 = 4;
/// Passes a 32-bit key takes.
pub(super) const MAX_PASSES: u32 = u32::BITS / DIGIT_BITS;
/// Channels per dispatch of the blending.
pub(super) const CHUNK_CHANNELS: usize = 4;

/// `View` of `common.wgsl`, field by field.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, Pod, Zeroable)]
pub(super) struct ViewParams {
    rows_of_pose: [[f32; 4]; 3],
    focal: [f32; 2],
    center: [f32; 2],
    size: [f32; 2],
    clamp_min: [f32; 2],
    clamp_max: [f32; 2],
    near: f32,
    far: f32,
    radius_clip: f32,
    blur: f32,
    alpha_cap: f32,
    convention: u32,
    splats: u32,
    time: f32,
    width: u32,
    height: u32,
    columns: u32,
    rows: u32,
    capacity: u32,
    unused: u32,
}

impl ViewParams {
    /// What `motion.wgsl` reads.
    pub(super) fn of_time(splats: u32, time: f32) -> Self {
        Self { splats, time, ..Self::default() }
    }

    /// A validated view of a scene whose tile lists have room for `capacity` entries.
    pub(super) fn new(view: &View, settings: &RasterSettings, splats: u32, capacity: u32) -> Self {
        let columns_of_pose = view.camera_from_world.matrix3.to_cols_array_2d();
        let translation = view.camera_from_world.translation.to_array();
        let k = &view.intrinsics;
        let (focal, center) = ([k.fx, k.fy], [k.cx, k.cy]);
        let size = [k.width as f32, k.height as f32];
        let (mut clamp_min, mut clamp_max) = ([0.0; 2], [0.0; 2]);
        for axis in 0..2 {
            // In f64 as on the CPU; the shader gets the rounded result.
            let [focal, center, size] = [focal[axis], center[axis], size[axis]].map(f64::from);
            let tan_half_fov = 0.5 * size / focal;
            let (low, high) = match settings.convention {
                Convention::Pinned => (-1.3 * tan_half_fov, 1.3 * tan_half_fov),
                Convention::Latest => {
                    (-(center / focal + 0.3 * tan_half_fov), (size - center) / focal + 0.3 * tan_half_fov)
                }
            };
            (clamp_min[axis], clamp_max[axis]) = (low as f32, high as f32);
        }
        let [columns, rows] = tiles_of(view);
        Self {
            rows_of_pose: std::array::from_fn(|r| {
                std::array::from_fn(|c| columns_of_pose.get(c).map_or(translation[r], |column| column[r]))
            }),
            focal,
            center,
            size,
            clamp_min,
            clamp_max,
            near: settings.near,
            far: settings.far,
            radius_clip: settings.radius_clip,
            blur: settings.blur,
            alpha_cap: settings.convention.alpha_cap(),
            convention: u32::from(settings.convention == Convention::Latest),
            splats,
            time: 0.0,
            width: k.width as u32,
            height: k.height as u32,
            columns,
            rows,
            capacity,
            unused: 0,
        }
    }
}

/// Columns and rows of 16x16 tiles.
pub(super) fn tiles_of(view: &View) -> [u32; 2] {
    [view.intrinsics.width, view.intrinsics.height].map(|side| side.div_ceil(TILE_RULE) as u32)
}

/// Passes that sort depths between the clip planes (their bits minus those of `near`).
pub(super) fn depth_passes(settings: &RasterSettings) -> u32 {
    passes_for(settings.far.to_bits().saturating_sub(settings.near.to_bits()))
}

/// Passes that sort tile numbers, one number more than there are tiles (see `emit_one` in `scan.wgsl`).
pub(super) fn tile_passes(view: &View) -> u32 {
    let [columns, rows] = tiles_of(view);
    passes_for(columns * rows)
}

/// Passes for keys up to `largest`.
fn passes_for(largest: u32) -> u32 {
    (u32::BITS - largest.leading_zeros()).div_ceil(DIGIT_BITS)
}

/// What a scan or a sorting pass works on: `Step` of `scan.wgsl` and `sort.wgsl`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Step {
    /// Which splats have a tile.
    Drawn,
    /// How many tiles each splat has.
    Tiles,
    /// A pass of the depth sort.
    DepthDigit(u32),
    /// A pass of the tile sort.
    TileDigit(u32),
}

impl Step {
    /// Every step, in the order of [`offset`](Self::offset).
    pub(super) fn all() -> impl Iterator<Item = Self> {
        let digits = (0..MAX_PASSES).map(Self::DepthDigit).chain((0..MAX_PASSES).map(Self::TileDigit));
        [Self::Drawn, Self::Tiles].into_iter().chain(digits)
    }

    /// Place in the uniform buffer of steps, bytes.
    pub(super) fn offset(self) -> u64 {
        let index = match self {
            Self::Drawn => 0,
            Self::Tiles => 1,
            Self::DepthDigit(pass) => 2 + pass,
            Self::TileDigit(pass) => 2 + MAX_PASSES + pass,
        };
        u64::from(index) * UNIFORM_STRIDE
    }

    /// `shift`, `scan` and padding.
    pub(super) fn words(self) -> [u32; 4] {
        match self {
            Self::Drawn => [0, 0, 0, 0],
            Self::Tiles => [0, 1, 0, 0],
            Self::DepthDigit(pass) => [pass * DIGIT_BITS, 2, 0, 0],
            Self::TileDigit(pass) => [pass * DIGIT_BITS, 3, 0, 0],
        }
    }
}

/// Entries of a uniform buffer, each at its stride.
pub(super) fn strided<T: Pod>(entries: impl Iterator<Item = T>) -> Vec<u8> {
    let mut bytes = Vec::new();
    for entry in entries {
        let start = bytes.len();
        bytes.extend_from_slice(bytemuck::bytes_of(&entry));
        bytes.resize(start + UNIFORM_STRIDE as usize, 0);
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn passes_cover_their_keys() {
        assert_eq!(passes_for(0), 0);
        assert_eq!(passes_for(15), 1);
        assert_eq!(passes_for(16), 2);
        assert_eq!(passes_for(u32::MAX), MAX_PASSES);
        // 0.2 m to 400 m are eleven octaves: 27 bits.
        assert_eq!(depth_passes(&RasterSettings::default()), 7);
    }

    #[test]
    fn steps_lie_where_their_offsets_say() {
        for (index, step) in Step::all().enumerate() {
            assert_eq!(step.offset(), index as u64 * UNIFORM_STRIDE, "{step:?}");
        }
        assert_eq!(strided(Step::all().map(Step::words)).len() as u64, 18 * UNIFORM_STRIDE);
    }
}
