//! The same rules written down once, slowly and obviously: f64, one Gaussian, one pixel at a time.
//!
//! Nothing here is shared with the fast version but the input checks and the constants; tests compare the two.

use super::scene::validate_views;
use super::settings::{ALPHA_FLOOR, ALPHA_MIN, DISCRIMINANT_FLOOR, LATEST_EXTENT, OPACITY_CEILING, TILE_RULE};
use super::{Convention, Picture, Projection, RasterError, RasterSettings, Splats, TRANSMITTANCE_STOP};
use crate::camera::View;

/// How close to a threshold counts as fragile, relative: f32 and f64 may decide differently there.
const FRAGILE_ALPHA: f64 = 1e-3;
/// As [`FRAGILE_ALPHA`], for the transmittance that ends a pixel (it is a long product).
const FRAGILE_STOP: f64 = 5e-3;
/// Relative depth gap below which the order of two splats is undecided in f32.
const FRAGILE_DEPTH: f64 = 2e-6;
/// Weight below which a swapped order changes nothing worth a mark.
const FRAGILE_WEIGHT: f64 = 1e-5;
/// Distance of a rectangle's side from a tile edge, pixels, at which f32 may list one tile more or less.
const FRAGILE_EDGE_PX: f64 = 2e-3;
/// Relative distance of a radius from a whole number at which its `ceil` is undecided.
const FRAGILE_RADIUS: f64 = 1e-4;

/// Renders every view; same input, same rules, same output as [`CpuRasterizer::render`](super::CpuRasterizer::render).
///
/// # Errors
/// As the fast version.
pub fn render(settings: &RasterSettings, splats: &Splats, views: &[View]) -> Result<Vec<Picture>, RasterError> {
    Ok(render_with_fragile(settings, splats, views)?.into_iter().map(|(picture, _)| picture).collect())
}

/// [`render`] with, per pixel, whether a decision (1/255, stop, depth order, radius, tile) was so close that f32 may
/// take it the other way.
///
/// # Errors
/// As the fast version.
pub fn render_with_fragile(
    settings: &RasterSettings,
    splats: &Splats,
    views: &[View],
) -> Result<Vec<(Picture, Vec<bool>)>, RasterError> {
    settings.validate()?;
    splats.validate()?;
    validate_views(views, splats.feature_count)?;
    Ok(views.iter().map(|view| render_view(settings, splats, view)).collect())
}

/// Where each Gaussian lands in a view: `None` where it is invalid or culled.
///
/// # Errors
/// As the fast version.
pub fn project(
    settings: &RasterSettings,
    splats: &Splats,
    view: &View,
) -> Result<Vec<Option<Projection>>, RasterError> {
    settings.validate()?;
    splats.validate()?;
    validate_views(std::slice::from_ref(view), splats.feature_count)?;
    let f = |x: f64| x as f32;
    Ok((0..splats.len())
        .map(|i| {
            let e = project_one(settings, splats, view, i)?;
            let radius = e.radius.map(f);
            Some(Projection { mean: e.mean.map(f), conic: e.conic.map(f), depth: f(e.depth), radius })
        })
        .collect())
}

/// A Gaussian in a picture.
struct Ellipse {
    id: usize,
    mean: [f64; 2],
    conic: [f64; 3],
    depth: f64,
    radius: [f64; 2],
    /// Before `ceil`.
    exact_radius: [f64; 2],
    opacity: f64,
}

/// Tiles `[first, end)` of one axis that the span `center - radius .. center + radius` touches.
fn tile_span(center: f64, radius: f64) -> (f64, f64) {
    (((center - radius) / TILE_RULE as f64).floor(), ((center + radius) / TILE_RULE as f64).ceil())
}

impl Ellipse {
    fn in_tile(&self, tile: [f64; 2]) -> bool {
        (0..2).all(|axis| {
            let (first, end) = tile_span(self.mean[axis], self.radius[axis]);
            first <= tile[axis] && tile[axis] < end
        })
    }

    /// True when a rounding of the radius or the centre could put the splat into this tile or out of it.
    fn tile_is_fragile(&self, tile: [f64; 2]) -> bool {
        (0..2).any(|axis| {
            let exact = self.exact_radius[axis];
            let near_whole = (exact - exact.round()).abs() < FRAGILE_RADIUS * exact.max(1.0);
            let slack = FRAGILE_EDGE_PX + if near_whole { 1.0 } else { 0.0 };
            let (wide_first, wide_end) = tile_span(self.mean[axis], self.radius[axis] + slack);
            let (tight_first, tight_end) = tile_span(self.mean[axis], self.radius[axis] - slack);
            let may = wide_first <= tile[axis] && tile[axis] < wide_end;
            let must = tight_first <= tile[axis] && tile[axis] < tight_end;
            may != must
        })
    }

    /// `o exp(-sigma)` at a picture point; `None` where rounding has made the exponent negative.
    fn falloff(&self, x: f64, y: f64) -> Option<f64> {
        let (dx, dy) = (self.mean[0] - x, self.mean[1] - y);
        let [a, b, c] = self.conic;
        let sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy;
        (sigma >= 0.0).then(|| self.opacity * (-sigma).exp())
    }
}

type Mat3 = [[f64; 3]; 3];

fn multiply(a: &Mat3, b: &Mat3) -> Mat3 {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

fn transpose(a: &Mat3) -> Mat3 {
    std::array::from_fn(|i| std::array::from_fn(|j| a[j][i]))
}

fn rotation_of(quat: &[f32; 4]) -> Mat3 {
    let q = quat.map(f64::from);
    let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    let [w, x, y, z] = q.map(|v| v / norm);
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

fn project_one(settings: &RasterSettings, splats: &Splats, view: &View, id: usize) -> Option<Ellipse> {
    if !splats.is_usable(id) {
        return None;
    }
    let cols = view.camera_from_world.matrix3.to_cols_array_2d();
    let w: Mat3 = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(cols[j][i])));
    let t = view.camera_from_world.translation.to_array();
    let mean = splats.means[id].map(f64::from);
    let [x, y, z]: [f64; 3] = std::array::from_fn(|i| (0..3).map(|j| w[i][j] * mean[j]).sum::<f64>() + f64::from(t[i]));
    if !(z >= f64::from(settings.near) && z <= f64::from(settings.far)) {
        return None;
    }
    let k = &view.intrinsics;
    let (fx, fy, cx, cy) = (f64::from(k.fx), f64::from(k.fy), f64::from(k.cx), f64::from(k.cy));
    let (width, height) = (k.width as f64, k.height as f64);
    let (u, v) = (fx * x / z + cx, fy * y / z + cy);

    // The field of view the Jacobian is taken in.
    let (tan_x, tan_y) = (0.5 * width / fx, 0.5 * height / fy);
    let (tx, ty) = match settings.convention {
        Convention::Pinned => {
            (z * (x / z).clamp(-1.3 * tan_x, 1.3 * tan_x), z * (y / z).clamp(-1.3 * tan_y, 1.3 * tan_y))
        }
        Convention::Latest => (
            z * (x / z).max(-(cx / fx + 0.3 * tan_x)).min((width - cx) / fx + 0.3 * tan_x),
            z * (y / z).max(-(cy / fy + 0.3 * tan_y)).min((height - cy) / fy + 0.3 * tan_y),
        ),
    };

    // Sigma = R S S R^T in the world, W Sigma W^T in the camera, J Sigma J^T + blur in the picture.
    let mut rs = rotation_of(&splats.quats[id]);
    for row in &mut rs {
        for (entry, &scale) in row.iter_mut().zip(&splats.scales[id]) {
            *entry *= f64::from(scale);
        }
    }
    let sigma = multiply(&rs, &transpose(&rs));
    let sigma = multiply(&multiply(&w, &sigma), &transpose(&w));
    let j: Mat3 = [[fx / z, 0.0, -fx * tx / (z * z)], [0.0, fy / z, -fy * ty / (z * z)], [0.0; 3]];
    let cov = multiply(&multiply(&j, &sigma), &transpose(&j));
    let blur = f64::from(settings.blur);
    let (a, b, c) = (cov[0][0] + blur, cov[0][1], cov[1][1] + blur);
    let det = a * c - b * b;
    if !(det > 0.0 && det < f64::MAX) {
        return None;
    }

    let opacity = f64::from(splats.opacities[id].min(OPACITY_CEILING));
    let mid = 0.5 * (a + c);
    let largest = (mid + (mid * mid - det).max(DISCRIMINANT_FLOOR).sqrt()).sqrt();
    let clip = f64::from(settings.radius_clip);
    let (exact_radius, too_small) = match settings.convention {
        Convention::Pinned => {
            let r = 3.0 * largest;
            ([r, r], r.ceil() <= clip)
        }
        Convention::Latest => {
            if splats.opacities[id] < ALPHA_MIN || opacity <= 0.0 {
                return None;
            }
            let extent = (2.0 * (opacity / f64::from(ALPHA_MIN)).ln()).max(0.0).sqrt().min(LATEST_EXTENT);
            let r = [extent * a.sqrt().min(largest), extent * c.sqrt().min(largest)];
            (r, r[0].ceil() <= clip && r[1].ceil() <= clip)
        }
    };
    let radius = exact_radius.map(f64::ceil);
    let inside_x = u + radius[0] > 0.0 && u - radius[0] < width;
    let inside_y = v + radius[1] > 0.0 && v - radius[1] < height;
    if too_small || !inside_x || !inside_y {
        return None;
    }
    Some(Ellipse { id, mean: [u, v], conic: [c / det, -b / det, a / det], depth: z, radius, exact_radius, opacity })
}

/// A view's picture before it is rounded to f32.
pub(super) struct ExactPicture {
    pub(super) features: Vec<f64>,
    pub(super) alpha: Vec<f64>,
    pub(super) depth: Vec<f64>,
    pub(super) fragile: Vec<bool>,
}

fn render_view(settings: &RasterSettings, splats: &Splats, view: &View) -> (Picture, Vec<bool>) {
    let exact = render_exact(settings, splats, view);
    let mut picture = Picture::default();
    picture.resize(view.intrinsics.width, view.intrinsics.height, splats.feature_count);
    let round = |to: &mut [f32], from: &[f64], low: f32, high: f32| {
        for (to, from) in to.iter_mut().zip(from) {
            *to = from.clamp(f64::from(low), f64::from(high)) as f32;
        }
    };
    round(&mut picture.features, &exact.features, f32::MIN, f32::MAX);
    round(&mut picture.alpha, &exact.alpha, 0.0, 1.0);
    round(&mut picture.depth, &exact.depth, 0.0, f32::MAX);
    (picture, exact.fragile)
}

/// Renders checked input in f64; what finite differences are taken of.
pub(super) fn render_exact(settings: &RasterSettings, splats: &Splats, view: &View) -> ExactPicture {
    let mut ellipses: Vec<Ellipse> = (0..splats.len()).filter_map(|i| project_one(settings, splats, view, i)).collect();
    // The order of the fast version: z rounded to f32, then index.
    ellipses.sort_by(|p, q| (p.depth as f32).total_cmp(&(q.depth as f32)).then(p.id.cmp(&q.id)));
    let (width, height) = (view.intrinsics.width, view.intrinsics.height);
    let mut picture = ExactPicture { features: vec![], alpha: vec![], depth: vec![], fragile: vec![] };
    let mut sums = vec![0.0; splats.feature_count];
    for row in 0..height {
        for col in 0..width {
            let (weight, weighted_depth, fragile) = blend_pixel(settings, splats, &ellipses, col, row, &mut sums);
            picture.features.extend_from_slice(&sums);
            picture.alpha.push(weight);
            picture.depth.push(weighted_depth / weight.max(f64::from(ALPHA_FLOOR)));
            picture.fragile.push(fragile);
        }
    }
    picture
}

/// `sum(w)`, `sum(w z)` and fragility of one pixel; `sums` receives `sum(w f)`.
fn blend_pixel(
    settings: &RasterSettings,
    splats: &Splats,
    ellipses: &[Ellipse],
    col: usize,
    row: usize,
    sums: &mut [f64],
) -> (f64, f64, bool) {
    let cap = f64::from(settings.convention.alpha_cap());
    let (alpha_min, stop) = (f64::from(ALPHA_MIN), f64::from(TRANSMITTANCE_STOP));
    let tile = [(col / TILE_RULE) as f64, (row / TILE_RULE) as f64];
    let (mut transmittance, mut weight_sum, mut weighted_depth) = (1.0, 0.0, 0.0);
    let mut fragile = false;
    let mut previous_depth = f64::NEG_INFINITY;
    sums.fill(0.0);
    for e in ellipses {
        let Some(falloff) = e.falloff(col as f64 + 0.5, row as f64 + 0.5) else { continue };
        if falloff < (1.0 - FRAGILE_ALPHA) * alpha_min {
            continue;
        }
        fragile |= e.tile_is_fragile(tile);
        if !e.in_tile(tile) {
            continue;
        }
        fragile |= (falloff / alpha_min - 1.0).abs() < FRAGILE_ALPHA;
        let alpha = falloff.min(cap);
        if alpha < alpha_min {
            continue;
        }
        let next = transmittance * (1.0 - alpha);
        fragile |= (next / stop - 1.0).abs() < FRAGILE_STOP;
        if next <= stop {
            break;
        }
        let weight = alpha * transmittance;
        if weight > FRAGILE_WEIGHT {
            fragile |= e.depth - previous_depth < FRAGILE_DEPTH * e.depth;
            previous_depth = e.depth;
        }
        weight_sum += weight;
        weighted_depth += weight * e.depth;
        for (sum, &feature) in sums.iter_mut().zip(splats.feature_row(e.id)) {
            *sum += weight * f64::from(feature);
        }
        transmittance = next;
    }
    (weight_sum, weighted_depth, fragile)
}
