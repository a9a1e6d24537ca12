//! Blocks of Gaussians to picture ellipses.
//!
//! In f64: a needle seen along its length has a covariance whose entries cancel, and in f32 its ellipse tilts enough
//! to show (5e-5 of colour). With `G = J W R S` the 2D covariance is `G G^T + blur I`, and its determinant
//! is the sum of the squared 2x2 minors of `G` plus `blur trace + blur^2`, which cannot cancel.

use super::block::{Centers, LANES, Lane, Shapes};
use super::settings::{Convention, DISCRIMINANT_FLOOR, LATEST_EXTENT, RasterSettings, TILE_RULE};
use super::simd::fma64;
use crate::camera::View;

/// Pixels added to each side of the exact box of `alpha >= 1/255`, for the rounding of the f32 blending.
const BOX_MARGIN_PX: f64 = 2e-3;
/// Share added to the bound that rejects Gaussians before their covariance is known: poses are rigid to 1e-3 only.
const REJECT_SLACK: f64 = 1.01;
/// `log2(e) / 2`: exponents are kept in base 2, with the 1/2 of `exp(-d^2 / 2)`.
const HALF_LOG2_E: f64 = 0.5 * std::f64::consts::LOG2_E;

/// A view made ready: f64, with the clamps of the Jacobian.
#[derive(Debug, Clone)]
pub(crate) struct Camera {
    pub(crate) rotation: [[f64; 3]; 3],
    pub(crate) translation: [f64; 3],
    pub(crate) focal: [f64; 2],
    center: [f64; 2],
    size: [f64; 2],
    /// Smallest and largest x/z and y/z at which the Jacobian is taken.
    pub(crate) clamp_min: [f64; 2],
    pub(crate) clamp_max: [f64; 2],
    /// Bound on `z^2 |J|^2`.
    jacobian_bound: f64,
}

impl Camera {
    pub(crate) fn new(view: &View, convention: Convention) -> Self {
        let cols = view.camera_from_world.matrix3.to_cols_array_2d();
        let rotation = std::array::from_fn(|row| std::array::from_fn(|col| f64::from(cols[col][row])));
        let k = &view.intrinsics;
        let focal = [f64::from(k.fx), f64::from(k.fy)];
        let center = [f64::from(k.cx), f64::from(k.cy)];
        let size = [k.width as f64, k.height as f64];
        let (mut clamp_min, mut clamp_max) = ([0.0; 2], [0.0; 2]);
        for axis in 0..2 {
            let tan_half_fov = 0.5 * size[axis] / focal[axis];
            (clamp_min[axis], clamp_max[axis]) = match convention {
                Convention::Pinned => (-1.3 * tan_half_fov, 1.3 * tan_half_fov),
                Convention::Latest => (
                    -(center[axis] / focal[axis] + 0.3 * tan_half_fov),
                    (size[axis] - center[axis]) / focal[axis] + 0.3 * tan_half_fov,
                ),
            };
        }
        let jacobian_bound =
            (0..2).map(|a| focal[a] * focal[a] * (1.0 + clamp_min[a].abs().max(clamp_max[a].abs()).powi(2))).sum();
        let translation = view.camera_from_world.translation.to_array().map(f64::from);
        Self { rotation, translation, focal, center, size, clamp_min, clamp_max, jacobian_bound }
    }
}

/// The rules a projection follows, from the settings.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rules {
    convention: Convention,
    near: f64,
    far: f64,
    radius_clip: f64,
    blur: f64,
}

impl From<&RasterSettings> for Rules {
    fn from(s: &RasterSettings) -> Self {
        Self {
            convention: s.convention,
            near: f64::from(s.near),
            far: f64::from(s.far),
            radius_clip: f64::from(s.radius_clip),
            blur: f64::from(s.blur),
        }
    }
}

/// Eight Gaussians in one view.
#[derive(Debug, Clone)]
pub(crate) struct Footprints {
    /// Picture position, pixels.
    pub(crate) u: Lane,
    pub(crate) v: Lane,
    /// Camera z, metres.
    pub(crate) z: Lane,
    /// 2D covariance with blur, `[[a, b], [b, c]]`, and its determinant.
    pub(crate) a: Lane,
    pub(crate) b: Lane,
    pub(crate) c: Lane,
    pub(crate) det: Lane,
    /// Half sides of the convention's rectangle, pixels.
    pub(crate) radius_x: Lane,
    pub(crate) radius_y: Lane,
    /// Pixel box `[x0, x1) x [y0, y1)` that holds every pixel to blend; inside the picture; may be empty.
    pub(crate) x0: Lane,
    pub(crate) x1: Lane,
    pub(crate) y0: Lane,
    pub(crate) y1: Lane,
    /// The convention blends this splat.
    pub(crate) visible: [bool; LANES],
}

impl Footprints {
    pub(crate) fn new() -> Self {
        let zero = [0.0; LANES];
        Self {
            u: zero,
            v: zero,
            z: zero,
            a: zero,
            b: zero,
            c: zero,
            det: zero,
            radius_x: zero,
            radius_y: zero,
            x0: zero,
            x1: zero,
            y0: zero,
            y1: zero,
            visible: [false; LANES],
        }
    }

    /// Coefficients `(k, e, f)` of the f32 blending: `alpha = o 2^-(e (dx - k dy)^2 + f dy^2)`, a sum of squares, so
    /// that a long thin ellipse does not lose its digits to cancellation.
    #[inline(always)]
    pub(crate) fn quadratic(&self, l: usize) -> (f32, f32, f32) {
        let slope = self.b[l] / self.c[l];
        let across = (HALF_LOG2_E * self.c[l] / self.det[l]) as f32;
        let along = (HALF_LOG2_E / self.c[l]) as f32;
        (slope as f32, across.max(f32::MIN_POSITIVE), along)
    }
}

/// No rectangle of either convention is larger than this, pixels, for Gaussians with this largest squared scale and at
/// least this far away.
#[inline(always)]
fn radius_bound(size2: f64, camera: &Camera, rules: &Rules, inverse_z: f64) -> f64 {
    let variance = size2 * camera.jacobian_bound * inverse_z * inverse_z + rules.blur;
    LATEST_EXTENT * REJECT_SLACK * (REJECT_SLACK * variance + DISCRIMINANT_FLOOR.sqrt()).sqrt() + 1.0
}

/// A box of centres, with the largest squared scale of what stands in it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Bounds {
    pub(crate) center: [f64; 3],
    pub(crate) half: [f64; 3],
    pub(crate) size2: f64,
}

impl Bounds {
    /// False only when nothing inside can be in the picture; numbers that are not finite are never sure of that.
    pub(crate) fn may_show(&self, camera: &Camera, rules: &Rules) -> bool {
        let (r, t) = (&camera.rotation, &camera.translation);
        let (c, h) = (&self.center, &self.half);
        let span = |row: usize| {
            let middle = r[row][0] * c[0] + r[row][1] * c[1] + r[row][2] * c[2] + t[row];
            let half = REJECT_SLACK * (r[row][0].abs() * h[0] + r[row][1].abs() * h[1] + r[row][2].abs() * h[2]);
            (middle - half, middle + half)
        };
        let (nearest, farthest) = span(2);
        if farthest < rules.near || nearest > rules.far {
            return false;
        }
        let (nearest, farthest) = (nearest.max(rules.near), farthest.min(rules.far));
        let radius = radius_bound(self.size2, camera, rules, 1.0 / nearest);
        for axis in 0..2 {
            let (low, high) = span(axis);
            let first = camera.focal[axis] * (low / nearest).min(low / farthest) + camera.center[axis];
            let last = camera.focal[axis] * (high / nearest).max(high / farthest) + camera.center[axis];
            if last + radius < 0.0 || first - radius > camera.size[axis] {
                return false;
            }
        }
        true
    }
}

/// Camera-space position of the block's lanes and whether any of them can be in the picture.
#[inline(always)]
fn place<const FMA: bool>(
    centers: &Centers,
    shapes: &Shapes,
    camera: &Camera,
    rules: &Rules,
    position: &mut [Lane; 3],
) -> bool {
    let (r, t) = (&camera.rotation, &camera.translation);
    let mut any = [0u64; LANES];
    for l in 0..LANES {
        let (mx, my, mz) = (centers.mean[0][l], centers.mean[1][l], centers.mean[2][l]);
        let dot =
            |row: &[f64; 3], t: f64| fma64::<FMA>(row[0], mx, fma64::<FMA>(row[1], my, fma64::<FMA>(row[2], mz, t)));
        let (x, y, z) = (dot(&r[0], t[0]), dot(&r[1], t[1]), dot(&r[2], t[2]));
        (position[0][l], position[1][l], position[2][l]) = (x, y, z);
        let inverse_z = 1.0 / z;
        let radius = radius_bound(shapes.size2[l], camera, rules, inverse_z);
        let u = camera.focal[0] * x * inverse_z + camera.center[0];
        let v = camera.focal[1] * y * inverse_z + camera.center[1];
        let near_enough = (z >= rules.near) & (z <= rules.far);
        let inside_x = (u + radius > 0.0) & (u - radius < camera.size[0]);
        let inside_y = (v + radius > 0.0) & (v - radius < camera.size[1]);
        any[l] = u64::from(near_enough & inside_x & inside_y);
    }
    any.iter().fold(0, |a, b| a | b) != 0
}

/// Projects eight Gaussians into a view; false (and `out` untouched) when none of them can be in the picture.
#[inline(always)]
pub(crate) fn project<const FMA: bool>(
    centers: &Centers,
    shapes: &Shapes,
    camera: &Camera,
    rules: &Rules,
    out: &mut Footprints,
) -> bool {
    let mut position = [[0.0; LANES]; 3];
    if !place::<FMA>(centers, shapes, camera, rules, &mut position) {
        return false;
    }
    covariance::<FMA>(shapes, camera, rules, &position, out);
    match rules.convention {
        Convention::Pinned => square_radius(out),
        Convention::Latest => rectangle_radius(shapes, out),
    }
    boxes(centers, shapes, camera, rules, out);
    true
}

/// Picture position and 2D covariance.
#[inline(always)]
fn covariance<const FMA: bool>(
    shapes: &Shapes,
    camera: &Camera,
    rules: &Rules,
    position: &[Lane; 3],
    out: &mut Footprints,
) {
    let r = &camera.rotation;
    for l in 0..LANES {
        let (x, y, z) = (position[0][l], position[1][l], position[2][l]);
        let inverse_z = 1.0 / z;
        let (ratio_x, ratio_y) = (x * inverse_z, y * inverse_z);
        let tangent_x = ratio_x.max(camera.clamp_min[0]).min(camera.clamp_max[0]);
        let tangent_y = ratio_y.max(camera.clamp_min[1]).min(camera.clamp_max[1]);
        // Rows of J W, with J = [[fx/z, 0, -fx tx/z], [0, fy/z, -fy ty/z]].
        let (jx, jy) = (camera.focal[0] * inverse_z, camera.focal[1] * inverse_z);
        let (mut g0, mut g1) = ([0.0; 3], [0.0; 3]);
        let p0: [f64; 3] = std::array::from_fn(|k| jx * fma64::<FMA>(-tangent_x, r[2][k], r[0][k]));
        let p1: [f64; 3] = std::array::from_fn(|k| jy * fma64::<FMA>(-tangent_y, r[2][k], r[1][k]));
        for k in 0..3 {
            let (m0, m1, m2) = (shapes.axes[0][k][l], shapes.axes[1][k][l], shapes.axes[2][k][l]);
            g0[k] = fma64::<FMA>(p0[0], m0, fma64::<FMA>(p0[1], m1, p0[2] * m2));
            g1[k] = fma64::<FMA>(p1[0], m0, fma64::<FMA>(p1[1], m1, p1[2] * m2));
        }
        let a = fma64::<FMA>(g0[0], g0[0], fma64::<FMA>(g0[1], g0[1], g0[2] * g0[2]));
        let b = fma64::<FMA>(g0[0], g1[0], fma64::<FMA>(g0[1], g1[1], g0[2] * g1[2]));
        let c = fma64::<FMA>(g1[0], g1[0], fma64::<FMA>(g1[1], g1[1], g1[2] * g1[2]));
        let m01 = g0[0] * g1[1] - g0[1] * g1[0];
        let m02 = g0[0] * g1[2] - g0[2] * g1[0];
        let m12 = g0[1] * g1[2] - g0[2] * g1[1];
        let minors = fma64::<FMA>(m01, m01, fma64::<FMA>(m02, m02, m12 * m12));
        out.u[l] = fma64::<FMA>(camera.focal[0], ratio_x, camera.center[0]);
        out.v[l] = fma64::<FMA>(camera.focal[1], ratio_y, camera.center[1]);
        out.z[l] = z;
        out.a[l] = a + rules.blur;
        out.b[l] = b;
        out.c[l] = c + rules.blur;
        out.det[l] = fma64::<FMA>(rules.blur, a + c + rules.blur, minors);
    }
}

/// Larger eigenvalue of the covariance as gsplat bounds it.
#[inline(always)]
fn larger_eigenvalue(a: f64, c: f64, det: f64) -> f64 {
    let mid = 0.5 * (a + c);
    mid + (mid * mid - det).max(DISCRIMINANT_FLOOR).sqrt()
}

/// Pinned: `ceil(3 sigma)` of the larger axis, both ways.
#[inline(always)]
fn square_radius(out: &mut Footprints) {
    for l in 0..LANES {
        let radius = (3.0 * larger_eigenvalue(out.a[l], out.c[l], out.det[l]).sqrt()).ceil();
        out.radius_x[l] = radius;
        out.radius_y[l] = radius;
    }
}

/// Latest: per axis, as far as this opacity reaches 1/255, at most 3.33 standard deviations.
#[inline(always)]
fn rectangle_radius(shapes: &Shapes, out: &mut Footprints) {
    for l in 0..LANES {
        let extent = shapes.reach2[l].max(0.0).sqrt().min(LATEST_EXTENT);
        let largest = extent * larger_eigenvalue(out.a[l], out.c[l], out.det[l]).sqrt();
        out.radius_x[l] = (extent * out.a[l].sqrt()).min(largest).ceil();
        out.radius_y[l] = (extent * out.c[l].sqrt()).min(largest).ceil();
    }
}

/// Culling, and the pixels to look at: the tiles of the rule, the picture, and the box of `alpha >= 1/255`.
#[inline(always)]
fn boxes(centers: &Centers, shapes: &Shapes, camera: &Camera, rules: &Rules, out: &mut Footprints) {
    let [width, height] = camera.size;
    for l in 0..LANES {
        (out.x0[l], out.x1[l]) = pixel_span(out.u[l], out.radius_x[l], shapes.reach2[l] * out.a[l], width);
        (out.y0[l], out.y1[l]) = pixel_span(out.v[l], out.radius_y[l], shapes.reach2[l] * out.c[l], height);
    }
    for l in 0..LANES {
        let (u, v, rx, ry) = (out.u[l], out.v[l], out.radius_x[l], out.radius_y[l]);
        let ahead = out.z[l] >= rules.near && out.z[l] <= rules.far;
        let solid = out.det[l] > 0.0 && out.det[l] < f64::MAX;
        let large = match rules.convention {
            Convention::Pinned => rx > rules.radius_clip,
            Convention::Latest => (rx > rules.radius_clip || ry > rules.radius_clip) && shapes.reach2[l] >= 0.0,
        };
        let inside = u + rx > 0.0 && u - rx < width && v + ry > 0.0 && v - ry < height;
        let (k, e, f) = out.quadratic(l);
        let representable = k.is_finite() && e.is_finite() && f.is_finite();
        out.visible[l] = centers.usable[l] && ahead && solid && large && inside && representable;
    }
}

/// `[first, end)` of the pixels of one axis that lie in the rule's tiles, in the picture and within reach.
#[inline(always)]
fn pixel_span(center: f64, radius: f64, reach2: f64, size: f64) -> (f64, f64) {
    let tile = TILE_RULE as f64;
    let reach = reach2.max(0.0).sqrt() + BOX_MARGIN_PX;
    let rule_first = ((center - radius) * (1.0 / tile)).floor() * tile;
    let rule_end = ((center + radius) * (1.0 / tile)).ceil() * tile;
    let first = (center - reach - 0.5).ceil().max(rule_first).max(0.0);
    let end = ((center + reach - 0.5).floor() + 1.0).min(rule_end).min(size);
    (first, end)
}

impl Footprints {
    /// Lane `l` in gsplat's words.
    pub(crate) fn projection(&self, l: usize) -> super::Projection {
        let conic = [self.c[l], -self.b[l], self.a[l]].map(|x| (x / self.det[l]) as f32);
        super::Projection {
            mean: [self.u[l] as f32, self.v[l] as f32],
            conic,
            depth: self.z[l] as f32,
            radius: [self.radius_x[l] as f32, self.radius_y[l] as f32],
        }
    }
}
