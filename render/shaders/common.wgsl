// What every shader shares: the view, the splat record, and which 16x16 tiles an ellipse meets.
//
// Algorithm: this text is put in front of each of the other files; it has no entry point.
// Bindings: none of its own. All files use group 0.
// Equations: alpha(d) = o 2^-q(d), q(d) = across (dx - slope dy)^2 + along dy^2, the Gaussian of Kerbl et al. 2023
// (eq. 4 of 3D Gaussian Splatting) in base 2 and as a sum of squares, with [[a, b], [b, c]] its 2D covariance:
//   slope = b / c,  across = log2(e)/2 * c / det,  along = log2(e)/2 / c.
// A pixel can be blended where q <= log2(255 o). For one dy the ellipse spans
//   dx = slope dy -+ sqrt((log2(255 o) - along dy^2) / across),
// a concave (convex) function of dy, whose extremum over a row of tiles is at a clamped known dy.

struct View {
    // Rows of the rotation, each with its part of the translation in w.
    row0: vec4<f32>,
    row1: vec4<f32>,
    row2: vec4<f32>,
    focal: vec2<f32>,
    center: vec2<f32>,
    // Picture size, pixels.
    size: vec2<f32>,
    // x/z and y/z between which the Jacobian is taken.
    clamp_min: vec2<f32>,
    clamp_max: vec2<f32>,
    near: f32,
    far: f32,
    radius_clip: f32,
    blur: f32,
    alpha_cap: f32,
    // 0: Convention::Pinned, 1: Convention::Latest.
    convention: u32,
    splats: u32,
    // Where the Gaussians are, seconds.
    time: f32,
    width: u32,
    height: u32,
    columns: u32,
    rows: u32,
    // Entries the tile lists have room for.
    capacity: u32,
    unused: u32,
}

struct Record {
    u: f32,
    v: f32,
    slope: f32,
    across: f32,
    along: f32,
    opacity: f32,
    depth: f32,
    unused: f32,
}

// Counts of one view, as they come back to the host.
const VISIBLE: u32 = 0u; // what the convention blends
const DRAWN: u32 = 1u;   // of these, what has a tile
const PAIRS: u32 = 2u;   // entries of the tile lists, also when there is no room for them

const TILE: u32 = 16u;
// Elements one workgroup of 256 scans, counts or moves.
const BLOCK: u32 = 2048u;
const PER_THREAD: u32 = 8u;
const ALPHA_MIN: f32 = 1.0 / 255.0;
const NO_MORE: u32 = 0xffffffffu;

fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

// Sum that stays at the largest number instead of wrapping round; associative, so scans may use it.
fn add_saturating(a: u32, b: u32) -> u32 {
    let sum = a + b;
    return select(sum, NO_MORE, sum < a);
}

// log2(255 o): q at which alpha has fallen to 1/255; negative where it never gets there.
fn reach_of(opacity: f32) -> f32 {
    if (opacity >= ALPHA_MIN) {
        return log2(opacity / ALPHA_MIN);
    }
    return -1.0;
}

// Columns [x, y) of tiles in tile row `row` with a pixel that may be blended, within [first, end).
fn row_span(record: Record, reach: f32, row: u32, first: u32, end: u32) -> vec2<u32> {
    // f32 rounding of the positions below; a tile too many only costs time.
    let margin = 2e-3;
    let top = f32(row * TILE) + 0.5 - record.v - margin;
    let bottom = f32(row * TILE + TILE - 1u) + 0.5 - record.v + margin;
    let enlarged = reach * 1.00001 + 1e-5;
    let half_height = sqrt(enlarged / record.along);
    let low = max(top, -half_height);
    let high = min(bottom, half_height);
    if (!(low <= high)) {
        return vec2<u32>(first, first);
    }
    // dy of the rightmost point; of the leftmost with the opposite sign.
    let tilt = abs(record.slope) * sqrt(record.across);
    var share = 1.0;
    if (tilt < 1e15) {
        share = tilt / sqrt(record.along + tilt * tilt);
    }
    let peak = sign(record.slope) * half_height * share;
    let right_dy = clamp(peak, low, high);
    let left_dy = clamp(-peak, low, high);
    let right = record.slope * right_dy
        + sqrt(max(enlarged - record.along * right_dy * right_dy, 0.0) / record.across);
    let left = record.slope * left_dy
        - sqrt(max(enlarged - record.along * left_dy * left_dy, 0.0) / record.across);
    let slack = margin + 4e-6 * (abs(left) + abs(right) + abs(record.u));
    let limit = f32(end * TILE);
    let first_pixel = clamp(ceil(record.u + left - slack - 0.5), f32(first * TILE), limit);
    let end_pixel = clamp(floor(record.u + right + slack - 0.5) + 1.0, f32(first * TILE), limit);
    if (first_pixel < end_pixel) {
        return vec2<u32>(u32(first_pixel) / TILE, (u32(end_pixel) + TILE - 1u) / TILE);
    }
    return vec2<u32>(first, first);
}
