// Gaussians to picture ellipses, one view.
//
// Algorithm: one thread per Gaussian: camera position, culling, 2D covariance, the convention's radius, then the record
// the blending reads, the tiles it may go to and how many of them its ellipse meets.
// Bindings: 0 view, 1 means, 2 quaternions, 3 scales, 4 solid (see check.wgsl), 5 records (out), 6 spans (out: columns
//   first | end << 16, rows first | end << 16, number of tiles, sort key), 7 totals (out: VISIBLE).
// Equations: Sigma' = J W Sigma W^T J^T + blur I (Zwicker et al. 2001, EWA splatting, eq. 31; Kerbl et al. 2023,
// eq. 5), J taken at the clamped x/z and y/z; radius and culling by gsplat (see `Convention`).
// Precision: the camera position is summed in pairs of f32, so that depths, hence the order, are those of f64. With
// G = J W R S / k the determinant is the sum of the squared 2x2 minors of G plus blur (trace + blur), all in units of k,
// which does not cancel as a c - b^2 does for needles; k, the largest entry, keeps the squares of huge splats in range.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> means: array<f32>;
@group(0) @binding(2) var<storage, read> quats: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> scales: array<f32>;
@group(0) @binding(4) var<storage, read> solid: array<u32>;
@group(0) @binding(5) var<storage, read_write> records: array<Record>;
@group(0) @binding(6) var<storage, read_write> spans: array<vec4<u32>>;
@group(0) @binding(7) var<storage, read_write> totals: array<atomic<u32>>;

const HALF_LOG2_E: f32 = 0.72134752;
const LN_2: f32 = 0.69314718;
const LATEST_EXTENT: f32 = 3.33;
const DISCRIMINANT_FLOOR: f32 = 0.01;
// Flattest falloff kept; over 32768 pixels it changes alpha by less than f32 can tell.
const FLATTEST: f32 = 1e-30;
// Positions outside are as good as infinite, and their tiles stay representable.
const FAR_AWAY: f32 = 1e30;

// A sum kept in two numbers.
struct Pair {
    high: f32,
    low: f32,
}

// Knuth's two-sum: the rounding error of a sum is itself a number.
fn add(sum: Pair, x: f32) -> Pair {
    let high = sum.high + x;
    let part = high - sum.high;
    let error = (sum.high - (high - part)) + (x - part);
    return Pair(high, sum.low + error);
}

// Adds a b. The factors are cut to halves of 12 bits, whose products are exact whether or not they are fused.
fn add_product(sum: Pair, a: f32, b: f32) -> Pair {
    let a_high = bitcast<f32>(bitcast<u32>(a) & 0xfffff000u);
    let b_high = bitcast<f32>(bitcast<u32>(b) & 0xfffff000u);
    let a_low = a - a_high;
    let b_low = b - b_high;
    var result = add(sum, a_high * b_high);
    result = add(result, a_high * b_low);
    result = add(result, a_low * b_high);
    return add(result, a_low * b_low);
}

fn transformed(row: vec4<f32>, p: vec3<f32>) -> f32 {
    var sum = add_product(Pair(row.w, 0.0), row.x, p.x);
    sum = add_product(sum, row.y, p.y);
    sum = add_product(sum, row.z, p.z);
    return sum.high + sum.low;
}

// The number whose bits these are, scaled so that subnormals are ordinary numbers.
fn mantissa(bits: u32) -> f32 {
    let size = f32(bits & 0x7fffffffu);
    return select(size, -size, (bits >> 31u) == 1u);
}

// A unit quaternion from any but zero, however large or small.
fn normalized(q: vec4<f32>) -> vec4<f32> {
    var p = q;
    let bits = bitcast<vec4<u32>>(q) & vec4<u32>(0x7fffffffu);
    let largest = max(max(bits.x, bits.y), max(bits.z, bits.w));
    if (largest < 0x00800000u) {
        let raw = bitcast<vec4<u32>>(q);
        p = vec4<f32>(mantissa(raw.x), mantissa(raw.y), mantissa(raw.z), mantissa(raw.w));
    }
    let size = max(max(abs(p.x), abs(p.y)), max(abs(p.z), abs(p.w)));
    // In two steps: the reciprocal of a huge size may be subnormal.
    p = p / size;
    return p / sqrt(dot(p, p));
}

// Tiles [first, end) of one axis within center -+ half_side, 0 to count.
fn tile_span(center: f32, half_side: f32, count: u32) -> vec2<u32> {
    let tile = f32(TILE);
    let limit = f32(count);
    let first = clamp(floor((center - half_side) / tile), 0.0, limit);
    let end = clamp(ceil((center + half_side) / tile), 0.0, limit);
    return vec2<u32>(u32(first), u32(end));
}

@compute @workgroup_size(256)
fn project(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x;
    if (i >= view.splats) {
        return;
    }
    spans[i] = vec4<u32>(0u);
    if (solid[i] == NO_MORE) {
        return;
    }
    let opacity = bitcast<f32>(solid[i]);
    let mean = vec3<f32>(means[3u * i], means[3u * i + 1u], means[3u * i + 2u]);
    let z = transformed(view.row2, mean);
    if (!(z >= view.near && z <= view.far)) {
        return;
    }
    let position = vec2<f32>(transformed(view.row0, mean), transformed(view.row1, mean));
    let ratio = position / z;
    let point = view.focal * ratio + view.center;
    if (!(abs(point.x) < FAR_AWAY && abs(point.y) < FAR_AWAY)) {
        return;
    }

    // Columns of R S / s with s the largest scale.
    let q = normalized(quats[i]);
    let scale = abs(vec3<f32>(scales[3u * i], scales[3u * i + 1u], scales[3u * i + 2u]));
    let largest_scale = max(max(scale.x, scale.y), max(scale.z, 1e-30));
    let s = scale / largest_scale;
    let axis0 = s.x * vec3<f32>(
        1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z));
    let axis1 = s.y * vec3<f32>(
        2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y));
    let axis2 = s.z * vec3<f32>(
        2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
    let tangent = clamp(ratio, view.clamp_min, view.clamp_max);
    // Rows of J W.
    let focal = view.focal / z;
    let jw0 = focal.x * (view.row0.xyz - tangent.x * view.row2.xyz);
    let jw1 = focal.y * (view.row1.xyz - tangent.y * view.row2.xyz);
    var g0 = vec3<f32>(dot(jw0, axis0), dot(jw0, axis1), dot(jw0, axis2));
    var g1 = vec3<f32>(dot(jw1, axis0), dot(jw1, axis1), dot(jw1, axis2));
    // Pixels of one unit: covariances below are in square units of it.
    let largest = max(max(abs(g0.x), max(abs(g0.y), abs(g0.z))), max(abs(g1.x), max(abs(g1.y), abs(g1.z))));
    let unit = max(largest * largest_scale, 1.0);
    if (!(unit < FAR_AWAY)) {
        return;
    }
    let shrink = largest_scale / unit;
    g0 = g0 * shrink;
    g1 = g1 * shrink;
    let blur = view.blur / unit / unit;
    let raw_a = dot(g0, g0);
    let raw_c = dot(g1, g1);
    let a = raw_a + blur;
    let b = dot(g0, g1);
    let c = raw_c + blur;
    let minors = cross(g0, g1);
    let det = dot(minors, minors) + blur * (raw_a + raw_c + blur);
    if (!(det > 0.0 && c > 0.0)) {
        return;
    }

    // Units of length from here on; the floor of the discriminant is in pixels to the fourth.
    let reach = reach_of(opacity);
    let half_difference = 0.5 * (a - c);
    let floor_units = DISCRIMINANT_FLOOR / unit / unit / unit / unit;
    let eigenvalue = 0.5 * (a + c) + sqrt(max(half_difference * half_difference + b * b, floor_units));
    var radius = vec2<f32>(ceil(3.0 * sqrt(eigenvalue) * unit));
    var large = radius.x > view.radius_clip;
    if (view.convention == 1u) {
        let extent = min(sqrt(2.0 * LN_2 * max(reach, 0.0)), LATEST_EXTENT);
        let longest = extent * sqrt(eigenvalue);
        radius = ceil(min(extent * sqrt(vec2<f32>(a, c)), vec2<f32>(longest)) * unit);
        large = (radius.x > view.radius_clip || radius.y > view.radius_clip) && reach >= 0.0;
    }
    let inside = all(point + radius > vec2<f32>(0.0)) && all(point - radius < view.size);
    let slope = b / c;
    let across = HALF_LOG2_E * c / det / unit / unit;
    let along = HALF_LOG2_E / c / unit / unit;
    if (!(large && inside && is_finite(slope) && is_finite(across) && is_finite(along))) {
        return;
    }
    atomicAdd(&totals[VISIBLE], 1u);
    if (!(reach >= 0.0)) {
        return;
    }

    var record: Record;
    record.u = point.x;
    record.v = point.y;
    record.slope = slope;
    record.across = max(across, FLATTEST);
    record.along = max(along, FLATTEST);
    record.opacity = opacity;
    record.depth = z;
    let columns = tile_span(point.x, radius.x, view.columns);
    let rows = tile_span(point.y, radius.y, view.rows);
    let used = used_rows(record, reach, rows);
    var tiles = 0u;
    for (var row = used.x; row < used.y; row++) {
        let span = row_span(record, reach, row, columns.x, columns.y);
        tiles += span.y - span.x;
    }
    records[i] = record;
    spans[i] = vec4<u32>(
        columns.x | (columns.y << 16u), used.x | (used.y << 16u), tiles, bitcast<u32>(z) - bitcast<u32>(view.near));
}

// The rows of the rule's rectangle that the ellipse reaches.
fn used_rows(record: Record, reach: f32, rows: vec2<u32>) -> vec2<u32> {
    let half_height = sqrt((reach * 1.00001 + 1e-5) / record.along) + 2e-3 + 4e-6 * abs(record.v);
    let reached = tile_span(record.v, half_height, view.rows);
    let first = max(rows.x, reached.x);
    return vec2<u32>(first, max(first, min(rows.y, reached.y)));
}
