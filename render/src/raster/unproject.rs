//! Sums of pairs to gradients of Gaussians: eight at a time, through `project` backwards, over all views.
//!
//! In f64, as `project` is. With `A = c / det`, `B = 1 / c`, `s = b / c` of the covariance `[[a, b], [b, c]]` and a
//! pixel at `(dx, dy)` from the centre, `lambda = cov^-1 (dx, dy) = (A q, B dy - s A q)` where `q = dx - s dy`; then
//! `dL/dcentre = sum(h lambda)` and `dL/dcov = sum(h lambda lambda^T) / 2`: the kept moments are all that is needed.

use super::Splats;
use super::block::{Block, LANES, Lane};
use super::project::Camera;
use super::simd::{dispatch, fma64};
use super::tiles::Chunk;
use super::unblend::{MOMENTS, Moment};
use std::ops::Range;
use std::sync::atomic::{AtomicU32, Ordering};

/// What all chunks share.
pub(crate) struct UnprojectInput<'a> {
    pub(crate) splats: Splats<'a>,
    pub(crate) cameras: &'a [Camera],
    pub(crate) blur: f64,
}

/// Gradients of one chunk's Gaussians, every value to be written.
pub(crate) struct ChunkGradients<'a> {
    pub(crate) means: &'a mut [[f32; 3]],
    pub(crate) quats: &'a mut [[f32; 4]],
    pub(crate) scales: &'a mut [[f32; 3]],
    pub(crate) opacities: &'a mut [f32],
    pub(crate) features: &'a mut [f32],
    /// Gaussians whose gradient was not finite and was set to zero.
    pub(crate) overflowed: usize,
}

/// What eight Gaussians have received from the views so far.
struct Received {
    mean: [Lane; 3],
    /// Of `R S`, row-major.
    axes: [[Lane; 3]; 3],
    opacity: Lane,
}

/// What eight Gaussians received from one view.
struct FromView {
    moments: [Lane; MOMENTS],
    /// Some moment is not 0.
    active: [bool; LANES],
}

dispatch!(
    /// Gradients of the Gaussians `range`, which are those of `chunk`.
    unproject_chunk, unproject_chunk_kernel,
    (input: &UnprojectInput<'_>, range: Range<usize>, chunk: &Chunk, out: &mut ChunkGradients<'_>)
);

#[inline(always)]
fn unproject_chunk_kernel<const FMA: bool>(
    input: &UnprojectInput,
    range: Range<usize>,
    chunk: &Chunk,
    out: &mut ChunkGradients,
) {
    out.means.fill([0.0; 3]);
    out.quats.fill([0.0; 4]);
    out.scales.fill([0.0; 3]);
    out.opacities.fill(0.0);
    out.features.fill(0.0);
    out.overflowed = 0;
    let channels = input.splats.feature_count;
    let mut cursors = vec![0; chunk.views.len()];
    let mut block = Block::new();
    for start in range.clone().step_by(LANES) {
        let count = (range.end - start).min(LANES);
        let first = start - range.start;
        let mut received = Received { mean: [[0.0; LANES]; 3], axes: [[[0.0; LANES]; 3]; 3], opacity: [0.0; LANES] };
        let features = &mut out.features[first * channels..(first + count) * channels];
        let mut loaded = false;
        let mut touched = [false; LANES];
        for ((view, camera), cursor) in chunk.views.iter().zip(input.cameras).zip(&mut cursors) {
            let mut from = FromView { moments: [[0.0; LANES]; MOMENTS], active: [false; LANES] };
            while let Some(&id) = view.ids.get(*cursor)
                && (id as usize) < start + count
            {
                let l = id as usize - start;
                let sums = view.record_sums(*cursor, MOMENTS + channels);
                let gathered = gather(sums, l, &mut from, &mut features[l * channels..(l + 1) * channels]);
                touched[l] |= gathered;
                received.opacity[l] += from.moments[Moment::One as usize][l] / f64::from(view.records[*cursor].opacity);
                *cursor += 1;
            }
            if from.active.iter().any(|&active| active) {
                if !loaded {
                    block.load(&input.splats, start, count, true);
                    loaded = true;
                }
                pull_back::<FMA>(&block, camera, input.blur, &from, &mut received);
            }
        }
        if touched.iter().any(|&t| t) {
            finish(input, start, &touched, &received, first, out);
        }
    }
}

/// Adds up the pairs of one record, in the order of the tiles; true when any sum is not 0.
#[inline(always)]
fn gather(sums: &[AtomicU32], l: usize, from: &mut FromView, features: &mut [f32]) -> bool {
    let value = |sum: &AtomicU32| f32::from_bits(sum.load(Ordering::Relaxed));
    let mut any = false;
    for row in sums.chunks_exact(MOMENTS + features.len()) {
        let (moments, rest) = row.split_at(MOMENTS);
        for (to, sum) in from.moments.iter_mut().zip(moments) {
            let x = value(sum);
            from.active[l] |= x != 0.0;
            to[l] += f64::from(x);
        }
        for (to, sum) in features.iter_mut().zip(rest) {
            let x = value(sum);
            any |= x != 0.0;
            *to += x;
        }
    }
    any | from.active[l]
}

/// One view's share: from moments through the ellipse and the projection to the mean and to `R S`.
#[inline(always)]
fn pull_back<const FMA: bool>(block: &Block, camera: &Camera, blur: f64, from: &FromView, to: &mut Received) {
    let (r, t) = (&camera.rotation, &camera.translation);
    let moment = |m: Moment| &from.moments[m as usize];
    let (m_q, m_y, m_depth) = (moment(Moment::Q), moment(Moment::Y), moment(Moment::Depth));
    let (m_qq, m_qy, m_yy) = (moment(Moment::QQ), moment(Moment::QY), moment(Moment::YY));
    for l in 0..LANES {
        let (mx, my, mz) = (block.centers.mean[0][l], block.centers.mean[1][l], block.centers.mean[2][l]);
        let place =
            |row: &[f64; 3], t: f64| fma64::<FMA>(row[0], mx, fma64::<FMA>(row[1], my, fma64::<FMA>(row[2], mz, t)));
        let (x, y, z) = (place(&r[0], t[0]), place(&r[1], t[1]), place(&r[2], t[2]));
        let inverse_z = 1.0 / z;
        let (ratio_x, ratio_y) = (x * inverse_z, y * inverse_z);
        let tangent_x = ratio_x.max(camera.clamp_min[0]).min(camera.clamp_max[0]);
        let tangent_y = ratio_y.max(camera.clamp_min[1]).min(camera.clamp_max[1]);
        let (jx, jy) = (camera.focal[0] * inverse_z, camera.focal[1] * inverse_z);
        // Rows of J W are jx n0 and jy n1.
        let n0: [f64; 3] = std::array::from_fn(|k| fma64::<FMA>(-tangent_x, r[2][k], r[0][k]));
        let n1: [f64; 3] = std::array::from_fn(|k| fma64::<FMA>(-tangent_y, r[2][k], r[1][k]));
        let axes: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|k| block.shapes.axes[i][k][l]));
        let g0: [f64; 3] = std::array::from_fn(|k| {
            jx * fma64::<FMA>(n0[0], axes[0][k], fma64::<FMA>(n0[1], axes[1][k], n0[2] * axes[2][k]))
        });
        let g1: [f64; 3] = std::array::from_fn(|k| {
            jy * fma64::<FMA>(n1[0], axes[0][k], fma64::<FMA>(n1[1], axes[1][k], n1[2] * axes[2][k]))
        });
        let a = dot::<FMA>(&g0, &g0);
        let b = dot::<FMA>(&g0, &g1);
        let c = dot::<FMA>(&g1, &g1);
        let m01 = g0[0] * g1[1] - g0[1] * g1[0];
        let m02 = g0[0] * g1[2] - g0[2] * g1[0];
        let m12 = g0[1] * g1[2] - g0[2] * g1[1];
        let det = fma64::<FMA>(blur, a + c + blur, dot::<FMA>(&[m01, m02, m12], &[m01, m02, m12]));
        let inverse_c = 1.0 / (c + blur);
        let across = (c + blur) / det;
        let slope = b * inverse_c;

        let d_u = across * m_q[l];
        let d_v = inverse_c * m_y[l] - slope * d_u;
        // dL/dG = 2 dL/dcov G, arranged so that the large `across` only meets `g0 - slope g1`, the thin side.
        let (mut d_g0, mut d_g1) = ([0.0; 3], [0.0; 3]);
        for k in 0..3 {
            let thin = g0[k] - slope * g1[k];
            d_g0[k] = across * (across * m_qq[l] * thin + inverse_c * m_qy[l] * g1[k]);
            d_g1[k] = inverse_c * (across * m_qy[l] * thin + inverse_c * m_yy[l] * g1[k]) - slope * d_g0[k];
        }
        // G = P (R S), P = [jx n0; jy n1].
        let d_p0: [f64; 3] = std::array::from_fn(|i| dot::<FMA>(&d_g0, &axes[i]));
        let d_p1: [f64; 3] = std::array::from_fn(|i| dot::<FMA>(&d_g1, &axes[i]));
        let d_jx = dot::<FMA>(&d_p0, &n0);
        let d_jy = dot::<FMA>(&d_p1, &n1);
        // Beyond the clamp the tangent is a constant.
        let free_x = ratio_x >= camera.clamp_min[0] && ratio_x <= camera.clamp_max[0];
        let free_y = ratio_y >= camera.clamp_min[1] && ratio_y <= camera.clamp_max[1];
        let d_tangent_x = if free_x { -jx * dot::<FMA>(&d_p0, &r[2]) } else { 0.0 };
        let d_tangent_y = if free_y { -jy * dot::<FMA>(&d_p1, &r[2]) } else { 0.0 };
        let d_ratio_x = fma64::<FMA>(camera.focal[0], d_u, d_tangent_x);
        let d_ratio_y = fma64::<FMA>(camera.focal[1], d_v, d_tangent_y);
        let d_x = d_ratio_x * inverse_z;
        let d_y = d_ratio_y * inverse_z;
        let d_z = m_depth[l] - (d_jx * jx + d_jy * jy + d_ratio_x * ratio_x + d_ratio_y * ratio_y) * inverse_z;
        let active = from.active[l];
        for k in 0..3 {
            let d_mean = fma64::<FMA>(r[0][k], d_x, fma64::<FMA>(r[1][k], d_y, r[2][k] * d_z));
            to.mean[k][l] += if active { d_mean } else { 0.0 };
        }
        for i in 0..3 {
            for k in 0..3 {
                let d_axis = fma64::<FMA>(jx * n0[i], d_g0[k], jy * n1[i] * d_g1[k]);
                to.axes[i][k][l] += if active { d_axis } else { 0.0 };
            }
        }
    }
}

#[inline(always)]
fn dot<const FMA: bool>(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    fma64::<FMA>(a[0], b[0], fma64::<FMA>(a[1], b[1], a[2] * b[2]))
}

/// From `R S` to quaternions and scales, and everything to f32.
#[inline(always)]
fn finish(
    input: &UnprojectInput,
    start: usize,
    touched: &[bool; LANES],
    received: &Received,
    first: usize,
    out: &mut ChunkGradients,
) {
    let splats = &input.splats;
    let (mut d_quat, mut d_scale) = ([[0.0; LANES]; 4], [[0.0; LANES]; 3]);
    let mut quat = [[1.0; LANES]; 4];
    let mut scale = [[0.0; LANES]; 3];
    for l in 0..LANES {
        if touched[l] {
            for k in 0..4 {
                quat[k][l] = f64::from(splats.quats[start + l][k]);
            }
            for k in 0..3 {
                scale[k][l] = f64::from(splats.scales[start + l][k]);
            }
        }
    }
    for l in 0..LANES {
        let q: [f64; 4] = std::array::from_fn(|k| quat[k][l]);
        let inverse_norm = 1.0 / (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt();
        let [w, x, y, z] = q.map(|v| v * inverse_norm);
        let rotation = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ];
        let d = &received.axes;
        for k in 0..3 {
            d_scale[k][l] = rotation[0][k] * d[0][k][l] + rotation[1][k] * d[1][k][l] + rotation[2][k] * d[2][k][l];
        }
        // dL/dR, then the derivatives of R's polynomials.
        let r: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|k| d[i][k][l] * scale[k][l]));
        let d_unit = [
            2.0 * (x * (r[2][1] - r[1][2]) + y * (r[0][2] - r[2][0]) + z * (r[1][0] - r[0][1])),
            2.0 * (w * (r[2][1] - r[1][2]) + y * (r[0][1] + r[1][0]) + z * (r[0][2] + r[2][0])
                - 2.0 * x * (r[1][1] + r[2][2])),
            2.0 * (w * (r[0][2] - r[2][0]) + x * (r[0][1] + r[1][0]) + z * (r[1][2] + r[2][1])
                - 2.0 * y * (r[0][0] + r[2][2])),
            2.0 * (w * (r[1][0] - r[0][1]) + x * (r[0][2] + r[2][0]) + y * (r[1][2] + r[2][1])
                - 2.0 * z * (r[0][0] + r[1][1])),
        ];
        // The normalisation takes away what points along the quaternion.
        let unit = [w, x, y, z];
        let along = d_unit[0] * w + d_unit[1] * x + d_unit[2] * y + d_unit[3] * z;
        for k in 0..4 {
            d_quat[k][l] = (d_unit[k] - along * unit[k]) * inverse_norm;
        }
    }
    let channels = splats.feature_count;
    for l in 0..LANES {
        if !touched[l] {
            continue;
        }
        let i = first + l;
        let features = &mut out.features[i * channels..(i + 1) * channels];
        let mean: [f64; 3] = std::array::from_fn(|k| received.mean[k][l]);
        let quat: [f64; 4] = std::array::from_fn(|k| d_quat[k][l]);
        let scale: [f64; 3] = std::array::from_fn(|k| d_scale[k][l]);
        let opacity = received.opacity[l];
        let finite = mean.iter().chain(&quat).chain(&scale).all(|x| x.is_finite())
            && opacity.is_finite()
            && features.iter().all(|x| x.is_finite());
        if finite {
            out.means[i] = mean.map(narrow);
            out.quats[i] = quat.map(narrow);
            out.scales[i] = scale.map(narrow);
            out.opacities[i] = narrow(opacity);
        } else {
            features.fill(0.0);
            out.overflowed += 1;
        }
    }
}

/// A finite f64 as a finite f32.
#[inline(always)]
fn narrow(x: f64) -> f32 {
    x.clamp(f64::from(f32::MIN), f64::from(f32::MAX)) as f32
}
