//! The colour transform that fits pairs of colours best, by least squares with a prior.

use super::Affine;

/// A colour and a one.
const N: usize = 4;

/// Sums over pairs of colours `(x, y)`, enough to find the transform that takes `x` to `y`.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct AffineFit {
    /// Sum of `[x 1] [x 1]'`.
    gram: [[f64; N]; N],
    /// Sum of `y [x 1]'`.
    cross: [[f64; N]; 3],
    /// Sum of weights.
    weight: f64,
}

impl AffineFit {
    /// Counts a pair; what is not finite is left out.
    pub fn add(&mut self, from: [f32; 3], to: [f32; 3], weight: f64) {
        let x = [from[0], from[1], from[2], 1.0].map(f64::from);
        let sum: f64 = x.iter().chain(&to.map(f64::from)).sum();
        if !sum.is_finite() || !weight.is_finite() || weight <= 0.0 {
            return;
        }
        for (row, a) in self.gram.iter_mut().zip(x) {
            row.iter_mut().zip(x).for_each(|(sum, b)| *sum += weight * a * b);
        }
        for (row, y) in self.cross.iter_mut().zip(to) {
            row.iter_mut().zip(x).for_each(|(sum, b)| *sum += weight * f64::from(y) * b);
        }
        self.weight += weight;
    }

    /// Sum of the pairs' weights.
    pub fn weight(&self) -> f64 {
        self.weight
    }

    /// The `(A, b)` that makes `sum of weight |A x + b - y|^2 + strength |(A, b) - prior|^2` least. `strength` counts in pairs: as many
    /// of weight one pull as strongly. The prior where that cannot be solved (not positive, or colours that are no numbers).
    pub fn solve(&self, prior: &Affine, strength: f64) -> Affine {
        let mut left = self.gram;
        (0..N).for_each(|i| left[i][i] += strength);
        let Some(lower) = cholesky(&left) else { return *prior };
        let mut out = *prior;
        for p in 0..3 {
            let m = prior.matrix[p];
            let old = [m[0], m[1], m[2], prior.bias[p]].map(f64::from);
            let right = std::array::from_fn(|i| self.cross[p][i] + strength * old[i]);
            let row = substitute(&lower, right).map(|x| x as f32);
            if row.iter().any(|x| !x.is_finite()) {
                return *prior;
            }
            out.matrix[p] = [row[0], row[1], row[2]];
            out.bias[p] = row[3];
        }
        out
    }
}

/// `L` with `L L' = a`; none where `a` is not positive definite.
fn cholesky(a: &[[f64; N]; N]) -> Option<[[f64; N]; N]> {
    let mut l = [[0.0; N]; N];
    for i in 0..N {
        for j in 0..=i {
            let dot: f64 = (0..j).map(|k| l[i][k] * l[j][k]).sum();
            let rest = a[i][j] - dot;
            l[i][j] = if i == j { rest.sqrt() } else { rest / l[j][j] };
        }
        if l[i][i].is_nan() || l[i][i] <= 0.0 {
            return None;
        }
    }
    Some(l)
}

/// Solves `L L' x = b`.
fn substitute(l: &[[f64; N]; N], b: [f64; N]) -> [f64; N] {
    let mut x = b;
    for i in 0..N {
        let dot: f64 = (0..i).map(|k| l[i][k] * x[k]).sum();
        x[i] = (x[i] - dot) / l[i][i];
    }
    for i in (0..N).rev() {
        let dot: f64 = (i + 1..N).map(|k| l[k][i] * x[k]).sum();
        x[i] = (x[i] - dot) / l[i][i];
    }
    x
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn apart(a: &Affine, b: &Affine) -> f32 {
        let numbers = |x: &Affine| x.matrix.into_iter().flatten().chain(x.bias).collect::<Vec<f32>>();
        numbers(a).iter().zip(numbers(b)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    }

    const TRUE: Affine =
        Affine { matrix: [[0.9, 0.05, 0.0], [-0.1, 1.2, 0.02], [0.0, 0.1, 0.8]], bias: [0.1, -0.2, 0.05] };

    fn color(k: usize) -> [f32; 3] {
        [(k * 7 % 11) as f32, (k * 5 % 13) as f32, (k * 3 % 17) as f32].map(|x| x / 8.0 - 1.0)
    }

    #[test]
    fn enough_pairs_give_the_transform_whatever_the_prior() {
        let mut fit = AffineFit::default();
        (0..400).for_each(|k| fit.add(color(k), TRUE.apply(color(k)), 1.0));
        // Colours are f32, some 1e-7 each.
        assert!(apart(&fit.solve(&Affine::IDENTITY, 1e-6), &TRUE) < 1e-5);
        assert!(apart(&fit.solve(&TRUE, 1e9), &TRUE) < 1e-5);
        assert_eq!(fit.weight(), 400.0);
    }

    #[test]
    fn few_pairs_leave_the_prior_almost_as_it_is() {
        let mut fit = AffineFit::default();
        assert_eq!(fit.solve(&TRUE, 10.0), TRUE);
        fit.add(color(3), [1.0; 3], 1.0);
        let got = fit.solve(&TRUE, 1e4);
        assert!(apart(&got, &TRUE) < 1e-3 && got != TRUE, "{got:?}");
        // Grey colours say nothing of how channels mix: without a prior there is no answer, with one there is.
        let mut grey = AffineFit::default();
        (0..9).for_each(|k| grey.add([k as f32 / 9.0; 3], [k as f32 / 18.0; 3], 1.0));
        assert_eq!(grey.solve(&TRUE, 0.0), TRUE);
        let halved = grey.solve(&Affine::IDENTITY, 1e-6).apply([0.5; 3]);
        assert!(halved.iter().all(|x| (x - 0.25).abs() < 1e-4), "{halved:?}");
    }

    #[test]
    fn what_is_no_number_is_left_out() {
        let mut fit = AffineFit::default();
        fit.add([f32::NAN, 0.0, 0.0], [0.0; 3], 1.0);
        fit.add([0.0; 3], [f32::INFINITY, 0.0, 0.0], 1.0);
        fit.add([0.0; 3], [0.0; 3], f64::NAN);
        assert_eq!(fit, AffineFit::default());
        assert_eq!(fit.solve(&TRUE, f64::NAN), TRUE);
        assert_eq!(fit.solve(&TRUE, -1.0), TRUE);
    }

    proptest! {
        #[test]
        fn no_other_transform_fits_better(
            pairs in prop::collection::vec((prop::array::uniform3(-1f32..1.0), prop::array::uniform3(-1f32..1.0)), 8..40),
            nudge in prop::array::uniform4(-0.05f32..0.05),
        ) {
            let mut fit = AffineFit::default();
            pairs.iter().for_each(|&(x, y)| fit.add(x, y, 1.0));
            let cost = |a: &Affine| -> f64 {
                let one = |(x, y): &([f32; 3], [f32; 3])| {
                    a.apply(*x).iter().zip(y).map(|(p, y)| f64::from(p - y).powi(2)).sum::<f64>()
                };
                let pull = apart_squared(a, &TRUE);
                pairs.iter().map(one).sum::<f64>() + 2.0 * pull
            };
            let best = fit.solve(&TRUE, 2.0);
            let mut other = best;
            (0..3).for_each(|q| other.matrix[1][q] += nudge[q]);
            other.bias[2] += nudge[3];
            // f32 rounding of the costs.
            prop_assert!(cost(&best) <= cost(&other) + 1e-5);
        }
    }

    fn apart_squared(a: &Affine, b: &Affine) -> f64 {
        let numbers = |x: &Affine| x.matrix.into_iter().flatten().chain(x.bias).collect::<Vec<f32>>();
        numbers(a).iter().zip(numbers(b)).map(|(a, b)| f64::from(a - b).powi(2)).sum()
    }
}
