//! The one loop everything goes through: 32x32 sums of a left and a right panel.
//!
//! Four tiles hold the sums, two the left operand's step, two the right one's. Tiles are loaded from panels that lie in the
//! order they are read, so the hardware fetches ahead of itself.

use std::arch::asm;
use std::marker::PhantomData;

use super::{Parts, SIDE};

/// What `ldtilecfg` reads: all eight tiles of 16 rows of 64 bytes.
#[repr(C, align(64))]
struct Config {
    palette: u8,
    start_row: u8,
    reserved: [u8; 14],
    row_bytes: [u16; 16],
    rows: [u8; 16],
}

static CONFIG: Config = Config {
    palette: 1,
    start_row: 0,
    reserved: [0; 14],
    row_bytes: [64, 64, 64, 64, 64, 64, 64, 64, 0, 0, 0, 0, 0, 0, 0, 0],
    rows: [16, 16, 16, 16, 16, 16, 16, 16, 0, 0, 0, 0, 0, 0, 0, 0],
};

/// This thread's tiles are set up; dropped, they are given back, so that nobody saves them at every switch of threads.
pub(in crate::kernels) struct Configured {
    /// Of this thread alone.
    thread: PhantomData<*const ()>,
}

impl Configured {
    /// Panics where there are no tiles for this process.
    pub(in crate::kernels) fn new() -> Self {
        assert!(super::available(), "AMX is not available on this machine");
        // SAFETY: the units are there and the process may use them, as just asked; `CONFIG` is what the instruction reads.
        unsafe { asm!("ldtilecfg [{}]", in(reg) &raw const CONFIG, options(nostack, readonly, preserves_flags)) };
        Self { thread: PhantomData }
    }
}

impl Drop for Configured {
    fn drop(&mut self) {
        // SAFETY: only made where the units are there.
        unsafe { asm!("tilerelease", options(nostack, nomem, preserves_flags)) };
    }
}

/// Sums that start at zero.
macro_rules! fresh {
    () => {
        "tilezero tmm0\n tilezero tmm1\n tilezero tmm2\n tilezero tmm3"
    };
}

/// Sums that go on from what is there.
macro_rules! onto {
    () => {
        "tileloadd tmm0, [{c} + {cs}*1]\n tileloadd tmm1, [{c} + {cs}*1 + 64]
         tileloadd tmm2, [{d} + {cs}*1]\n tileloadd tmm3, [{d} + {cs}*1 + 64]"
    };
}

/// The left step's part at this many bytes.
macro_rules! left {
    ($at:literal) => {
        concat!("tileloadd tmm4, [{a} + {s}*1 + ", $at, "]\n tileloadd tmm5, [{a} + {s}*1 + ", $at, " + 1024]\n")
    };
}

/// The right step's.
macro_rules! right {
    ($at:literal) => {
        concat!("tileloadd tmm6, [{b} + {s}*1 + ", $at, "]\n tileloadd tmm7, [{b} + {s}*1 + ", $at, " + 1024]\n")
    };
}

macro_rules! multiply {
    () => {
        "tdpbf16ps tmm0, tmm4, tmm6\n tdpbf16ps tmm1, tmm4, tmm7\n tdpbf16ps tmm2, tmm5, tmm6\n tdpbf16ps tmm3, tmm5, tmm7\n"
    };
}

/// A step of one part.
macro_rules! one {
    () => {
        concat!(left!(0), right!(0), multiply!(), "add {a}, 2048\n add {b}, 2048\n")
    };
}

/// A step of three: high, middle and low at 0, 2048 and 4096 bytes. Small products first would be more exact by less than a
/// rounding, and cost two loads more.
macro_rules! three {
    () => {
        concat!(
            left!(0),
            right!(0),
            multiply!(),
            right!(4096),
            multiply!(),
            right!(2048),
            multiply!(),
            left!(2048),
            multiply!(),
            right!(0),
            multiply!(),
            left!(4096),
            multiply!(),
            "add {a}, 6144\n add {b}, 6144\n"
        )
    };
}

macro_rules! tiles {
    ($start:expr, $step:expr, $steps:ident, $a:ident, $b:ident, $c:ident, $stride:ident) => {
        // SAFETY: the caller's contract; every tile is written before it is read.
        unsafe {
            asm!(
                $start,
                "2:",
                $step,
                "dec {n}",
                "jnz 2b",
                "tilestored [{c} + {cs}*1], tmm0",
                "tilestored [{c} + {cs}*1 + 64], tmm1",
                "tilestored [{d} + {cs}*1], tmm2",
                "tilestored [{d} + {cs}*1 + 64], tmm3",
                n = inout(reg) $steps => _,
                a = inout(reg) $a => _,
                b = inout(reg) $b => _,
                c = in(reg) $c,
                d = in(reg) $c.wrapping_add(SIDE / 2 * $stride),
                cs = in(reg) $stride * size_of::<f32>(),
                s = in(reg) 64usize,
                out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
                out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
                options(nostack),
            )
        }
    };
}

/// `c = a b` for panels of `steps` steps: `c` has 32 rows of 32 floats, `stride` floats apart.
///
/// # Safety
/// `steps` is not 0; `a` and `b` are readable for that many steps of `parts`, `c` is writable at its rows.
#[inline(always)]
pub(in crate::kernels) unsafe fn product(
    _tiles: &Configured,
    parts: Parts,
    steps: usize,
    (a, b): (*const f32, *const f32),
    c: *mut f32,
    stride: usize,
) {
    match parts {
        Parts::One => tiles!(fresh!(), one!(), steps, a, b, c, stride),
        Parts::Three => tiles!(fresh!(), three!(), steps, a, b, c, stride),
    }
}

/// `c += a b`, else as [`product`].
///
/// # Safety
/// As there, and `c` is readable.
#[inline(always)]
pub(in crate::kernels) unsafe fn product_onto(
    _tiles: &Configured,
    parts: Parts,
    steps: usize,
    (a, b): (*const f32, *const f32),
    c: *mut f32,
    stride: usize,
) {
    match parts {
        Parts::One => tiles!(onto!(), one!(), steps, a, b, c, stride),
        Parts::Three => tiles!(onto!(), three!(), steps, a, b, c, stride),
    }
}
