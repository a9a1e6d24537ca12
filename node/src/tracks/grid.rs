//! Points in a grid of cubes, found by where they are.

use std::ops::Range;

/// Points in cubes, the cubes in a table by hash; a place of the table lists its points one after the other. Cubes that
/// lie side by side along x have places side by side, so that two of them are one list.
pub(super) struct Grid {
    inverse_m: f32,
    cube_m: f32,
    /// First item of every place, and the end.
    starts: Vec<u32>,
    /// Place and number of every point, cube after cube.
    pub items: Vec<([f32; 3], u32)>,
}

/// Where the row of cubes along x begins that has these indices along y and z.
fn row(y: i32, z: i32) -> u32 {
    let mixed = (y as u32).wrapping_mul(0x85eb_ca77) ^ (z as u32).wrapping_mul(0xc2b2_ae3d);
    mixed ^ (mixed >> 15)
}

/// Cubes along an axis to either side; what lies farther out shares the outermost ones.
const CUBES: f32 = 4e6;
/// Floats from here on are whole numbers, the lowest bits of which are the number itself.
const WHOLE: f32 = 12_582_912.0;

/// The cube's own index along an axis and the place in it, 0 to 1; a place on a face counts for either side. (`floor` and
/// a checked conversion are calls and branches where the processor is not known to have them; this is a few additions.)
fn split(scaled: f32) -> (i32, f32) {
    let scaled = scaled.clamp(-CUBES, CUBES);
    let whole = (scaled - 0.5) + WHOLE;
    ((whole.to_bits() as i32).wrapping_sub(WHOLE.to_bits() as i32), scaled - (whole - WHOLE))
}

/// Distances to faces count as a little less, for what their computation rounds.
const NEARLY: f32 = 0.999;

/// Nearest so far: number, squared distance. Of equals the first counts.
pub(super) type Best = (u32, f32);

/// A number that is smaller for what is nearer, of equals for the first: one to compare, and no branch to guess. Bits of
/// floats that are not negative are ordered as they are, so a distance in front of a number makes a float again.
fn key((i, distance2): Best) -> f64 {
    f64::from_bits(u64::from(distance2.to_bits()) << 32 | u64::from(i))
}

impl Grid {
    /// `cube_m` is the cubes' edge.
    pub fn new(points: &[[f32; 3]], cube_m: f32) -> Self {
        let (mut grid, at) = Self::counted(points, cube_m);
        let places = grid.starts.len() - 1;
        for i in 0..places {
            grid.starts[i + 1] += grid.starts[i];
        }
        grid.items = vec![([0.0; 3], 0); points.len()];
        // Backwards, so that `starts` can count down to what it has to be and items keep their order.
        let ends = &mut grid.starts[1..];
        for (i, (p, &a)) in points.iter().zip(&at).enumerate().rev() {
            ends[a as usize] -= 1;
            grid.items[ends[a as usize] as usize] = (*p, i as u32);
        }
        // Every place's end has become its start: one to the left.
        grid.starts.copy_within(1.., 0);
        grid.starts[places] = points.len() as u32;
        grid
    }

    /// A grid whose places are counted, each in the start of the next, and the points' places.
    fn counted(points: &[[f32; 3]], cube_m: f32) -> (Self, Vec<u32>) {
        let places = points.len().next_power_of_two();
        let mut grid = Self { inverse_m: 1.0 / cube_m, cube_m, starts: vec![0; places + 1], items: Vec::new() };
        let at: Vec<u32> = points.iter().map(|p| grid.place(grid.cube(p)) as u32).collect();
        at.iter().for_each(|&a| grid.starts[a as usize + 1] += 1);
        (grid, at)
    }

    /// Points in a cube of such a grid as one of its points sees it: averaged over all points.
    pub fn crowd(points: &[[f32; 3]], cube_m: f32) -> f32 {
        let (grid, _) = Self::counted(points, cube_m);
        let squares: u64 = grid.starts.iter().map(|&n| u64::from(n).pow(2)).sum();
        squares as f32 / points.len().max(1) as f32
    }

    fn cube(&self, p: &[f32; 3]) -> [i32; 3] {
        p.map(|x| split(x * self.inverse_m).0)
    }

    fn place(&self, [x, y, z]: [i32; 3]) -> usize {
        row(y, z).wrapping_add(x as u32) as usize & (self.starts.len() - 2)
    }

    /// The nearest among the points of `places` of the table and `best`.
    #[inline]
    fn look(&self, places: Range<usize>, p: &[f32; 3], best: Best) -> Best {
        let items = self.starts[places.start] as usize..self.starts[places.end] as usize;
        let mut nearest = key(best);
        for (q, i) in &self.items[items] {
            let d2 = (q[0] - p[0]).powi(2) + (q[1] - p[1]).powi(2) + (q[2] - p[2]).powi(2);
            let this = key((*i, d2));
            nearest = if this < nearest { this } else { nearest };
        }
        let bits = nearest.to_bits();
        (bits as u32, f32::from_bits((bits >> 32) as u32))
    }

    /// The nearest among the eight cubes around the corner nearest to `p`; false when a nearer one within `within2`
    /// may lie beyond them.
    pub fn beside(&self, p: &[f32; 3], within2: f32) -> (Best, bool) {
        let mask = self.starts.len() - 2;
        let own = p.map(|x| split(x * self.inverse_m));
        // The other cube along an axis, how far off it is, and how far one sees beyond the own or the other.
        let other = own.map(|(index, part)| index.wrapping_add(if part < 0.5 { -1 } else { 1 }));
        let apart2 = own.map(|(_, part)| (part.min(1.0 - part) * self.cube_m * NEARLY).powi(2));
        let reach = own.iter().fold(f32::INFINITY, |reach, (_, part)| reach.min(part.max(1.0 - part)));
        let first_x = own[0].0.wrapping_add(if own[0].1 < 0.5 { -1 } else { 0 }) as u32;
        let mut best = (u32::MAX, within2);
        let look = |y: i32, z: i32, best: Best| {
            let place = row(y, z).wrapping_add(first_x) as usize & mask;
            if place < mask {
                self.look(place..place + 2, p, best)
            } else {
                self.look(0..1, p, self.look(mask..mask + 1, p, best))
            }
        };
        best = look(own[1].0, own[2].0, best);
        if apart2[1] <= best.1 {
            best = look(other[1], own[2].0, best);
        }
        if apart2[2] <= best.1 {
            best = look(own[1].0, other[2], best);
        }
        if apart2[1] + apart2[2] <= best.1 {
            best = look(other[1], other[2], best);
        }
        let seen = reach * self.cube_m * NEARLY;
        (best, best.1 <= seen * seen)
    }

    /// The nearest point whose squared distance is at most `within2`, with that distance: ring after ring of cubes.
    pub fn around(&self, p: &[f32; 3], within2: f32) -> Best {
        let [x, y, z] = self.cube(p);
        // How far from the cube's own faces: so much around is seen with the cube, a cube more with every ring.
        let to_face = |v: f32| {
            let part = split(v * self.inverse_m).1;
            part.min(1.0 - part) * self.cube_m
        };
        let inner = p.iter().fold(f32::INFINITY, |m, &v| m.min(to_face(v)));
        let (mut best, mut ring) = ((u32::MAX, within2), 0i32);
        loop {
            for dx in -ring..=ring {
                for dy in -ring..=ring {
                    // Inside the ring's shell only its two ends.
                    let shell = dx.abs() == ring || dy.abs() == ring;
                    let step = if shell { 1 } else { (2 * ring).max(1) };
                    for dz in (-ring..=ring).step_by(step as usize) {
                        let cube = [x.wrapping_add(dx), y.wrapping_add(dy), z.wrapping_add(dz)];
                        let place = self.place(cube);
                        best = self.look(place..place + 1, p, best);
                    }
                }
            }
            let seen = ring as f32 * self.cube_m + inner;
            // Phrased as what goes on, so that a NaN ends it.
            if seen * seen <= best.1 {
                ring += 1;
            } else {
                return best;
            }
        }
    }
}
