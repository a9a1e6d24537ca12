//! Voxels of a tile: numbers for them, and the table that finds a cell by its voxel.
//!
//! Voxels come in [`LEVELS`] sizes, each twice the last. A voxel that holds smaller occupied ones is marked as refined:
//! whoever asks for it is sent on to the smaller ones.

use glam::Vec3;

/// Sizes of voxels.
pub(super) const LEVELS: u32 = 5;
/// Bits of a voxel's index along one axis.
const AXIS_BITS: u32 = 9;
/// Most finest voxels along a tile's edge.
pub const MAX_PER_EDGE: u32 = 1 << AXIS_BITS;

/// The number of the voxel of `level` around a place.
///
/// `inverse_m` is one over the finest voxel's edge. Places outside the tile count as on its border.
pub(super) fn key_at(position: Vec3, inverse_m: f32, level: u32) -> u32 {
    // `as` saturates, and turns NaN into 0.
    let axis = |x: f32| ((x * inverse_m) as u32).min(MAX_PER_EDGE - 1) >> level;
    let [x, y, z] = position.to_array().map(axis);
    level << (3 * AXIS_BITS) | x << (2 * AXIS_BITS) | y << AXIS_BITS | z
}

/// The level of a voxel.
pub(super) fn level_of(key: u32) -> u32 {
    key >> (3 * AXIS_BITS)
}

/// The voxel twice the size around a voxel; none for the largest.
pub(super) fn parent(key: u32) -> Option<u32> {
    let level = level_of(key) + 1;
    let half = |shift: u32| ((key >> shift) & (MAX_PER_EDGE - 1)) >> 1 << shift;
    (level < LEVELS).then(|| level << (3 * AXIS_BITS) | half(2 * AXIS_BITS) | half(AXIS_BITS) | half(0))
}

/// What is at a voxel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Slot {
    Empty,
    /// Smaller voxels in it are occupied.
    Refined,
    /// Number of the cell.
    Cell(u32),
}

const EMPTY: u32 = u32::MAX;
const REFINED: u32 = u32::MAX - 1;
/// Most cells of a tile, so that numbers never meet the marks above.
pub(super) const MAX_CELLS: usize = 1 << 26;
/// Fewest places of a table.
const MIN_PLACES: usize = 64;

/// Open addressing with linear probing; nothing is ever taken out, the table is built anew instead.
#[derive(Debug, Clone, Default)]
pub(super) struct Table {
    /// Voxel and value; a power of two of them.
    places: Vec<(u32, u32)>,
    used: usize,
}

impl Table {
    pub fn clear(&mut self) {
        self.places.fill((0, EMPTY));
        self.used = 0;
    }

    pub fn bytes(&self) -> usize {
        self.places.capacity() * size_of::<(u32, u32)>()
    }

    /// Neighbouring keys land apart: the golden ratio's bits, the high ones of the product.
    fn start(&self, key: u32) -> usize {
        let bits = self.places.len().trailing_zeros();
        (key.wrapping_mul(0x9e37_79b1) >> (32 - bits)) as usize
    }

    /// Where `key` is, or the free place it would go to.
    fn find(&self, key: u32) -> usize {
        let mask = self.places.len() - 1;
        let mut at = self.start(key);
        while self.places[at].1 != EMPTY && self.places[at].0 != key {
            at = (at + 1) & mask;
        }
        at
    }

    pub fn get(&self, key: u32) -> Slot {
        if self.places.is_empty() {
            return Slot::Empty;
        }
        match self.places[self.find(key)].1 {
            EMPTY => Slot::Empty,
            REFINED => Slot::Refined,
            cell => Slot::Cell(cell),
        }
    }

    /// Puts a cell's number at a voxel, whatever was there.
    pub fn put_cell(&mut self, key: u32, cell: u32) {
        self.put(key, cell);
    }

    /// Marks a voxel as refined, whatever was there.
    pub fn put_refined(&mut self, key: u32) {
        self.put(key, REFINED);
    }

    fn put(&mut self, key: u32, value: u32) {
        // At most two thirds full, so that probes stay short.
        if 3 * (self.used + 1) > 2 * self.places.len() {
            self.grow();
        }
        let at = self.find(key);
        self.used += usize::from(self.places[at].1 == EMPTY);
        self.places[at] = (key, value);
    }

    fn grow(&mut self) {
        let places = (2 * self.places.len()).max(MIN_PLACES);
        let old = std::mem::replace(&mut self.places, vec![(0, EMPTY); places]);
        for (key, value) in old {
            if value != EMPTY {
                let at = self.find(key);
                self.places[at] = (key, value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_parent_is_the_next_larger_voxel_around_the_same_place() {
        for i in 0..2000 {
            let p = Vec3::new((i * 37 % 160) as f32, (i * 91 % 160) as f32, (i * 13 % 160) as f32) * 0.1;
            for level in 0..LEVELS - 1 {
                let key = key_at(p, 10.0, level);
                assert_eq!((parent(key), level_of(key)), (Some(key_at(p, 10.0, level + 1)), level));
            }
            assert_eq!(parent(key_at(p, 10.0, LEVELS - 1)), None);
        }
        let wild = [Vec3::NAN, Vec3::splat(-1.0), Vec3::splat(f32::INFINITY), Vec3::splat(1e9)];
        wild.iter().for_each(|p| assert!(key_at(*p, 10.0, 0) < 1 << (3 * AXIS_BITS)));
    }

    proptest! {
        #[test]
        fn finds_what_a_hash_map_finds(puts in proptest::collection::vec((0u32..300, 0u32..1000, any::<bool>()), 0..800)) {
            let (mut table, mut reference) = (Table::default(), HashMap::new());
            for (key, value, refined) in puts {
                match refined {
                    true => table.put_refined(key),
                    false => table.put_cell(key, value),
                }
                reference.insert(key, if refined { Slot::Refined } else { Slot::Cell(value) });
            }
            for key in 0..310 {
                prop_assert_eq!(table.get(key), reference.get(&key).copied().unwrap_or(Slot::Empty));
            }
        }
    }

    /// A plane, a wall and a column of voxels, as streets are: probes stay short.
    #[test]
    fn surfaces_spread_over_the_table() {
        let mut table = Table::default();
        let mut keys = Vec::new();
        for a in 0..100 {
            for b in 0..100 {
                for (x, y, z) in [(a, b, 11), (40, a, b), (a, 7, b)] {
                    keys.push(key_at(Vec3::new(x as f32, y as f32, z as f32) + 0.5, 1.0, 0));
                }
            }
        }
        keys.iter().for_each(|&k| table.put_cell(k, k & 0xff));
        let mask = table.places.len() - 1;
        let probes: usize = keys.iter().map(|&k| (table.find(k).wrapping_sub(table.start(k))) & mask).sum();
        assert!(probes < 2 * keys.len(), "{} probes for {}", probes, keys.len());
    }
}
