//! Keeping new trajectories apart from all others.

use std::collections::HashMap;

use glam::DVec3;

use crate::map::VoxelHash;

/// No further place in a cube.
const END: u32 = u32::MAX;

/// A set of places, at least `spacing_m` apart as far as they were added through [`Spacing::claim`].
pub(super) struct Spacing {
    spacing_m: f64,
    origin: DVec3,
    /// Per cube of the spacing's edge, its newest place.
    newest: HashMap<[i32; 3], u32, VoxelHash>,
    /// Places, and the one before in the same cube.
    places: Vec<(DVec3, u32)>,
}

impl Spacing {
    /// `about` is how many places there will be, roughly.
    pub fn new(spacing_m: f64, origin: DVec3, about: usize) -> Self {
        let newest = HashMap::with_capacity_and_hasher(about, VoxelHash::default());
        Self { spacing_m, origin, newest, places: Vec::with_capacity(about) }
    }

    fn key(&self, p: DVec3) -> [i32; 3] {
        // `as` saturates: places far outside share a cube, which is slower and no less right.
        ((p - self.origin) / self.spacing_m).floor().to_array().map(|x| (x as i32).clamp(i32::MIN + 1, i32::MAX - 1))
    }

    /// Adds a place, near others or not.
    pub fn add(&mut self, p: DVec3) {
        let at = self.places.len() as u32;
        let before = self.newest.insert(self.key(p), at).unwrap_or(END);
        self.places.push((p, before));
    }

    /// Adds a place if none added before is nearer than the spacing; true if it was.
    pub fn claim(&mut self, p: DVec3) -> bool {
        let [x, y, z] = self.key(p);
        let limit2 = self.spacing_m * self.spacing_m;
        for i in 0..27 {
            let near = [x + i / 9 - 1, y + i / 3 % 3 - 1, z + i % 3 - 1];
            let mut next = self.newest.get(&near).copied().unwrap_or(END);
            while let Some((q, before)) = self.places.get(next as usize) {
                if q.distance_squared(p) < limit2 {
                    return false;
                }
                next = *before;
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
        let mut s = Spacing::new(0.5, utm, 0);
        assert!(s.claim(utm + DVec3::new(0.49, 0.0, 0.0)));
        assert!(!s.claim(utm + DVec3::new(0.51, -0.01, -0.01)));
        assert!(s.claim(utm + DVec3::new(1.0, 0.0, 0.0)));
        s.add(utm + DVec3::new(1.1, 0.0, 0.0));
        assert!(!s.claim(utm + DVec3::new(1.55, 0.0, 0.0)));
    }
}
