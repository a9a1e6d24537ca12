//! Mutual nearest neighbours between predicted and observed places.

use glam::DVec3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};

/// A k-d tree over points given relative to a local origin.
struct Tree(ImmutableKdTree<f64, 3>);

impl Tree {
    /// None for no points. Built by one thread: the same points give the same tree everywhere.
    fn new(points: &[[f64; 3]]) -> Option<Self> {
        if points.is_empty() {
            return None;
        }
        ImmutableKdTree::builder().with_serial_construction().build_from_slice(points).ok().map(Self)
    }

    fn nearest(&self, p: &[f64; 3]) -> (usize, f64) {
        let hit = self.0.query(p).nearest_one::<SquaredEuclidean<f64>>().execute();
        (hit.item as usize, hit.distance)
    }
}

/// For every observed place, the predicted one it continues: the nearest one, if it lies within `gate_m` and if the
/// observed place is in turn the nearest to it. So no prediction is used twice.
pub(super) fn mutual_nearest(predicted: &[DVec3], observed: &[DVec3], gate_m: f64) -> Vec<Option<usize>> {
    let none = vec![None; observed.len()];
    // Relative to one of the points: squares of UTM-sized coordinates would lose the centimetres.
    let Some(&origin) = observed.first() else { return none };
    let local = |p: &DVec3| (*p - origin).to_array();
    let (from, to): (Vec<_>, Vec<_>) = (predicted.iter().map(local).collect(), observed.iter().map(local).collect());
    let (Some(from_tree), Some(to_tree)) = (Tree::new(&from), Tree::new(&to)) else { return none };
    let gate2 = gate_m * gate_m;
    // Few predictions, many observations: asking from the predictions' side first leaves few questions for the other.
    let mut matched = none;
    for (i, p) in from.iter().enumerate() {
        let (at, distance2) = to_tree.nearest(p);
        if distance2 <= gate2 {
            let (back, back2) = from_tree.nearest(&to[at]);
            // Of predictions at one and the same place, the tree names one; the first to ask gets the observation.
            if (back == i || back2 == distance2) && matched[at].is_none() {
                matched[at] = Some(i);
            }
        }
    }
    matched
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// The obvious version: every pair compared.
    fn brute(predicted: &[DVec3], observed: &[DVec3], gate_m: f64) -> Vec<Option<usize>> {
        let nearest = |from: DVec3, to: &[DVec3]| {
            let d = |i: &usize| to[*i].distance_squared(from);
            (0..to.len()).min_by(|a, b| d(a).total_cmp(&d(b)))
        };
        observed
            .iter()
            .enumerate()
            .map(|(j, &o)| {
                let i = nearest(o, predicted)?;
                let mutual = nearest(predicted[i], observed)? == j;
                (mutual && predicted[i].distance(o) <= gate_m).then_some(i)
            })
            .collect()
    }

    fn points(n: std::ops::Range<usize>) -> impl Strategy<Value = Vec<DVec3>> {
        let place = (-5.0f64..5.0, -5.0f64..5.0, -1.0f64..1.0).prop_map(|(x, y, z)| DVec3::new(x, y, z));
        proptest::collection::vec(place, n)
    }

    proptest! {
        #[test]
        fn agrees_with_comparing_every_pair(
            predicted in points(0..60), observed in points(0..200), gate_m in 0.1f64..3.0,
        ) {
            prop_assert_eq!(mutual_nearest(&predicted, &observed, gate_m), brute(&predicted, &observed, gate_m));
        }
    }

    #[test]
    fn many_points_at_one_place_are_no_trouble() {
        let utm = DVec3::new(4.5e6, -6e5, 100.0);
        let (from, to) = (vec![utm; 500], vec![utm + DVec3::X * 0.01; 3000]);
        let matched = mutual_nearest(&from, &to, 0.5);
        assert_eq!(matched.iter().flatten().count(), 1);
        let flat: Vec<DVec3> = (0..4000).map(|i| utm + DVec3::new(0.01 * f64::from(i % 50), 0.0, 0.0)).collect();
        assert!(mutual_nearest(&flat, &flat, 0.5).iter().flatten().count() >= 50 - 1);
    }
}
