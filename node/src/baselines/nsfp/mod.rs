//! Scene flow of one pair of point clouds by optimising a network on it alone (Neural Scene Flow Prior, Li et al., 2021).
//!
//! A network moves the first cloud onto the second, another one moves the result back onto the first (cycle); both are
//! fitted to the truncated Chamfer distance with Adam and early stopping. Smaller than the original (4 hidden layers of 64
//! instead of 8 of 128), and it moves at most 2,048 points of a cloud, so that a CPU does it in seconds; their nearest ones are
//! sought in the other's whole cloud. Coordinates are divided by 10 m before they enter the network. Ground is left out, as
//! usual with this method: a sensor that moves sees it in a pattern that moves along.

mod chamfer;
mod mlp;

use std::collections::BTreeMap;

use chamfer::chamfer;
use mlp::{LEN, Mlp};

use super::adam::Adam;
use super::nearest::Cloud;
use crate::dice::Dice;

/// Most points of a cloud that are moved.
pub const POINTS: usize = 2048;
/// Metres that count as 1 in the network.
const UNIT_M: f32 = 10.0;
/// Learning rate (NSFP).
const RATE: f32 = 8e-3;
const EPS: f32 = 1e-8;
/// The fit ends after this many iterations without a better loss (NSFP).
const PATIENCE: u64 = 100;
/// Points lower than this above the lowest one of their cell are ground, metres (usual for Argoverse).
const GROUND_M: f32 = 0.3;
/// Edge of the cells, metres: the road rises less than [`GROUND_M`] across one.
const GROUND_CELL_M: f32 = 4.0;
/// Most iterations of a fit.
pub const ITERATIONS: u64 = 500;

/// The fitted pair of networks.
pub struct Flow {
    forward: Mlp,
    backward: Mlp,
    /// The best loss, m^2.
    pub loss: f64,
    /// Iterations run.
    pub iterations: u64,
}

fn scaled(points: &[[f32; 3]]) -> Vec<[f32; 3]> {
    points.iter().map(|p| p.map(|x| x / UNIT_M)).collect()
}

fn moved(points: &[[f32; 3]], by: &[[f32; 3]]) -> Vec<[f32; 3]> {
    points.iter().zip(by).map(|(p, d)| [0, 1, 2].map(|k| p[k] + d[k])).collect()
}

/// At most [`POINTS`] of a cloud, drawn without replacement.
fn sample(points: &[[f32; 3]], dice: &mut Dice) -> Vec<[f32; 3]> {
    let mut order: Vec<usize> = (0..points.len()).collect();
    dice.shuffle(&mut order);
    order.truncate(POINTS);
    order.into_iter().map(|i| points[i]).collect()
}

/// Which points are ground: those less than `GROUND_M` above the lowest point of their cell (z is up).
pub fn ground(points: &[[f32; 3]]) -> Vec<bool> {
    let cell = |p: &[f32; 3]| ((p[0] / GROUND_CELL_M).floor() as i64, (p[1] / GROUND_CELL_M).floor() as i64);
    let mut lowest: BTreeMap<(i64, i64), f32> = BTreeMap::new();
    for p in points {
        let low = lowest.entry(cell(p)).or_insert(p[2]);
        *low = low.min(p[2]);
    }
    points.iter().map(|p| lowest.get(&cell(p)).is_some_and(|low| p[2] - low < GROUND_M)).collect()
}

impl Flow {
    /// Fits the flow that takes `from` to `to`, metres. `None` when a cloud is empty.
    pub fn fit(from: &[[f32; 3]], to: &[[f32; 3]], iterations: u64, seed: u64) -> Option<Self> {
        if from.is_empty() || to.is_empty() {
            return None;
        }
        let mut dice = Dice::new(seed);
        let (all_from, all_to) = (Cloud::new(from.to_vec()), Cloud::new(to.to_vec()));
        let (from, to) = (sample(from, &mut dice), sample(to, &mut dice));
        let (mut forward, mut backward) = (Mlp::new(&mut dice), Mlp::new(&mut dice));
        let (mut adam_f, mut adam_b) = (Adam::new(LEN, EPS), Adam::new(LEN, EPS));
        let from_scaled = scaled(&from);
        let mut best =
            Self { forward: forward.clone(), backward: backward.clone(), loss: f64::INFINITY, iterations: 0 };
        let mut waited = 0;
        for iteration in 0..iterations {
            let there = moved(&from, &forward.forward(&from_scaled));
            let there_scaled = scaled(&there);
            let back = moved(&there, &backward.forward(&there_scaled));
            let (loss_there, by_there) = chamfer(&there, &all_to, &to);
            let (loss_back, by_back) = chamfer(&back, &all_from, &from);
            let loss = loss_there + loss_back;
            best.iterations = iteration + 1;
            if loss < best.loss {
                (best.forward, best.backward, best.loss) = (forward.clone(), backward.clone(), loss);
                waited = 0;
            } else {
                waited += 1;
                if waited >= PATIENCE {
                    break;
                }
            }
            let (by_backward, through) = backward.backward(&there_scaled, &by_back);
            let by_moved: Vec<[f32; 3]> = (0..there.len())
                .map(|i| [0, 1, 2].map(|k| by_there[i][k] + by_back[i][k] + through[i][k] / UNIT_M))
                .collect();
            let (by_forward, _) = forward.backward(&from_scaled, &by_moved);
            adam_f.step(&mut forward.0, &by_forward, RATE);
            adam_b.step(&mut backward.0, &by_backward, RATE);
        }
        best.loss.is_finite().then_some(best)
    }

    /// Where points of the first cloud's time go, metres.
    pub fn ahead(&self, points: &[[f32; 3]]) -> Vec<[f32; 3]> {
        self.forward.forward(&scaled(points))
    }

    /// Where points of the second cloud's time came from, metres.
    pub fn back(&self, points: &[[f32; 3]]) -> Vec<[f32; 3]> {
        self.backward.forward(&scaled(points))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A floor that stays and a box above it that moves by `step`.
    fn scene(step: [f32; 3]) -> (Vec<[f32; 3]>, Vec<[f32; 3]>, usize) {
        let mut points = Vec::new();
        for i in 0..20 {
            for j in 0..20 {
                points.push([i as f32 * 0.5, j as f32 * 0.5, 0.0]);
            }
        }
        let floor = points.len();
        let mut dice = Dice::new(11);
        points.extend((0..300).map(|_| [4.0 + dice.unit(), 4.0 + 2.0 * dice.unit(), 1.5 + 1.5 * dice.unit()]));
        let mut after = points.clone();
        after[floor..].iter_mut().for_each(|p| (0..3).for_each(|k| p[k] += step[k]));
        (points, after, floor)
    }

    #[test]
    fn ground_is_what_lies_lowest() {
        let points = [[0.1, 0.1, 2.0], [1.0, 3.0, 2.2], [2.0, 1.0, 2.5], [9.0, 0.0, 7.0], [-0.1, 0.0, 9.0]];
        assert_eq!(ground(&points), [true, true, false, true, true]);
    }

    #[test]
    fn a_moving_box_over_a_still_floor_is_told_apart_and_twice_alike() {
        let step = [0.4, 0.3, 0.0];
        let (before, after, floor) = scene(step);
        let fit = || Flow::fit(&before, &after, 200, 4).unwrap();
        let flow = fit();
        let ahead = flow.ahead(&before);
        let error = |d: &[f32; 3], want: [f32; 3]| (0..3).map(|k| (d[k] - want[k]).powi(2)).sum::<f32>().sqrt();
        let mean = |x: Vec<f32>| x.iter().sum::<f32>() / x.len() as f32;
        let still = mean(ahead[..floor].iter().map(|d| error(d, [0.0; 3])).collect());
        let moving = mean(ahead[floor..].iter().map(|d| error(d, step)).collect());
        // The box moves 0.5 m.
        assert!(still < 0.1 && moving < 0.2, "floor {still} m, box {moving} m, loss {}", flow.loss);
        let back = mean(flow.back(&after)[floor..].iter().map(|d| error(d, step.map(|x| -x))).collect());
        assert!(back < 0.25, "{back}");
        assert_eq!(fit().ahead(&before), ahead);
        assert!(Flow::fit(&[], &after, 5, 1).is_none());
    }
}
