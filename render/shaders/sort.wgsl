// One pass of a stable least-significant-digit radix sort of (key, slot), four bits at a time.
//
// Algorithm: `count_digits` writes a histogram per block of 2048 keys, digit-major; scan.wgsl's `scan_sums` turns them
// into starting positions; `move_keys` ranks each key among the equal digits before it in its block and moves it.
// Ranks come from 16 counters per thread, two to a word, scanned over the threads: no subgroup operations, no order
// that depends on scheduling. (Merrill and Grimshaw 2010, without its fusions.)
// Sorting splats by depth and then their tiles by tile number gives each tile its splats nearest first, equal depths in
// index order, from 32-bit keys.
// Bindings: 0 view, 1 step, 2 totals, 3 keys in, 4 slots in, 5 keys out, 6 slots out, 7 histograms.
// Equations: none.

struct Step {
    shift: u32,
    scan: u32,
    unused0: u32,
    unused1: u32,
}

// The value of `step.scan` that means the splats (scan.wgsl); else their tiles.
const SCAN_DRAWN_DIGITS: u32 = 2u;
const DIGITS: u32 = 16u;

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read> totals: array<u32>;
@group(0) @binding(3) var<storage, read> keys_in: array<u32>;
@group(0) @binding(4) var<storage, read> slots_in: array<u32>;
@group(0) @binding(5) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> slots_out: array<u32>;
@group(0) @binding(7) var<storage, read_write> histograms: array<u32>;

fn key_count() -> u32 {
    if (step.scan == SCAN_DRAWN_DIGITS) {
        return totals[DRAWN];
    }
    return min(totals[PAIRS], view.capacity);
}

fn digit_of(key: u32) -> u32 {
    return (key >> step.shift) & (DIGITS - 1u);
}

fn blocks_of(count: u32) -> u32 {
    return count / BLOCK + min(count % BLOCK, 1u);
}

var<workgroup> histogram: array<atomic<u32>, 16>;

@compute @workgroup_size(256)
fn count_digits(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) block: vec3<u32>) {
    if (t < DIGITS) {
        atomicStore(&histogram[t], 0u);
    }
    workgroupBarrier();
    let count = key_count();
    for (var k = 0u; k < PER_THREAD; k++) {
        let i = block.x * BLOCK + k * 256u + t;
        if (i < count) {
            atomicAdd(&histogram[digit_of(keys_in[i])], 1u);
        }
    }
    workgroupBarrier();
    if (t < DIGITS) {
        histograms[t * blocks_of(count) + block.x] = atomicLoad(&histogram[t]);
    }
}

// Counters of digits 2w and 2w + 1 of thread t at [w * 256 + t]; a block has 2048 keys, so 16 bits do.
const WORDS: u32 = 8u;
var<workgroup> counters: array<u32, 2048>;

@compute @workgroup_size(256)
fn move_keys(@builtin(local_invocation_index) t: u32, @builtin(workgroup_id) block: vec3<u32>) {
    let count = key_count();
    let first = block.x * BLOCK + t * PER_THREAD;
    for (var w = 0u; w < WORDS; w++) {
        counters[w * 256u + t] = 0u;
    }
    // How many of the thread's own earlier keys have the digit.
    var ranks: array<u32, 8>;
    for (var k = 0u; k < PER_THREAD; k++) {
        if (first + k < count) {
            let digit = digit_of(keys_in[first + k]);
            let at = (digit >> 1u) * 256u + t;
            let bits = 16u * (digit & 1u);
            ranks[k] = (counters[at] >> bits) & 0xffffu;
            counters[at] += 1u << bits;
        }
    }
    var own: array<u32, 8>;
    for (var w = 0u; w < WORDS; w++) {
        own[w] = counters[w * 256u + t];
    }
    workgroupBarrier();
    for (var distance = 1u; distance < 256u; distance *= 2u) {
        var before: array<u32, 8>;
        for (var w = 0u; w < WORDS; w++) {
            before[w] = 0u;
            if (t >= distance) {
                before[w] = counters[w * 256u + t - distance];
            }
        }
        workgroupBarrier();
        for (var w = 0u; w < WORDS; w++) {
            counters[w * 256u + t] += before[w];
        }
        workgroupBarrier();
    }
    // Each thread reads and writes only its own counters from here on.
    for (var w = 0u; w < WORDS; w++) {
        counters[w * 256u + t] -= own[w];
    }
    let blocks = blocks_of(count);
    for (var k = 0u; k < PER_THREAD; k++) {
        if (first + k < count) {
            let key = keys_in[first + k];
            let digit = digit_of(key);
            let earlier = (counters[(digit >> 1u) * 256u + t] >> (16u * (digit & 1u))) & 0xffffu;
            let to = histograms[digit * blocks + block.x] + earlier + ranks[k];
            keys_out[to] = key;
            slots_out[to] = slots_in[first + k];
        }
    }
}
