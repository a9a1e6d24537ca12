//! Nearest points of a cloud.

use kiddo::{ImmutableKdTree, SquaredEuclidean};

/// Points that can be asked for their nearest.
pub struct Cloud {
    points: Vec<[f32; 3]>,
    tree: Option<ImmutableKdTree<f32, 3>>,
}

impl Cloud {
    /// Built by one thread: the same points give the same tree everywhere.
    pub fn new(points: Vec<[f32; 3]>) -> Self {
        let tree = (!points.is_empty())
            .then(|| ImmutableKdTree::builder().with_serial_construction().build_from_slice(&points).ok())
            .flatten();
        Self { points, tree }
    }

    /// The points.
    pub fn points(&self) -> &[[f32; 3]] {
        &self.points
    }

    /// Index and squared distance of the nearest point.
    pub fn nearest(&self, p: &[f32; 3]) -> Option<(usize, f32)> {
        let hit = self.tree.as_ref()?.query(p).nearest_one::<SquaredEuclidean<f32>>().execute();
        Some((hit.item as usize, hit.distance))
    }
}
