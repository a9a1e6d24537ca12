// Front-to-back blending of one 16x16 tile, four channels per dispatch.
//
// Algorithm: a workgroup is a tile, a thread a pixel. 256 splats at a time are fetched into workgroup memory and blended
// by all pixels; the tile ends when no pixel is unfinished. The first dispatch also writes alpha and depth.
// Bindings: 0 view, 1 chunk, 2 records, 3 slots (sorted by tile, then depth), 4 ranges, 5 the part of the features that
//   the chunk's channels are in (row-major Gaussians x channels of the part), 6 the buffer of the picture's features that
//   they go to (out, row-major pixels x channels of the buffer), 7 alpha of all pixels, then depth of all (out).
// Equations: C = sum_i f_i alpha_i T_i, T_i = prod_{j<i} (1 - alpha_j) (Kerbl et al. 2023, eq. 3), expected depth
// sum_i z_i w_i / max(sum_i w_i, 1e-10); alpha below 1/255 skipped, the splat that would bring T to 1e-4 ends the pixel
// and is left out (gsplat).

// The channels of this dispatch: where they are, how many (up to 4), where they go, and whether alpha and depth do too.
struct Chunk {
    source_first: u32,
    source_stride: u32,
    channels: u32,
    out_first: u32,
    out_stride: u32,
    planes: u32,
    unused0: u32,
    unused1: u32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> chunk: Chunk;
@group(0) @binding(2) var<storage, read> records: array<Record>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read> features: array<f32>;
@group(0) @binding(6) var<storage, read_write> out_features: array<f32>;
@group(0) @binding(7) var<storage, read_write> out_planes: array<f32>;

const BATCH: u32 = 256u;
const TRANSMITTANCE_STOP: f32 = 1e-4;
const ALPHA_FLOOR: f32 = 1e-10;
const LARGEST: f32 = 3.4028234e38;

// u, v, slope, across; along, opacity, depth, -.
var<workgroup> batch_shape: array<vec4<f32>, 256>;
var<workgroup> batch_rest: array<vec4<f32>, 256>;
var<workgroup> batch_features: array<vec4<f32>, 256>;
var<workgroup> unfinished: array<atomic<u32>, 1>;
var<workgroup> range: vec2<u32>;
var<workgroup> again: u32;

fn feature(slot: u32, channel: u32) -> f32 {
    if (channel < chunk.channels) {
        return features[slot * chunk.source_stride + chunk.source_first + channel];
    }
    return 0.0;
}

@compute @workgroup_size(16, 16)
fn blend(
    @builtin(local_invocation_index) t: u32,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(workgroup_id) tile: vec3<u32>,
) {
    let x = tile.x * TILE + local.x;
    let y = tile.y * TILE + local.y;
    let inside = x < view.width && y < view.height;
    if (t == 0u) {
        range = ranges[tile.y * view.columns + tile.x];
    }
    let span = workgroupUniformLoad(&range);
    // The pixel's centre seen from the tile's corner: small numbers keep their digits.
    let corner = vec2<f32>(f32(tile.x * TILE), f32(tile.y * TILE));
    let pixel = vec2<f32>(f32(local.x) + 0.5, f32(local.y) + 0.5);
    var transmittance = 1.0;
    var done = !inside;
    var weight_sum = 0.0;
    var weighted_depth = 0.0;
    var color = vec4<f32>(0.0);
    for (var start = span.x; start < span.y; start += BATCH) {
        if (t == 0u) {
            atomicStore(&unfinished[0], 0u);
        }
        if (start + t < span.y) {
            let slot = slots[start + t];
            let r = records[slot];
            batch_shape[t] = vec4<f32>(r.u - corner.x, r.v - corner.y, r.slope, r.across);
            batch_rest[t] = vec4<f32>(r.along, r.opacity, r.depth, 0.0);
            batch_features[t] = vec4<f32>(feature(slot, 0u), feature(slot, 1u), feature(slot, 2u), feature(slot, 3u));
        }
        workgroupBarrier();
        let count = min(BATCH, span.y - start);
        for (var k = 0u; k < count && !done; k++) {
            let shape = batch_shape[k];
            let rest = batch_rest[k];
            let dx = pixel.x - shape.x;
            let dy = pixel.y - shape.y;
            let sideways = dx - shape.z * dy;
            let alpha = min(rest.y * exp2(-(shape.w * sideways * sideways + rest.x * dy * dy)), view.alpha_cap);
            if (alpha >= ALPHA_MIN) {
                let weight = alpha * transmittance;
                let after = transmittance - weight;
                if (after > TRANSMITTANCE_STOP) {
                    transmittance = after;
                    weight_sum += weight;
                    weighted_depth += weight * rest.z;
                    color += weight * batch_features[k];
                } else {
                    done = true;
                }
            }
        }
        if (!done) {
            atomicAdd(&unfinished[0], 1u);
        }
        workgroupBarrier();
        if (t == 0u) {
            again = atomicLoad(&unfinished[0]);
        }
        if (workgroupUniformLoad(&again) == 0u) {
            break;
        }
    }
    if (!inside) {
        return;
    }
    let at = y * view.width + x;
    if (chunk.planes == 1u) {
        out_planes[at] = min(weight_sum, 1.0);
        out_planes[view.width * view.height + at] = weighted_depth / max(weight_sum, ALPHA_FLOOR);
    }
    for (var k = 0u; k < 4u; k++) {
        if (k < chunk.channels) {
            out_features[at * chunk.out_stride + chunk.out_first + k] = clamp(color[k], -LARGEST, LARGEST);
        }
    }
}
