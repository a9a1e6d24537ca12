//! Keeping new trajectories apart from each other; from those alive they are kept by a grid, all at once.

use glam::DVec3;

/// No further place.
const END: u32 = u32::MAX;

/// A set of places at least `spacing_m` apart.
pub(super) struct Spacing {
    inverse_m: f64,
    limit2: f64,
    origin: DVec3,
    /// Per hash of a cube of the spacing's edge its newest place; a power of two of them. Cubes may share one.
    newest: Vec<u32>,
    /// Places, and the one before of the same hash.
    places: Vec<(DVec3, u32)>,
}

impl Spacing {
    /// `about` is how many places there will be, roughly.
    pub fn new(spacing_m: f64, origin: DVec3, about: usize) -> Self {
        let newest = vec![END; (2 * about).next_power_of_two()];
        let places = Vec::with_capacity(about);
        Self { inverse_m: 1.0 / spacing_m, limit2: spacing_m * spacing_m, origin, newest, places }
    }

    fn cube(&self, p: DVec3) -> [i32; 3] {
        // `as` saturates: places far outside share a cube, which is slower and no less right.
        ((p - self.origin) * self.inverse_m).floor().to_array().map(|x| x as i32)
    }

    fn hash(&self, [x, y, z]: [i32; 3]) -> usize {
        let mixed = (x as u32).wrapping_mul(0x9e37_79b1)
            ^ (y as u32).wrapping_mul(0x85eb_ca77)
            ^ (z as u32).wrapping_mul(0xc2b2_ae3d);
        mixed as usize & (self.newest.len() - 1)
    }

    /// Adds a place, near others or not.
    fn add(&mut self, p: DVec3) {
        let (at, hash) = (self.places.len() as u32, self.hash(self.cube(p)));
        self.places.push((p, std::mem::replace(&mut self.newest[hash], at)));
    }

    /// Adds a place if none added before is nearer than the spacing; true if it was.
    pub fn claim(&mut self, p: DVec3) -> bool {
        let [x, y, z] = self.cube(p);
        for i in 0..27 {
            let near = [x.wrapping_add(i / 9 - 1), y.wrapping_add(i / 3 % 3 - 1), z.wrapping_add(i % 3 - 1)];
            let mut next = self.newest[self.hash(near)];
            while let Some((q, before)) = self.places.get(next as usize) {
                if q.distance_squared(p) < self.limit2 {
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
