//! One tile, back to front: the gradient of what `blend` drew, as sums over pixels that each (tile, splat) pair keeps
//! in its own row of the chunk.
//!
//! With `w = alpha T` the weight and `G = sum(g_c f_c) + g_alpha + g_depth (z - D) / A` the loss per unit of weight,
//! `dL/dalpha = T (G - R)`, where `R` is the loss per unit of light that passes: `R = 0` behind the last splat and
//! `R += alpha (G - R)` in front of each. Nothing is subtracted from a total, so nothing cancels.

use super::grid::{TILE_H, TILE_W};
use super::settings::ALPHA_MIN;
use super::simd::{dispatch, exp2_neg_lanes, fma};
use super::tile::{BATCH, Cut, EDGE, PITCH, Row, TileEnd, TileInput, WIDTH, is_live, locate, mask, prefetch_records};
use std::sync::atomic::Ordering;

/// Planes of upstream gradients besides the features: alpha, `g_depth / A`, and the rendered depth `D`.
const BASE_PLANES: usize = 3;
/// Sums of a pair besides the features; see [`Moment`].
pub(crate) const MOMENTS: usize = 7;

/// The sums of a pair over its pixels, in the order they are kept. `h = alpha dL/dalpha` (0 where alpha is capped),
/// and `across`, `y` are the terms of the record's exponent: `q = dx - slope dy` and `dy`, pixels from the centre.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Moment {
    /// `sum(h)`.
    One,
    /// `sum(h q)`.
    Q,
    /// `sum(h dy)`.
    Y,
    /// `sum(h q q)`.
    QQ,
    /// `sum(h q dy)`.
    QY,
    /// `sum(h dy dy)`.
    YY,
    /// `sum(w g_depth / A)`: what the splat's own depth receives.
    Depth,
}

/// Upstream gradients at the pixels of one tile row of one view; empty slices stand for zeros.
pub(crate) struct UpstreamRow<'a> {
    pub(crate) features: &'a [f32],
    pub(crate) alpha: &'a [f32],
    /// `g_depth / A`.
    pub(crate) depth_share: &'a [f32],
    /// What was rendered, metres.
    pub(crate) depth: &'a [f32],
}

/// Buffers of one tile, reused.
pub(crate) struct UnblendScratch {
    /// In front of what has been taken off so far; negative while the pixel is still finished, 0 outside the picture.
    transmittance: [Row; TILE_H],
    /// `R`.
    behind: [Row; TILE_H],
    /// Per tile row: alpha, depth share, depth, then the features.
    upstream: Vec<Row>,
    live: [u32; TILE_H],
    batch: Vec<Cut>,
    fetched: Vec<Cut>,
    /// Sums of one splat, per lane: the moments, then the features.
    sums: Vec<[f32; WIDTH]>,
}

impl UnblendScratch {
    pub(crate) fn new() -> Self {
        Self {
            transmittance: [[0.0; PITCH]; TILE_H],
            behind: [[0.0; PITCH]; TILE_H],
            upstream: Vec::new(),
            live: [0; TILE_H],
            batch: Vec::with_capacity(BATCH),
            fetched: Vec::with_capacity(BATCH),
            sums: Vec::new(),
        }
    }

    /// Back to how the tile ended.
    pub(crate) fn reset(&mut self, input: &TileInput, end: &TileEnd) {
        self.behind = [[0.0; PITCH]; TILE_H];
        self.upstream.clear();
        self.upstream.resize(TILE_H * (BASE_PLANES + input.features.count), [0.0; PITCH]);
        self.transmittance = [[0.0; PITCH]; TILE_H];
        for (row, kept) in self.transmittance.iter_mut().zip(end.transmittance.chunks_exact(TILE_W)) {
            row[..TILE_W].copy_from_slice(kept);
        }
        for (bits, row) in self.live.iter_mut().zip(&self.transmittance) {
            *bits = (0..TILE_W).fold(0, |bits, x| bits | u32::from(row[x] > 0.0) << x);
        }
    }

    /// Takes over the upstream gradients of tile row `y`.
    pub(crate) fn set_upstream(&mut self, y: usize, feature_count: usize, source: &UpstreamRow) {
        let planes = BASE_PLANES + feature_count;
        let Some([alpha, share, depth, features @ ..]) = self.upstream.chunks_exact_mut(planes).nth(y) else { return };
        for (plane, values) in [(alpha, source.alpha), (share, source.depth_share), (depth, source.depth)] {
            for (to, &from) in plane.iter_mut().zip(values) {
                *to = from;
            }
        }
        if feature_count > 0 {
            for (x, pixel) in source.features.chunks_exact(feature_count).take(TILE_W).enumerate() {
                for (plane, &value) in features.iter_mut().zip(pixel) {
                    plane[x] = value;
                }
            }
        }
    }
}

dispatch!(
    /// Takes the splats of a tile off again, last first, and writes the sums of each pair; `scratch` holds the upstream.
    unblend_tile, unblend_tile_kernel, (input: &TileInput<'_>, end: &TileEnd, scratch: &mut UnblendScratch)
);

#[inline(always)]
fn unblend_tile_kernel<const FMA: bool>(input: &TileInput, end: &TileEnd, scratch: &mut UnblendScratch) {
    scratch.sums.clear();
    scratch.sums.resize(MOMENTS + input.features.count, [0.0; WIDTH]);
    let mut finished = end.finished.as_slice();
    // Behind the splat that finished the last pixel nothing was blended, unless some pixel never was finished.
    let count = match finished.last() {
        Some(last) if scratch.live.iter().all(|&bits| bits == 0) => last.position as usize,
        _ => input.keys.len(),
    };
    let keys = input.keys.get(..count).unwrap_or_default();
    let batches = count.div_ceil(BATCH);
    let batch = |ahead: usize| {
        let first = batches.checked_sub(ahead + 1).map_or(count, |index| index * BATCH);
        let keys = keys.get(first..).unwrap_or_default();
        (first, keys.get(..BATCH).unwrap_or(keys))
    };
    prefetch_records(input, batch(0).1);
    prefetch_records(input, batch(1).1);
    fetch(input, batch(0), &mut scratch.fetched);
    for index in 0..batches {
        std::mem::swap(&mut scratch.batch, &mut scratch.fetched);
        prefetch_records(input, batch(index + 2).1);
        fetch(input, batch(index + 1), &mut scratch.fetched);
        for at in (0..scratch.batch.len()).rev() {
            let cut = scratch.batch[at];
            while let Some((last, rest)) = finished.split_last()
                && last.position > cut.position
            {
                let (x, y) = (usize::from(last.x), usize::from(last.y));
                scratch.live[y] |= 1 << x;
                scratch.transmittance[y][x] = -scratch.transmittance[y][x];
                finished = rest;
            }
            if is_live(&scratch.live, &cut) && unblend_splat::<FMA>(input, &cut, scratch) {
                keep(input, &cut, &scratch.sums);
            }
        }
    }
}

/// Reads the records of a batch that begins at position `first` and asks for the features.
#[inline(always)]
fn fetch(input: &TileInput, (first, keys): (usize, &[u64]), fetched: &mut Vec<Cut>) {
    fetched.clear();
    for (offset, &key) in keys.iter().enumerate() {
        let cut = Cut::new(input, first + offset, key);
        input.features.prefetch(cut.id);
        fetched.push(cut);
    }
}

/// Takes one splat off and leaves its sums per lane; false when it hit no pixel.
#[inline(always)]
fn unblend_splat<const FMA: bool>(input: &TileInput, cut: &Cut, scratch: &mut UnblendScratch) -> bool {
    let record = &cut.record;
    let features = input.features.of(cut.id);
    let planes = BASE_PLANES + features.len();
    let left = (input.x0 as f32 - f32::from(record.x0)) + 0.5;
    let top = (input.y0 as f32 - f32::from(record.y0)) + 0.5;
    let mut m = [[0.0f32; WIDTH]; MOMENTS];
    let (_, feature_sums) = scratch.sums.split_at_mut(MOMENTS);
    feature_sums.fill([0.0; WIDTH]);
    let mut any = [0u32; WIDTH];
    for strip in (cut.x0..cut.x1).step_by(WIDTH) {
        let edge = EDGE[(cut.x1 - strip).min(WIDTH)];
        let first = left + strip as f32 - record.u;
        let mut dx = [0.0; WIDTH];
        for l in 0..WIDTH {
            dx[l] = first + l as f32;
        }
        let rows = scratch.transmittance[cut.y0..cut.y1].iter_mut().zip(&mut scratch.behind[cut.y0..cut.y1]);
        // Not `chunks_exact`: its length is a division, which costs as much as a row.
        let mut rest = &scratch.upstream[cut.y0 * planes..];
        for (y, (transmittance, behind)) in (cut.y0..cut.y1).zip(rows) {
            let Some((upstream, after)) = rest.split_at_checked(planes) else { break };
            rest = after;
            let dy = top + y as f32 - record.v;
            let shift = record.slope * dy;
            let along = record.along * dy * dy;
            let (Some(after), Some(behind)) =
                (transmittance[strip..].first_chunk_mut::<WIDTH>(), behind[strip..].first_chunk_mut::<WIDTH>())
            else {
                continue;
            };
            let (mut q, mut falloff) = ([0.0; WIDTH], [0.0; WIDTH]);
            for l in 0..WIDTH {
                q[l] = dx[l] - shift;
            }
            for l in 0..WIDTH {
                // The forward's very number: its infinite `dx` beyond the box becomes an infinite exponent here.
                falloff[l] = fma::<FMA>(record.across * q[l], q[l], along) + edge[l];
            }
            exp2_neg_lanes::<FMA>(&mut falloff);
            let step = unshade(&falloff, after, record.opacity, input.alpha_cap);
            *after = step.before;
            let [g_alpha, g_depth, depth, g_features @ ..] = upstream else { continue };
            let (Some(g_alpha), Some(g_depth), Some(depth)) =
                (eight(g_alpha, strip), eight(g_depth, strip), eight(depth, strip))
            else {
                continue;
            };
            let mut g = *g_alpha;
            let mut beyond = [0.0; WIDTH];
            for l in 0..WIDTH {
                beyond[l] = cut.depth - depth[l];
            }
            add::<FMA>(&mut g, g_depth, &beyond);
            for (plane, &feature) in g_features.iter().zip(features) {
                let Some(plane) = eight(plane, strip) else { break };
                add::<FMA>(&mut g, plane, &[feature; WIDTH]);
            }
            for (plane, sum) in g_features.iter().zip(feature_sums.iter_mut()) {
                let Some(plane) = eight(plane, strip) else { break };
                add::<FMA>(sum, plane, &step.weight);
            }
            for l in 0..WIDTH {
                g[l] -= behind[l];
            }
            add::<FMA>(behind, &step.alpha, &g);
            let (mut h, mut hq, mut hy) = ([0.0; WIDTH], [0.0; WIDTH], [0.0; WIDTH]);
            for l in 0..WIDTH {
                h[l] = f32::from_bits((step.weight[l] * g[l]).to_bits() & step.free[l]);
            }
            for l in 0..WIDTH {
                // Pixels far from a long thin splat may have a `q` that is not finite.
                q[l] = f32::from_bits(q[l].to_bits() & step.free[l]);
            }
            for l in 0..WIDTH {
                hq[l] = h[l] * q[l];
            }
            for l in 0..WIDTH {
                hy[l] = h[l] * dy;
            }
            for l in 0..WIDTH {
                any[l] |= step.hit[l];
            }
            let [one, m_q, m_y, m_qq, m_qy, m_yy, m_depth] = &mut m;
            for l in 0..WIDTH {
                one[l] += h[l];
            }
            for l in 0..WIDTH {
                m_q[l] += hq[l];
            }
            for l in 0..WIDTH {
                m_y[l] += hy[l];
            }
            add::<FMA>(m_qq, &hq, &q);
            add::<FMA>(m_qy, &hq, &[dy; WIDTH]);
            add::<FMA>(m_yy, &hy, &[dy; WIDTH]);
            add::<FMA>(m_depth, &step.weight, g_depth);
        }
    }
    scratch.sums[..MOMENTS].copy_from_slice(&m);
    any.iter().fold(0, |a, b| a | b) != 0
}

/// `sum += a * b` per lane. One operation per loop and no reading after the first write: what the compiler turns into
/// vectors.
#[inline(always)]
fn add<const FMA: bool>(sum: &mut [f32; WIDTH], a: &[f32; WIDTH], b: &[f32; WIDTH]) {
    let mut total = [0.0; WIDTH];
    for l in 0..WIDTH {
        total[l] = fma::<FMA>(a[l], b[l], sum[l]);
    }
    *sum = total;
}

/// Eight pixels of a row.
#[inline(always)]
fn eight(row: &Row, strip: usize) -> Option<&[f32; WIDTH]> {
    row[strip..].first_chunk()
}

/// What a splat did to eight pixels.
struct Step {
    /// 0 where it was skipped.
    alpha: [f32; WIDTH],
    weight: [f32; WIDTH],
    /// Transmittance in front of it.
    before: [f32; WIDTH],
    /// All ones where it was blended, else 0.
    hit: [u32; WIDTH],
    /// As `hit`, but 0 where alpha is capped.
    free: [u32; WIDTH],
}

/// The forward's `shade` from the other side.
#[inline(always)]
fn unshade(falloff: &[f32; WIDTH], after: &[f32; WIDTH], opacity: f32, alpha_cap: f32) -> Step {
    let (mut alpha, mut weight, mut before) = ([0.0f32; WIDTH], [0.0f32; WIDTH], [0.0f32; WIDTH]);
    let (mut hit, mut free) = ([0u32; WIDTH], [0u32; WIDTH]);
    for l in 0..WIDTH {
        alpha[l] = opacity * falloff[l];
    }
    for l in 0..WIDTH {
        free[l] = mask(alpha[l] <= alpha_cap);
    }
    for l in 0..WIDTH {
        alpha[l] = if alpha[l] < alpha_cap { alpha[l] } else { alpha_cap };
    }
    for l in 0..WIDTH {
        hit[l] = mask(alpha[l] >= ALPHA_MIN) & mask(after[l] > 0.0);
    }
    for l in 0..WIDTH {
        alpha[l] = f32::from_bits(alpha[l].to_bits() & hit[l]);
    }
    for l in 0..WIDTH {
        free[l] &= hit[l];
    }
    for l in 0..WIDTH {
        before[l] = 1.0 - alpha[l];
    }
    for l in 0..WIDTH {
        before[l] = after[l] / before[l];
    }
    for l in 0..WIDTH {
        weight[l] = alpha[l] * before[l];
    }
    Step { alpha, weight, before, hit, free }
}

/// Writes a splat's sums into its pair's row.
#[inline(always)]
fn keep(input: &TileInput, cut: &Cut, sums: &[[f32; WIDTH]]) {
    let Some(&key) = input.keys.get(cut.position as usize) else { return };
    let (view, at) = locate(input, key);
    let Some(row) = view.pair_sums(at, input.x0 / TILE_W, input.y0 / TILE_H, sums.len()) else { return };
    for (to, lanes) in row.iter().zip(sums) {
        // Only this tile writes this row; the atomic is how threads share a vector safely, and costs a plain store.
        to.store(add_lanes(lanes).to_bits(), Ordering::Relaxed);
    }
}

/// Sum of the lanes, pairwise.
#[inline(always)]
fn add_lanes(lanes: &[f32; WIDTH]) -> f32 {
    let [a, b, c, d, e, f, g, h] = *lanes;
    ((a + e) + (c + g)) + ((b + f) + (d + h))
}
