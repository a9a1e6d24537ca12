//! `2^x`, `erf`, GELU and SiLU on vectors, by polynomials fitted for this program (minimax in 40-digit arithmetic).

use super::Isa;
use super::simd::{Kernel, Simd, dispatch};
use crate::ops::Activation;

/// `2^f = 1 + f P(f)` on `|f| <= 1/2`; relative error 2e-9 before rounding.
const EXP2: [f32; 6] =
    [std::f32::consts::LN_2, 0.240_226_48, 0.055_503_324, 0.009_618_437, 0.001_339_887_4, 0.000_153_533_75];
/// `erfc(u / sqrt 2) = 2^(-u P(u))` on `0 <= u <= 6`; absolute error of `erf` 7e-9 before rounding.
const PHI: [f32; 10] = [
    1.151_104_6,
    0.459_218_23,
    0.052_447_464,
    -0.006_953_034_5,
    2.535_283_6e-6,
    0.000_279_457_8,
    -7.659_401e-5,
    1.100_467e-5,
    -8.618_361e-7,
    2.887_343_2e-8,
];
/// Past this many standard deviations the tail (under 1e-9) is taken as zero.
const PHI_END: f32 = 6.0;
/// The nearest bf16, ties to even; NaN stays NaN.
#[inline(always)]
pub(crate) fn bf16(x: f32) -> f32 {
    let bits = x.to_bits();
    let rounded = bits.wrapping_add(0x7fff + (bits >> 16 & 1)) & 0xffff_0000;
    if x.is_nan() { x } else { f32::from_bits(rounded) }
}

/// Added to a float of at most 2^22 it leaves the nearest whole number in the low bits.
pub(crate) const ROUND: f32 = 12_582_912.0;
/// The smallest exponent of a normal float: smaller powers are returned as 2^-126.
const MIN_EXPONENT: f32 = -126.0;

/// `2^x` for `x <= 127`; relative error under 1.5e-7. `x < -126` gives `2^-126`; NaN stays NaN.
#[inline(always)]
pub(crate) fn exp2<S: Simd>(x: S::V) -> S::V {
    let x = S::max_of(S::splat(MIN_EXPONENT), x);
    let t = S::add(x, S::splat(ROUND));
    let f = S::sub(x, S::sub(t, S::splat(ROUND)));
    let mut p = S::splat(EXP2[5]);
    for c in [EXP2[4], EXP2[3], EXP2[2], EXP2[1], EXP2[0], 1.0] {
        p = S::mul_add(p, f, S::splat(c));
    }
    S::mul(p, S::exponent(t))
}

/// `2^f = 1 + f P(f)` on `|f| <= 1/2`; relative error 9e-8 before rounding.
#[allow(clippy::approx_constant)] // Not ln 2, but what the fit gives beside it.
const EXP2_SHORT: [f32; 5] = [0.693_147, 0.240_222_42, 0.055_507_336, 0.009_671_513, 0.001_326_472_7];

/// `2^x` for `|x| <= 120`, nothing else; relative error under 2.5e-7. NaN gives some number: keep it out.
#[inline(always)]
pub(crate) fn exp2_short<S: Simd>(x: S::V) -> S::V {
    let t = S::add(x, S::splat(ROUND));
    let f = S::sub(x, S::sub(t, S::splat(ROUND)));
    let mut p = S::splat(EXP2_SHORT[4]);
    for c in [EXP2_SHORT[3], EXP2_SHORT[2], EXP2_SHORT[1], EXP2_SHORT[0], 1.0] {
        p = S::mul_add(p, f, S::splat(c));
    }
    S::scale(p, t)
}

/// `2^f = 1 + f P(f)` on `|f| <= 1/2`; relative error 7e-6.
const EXP2_ROUGH: [f32; 4] = [0.693_136_73, 0.240_225_3, 0.055_838_283, 0.009_656_71];

/// `2^x` for `|x| <= 120`, nothing else; relative error under 8e-6. NaN gives some number: keep it out.
#[inline(always)]
pub(crate) fn exp2_rough<S: Simd>(x: S::V) -> S::V {
    let t = S::add(x, S::splat(ROUND));
    let f = S::sub(x, S::sub(t, S::splat(ROUND)));
    let mut p = S::splat(EXP2_ROUGH[3]);
    for c in [EXP2_ROUGH[2], EXP2_ROUGH[1], EXP2_ROUGH[0], 1.0] {
        p = S::mul_add(p, f, S::splat(c));
    }
    S::scale(p, t)
}

/// `erfc(u / sqrt 2)`, `u >= 0`: twice the normal distribution's tail beyond `u` standard deviations.
#[inline(always)]
fn two_tails<S: Simd>(u: S::V) -> S::V {
    let mut p = S::splat(PHI[9]);
    for i in (0..9).rev() {
        p = S::mul_add(p, u, S::splat(PHI[i]));
    }
    let exponent = S::mul(S::sub(S::zero(), u), p);
    S::select_lt(u, S::splat(PHI_END), exp2::<S>(exponent), S::zero())
}

/// Exact GELU, `x Phi(x)`. The tail is computed directly, so nothing cancels for negative `x`.
#[inline(always)]
pub(crate) fn gelu<S: Simd>(x: S::V) -> S::V {
    let h = S::mul(S::splat(0.5), two_tails::<S>(S::abs(x)));
    S::mul(x, S::select_lt(x, S::zero(), h, S::sub(S::splat(1.0), h)))
}

/// `x / (1 + e^-x)`.
#[inline(always)]
pub(crate) fn silu<S: Simd>(x: S::V) -> S::V {
    // e^-x = 1 / e^x keeps the argument of exp2 at or below zero on either side.
    let e = exp2::<S>(S::mul(S::abs(x), S::splat(-std::f32::consts::LOG2_E)));
    let numerator = S::select_lt(x, S::zero(), e, S::splat(1.0));
    S::mul(x, S::div(numerator, S::add(S::splat(1.0), e)))
}

/// Past this many standard deviations the normal density (under 1e-43) is taken as zero.
const DENSITY_END: f32 = 14.0;

/// [`gelu`] and its derivative, `Phi(x) + x phi(x)`.
#[inline(always)]
fn gelu_and_slope<S: Simd>(x: S::V) -> (S::V, S::V) {
    let u = S::abs(x);
    let h = S::mul(S::splat(0.5), two_tails::<S>(u));
    let below = S::select_lt(x, S::zero(), h, S::sub(S::splat(1.0), h));
    let exponent = S::mul(S::mul(u, u), S::splat(-0.5 * std::f32::consts::LOG2_E));
    // 1 / sqrt(2 pi).
    let density =
        S::mul(S::splat(0.5 * std::f32::consts::FRAC_2_SQRT_PI * std::f32::consts::FRAC_1_SQRT_2), exp2::<S>(exponent));
    let moment = S::select_lt(S::splat(DENSITY_END), u, S::zero(), S::mul(x, density));
    (S::mul(x, below), S::add(below, moment))
}

/// [`silu`] and its derivative, `s + x s (1 - s)` for the sigmoid `s`.
#[inline(always)]
fn silu_and_slope<S: Simd>(x: S::V) -> (S::V, S::V) {
    let e = exp2::<S>(S::mul(S::abs(x), S::splat(-std::f32::consts::LOG2_E)));
    let inverse = S::div(S::splat(1.0), S::add(S::splat(1.0), e));
    let small = S::mul(e, inverse);
    // Both the sigmoid and one less it are had without subtracting.
    let s = S::select_lt(x, S::zero(), small, inverse);
    let rest = S::select_lt(x, S::zero(), inverse, small);
    let value = S::mul(x, s);
    (value, S::mul_add(value, rest, s))
}

/// The activation and its derivative.
#[inline(always)]
pub(crate) fn activate_and_slope<S: Simd>(act: Activation, x: S::V) -> (S::V, S::V) {
    match act {
        Activation::None => (x, S::splat(1.0)),
        Activation::Gelu => gelu_and_slope::<S>(x),
        Activation::Silu => silu_and_slope::<S>(x),
    }
}

/// `erf(x)`; absolute error under 1e-7.
#[inline(always)]
fn erf<S: Simd>(x: S::V) -> S::V {
    let erfc = two_tails::<S>(S::mul(S::abs(x), S::splat(std::f32::consts::SQRT_2)));
    let erf = S::sub(S::splat(1.0), erfc);
    S::select_lt(x, S::zero(), S::sub(S::zero(), erf), erf)
}

/// The activation of a linear layer.
#[inline(always)]
pub(crate) fn activate<S: Simd>(act: Activation, x: S::V) -> S::V {
    match act {
        Activation::None => x,
        Activation::Gelu => gelu::<S>(x),
        Activation::Silu => silu::<S>(x),
    }
}

/// A function of one variable, applied to every element of a slice.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Function {
    /// `2^x`.
    Exp2,
    /// `2^x` for `|x| <= 120`, to 2.5e-7.
    Exp2Short,
    /// The error function.
    Erf,
    /// Exact GELU.
    Gelu,
    /// `x * sigmoid(x)`.
    Silu,
}

struct Map<'a> {
    function: Function,
    values: &'a mut [f32],
}

impl Kernel for Map<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd, const MR: usize>(self) {
        // A macro, not closures: a closure does not inherit the target features of the function around it, and when it is
        // not inlined every intrinsic in it becomes a call.
        macro_rules! map {
            ($f:ident) => {{
                let mut chunks = self.values.chunks_exact_mut(S::W);
                for chunk in &mut chunks {
                    // SAFETY: the chunk has exactly `W` floats.
                    unsafe { S::store(chunk.as_mut_ptr(), $f::<S>(S::load(chunk.as_ptr()))) };
                }
                let rest = chunks.into_remainder();
                let mut lanes = [0f32; 16];
                lanes[..rest.len()].copy_from_slice(rest);
                // SAFETY: no vector has more than 16 lanes.
                unsafe { S::store(lanes.as_mut_ptr(), $f::<S>(S::load(lanes.as_ptr()))) };
                rest.copy_from_slice(&lanes[..rest.len()]);
            }};
        }
        match self.function {
            Function::Exp2 => map!(exp2),
            Function::Exp2Short => map!(exp2_short),
            Function::Erf => map!(erf),
            Function::Gelu => map!(gelu),
            Function::Silu => map!(silu),
        }
    }
}

struct Slope<'a> {
    act: Activation,
    x: &'a [f32],
    grad: &'a mut [f32],
    value: Option<&'a mut [f32]>,
}

impl Kernel for Slope<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd, const MR: usize>(self) {
        let Slope { act, x, grad, mut value } = self;
        let whole = x.len() / S::W * S::W;
        for at in (0..whole).step_by(S::W) {
            // SAFETY: `at + W <= whole`, the length of none of the slices is under it.
            unsafe {
                let (v, slope) = activate_and_slope::<S>(act, S::load(x.as_ptr().add(at)));
                let to = grad.as_mut_ptr().add(at);
                S::store(to, S::mul(S::load(to), slope));
                if let Some(value) = &mut value {
                    S::store(value.as_mut_ptr().add(at), v);
                }
            }
        }
        let rest = x.len() - whole;
        if rest > 0 {
            let (mut lanes, mut values, mut slopes) = ([0f32; 16], [0f32; 16], [0f32; 16]);
            lanes[..rest].copy_from_slice(&x[whole..]);
            // SAFETY: no vector has more than 16 lanes.
            unsafe {
                let (v, slope) = activate_and_slope::<S>(act, S::load(lanes.as_ptr()));
                S::store(values.as_mut_ptr(), v);
                S::store(slopes.as_mut_ptr(), slope);
            }
            grad[whole..].iter_mut().zip(slopes).for_each(|(g, s)| *g *= s);
            if let Some(value) = value {
                value[whole..].copy_from_slice(&values[..rest]);
            }
        }
    }
}

/// `grad *= act'(x)` element by element on this thread, and `value = act(x)` where that is wanted.
///
/// Panics when the lengths disagree.
pub fn backward(isa: Isa, act: Activation, x: &[f32], grad: &mut [f32], value: Option<&mut [f32]>) {
    assert!(grad.len() == x.len() && value.as_ref().is_none_or(|v| v.len() == x.len()), "{} values", x.len());
    dispatch(isa, Slope { act, x, grad, value });
}

/// Applies the activation of a linear layer in place, on this thread.
pub fn activation(isa: Isa, act: Activation, values: &mut [f32]) {
    match act {
        Activation::None => {}
        Activation::Gelu => apply(isa, Function::Gelu, values),
        Activation::Silu => apply(isa, Function::Silu, values),
    }
}

/// Applies `function` in place, on this thread.
pub fn apply(isa: Isa, function: Function, values: &mut [f32]) {
    dispatch(isa, Map { function, values });
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What the program promises for erf; it is about 1.7 units in the last place of a number near 1.
    const ERF_TOLERANCE: f64 = 1e-7;
    /// One rounding of the result, one of each of the last two polynomial steps.
    const EXP2_RELATIVE: f64 = 1.8e-7;
    /// GELU and SiLU against their size: the fit of the tail is weighted for absolute error and loosens to 6e-6 far out.
    const ACTIVATION_RELATIVE: f64 = 8e-6;
    /// GELU in absolute terms: the rounding of results up to 8, plus the cut tail.
    const GELU_TOLERANCE: f64 = 6e-7;

    fn erf64(x: f64) -> f64 {
        candle_core::cpu::erf::erf_f64(x)
    }

    fn grid(from: f32, to: f32, n: usize) -> Vec<f32> {
        (0..=n).map(|i| from + (to - from) * (i as f32 / n as f32)).collect()
    }

    #[test]
    fn erf_within_1e7() {
        for isa in Isa::tested() {
            let xs = grid(-7.0, 7.0, 400_003);
            let mut ys = xs.clone();
            apply(isa, Function::Erf, &mut ys);
            let worst = xs.iter().zip(&ys).map(|(&x, &y)| (erf64(x.into()) - f64::from(y)).abs()).fold(0.0, f64::max);
            println!("{isa:?} erf: worst absolute error {worst:.2e}");
            assert!(worst < ERF_TOLERANCE, "{isa:?} {worst:e}");
        }
    }

    #[test]
    fn exp2_relative() {
        for isa in Isa::tested() {
            let xs = grid(-125.9, 20.0, 400_003);
            let mut ys = xs.clone();
            apply(isa, Function::Exp2, &mut ys);
            let worst =
                xs.iter().zip(&ys).map(|(&x, &y)| (f64::from(y) / f64::from(x).exp2() - 1.0).abs()).fold(0.0, f64::max);
            println!("{isa:?} exp2: worst relative error {worst:.2e}");
            assert!(worst < EXP2_RELATIVE, "{isa:?} {worst:e}");
            let mut edge = [-1e30, f32::NEG_INFINITY, f32::NAN, 0.0, -126.0];
            apply(isa, Function::Exp2, &mut edge);
            assert_eq!(edge[0], f32::MIN_POSITIVE);
            assert_eq!(edge[1], f32::MIN_POSITIVE);
            assert!(edge[2].is_nan());
            assert_eq!(edge[3], 1.0);
            assert_eq!(edge[4], f32::MIN_POSITIVE);
        }
    }

    #[test]
    fn short_exp2_relative() {
        for isa in Isa::tested() {
            let xs = grid(-120.0, 120.0, 400_003);
            let mut ys = xs.clone();
            apply(isa, Function::Exp2Short, &mut ys);
            let worst =
                xs.iter().zip(&ys).map(|(&x, &y)| (f64::from(y) / f64::from(x).exp2() - 1.0).abs()).fold(0.0, f64::max);
            println!("{isa:?} short exp2: worst relative error {worst:.2e}");
            assert!(worst < 2.5e-7, "{isa:?} {worst:e}");
        }
    }

    #[test]
    fn slopes_follow_their_definitions() {
        /// Slopes of at most 1.13: three roundings of terms of that size.
        const SLOPE_TOLERANCE: f64 = 4e-7;
        /// The value beside the slope may be multiplied in another order than [`activate`]'s: a few roundings.
        const VALUE_RELATIVE: f32 = 4e-7;
        for isa in Isa::tested() {
            for act in [Activation::Gelu, Activation::Silu] {
                let xs = grid(-16.0, 16.0, 100_003);
                let (mut slopes, mut values) = (vec![1f32; xs.len()], vec![0f32; xs.len()]);
                backward(isa, act, &xs, &mut slopes, Some(&mut values));
                let mut forward = xs.clone();
                let function = if act == Activation::Gelu { Function::Gelu } else { Function::Silu };
                apply(isa, function, &mut forward);
                let mut worst = 0f64;
                for ((&x, &slope), (&value, &want)) in xs.iter().zip(&slopes).zip(values.iter().zip(&forward)) {
                    assert!((value - want).abs() <= VALUE_RELATIVE * want.abs(), "{isa:?} {act:?} {x}: {value} {want}");
                    let x = f64::from(x);
                    let s = 1.0 / (1.0 + (-x).exp());
                    let exact = match act {
                        Activation::Gelu => {
                            let density = (-0.5 * x * x).exp() / (2.0 * std::f64::consts::PI).sqrt();
                            0.5 * (1.0 + erf64(x / 2f64.sqrt())) + x * density
                        }
                        _ => s + x * s * (1.0 - s),
                    };
                    worst = worst.max((f64::from(slope) - exact).abs());
                }
                println!("{isa:?} {act:?} slope: worst absolute error {worst:.2e}");
                assert!(worst < SLOPE_TOLERANCE, "{isa:?} {act:?} {worst:e}");
                let mut edge = [1.0; 3];
                backward(isa, act, &[1e30, -1e30, f32::NAN], &mut edge, None);
                assert!(edge[0] == 1.0 && edge[1].abs() < 1e-6 && edge[2].is_nan(), "{isa:?} {act:?} {edge:?}");
            }
        }
    }

    #[test]
    fn activations_follow_their_definitions() {
        for isa in Isa::tested() {
            let xs = grid(-12.0, 12.0, 300_001);
            let (mut g, mut s) = (xs.clone(), xs.clone());
            apply(isa, Function::Gelu, &mut g);
            apply(isa, Function::Silu, &mut s);
            let (mut worst_abs, mut worst_rel, mut worst_silu) = (0f64, 0f64, 0f64);
            for ((&x, &g), &s) in xs.iter().zip(&g).zip(&s) {
                let x = f64::from(x);
                // erfc by its own series would be needed far out; up to 4 the difference still has 11 digits.
                let exact = 0.5 * x * (1.0 + erf64(x / 2f64.sqrt()));
                worst_abs = worst_abs.max((f64::from(g) - exact).abs());
                if x.abs() < 4.0 && x != 0.0 {
                    worst_rel = worst_rel.max((f64::from(g) - exact).abs() / exact.abs());
                }
                let exact = x / (1.0 + (-x).exp());
                if x != 0.0 {
                    worst_silu = worst_silu.max((f64::from(s) - exact).abs() / exact.abs());
                }
            }
            println!("{isa:?} gelu abs {worst_abs:.2e} rel {worst_rel:.2e}, silu rel {worst_silu:.2e}");
            assert!(worst_abs < GELU_TOLERANCE && worst_rel < ACTIVATION_RELATIVE && worst_silu < ACTIVATION_RELATIVE);
            let mut edge = [1e30, -1e30, f32::NAN];
            apply(isa, Function::Gelu, &mut edge);
            assert!(edge[0] == 1e30 && edge[1] == 0.0 && edge[2].is_nan());
            let mut edge = [1e30, -200.0, f32::NAN];
            apply(isa, Function::Silu, &mut edge);
            assert!(edge[0] == 1e30 && edge[1].abs() < 1e-30 && edge[2].is_nan());
        }
    }
}
