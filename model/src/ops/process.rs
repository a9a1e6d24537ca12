//! What a process asks of the C library's allocator, and one that trains of candle's threads.

use std::mem::MaybeUninit;
use std::ops::Range;

use rayon::prelude::*;

/// Floats that are cleared by all threads: from 1 MB, to where glibc maps blocks one by one (those are clear when they come).
const SHARED_CLEARING: Range<usize> = 1 << 18..8 << 20;
/// Floats of such a block that a thread clears at a time.
const CLEARED_AT_A_TIME: usize = 1 << 16;

/// Environment variable with the number of threads of candle's own pool.
const CANDLE_THREADS: &str = "CANDLE_NUM_THREADS";

/// Makes this process train faster; results do not change. For programs that train, not for those that only infer.
///
/// - candle runs its own element-wise operations on the thread that calls them (unless the user set
///   `CANDLE_NUM_THREADS`). By default it gives those on more than 65,536 values to a second thread pool beside rayon's,
///   whose threads spin while they wait. A backward pass has hundreds of them (candle adds each gradient to zeros), and
///   the spinning takes the cores from the kernels: the `train_network` example needs more than twice the processor time.
///   Matrix products and the kernels keep all threads.
/// - With glibc, memory that was freed is kept for the next step instead of being handed back to the system and fetched,
///   page by page, again: about a tenth of a step. The process stays as large as its largest step.
///
/// # Safety
/// This writes to the environment, which candle reads at its first operation: no other thread may read or write it
/// meanwhile. Call it first in `main`.
pub unsafe fn set_up_training() {
    if std::env::var_os(CANDLE_THREADS).is_none() {
        // SAFETY: the caller's contract.
        unsafe { std::env::set_var(CANDLE_THREADS, "1") };
    }
    keep_freed_memory();
}

/// With glibc, memory that was freed stays with the process for the next step instead of being handed back to the system and
/// fetched, page by page, again. The process stays as large as its largest step; elsewhere this does nothing.
pub fn keep_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    glibc::keep_freed_memory();
}

/// With glibc, all threads take their memory from one heap; elsewhere this does nothing. Call it before there are threads.
///
/// By default each thread has a heap of its own. What one thread allocates and another frees (scenes, pictures and map cells do
/// that at every step) leaves holes in each of them, and over an hour's drive the process grows by a few per cent while what it
/// holds stays the same. Kernels do not allocate in their loops, so threads seldom wait for the one heap.
pub fn share_one_heap() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    glibc::share_one_heap();
}

/// Zeros for a result. On Linux large ones are asked for in large pages: blocks of this size are fetched from the system and handed
/// back each time, and with pages of 4 KiB that takes longer than many a kernel that fills them.
///
/// Those of middling size usually lie in memory that was used before and has to be cleared, which all threads do together: as much
/// as it is, one thread's memory traffic takes longer than many a kernel.
pub(super) fn zeros(len: usize) -> Vec<f32> {
    if SHARED_CLEARING.contains(&len) {
        let mut values = Vec::with_capacity(len);
        let places = &mut values.spare_capacity_mut()[..len];
        places.par_chunks_mut(CLEARED_AT_A_TIME).for_each(|part| part.fill(MaybeUninit::new(0.0)));
        // SAFETY: all of them were just written.
        unsafe { values.set_len(len) };
        return values;
    }
    let values = vec![0f32; len];
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    glibc::use_large_pages(&values);
    values
}

/// With glibc, hands memory that was freed back to the system: about 2 ms for 64 MiB. Elsewhere this does nothing.
pub fn give_back_freed_memory() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    glibc::give_back_freed_memory();
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
mod glibc {
    use std::ffi::{c_int, c_void};

    /// `malloc.h`: free memory at the top of the heap beyond this many bytes goes back to the system.
    const M_TRIM_THRESHOLD: c_int = -1;
    /// `malloc.h`: blocks of this many bytes and more are mapped and unmapped one by one.
    const M_MMAP_THRESHOLD: c_int = -3;
    /// `malloc.h`: heaps at most.
    const M_ARENA_MAX: c_int = -8;
    /// The largest the library takes on 64-bit machines.
    const LARGEST_MMAP_THRESHOLD: c_int = 32 << 20;

    unsafe extern "C" {
        fn mallopt(parameter: c_int, value: c_int) -> c_int;
        fn malloc_trim(kept_at_the_top: usize) -> c_int;
        fn madvise(start: *mut c_void, bytes: usize, advice: c_int) -> c_int;
    }

    /// A refused value leaves the allocator as it was.
    pub fn keep_freed_memory() {
        // SAFETY: `mallopt` takes two numbers and locks the allocator itself.
        unsafe {
            mallopt(M_MMAP_THRESHOLD, LARGEST_MMAP_THRESHOLD);
            mallopt(M_TRIM_THRESHOLD, c_int::MAX);
        }
    }

    /// As [`keep_freed_memory`]; heaps that threads have already stay theirs.
    pub fn share_one_heap() {
        // SAFETY: as above.
        unsafe {
            mallopt(M_ARENA_MAX, 1);
        }
    }

    /// `asm/mman.h`.
    const MADV_HUGEPAGE: c_int = 14;
    /// A large page of x86-64, and of most other machines.
    const LARGE_PAGE: usize = 2 << 20;

    /// Only blocks that are mapped one by one: what it says of them ends with them. A refusal changes nothing.
    pub fn use_large_pages(values: &[f32]) {
        let bytes = size_of_val(values);
        let start = values.as_ptr() as usize;
        let (first, end) = (start.next_multiple_of(LARGE_PAGE), (start + bytes) / LARGE_PAGE * LARGE_PAGE);
        if bytes > LARGEST_MMAP_THRESHOLD as usize && first < end {
            // SAFETY: whole pages within our own memory; the advice changes no contents.
            unsafe { madvise(first as *mut c_void, end - first, MADV_HUGEPAGE) };
        }
    }

    pub fn give_back_freed_memory() {
        // SAFETY: takes the allocator's own locks, and touches only pages that hold nothing.
        unsafe {
            malloc_trim(0);
        }
    }
}
