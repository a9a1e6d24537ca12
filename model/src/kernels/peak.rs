//! What the machine's multiply-add units give at most: the number kernels are compared with.

use std::time::Instant;

use rayon::prelude::*;

use super::Isa;
use super::simd::{Kernel, Simd, dispatch};

/// Multiply-adds in flight: enough to cover their latency on two units.
const CHAINS: usize = 12;

struct Chains {
    steps: usize,
    factor: f32,
}

impl Kernel for Chains {
    type Out = f32;

    #[inline(always)]
    fn run<S: Simd, const MR: usize>(self) -> f32 {
        let (factor, offset) = (S::splat(self.factor), S::splat(1e-3));
        let mut acc = [S::splat(0.5); CHAINS];
        for _ in 0..self.steps {
            for a in &mut acc {
                *a = S::mul_add(*a, factor, offset);
            }
        }
        acc.iter().map(|&a| S::sum(a)).sum()
    }
}

/// Independent multiply-adds held in registers, on every thread of the pool: floating-point operations done, and
/// seconds taken.
pub fn fma(isa: Isa, steps: usize) -> (f64, f64) {
    let threads = rayon::current_num_threads();
    let start = Instant::now();
    let sum: f32 =
        (0..threads).into_par_iter().map(|t| dispatch(isa, Chains { steps, factor: 0.9 + 1e-3 * t as f32 })).sum();
    let seconds = start.elapsed().as_secs_f64();
    std::hint::black_box(sum);
    ((threads * steps * CHAINS * isa.lanes() * 2) as f64, seconds)
}
