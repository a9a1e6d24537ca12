// Prefix sums, and the three lists made with them.
//
// Algorithm: reduce, then scan. `reduce_*` adds up blocks of 2048 numbers; `scan_sums` turns the block sums into
// exclusive prefix sums in one workgroup and writes the total and the size of the next dispatches; `compact` and `emit`
// scan their block again from its sum on. Hillis and Steele's scan inside a workgroup; no subgroup operations.
// Sums saturate, so that more entries than u32 counts is seen as too many and not as few.
// Bindings: 0 view, 1 step, 2 spans (see project.wgsl), 3 totals, 4 sums, 5 keys, 6 slots (values), 7 records, 8 args,
//   9 sorted slots (in).
// Equations: none.

struct Step {
    // First bit of the digit (sort.wgsl).
    shift: u32,
    // What is scanned: one of the SCAN constants.
    scan: u32,
    unused0: u32,
    unused1: u32,
}

const SCAN_DRAWN: u32 = 0u;  // block sums of "has a tile"
const SCAN_TILES: u32 = 1u;  // block sums of tile numbers, nearest splat first
const SCAN_DRAWN_DIGITS: u32 = 2u; // digit histograms of the depth sort
const SCAN_PAIR_DIGITS: u32 = 3u;  // digit histograms of the tile sort

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read> spans: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read_write> totals: array<u32>;
@group(0) @binding(4) var<storage, read_write> sums: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys: array<u32>;
@group(0) @binding(6) var<storage, read_write> slots: array<u32>;
@group(0) @binding(7) var<storage, read> records: array<Record>;
@group(0) @binding(8) var<storage, read_write> args: array<u32>;
@group(0) @binding(9) var<storage, read> sorted: array<u32>;

var<workgroup> shared_sums: array<u32, 256>;

// Inclusive prefix sum of one number per thread.
fn scan_workgroup(t: u32, value: u32) -> u32 {
    var sum = value;
    shared_sums[t] = sum;
    workgroupBarrier();
    for (var distance = 1u; distance < 256u; distance *= 2u) {
        var before = 0u;
        if (t >= distance) {
            before = shared_sums[t - distance];
        }
        workgroupBarrier();
        sum = add_saturating(sum, before);
        shared_sums[t] = sum;
        workgroupBarrier();
    }
    return sum;
}

// 1 where splat i has a tile.
fn drawn(i: u32) -> u32 {
    if (i < view.splats) {
        return min(spans[i].z, 1u);
    }
    return 0u;
}

// Tiles of the j-th nearest splat.
fn tiles(j: u32, count: u32) -> u32 {
    if (j < count) {
        return spans[sorted[j]].z;
    }
    return 0u;
}

@compute @workgroup_size(256)
fn reduce_drawn(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) block: vec3<u32>) {
    var sum = 0u;
    for (var k = 0u; k < PER_THREAD; k++) {
        sum += drawn(block.x * BLOCK + k * 256u + t);
    }
    let total = scan_workgroup(t, sum);
    if (t == 255u) {
        sums[block.x] = total;
    }
}

@compute @workgroup_size(256)
fn reduce_tiles(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) block: vec3<u32>) {
    let count = totals[DRAWN];
    var sum = 0u;
    for (var k = 0u; k < PER_THREAD; k++) {
        sum = add_saturating(sum, tiles(block.x * BLOCK + k * 256u + t, count));
    }
    let total = scan_workgroup(t, sum);
    if (t == 255u) {
        sums[block.x] = total;
    }
}

fn blocks_of(count: u32) -> u32 {
    return count / BLOCK + min(count % BLOCK, 1u);
}

fn sums_to_scan() -> u32 {
    switch (step.scan) {
        case SCAN_DRAWN: {
            return blocks_of(view.splats);
        }
        case SCAN_TILES: {
            return blocks_of(totals[DRAWN]);
        }
        case SCAN_DRAWN_DIGITS: {
            return 16u * blocks_of(totals[DRAWN]);
        }
        default: {
            return 16u * blocks_of(min(totals[PAIRS], view.capacity));
        }
    }
}

var<workgroup> shared_length: u32;

// One workgroup.
@compute @workgroup_size(256)
fn scan_sums(@builtin(local_invocation_index) t: u32) {
    if (t == 0u) {
        shared_length = sums_to_scan();
    }
    let length = workgroupUniformLoad(&shared_length);
    var carry = 0u;
    for (var start = 0u; start < length; start += BLOCK) {
        let first = start + t * PER_THREAD;
        var own = 0u;
        for (var k = 0u; k < PER_THREAD; k++) {
            if (first + k < length) {
                own = add_saturating(own, sums[first + k]);
            }
        }
        scan_workgroup(t, own);
        var before = carry;
        if (t > 0u) {
            before = add_saturating(carry, shared_sums[t - 1u]);
        }
        carry = add_saturating(carry, shared_sums[255]);
        workgroupBarrier();
        for (var k = 0u; k < PER_THREAD; k++) {
            if (first + k < length) {
                let value = sums[first + k];
                sums[first + k] = before;
                before = add_saturating(before, value);
            }
        }
    }
    if (t == 0u && step.scan == SCAN_DRAWN) {
        totals[DRAWN] = carry;
        args[0] = blocks_of(carry);
        args[1] = 1u;
        args[2] = 1u;
    }
    if (t == 0u && step.scan == SCAN_TILES) {
        totals[PAIRS] = carry;
        args[4] = blocks_of(min(carry, view.capacity));
        args[5] = 1u;
        args[6] = 1u;
    }
}

// Lists the splats that have a tile, in index order: sort key and slot.
@compute @workgroup_size(256)
fn compact(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) block: vec3<u32>) {
    let first = block.x * BLOCK + t * PER_THREAD;
    var own = 0u;
    for (var k = 0u; k < PER_THREAD; k++) {
        own += drawn(first + k);
    }
    var at = sums[block.x] + scan_workgroup(t, own) - own;
    for (var k = 0u; k < PER_THREAD; k++) {
        if (drawn(first + k) == 1u) {
            keys[at] = spans[first + k].w;
            slots[at] = first + k;
            at += 1u;
        }
    }
}

// Lists the tiles of every splat, nearest splat first: tile number and slot.
@compute @workgroup_size(256)
fn emit(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) block: vec3<u32>) {
    let count = totals[DRAWN];
    let first = block.x * BLOCK + t * PER_THREAD;
    var own = 0u;
    for (var k = 0u; k < PER_THREAD; k++) {
        own = add_saturating(own, tiles(first + k, count));
    }
    scan_workgroup(t, own);
    var at = sums[block.x];
    if (t > 0u) {
        at = add_saturating(at, shared_sums[t - 1u]);
    }
    for (var k = 0u; k < PER_THREAD; k++) {
        let number = tiles(first + k, count);
        let end = min(add_saturating(at, number), view.capacity);
        if (number > 0u && at < end) {
            emit_one(sorted[first + k], at, end);
        }
        at = add_saturating(at, number);
    }
}

// Fills entries [at, end), all of them: should rounding find fewer tiles here than project.wgsl did, the rest gets a
// tile outside the picture.
fn emit_one(slot: u32, from_entry: u32, end: u32) {
    var at = from_entry;
    let span = spans[slot];
    let record = records[slot];
    let reach = reach_of(record.opacity);
    for (var row = span.y & 0xffffu; row < (span.y >> 16u) && at < end; row++) {
        let columns = row_span(record, reach, row, span.x & 0xffffu, span.x >> 16u);
        for (var column = columns.x; column < columns.y && at < end; column++) {
            keys[at] = row * view.columns + column;
            slots[at] = slot;
            at += 1u;
        }
    }
    for (; at < end; at++) {
        keys[at] = view.rows * view.columns;
        slots[at] = slot;
    }
}
