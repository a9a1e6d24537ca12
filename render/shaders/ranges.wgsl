// Where each tile's splats begin and end in the sorted list.
//
// Algorithm: an entry whose neighbour has another tile is an end. The host clears `ranges` first: a tile without
// entries keeps (0, 0).
// Bindings: 0 view, 1 totals, 2 tiles (sorted), 3 ranges (out).
// Equations: none.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> totals: array<u32>;
@group(0) @binding(2) var<storage, read> tiles: array<u32>;
@group(0) @binding(3) var<storage, read_write> ranges: array<vec2<u32>>;

@compute @workgroup_size(256)
fn find_ranges(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) block: vec3<u32>) {
    let count = min(totals[PAIRS], view.capacity);
    for (var k = 0u; k < PER_THREAD; k++) {
        let i = block.x * BLOCK + k * 256u + t;
        if (i >= count) {
            break;
        }
        let tile = tiles[i];
        if (tile >= view.columns * view.rows) {
            continue;
        }
        var begins = i == 0u;
        if (i > 0u) {
            begins = tiles[i - 1u] != tile;
        }
        if (begins) {
            ranges[tile].x = i;
        }
        var ends = i + 1u == count;
        if (!ends) {
            ends = tiles[i + 1u] != tile;
        }
        if (ends) {
            ranges[tile].y = i + 1u;
        }
    }
}
