// Which Gaussians are usable: finite numbers and an orientation.
//
// Algorithm: one thread per Gaussian looks at the bits of all its numbers, so that neither NaN arithmetic nor the
// flushing of subnormals, both left open by WGSL, decides. Once per upload, not per view; once more for each further
// buffer of features, where these do not fit one.
// Bindings: 0 part, 1 means, 2 quaternions, 3 scales, 4 opacities, 5 features of this part, 6 solid (out: bits of the
//   opacity, at most 1e18, or NO_MORE for an unusable Gaussian), 7 invalid (out: count).
// Equation: none; the rule is that of `Splats::is_usable` on the CPU.

struct Part {
    splats: u32,
    // Channels of this part.
    channels: u32,
    // 0 for the first part, 1 for the others.
    later: u32,
    unused: u32,
}

@group(0) @binding(0) var<uniform> part: Part;
@group(0) @binding(1) var<storage, read> means: array<u32>;
@group(0) @binding(2) var<storage, read> quats: array<u32>;
@group(0) @binding(3) var<storage, read> scales: array<u32>;
@group(0) @binding(4) var<storage, read> opacities: array<u32>;
@group(0) @binding(5) var<storage, read> features: array<u32>;
@group(0) @binding(6) var<storage, read_write> solid: array<u32>;
@group(0) @binding(7) var<storage, read_write> invalid: array<atomic<u32>>;

const EXPONENT: u32 = 0x7f800000u;
const OPACITY_CEILING: f32 = 1e18;

fn bad(bits: u32) -> bool {
    return (bits & EXPONENT) == EXPONENT;
}

@compute @workgroup_size(256)
fn check(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x;
    if (i >= part.splats) {
        return;
    }
    if (part.later == 1u && solid[i] == NO_MORE) {
        return;
    }
    var unusable = bad(opacities[i]);
    for (var k = 0u; k < 3u; k++) {
        unusable = unusable || bad(means[3u * i + k]) || bad(scales[3u * i + k]);
    }
    var orientation = 0u;
    for (var k = 0u; k < 4u; k++) {
        let bits = quats[4u * i + k];
        unusable = unusable || bad(bits);
        orientation |= bits & 0x7fffffffu;
    }
    for (var k = 0u; k < part.channels; k++) {
        unusable = unusable || bad(features[part.channels * i + k]);
    }
    if (unusable || orientation == 0u) {
        solid[i] = NO_MORE;
        atomicAdd(&invalid[0], 1u);
    } else {
        solid[i] = bitcast<u32>(min(bitcast<f32>(opacities[i]), OPACITY_CEILING));
    }
}
