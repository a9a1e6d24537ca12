//! A hash for voxel indices. The standard one guards against chosen keys, which costs half of an insertion here; the
//! order of the table never shows in the map.

use std::hash::{BuildHasherDefault, Hasher};

/// Hashes three 32-bit indices with two multiplications.
#[derive(Debug, Default, Clone, Copy)]
pub struct VoxelHasher(u64);

/// For `HashMap`.
pub type VoxelHash = BuildHasherDefault<VoxelHasher>;

/// Odd, with bits spread evenly (the golden ratio's), so that neighbouring indices land far apart.
const SPREAD: u64 = 0x9e37_79b9_7f4a_7c15;

impl Hasher for VoxelHasher {
    fn write(&mut self, bytes: &[u8]) {
        for chunk in bytes.chunks(8) {
            let mut word = [0; 8];
            word[..chunk.len()].copy_from_slice(chunk);
            // The high half of the product holds the mixed bits; folding it in brings them down to where the table
            // looks.
            let product = u128::from(self.0 ^ u64::from_le_bytes(word)) * u128::from(SPREAD);
            self.0 = (product as u64) ^ ((product >> 64) as u64).rotate_left(23);
        }
    }

    fn write_usize(&mut self, _length: usize) {
        // The length prefix of an array is the same for all keys.
    }

    fn finish(&self) -> u64 {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;
    use std::hash::BuildHasher;

    use super::*;

    /// A plane and a column of voxels, as streets and walls are: few collisions in the bits the table uses.
    #[test]
    fn neighbours_land_apart() {
        let hash = |k: [i32; 3]| VoxelHash::default().hash_one(k);
        let mut keys: Vec<[i32; 3]> = Vec::new();
        for a in -128..128 {
            for b in -128..128 {
                keys.extend([[a, b, 3], [7, a, b], [a, -5, b]]);
            }
        }
        keys.sort_unstable();
        keys.dedup();
        for bits in [0, 47] {
            // 17 bits for 196,000 keys: a random function fills 1 - exp(-1.5) of the places, 0.776.
            let used: HashSet<u64> = keys.iter().map(|&k| (hash(k) >> bits) & 0x1ffff).collect();
            let filled = used.len() as f64 / f64::from(1 << 17);
            assert!(filled > 0.75, "bits from {bits}: {filled}");
        }
    }
}
