//! One tile, front to back: each splat sweeps the rows of its box, eight pixels at a time, and leaves its weights; then
//! every channel is one multiply-add per row, so that more channels cost little.

use super::grid::{TILE_H, TILE_W};
use super::settings::{ALPHA_FLOOR, ALPHA_MIN, TRANSMITTANCE_STOP};
use super::simd::{dispatch, exp2_neg_lanes, fma};
use super::tile::{
    BATCH, Cut, EDGE, Finished, PITCH, Row, TileEnd, TileInput, WIDTH, is_live, low_bits, mask, prefetch_records,
};

/// Channels every picture has: `sum(w)` and `sum(w z)`.
const BASE_PLANES: usize = 2;
/// Sign bit of an f32.
const SIGN: u32 = 1 << 31;

/// The part of one picture row that a tile owns.
pub(crate) struct RowOut<'a> {
    pub(crate) features: &'a mut [f32],
    pub(crate) alpha: &'a mut [f32],
    pub(crate) depth: &'a mut [f32],
}

/// Buffers of one tile, reused.
pub(crate) struct Scratch {
    /// Transmittance; negated once the pixel is finished, 0 outside the picture.
    transmittance: [Row; TILE_H],
    /// Per tile row: `sum(w)`, `sum(w z)`, then the features.
    sums: Vec<Row>,
    /// Per row, a bit for each unfinished pixel.
    live: [u32; TILE_H],
    /// Splats to blend now, and those to blend next.
    batch: Vec<Cut>,
    fetched: Vec<Cut>,
    finished: Vec<Finished>,
    /// Splats blended so far, and the runs of eight pixels that took.
    pub(crate) blended: usize,
    pub(crate) sweeps: usize,
    /// For sorting.
    pub(crate) spare_keys: Vec<u64>,
}

impl Scratch {
    pub(crate) fn new() -> Self {
        Self {
            transmittance: [[0.0; PITCH]; TILE_H],
            sums: Vec::new(),
            live: [0; TILE_H],
            batch: Vec::with_capacity(BATCH),
            fetched: Vec::with_capacity(BATCH),
            finished: Vec::new(),
            blended: 0,
            sweeps: 0,
            spare_keys: Vec::new(),
        }
    }

    fn reset(&mut self, width: usize, height: usize, planes: usize) {
        self.sums.clear();
        self.sums.resize(TILE_H * planes, [0.0; PITCH]);
        self.finished.clear();
        (self.blended, self.sweeps) = (0, 0);
        for y in 0..TILE_H {
            let row_width = if y < height { width.min(TILE_W) } else { 0 };
            self.live[y] = low_bits(row_width);
            self.transmittance[y][..row_width].fill(1.0);
            self.transmittance[y][row_width..].fill(0.0);
        }
    }

    /// Keeps how the tile ended.
    pub(crate) fn keep(&self, end: &mut TileEnd) {
        end.keep(&self.transmittance, &self.finished);
    }

    /// Writes the tile into its rows of the picture.
    pub(crate) fn write(&self, rows: &mut [RowOut], feature_count: usize) {
        let planes = BASE_PLANES + feature_count;
        for (row, sums) in rows.iter_mut().zip(self.sums.chunks_exact(planes)) {
            let [weight, weighted_depth, features @ ..] = sums else { continue };
            let pixels = row.alpha.iter_mut().zip(row.depth.iter_mut());
            for ((alpha, depth), (w, wz)) in pixels.zip(weight.iter().zip(weighted_depth)) {
                *alpha = w.min(1.0);
                *depth = wz / w.max(ALPHA_FLOOR);
            }
            for (channel, source) in features.iter().enumerate() {
                for (pixel, &value) in row.features.chunks_exact_mut(feature_count).zip(source) {
                    // Weights add up to 1 give or take rounding, which features near f32::MAX do not forgive.
                    pixel[channel] = value.clamp(f32::MIN, f32::MAX);
                }
            }
        }
    }
}

dispatch!(
    /// Blends the splats of a tile into `scratch`.
    blend_tile, blend_tile_kernel, (input: &TileInput<'_>, scratch: &mut Scratch)
);

#[inline(always)]
fn blend_tile_kernel<const FMA: bool>(input: &TileInput, scratch: &mut Scratch) {
    scratch.reset(input.width, input.height, BASE_PLANES + input.features.count);
    let batch = |index: usize| {
        let keys = input.keys.get(index * BATCH..).unwrap_or_default();
        keys.get(..BATCH).unwrap_or(keys)
    };
    // While one batch is blended, the next has its features on the way and the one after that its records.
    prefetch_records(input, batch(0));
    prefetch_records(input, batch(1));
    fetch(input, 0, batch(0), scratch);
    for index in 0..input.keys.len().div_ceil(BATCH) {
        std::mem::swap(&mut scratch.batch, &mut scratch.fetched);
        prefetch_records(input, batch(index + 2));
        fetch(input, (index + 1) * BATCH, batch(index + 1), scratch);
        let Scratch { transmittance, sums, live, finished, batch, blended, sweeps, .. } = &mut *scratch;
        for cut in batch.iter() {
            if is_live(live, cut) {
                *blended += 1;
                *sweeps += (cut.x1 - cut.x0).div_ceil(WIDTH) * (cut.y1 - cut.y0);
                blend_splat::<FMA>(input, cut, transmittance, sums, live, finished);
            }
        }
        if scratch.live.iter().fold(0, |a, b| a | b) == 0 {
            break;
        }
    }
}

/// Reads the records of a batch, keeps the splats that may still add something, and asks for their features.
#[inline(always)]
fn fetch(input: &TileInput, first: usize, keys: &[u64], scratch: &mut Scratch) {
    scratch.fetched.clear();
    for (offset, &key) in keys.iter().enumerate() {
        let cut = Cut::new(input, first + offset, key);
        if is_live(&scratch.live, &cut) {
            input.features.prefetch(cut.id);
            scratch.fetched.push(cut);
        }
    }
}

/// Blends one splat, strip by strip of eight columns.
#[inline(always)]
fn blend_splat<const FMA: bool>(
    input: &TileInput,
    cut: &Cut,
    transmittance: &mut [Row; TILE_H],
    sums: &mut [Row],
    live: &mut [u32; TILE_H],
    done: &mut Vec<Finished>,
) {
    let record = &cut.record;
    let features = input.features.of(cut.id);
    let planes = BASE_PLANES + features.len();
    // The tile's corner seen from the centre; the whole numbers are exact, so small boxes keep all digits.
    let left = (input.x0 as f32 - f32::from(record.x0)) + 0.5;
    let top = (input.y0 as f32 - f32::from(record.y0)) + 0.5;
    for strip in (cut.x0..cut.x1).step_by(WIDTH) {
        // Outside the box (the rule's tiles may cut the ellipse short) alpha becomes 0.
        let mut dx = EDGE[(cut.x1 - strip).min(WIDTH)];
        let first = left + strip as f32 - record.u;
        for l in 0..WIDTH {
            dx[l] += first + l as f32;
        }
        let mut finished = [0u32; WIDTH];
        let rows = transmittance[cut.y0..cut.y1].iter_mut();
        // Not `chunks_exact_mut`: its length is a division, which costs as much as a row.
        let mut rest = &mut sums[cut.y0 * planes..];
        for (y, row) in (cut.y0..cut.y1).zip(rows) {
            let Some((sums, after)) = std::mem::take(&mut rest).split_at_mut_checked(planes) else { break };
            rest = after;
            let dy = top + y as f32 - record.v;
            let shift = record.slope * dy;
            let along = record.along * dy * dy;
            let Some(before) = row[strip..].first_chunk_mut::<WIDTH>() else { continue };
            let mut falloff = [0.0; WIDTH];
            for l in 0..WIDTH {
                let across = dx[l] - shift;
                falloff[l] = fma::<FMA>(record.across * across, across, along);
            }
            exp2_neg_lanes::<FMA>(&mut falloff);
            let step = shade::<FMA>(&falloff, before, record.opacity, input.alpha_cap);
            *before = step.after;
            for l in 0..WIDTH {
                finished[l] |= step.finished[l];
            }
            let [weight_sum, weighted_depth, feature_sums @ ..] = sums else { continue };
            add::<FMA>(weight_sum, strip, &step.weight, 1.0);
            add::<FMA>(weighted_depth, strip, &step.weight, cut.depth);
            for (sum, &feature) in feature_sums.iter_mut().zip(features) {
                add::<FMA>(sum, strip, &step.weight, feature);
            }
        }
        if finished.iter().fold(0, |a, b| a | b) != 0 {
            retire(live, done, transmittance, cut, strip);
        }
    }
}

/// `sum += weight * value` at eight pixels of a row.
#[inline(always)]
fn add<const FMA: bool>(sum: &mut Row, strip: usize, weight: &[f32; WIDTH], value: f32) {
    if let Some(sum) = sum[strip..].first_chunk_mut::<WIDTH>() {
        for l in 0..WIDTH {
            sum[l] = fma::<FMA>(weight[l], value, sum[l]);
        }
    }
}

/// What a splat does to eight pixels.
struct Step {
    weight: [f32; WIDTH],
    after: [f32; WIDTH],
    /// All ones where the splat finishes the pixel, else 0.
    finished: [u32; WIDTH],
}

/// Weights of a splat whose falloff and whose pixels' transmittance are given. One operation per loop, conditions as
/// bit masks: straight-line code the compiler reliably turns into vectors.
#[inline(always)]
fn shade<const FMA: bool>(falloff: &[f32; WIDTH], before: &[f32; WIDTH], opacity: f32, alpha_cap: f32) -> Step {
    let (mut alpha, mut hit, mut weight) = ([0.0f32; WIDTH], [0u32; WIDTH], [0.0f32; WIDTH]);
    let (mut after, mut finished) = ([0.0f32; WIDTH], [0u32; WIDTH]);
    for l in 0..WIDTH {
        alpha[l] = opacity * falloff[l];
    }
    for l in 0..WIDTH {
        alpha[l] = if alpha[l] < alpha_cap { alpha[l] } else { alpha_cap };
    }
    for l in 0..WIDTH {
        hit[l] = mask(alpha[l] >= ALPHA_MIN) & mask(before[l] > 0.0);
    }
    for l in 0..WIDTH {
        alpha[l] = f32::from_bits(alpha[l].to_bits() & hit[l]);
    }
    for l in 0..WIDTH {
        weight[l] = alpha[l] * before[l];
    }
    // Not `before - weight`, rounded twice: behind an alpha near 1 little more than the rounding would be left, and the
    // backward pass divides the same factor out again.
    for l in 0..WIDTH {
        after[l] = if FMA { fma::<FMA>(-alpha[l], before[l], before[l]) } else { before[l] * (1.0 - alpha[l]) };
    }
    for l in 0..WIDTH {
        finished[l] = mask(after[l] <= TRANSMITTANCE_STOP) & hit[l];
    }
    for l in 0..WIDTH {
        weight[l] = f32::from_bits(weight[l].to_bits() & !finished[l]);
    }
    for l in 0..WIDTH {
        // A finished pixel keeps its transmittance, negated.
        let kept = (before[l].to_bits() ^ SIGN) & finished[l];
        after[l] = f32::from_bits((after[l].to_bits() & !finished[l]) | kept);
    }
    Step { weight, after, finished }
}

/// Clears the live bits of the pixels a strip has finished, and notes them.
#[cold]
#[inline(never)]
fn retire(live: &mut [u32; TILE_H], done: &mut Vec<Finished>, transmittance: &[Row; TILE_H], cut: &Cut, strip: usize) {
    for (y, (bits, row)) in live.iter_mut().zip(transmittance).enumerate().take(cut.y1).skip(cut.y0) {
        let Some(row) = row[strip..].first_chunk::<WIDTH>() else { continue };
        let mut negative = [0u32; WIDTH];
        for l in 0..WIDTH {
            negative[l] = (row[l].to_bits() >> 31) << l;
        }
        let mut left = *bits & (negative.iter().fold(0, |a, b| a | b) << strip);
        *bits &= !left;
        while left != 0 {
            done.push(Finished { position: cut.position, x: left.trailing_zeros() as u8, y: y as u8 });
            left &= left - 1;
        }
    }
}
