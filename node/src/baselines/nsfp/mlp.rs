//! A small coordinate network, 3 numbers in, 3 out, with its gradient.

use rayon::prelude::*;

use crate::dice::Dice;

/// Width of the hidden layers.
pub const WIDTH: usize = 64;
/// Hidden layers, each with a ReLU.
pub const HIDDEN: usize = 4;
/// Points per task. Each task sums its own gradient and the sums are added in order, so threads do not matter.
const CHUNK: usize = 128;

const FIRST: usize = 3 * WIDTH;
const MIDDLE: usize = WIDTH * WIDTH;
/// Weights and biases of all layers: first, middle ones, last; each as (in, out) rows, then its biases.
pub const LEN: usize = FIRST + WIDTH + (HIDDEN - 1) * (MIDDLE + WIDTH) + WIDTH * 3 + 3;
const LAST: usize = LEN - WIDTH * 3 - 3;

type Hidden = [[f32; WIDTH]; HIDDEN];

/// The network's numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct Mlp(pub Vec<f32>);

fn middle(layer: usize) -> usize {
    FIRST + WIDTH + (layer - 1) * (MIDDLE + WIDTH)
}

impl Mlp {
    /// He's uniform start; the last layer small, so that flow starts near zero.
    pub fn new(dice: &mut Dice) -> Self {
        let mut w = vec![0f32; LEN];
        let mut fill = |at: usize, len: usize, inputs: usize, gain: f32| {
            let bound = gain * (6.0 / inputs as f32).sqrt();
            w[at..at + len].iter_mut().for_each(|x| *x = bound * (2.0 * dice.unit() - 1.0));
        };
        fill(0, FIRST, 3, 1.0);
        (1..HIDDEN).for_each(|layer| fill(middle(layer), MIDDLE, WIDTH, 1.0));
        fill(LAST, WIDTH * 3, WIDTH, 0.1);
        Self(w)
    }

    /// What every point is mapped to.
    pub fn forward(&self, points: &[[f32; 3]]) -> Vec<[f32; 3]> {
        points
            .par_chunks(CHUNK)
            .flat_map_iter(|chunk| {
                let mut hidden = [[0.0; WIDTH]; HIDDEN];
                chunk.iter().map(move |p| self.point(p, &mut hidden))
            })
            .collect()
    }

    fn point(&self, p: &[f32; 3], hidden: &mut Hidden) -> [f32; 3] {
        let w = &self.0;
        add_rows(&w[..FIRST], &w[FIRST..FIRST + WIDTH], p, &mut hidden[0]);
        for layer in 1..HIDDEN {
            let at = middle(layer);
            let (before, after) = hidden.split_at_mut(layer);
            add_rows(&w[at..at + MIDDLE], &w[at + MIDDLE..at + MIDDLE + WIDTH], &before[layer - 1], &mut after[0]);
        }
        let mut out = [w[LAST + WIDTH * 3], w[LAST + WIDTH * 3 + 1], w[LAST + WIDTH * 3 + 2]];
        for (a, row) in hidden[HIDDEN - 1].iter().zip(w[LAST..].chunks_exact(3)) {
            (0..3).for_each(|k| out[k] += a * row[k]);
        }
        out
    }

    /// Gradients with respect to the network's numbers and to the points, from those with respect to what they are mapped to.
    pub fn backward(&self, points: &[[f32; 3]], upstream: &[[f32; 3]]) -> (Vec<f32>, Vec<[f32; 3]>) {
        let parts: Vec<(Vec<f32>, Vec<[f32; 3]>)> = points
            .par_chunks(CHUNK)
            .zip(upstream.par_chunks(CHUNK))
            .map(|(points, upstream)| {
                let mut gradient = vec![0f32; LEN];
                let mut hidden = [[0.0; WIDTH]; HIDDEN];
                let by_point = points.iter().zip(upstream).map(|(p, g)| self.back(p, g, &mut hidden, &mut gradient));
                let by_point = by_point.collect();
                (gradient, by_point)
            })
            .collect();
        let mut gradient = vec![0f32; LEN];
        for (part, _) in &parts {
            gradient.iter_mut().zip(part).for_each(|(to, from)| *to += from);
        }
        (gradient, parts.into_iter().flat_map(|(_, by_point)| by_point).collect())
    }

    fn back(&self, p: &[f32; 3], g: &[f32; 3], hidden: &mut Hidden, gradient: &mut [f32]) -> [f32; 3] {
        self.point(p, hidden);
        let w = &self.0;
        let mut by_hidden = [0f32; WIDTH];
        let last = hidden[HIDDEN - 1];
        let rows = w[LAST..].chunks_exact(3).zip(gradient[LAST..].chunks_exact_mut(3));
        for ((a, to), (row, by_row)) in last.iter().zip(&mut by_hidden).zip(rows) {
            for k in 0..3 {
                by_row[k] += a * g[k];
                *to += row[k] * g[k];
            }
        }
        (0..3).for_each(|k| gradient[LAST + WIDTH * 3 + k] += g[k]);
        for layer in (1..HIDDEN).rev() {
            mask(&mut by_hidden, &hidden[layer]);
            let at = middle(layer);
            let mut by_before = [0f32; WIDTH];
            back_rows(&w[at..at + MIDDLE], &mut gradient[at..], &hidden[layer - 1], &by_hidden, &mut by_before);
            add(&mut gradient[at + MIDDLE..at + MIDDLE + WIDTH], &by_hidden);
            by_hidden = by_before;
        }
        mask(&mut by_hidden, &hidden[0]);
        let mut by_point = [0f32; 3];
        back_rows(&w[..FIRST], gradient, p, &by_hidden, &mut by_point);
        add(&mut gradient[FIRST..FIRST + WIDTH], &by_hidden);
        by_point
    }
}

/// `out = relu(bias + x W)`.
fn add_rows(weights: &[f32], bias: &[f32], x: &[f32], out: &mut [f32; WIDTH]) {
    out.copy_from_slice(bias);
    for (&x, row) in x.iter().zip(weights.chunks_exact(WIDTH)) {
        // Half of the hidden numbers are zero.
        if x != 0.0 {
            out.iter_mut().zip(row).for_each(|(o, w)| *o += x * w);
        }
    }
    out.iter_mut().for_each(|o| *o = o.max(0.0));
}

fn back_rows(weights: &[f32], gradient: &mut [f32], x: &[f32], by_out: &[f32; WIDTH], by_x: &mut [f32]) {
    let rows = weights.chunks_exact(WIDTH).zip(gradient.chunks_exact_mut(WIDTH));
    for ((&x, to), (row, by_row)) in x.iter().zip(by_x).zip(rows) {
        if x != 0.0 {
            by_row.iter_mut().zip(by_out).for_each(|(to, g)| *to += x * g);
        }
        // Eight running sums, so that the additions do not wait for one another.
        let mut sums = [0f32; 8];
        for (w, g) in row.chunks_exact(8).zip(by_out.chunks_exact(8)) {
            (0..8).for_each(|k| sums[k] += w[k] * g[k]);
        }
        *to = sums.iter().sum();
    }
}

fn mask(gradient: &mut [f32; WIDTH], hidden: &[f32; WIDTH]) {
    gradient.iter_mut().zip(hidden).for_each(|(g, &h)| *g = if h > 0.0 { *g } else { 0.0 });
}

fn add(to: &mut [f32], from: &[f32]) {
    to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_are_slopes() {
        let mut dice = Dice::new(3);
        let mlp = Mlp::new(&mut dice);
        let mut random = || [0; 3].map(|_| 4.0 * dice.unit() - 2.0);
        let points: Vec<[f32; 3]> = (0..200).map(|_| random()).collect();
        let upstream: Vec<[f32; 3]> = (0..200).map(|_| random()).collect();
        let dot = |out: &[[f32; 3]]| {
            let pairs = out.iter().flatten().zip(upstream.iter().flatten());
            pairs.map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>()
        };
        let (by_weight, by_point) = mlp.backward(&points, &upstream);
        // Rounding of 200 f32 outputs over the step, and the ReLU kinks that a step crosses.
        let (step, tolerance) = (1e-3f32, 0.02);
        for i in (0..LEN).step_by(997).chain([LEN - 1, FIRST + 3, LAST + 5]) {
            let at = |d: f32| {
                let mut moved = mlp.clone();
                moved.0[i] += d;
                dot(&moved.forward(&points))
            };
            let slope = (at(step) - at(-step)) / f64::from(2.0 * step);
            let gap = (slope - f64::from(by_weight[i])).abs();
            assert!(gap < tolerance * (1.0 + slope.abs()), "{i}: {slope} {}", by_weight[i]);
        }
        for i in [0, 77, 199] {
            for k in 0..3 {
                let at = |d: f32| {
                    let mut moved = points.clone();
                    moved[i][k] += d;
                    dot(&mlp.forward(&moved))
                };
                let slope = (at(step) - at(-step)) / f64::from(2.0 * step);
                let gap = (slope - f64::from(by_point[i][k])).abs();
                assert!(gap < tolerance * (1.0 + slope.abs()), "{i} {k}: {slope} {}", by_point[i][k]);
            }
        }
    }
}
