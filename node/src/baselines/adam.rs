//! Adam (Kingma and Ba, 2015) over plain numbers, without weight decay or clipping, as 3DGS and NSFP use it.

use rayon::prelude::*;

/// Numbers per task: elementwise work, so the split does not change the result.
const CHUNK: usize = 1 << 14;
/// Decay of the first moment.
const BETA1: f32 = 0.9;
/// Decay of the second moment.
const BETA2: f32 = 0.999;

/// What Adam remembers of one array of parameters.
#[derive(Debug, Clone)]
pub struct Adam {
    first: Vec<f32>,
    second: Vec<f32>,
    steps: i32,
    eps: f32,
}

impl Adam {
    /// For `n` parameters; `eps` is added to the root of the second moment.
    pub fn new(n: usize, eps: f32) -> Self {
        Self { first: vec![0.0; n], second: vec![0.0; n], steps: 0, eps }
    }

    /// One step against the gradient. Arrays shorter than `n` move their part only.
    pub fn step(&mut self, weights: &mut [f32], gradient: &[f32], rate: f32) {
        self.steps = self.steps.saturating_add(1);
        let fix1 = 1.0 - f64::from(BETA1).powi(self.steps);
        let fix2 = 1.0 - f64::from(BETA2).powi(self.steps);
        let (rate, root, eps) = ((f64::from(rate) / fix1) as f32, (1.0 / fix2.sqrt()) as f32, self.eps);
        let state = self.first.par_chunks_mut(CHUNK).zip(self.second.par_chunks_mut(CHUNK));
        let arrays = weights.par_chunks_mut(CHUNK).zip(gradient.par_chunks(CHUNK)).zip(state);
        arrays.for_each(|((weights, gradient), (first, second))| {
            for (((w, &g), m), v) in weights.iter_mut().zip(gradient).zip(first).zip(second) {
                *m = BETA1 * *m + (1.0 - BETA1) * g;
                *v = BETA2 * *v + (1.0 - BETA2) * g * g;
                *w -= rate * *m / (root * v.sqrt() + eps);
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_step_is_the_rate_and_a_parabola_is_descended() {
        let mut w = [3.0f32, -2.0];
        let mut adam = Adam::new(2, 1e-15);
        adam.step(&mut w, &[40.0, -1e-6], 0.1);
        // Whatever the gradient's size: f32 rounding only.
        assert!((w[0] - 2.9).abs() < 1e-6 && (w[1] + 1.9).abs() < 1e-6, "{w:?}");
        for _ in 0..400 {
            let g = w.map(|x| 2.0 * (x - 1.0));
            adam.step(&mut w, &g, 0.05);
        }
        assert!(w.iter().all(|x| (x - 1.0).abs() < 0.02), "{w:?}");
    }
}
