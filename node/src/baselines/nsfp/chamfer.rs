//! Truncated Chamfer distance with its gradient.

use rayon::prelude::*;

use crate::baselines::nearest::Cloud;

/// Squared distances from here on are no correspondence and count nothing, m^2 (NSFP).
pub const TRUNCATE_M2: f32 = 2.0;

fn nearest_all(cloud: &Cloud, from: &[[f32; 3]]) -> Vec<Option<(usize, f32)>> {
    from.par_iter().map(|p| cloud.nearest(p).filter(|(_, d2)| *d2 < TRUNCATE_M2)).collect()
}

/// Mean squared distance from `moved` to the nearest of `target`, and from `asked`, some points of `target`, to the nearest
/// of `moved`; and the gradient with respect to `moved`.
pub fn chamfer(moved: &[[f32; 3]], target: &Cloud, asked: &[[f32; 3]]) -> (f64, Vec<[f32; 3]>) {
    let mut gradient = vec![[0f32; 3]; moved.len()];
    if moved.is_empty() || asked.is_empty() {
        return (0.0, gradient);
    }
    let mut loss = 0f64;
    let share = 1.0 / moved.len() as f32;
    for ((hit, p), g) in nearest_all(target, moved).into_iter().zip(moved).zip(&mut gradient) {
        let Some((at, d2)) = hit else { continue };
        loss += f64::from(d2 * share);
        let q = &target.points()[at];
        (0..3).for_each(|k| g[k] += 2.0 * share * (p[k] - q[k]));
    }
    let share = 1.0 / asked.len() as f32;
    let cloud = Cloud::new(moved.to_vec());
    for (hit, q) in nearest_all(&cloud, asked).into_iter().zip(asked) {
        let Some((at, d2)) = hit else { continue };
        loss += f64::from(d2 * share);
        (0..3).for_each(|k| gradient[at][k] += 2.0 * share * (moved[at][k] - q[k]));
    }
    (loss, gradient)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dice::Dice;

    #[test]
    fn agrees_with_comparing_every_pair_and_the_gradient_is_the_slope() {
        let mut dice = Dice::new(1);
        let mut cloud = |n: usize| (0..n).map(|_| [0; 3].map(|_| 6.0 * dice.unit())).collect::<Vec<[f32; 3]>>();
        let (a, b) = (cloud(60), cloud(90));
        let target = Cloud::new(b.clone());
        let d2 = |p: &[f32; 3], q: &[f32; 3]| (0..3).map(|k| (p[k] - q[k]).powi(2)).sum::<f32>();
        let one_way = |from: &[[f32; 3]], to: &[[f32; 3]]| {
            let nearest = |p| to.iter().map(|q| d2(p, q)).fold(f32::INFINITY, f32::min);
            from.iter().map(nearest).filter(|d| *d < TRUNCATE_M2).map(f64::from).sum::<f64>() / from.len() as f64
        };
        let (loss, gradient) = chamfer(&a, &target, &b);
        assert!((loss - one_way(&a, &b) - one_way(&b, &a)).abs() < 1e-5, "{loss}");
        // f32 distances: rounding of 1e-6 over the step; a change of neighbour within it is of second order.
        let step = 2e-3f32;
        for i in (0..60).step_by(7) {
            let at = |d: f32| {
                let mut moved = a.clone();
                moved[i][1] += d;
                chamfer(&moved, &target, &b).0
            };
            let slope = (at(step) - at(-step)) / f64::from(2.0 * step);
            assert!((slope - f64::from(gradient[i][1])).abs() < 2e-3, "{slope} {}", gradient[i][1]);
        }
        assert_eq!(chamfer(&[], &target, &b).0, 0.0);
        assert_eq!(chamfer(&a, &Cloud::new(Vec::new()), &[]).0, 0.0);
    }
}
