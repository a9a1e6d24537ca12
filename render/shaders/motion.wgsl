// Where the Gaussians stand at the time drawn.
//
// Algorithm: one thread per Gaussian, once per time, not per view. What has no place at that time (a velocity or time
// that is not finite, or a centre beyond all numbers) is marked unusable for these views and counted.
// Bindings: 0 view (only `splats` and `time`), 1 means, 2 backward velocities, 3 forward velocities, 4 times, 5 solid (see
//   check.wgsl), 6 moved means (out), 7 solid now (out), 8 lost (out: how many usable Gaussians have no place).
// Equation: STORM's motion (paper eq. 1): mean(t') = mean + (t' - t) v, with v the backward velocity where t' < t and
// the forward velocity elsewhere.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> means: array<f32>;
@group(0) @binding(2) var<storage, read> backward: array<f32>;
@group(0) @binding(3) var<storage, read> forward: array<f32>;
@group(0) @binding(4) var<storage, read> times: array<f32>;
@group(0) @binding(5) var<storage, read> solid: array<u32>;
@group(0) @binding(6) var<storage, read_write> moved: array<f32>;
@group(0) @binding(7) var<storage, read_write> solid_now: array<u32>;
@group(0) @binding(8) var<storage, read_write> lost: array<atomic<u32>>;

@compute @workgroup_size(256)
fn move_means(@builtin(global_invocation_id) id: vec3<u32>) {
    let i = id.x;
    if (i >= view.splats) {
        return;
    }
    let dt = view.time - times[i];
    var placed = is_finite(times[i]) && is_finite(dt);
    for (var k = 0u; k < 3u; k++) {
        let at = 3u * i + k;
        var v = forward[at];
        if (dt < 0.0) {
            v = backward[at];
        }
        let x = means[at] + dt * v;
        placed = placed && is_finite(v) && is_finite(x);
        moved[at] = x;
    }
    if (solid[i] != NO_MORE && !placed) {
        atomicAdd(&lost[0], 1u);
        solid_now[i] = NO_MORE;
    } else {
        solid_now[i] = solid[i];
    }
}
