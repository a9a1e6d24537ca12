//! The one loop everything goes through: 32x32 sums of a left and a right panel.
//!
//! Four tiles hold the sums, two the left operand's step, two the right one's. Tiles are loaded from panels that lie in the
//! order they are read, so the hardware fetches ahead of itself.
//!
//! Every addition in a tile is rounded to f32. Of three parts the five small products are summed first, while the sums are small
//! and their rounding with them; only the large product's additions then round like a float's. For the same reason longer sums are
//! added up from several of these ([`product_onto`]).

use std::arch::asm;
use std::marker::PhantomData;

use super::{Parts, SIDE, TILE};
use crate::kernels::simd::{Avx512, Simd};

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

/// The left step's part at this many bytes from this register.
macro_rules! left {
    ($from:literal, $at:literal) => {
        concat!(
            "tileloadd tmm4, [{",
            $from,
            "} + {s}*1 + ",
            $at,
            "]\n tileloadd tmm5, [{",
            $from,
            "} + {s}*1 + ",
            $at,
            " + 1024]\n"
        )
    };
}

/// The right step's.
macro_rules! right {
    ($from:literal, $at:literal) => {
        concat!(
            "tileloadd tmm6, [{",
            $from,
            "} + {s}*1 + ",
            $at,
            "]\n tileloadd tmm7, [{",
            $from,
            "} + {s}*1 + ",
            $at,
            " + 1024]\n"
        )
    };
}

macro_rules! multiply {
    () => {
        "tdpbf16ps tmm0, tmm4, tmm6\n tdpbf16ps tmm1, tmm4, tmm7\n tdpbf16ps tmm2, tmm5, tmm6\n tdpbf16ps tmm3, tmm5, tmm7\n"
    };
}

/// `n` steps of one part, `bytes` apart, from `a` and `b` on.
macro_rules! large {
    ($bytes:literal) => {
        concat!(
            "3:\n",
            left!("a", 0),
            right!("b", 0),
            multiply!(),
            "add {a}, ",
            $bytes,
            "\n add {b}, ",
            $bytes,
            "\n dec {n}\n jnz 3b\n"
        )
    };
}

/// `n` steps of two parts, which lie at 0 and 2048 bytes of a step.
macro_rules! two {
    () => {
        concat!(
            "3:\n",
            left!("a", 0),
            right!("b", 2048),
            multiply!(),
            right!("b", 0),
            multiply!(),
            left!("a", 2048),
            multiply!(),
            "add {a}, 4096\n add {b}, 4096\n dec {n}\n jnz 3b\n"
        )
    };
}

/// `m` steps of what is small in products of three parts, which lie at 0, 2048 and 4096 bytes of a step.
macro_rules! small {
    () => {
        concat!(
            "2:\n",
            left!("e", 0),
            right!("f", 4096),
            multiply!(),
            right!("f", 2048),
            multiply!(),
            left!("e", 2048),
            multiply!(),
            right!("f", 0),
            multiply!(),
            left!("e", 4096),
            multiply!(),
            "add {e}, 6144\n add {f}, 6144\n dec {m}\n jnz 2b\n"
        )
    };
}

macro_rules! tiles {
    ($loops:expr, $steps:ident, $a:ident, $b:ident, $c:ident, $stride:ident, {$($more:tt)*}) => {
        // SAFETY: the caller's contract; every tile is written before it is read.
        unsafe {
            asm!(
                "tilezero tmm0\n tilezero tmm1\n tilezero tmm2\n tilezero tmm3",
                $loops,
                "tilestored [{c} + {cs}*1], tmm0",
                "tilestored [{c} + {cs}*1 + 64], tmm1",
                "tilestored [{d} + {cs}*1], tmm2",
                "tilestored [{d} + {cs}*1 + 64], tmm3",
                n = inout(reg) $steps => _,
                a = inout(reg) $a => _,
                b = inout(reg) $b => _,
                c = in(reg) $c,
                d = in(reg) $c.wrapping_add(TILE * $stride),
                cs = in(reg) $stride * size_of::<f32>(),
                s = in(reg) 64usize,
                $($more)*
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
        Parts::One => tiles!(large!(2048), steps, a, b, c, stride, {}),
        Parts::Two => tiles!(two!(), steps, a, b, c, stride, {}),
        Parts::Three => tiles!(concat!(small!(), large!(6144)), steps, a, b, c, stride, {
            m = inout(reg) steps => _, e = inout(reg) a => _, f = inout(reg) b => _,
        }),
    }
}

/// 32x32 floats in a cache line's place.
#[repr(C, align(64))]
struct Sums([f32; SIDE * SIDE]);

/// `c += a b`, else as [`product`].
///
/// # Safety
/// As there, `c` is readable, and the caller is compiled for AVX-512.
#[inline(always)]
pub(in crate::kernels) unsafe fn product_onto(
    tiles: &Configured,
    parts: Parts,
    steps: usize,
    both: (*const f32, *const f32),
    c: *mut f32,
    stride: usize,
) {
    type V = Avx512<true>;
    let mut sums = std::mem::MaybeUninit::<Sums>::uninit();
    let from = sums.as_mut_ptr().cast::<f32>();
    // SAFETY: the caller's contract; `sums` has 32 rows of 32 floats, all of them written by the product.
    unsafe {
        product(tiles, parts, steps, both, from, SIDE);
        for row in 0..SIDE {
            for half in [0, V::W] {
                let to = c.add(row * stride + half);
                V::store(to, V::add(V::load(to), V::load(from.add(row * SIDE + half))));
            }
        }
    }
}
