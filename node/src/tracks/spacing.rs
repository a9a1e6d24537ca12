//! Keeping new trajectories apart from all others.

use std::collections::HashMap;

use glam::DVec3;

/// A set of places, at least `spacing_m` apart as far as they were added through [`Spacing::claim`].
pub(super) struct Spacing {
    spacing_m: f64,
    origin: DVec3,
    grid: HashMap<[i64; 3], Vec<DVec3>>,
}

impl Spacing {
    pub fn new(spacing_m: f64, origin: DVec3) -> Self {
        Self { spacing_m, origin, grid: HashMap::new() }
    }

    fn key(&self, p: DVec3) -> [i64; 3] {
        ((p - self.origin) / self.spacing_m).floor().to_array().map(|x| x as i64)
    }

    /// Adds a place, near others or not.
    pub fn add(&mut self, p: DVec3) {
        self.grid.entry(self.key(p)).or_default().push(p);
    }

    /// Adds a place if none added before is nearer than the spacing; true if it was.
    pub fn claim(&mut self, p: DVec3) -> bool {
        let [x, y, z] = self.key(p);
        let limit2 = self.spacing_m * self.spacing_m;
        for i in 0..27 {
            let near = [x + i / 9 - 1, y + i / 3 % 3 - 1, z + i % 3 - 1];
            if self.grid.get(&near).is_some_and(|places| places.iter().any(|q| q.distance_squared(p) < limit2)) {
                return false;
            }
        }
        self.add(p);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_stay_apart_across_cell_borders() {
        let utm = DVec3::new(4.5e6, -6e5, 100.0);
        let mut s = Spacing::new(0.5, utm);
        assert!(s.claim(utm + DVec3::new(0.49, 0.0, 0.0)));
        assert!(!s.claim(utm + DVec3::new(0.51, -0.01, -0.01)));
        assert!(s.claim(utm + DVec3::new(1.0, 0.0, 0.0)));
        s.add(utm + DVec3::new(1.1, 0.0, 0.0));
        assert!(!s.claim(utm + DVec3::new(1.55, 0.0, 0.0)));
    }
}
