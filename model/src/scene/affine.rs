//! Exposure of one camera (paper section 3.2): `colour' = S colour + b`.

use crate::config::AffineKind;

/// A colour transform.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Affine {
    /// Row-major 3 x 3.
    pub matrix: [[f32; 3]; 3],
    /// Added afterwards.
    pub bias: [f32; 3],
}

impl Affine {
    /// Changes nothing.
    pub const IDENTITY: Self = Self { matrix: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], bias: [0.0; 3] };

    /// From the network's row-major 3 x 4 numbers; short input counts as zeros.
    pub fn new(kind: AffineKind, a: &[f32]) -> Self {
        let at = |p: usize, q: usize| a.get(4 * p + q).copied().unwrap_or(0.0);
        let mut out = Self { matrix: [[0.0; 3]; 3], bias: [0.0; 3] };
        for p in 0..3 {
            match kind {
                AffineKind::Gain => out.matrix[p][p] = (0..4).map(|q| at(p, q)).sum(),
                AffineKind::MatrixBias => {
                    out.matrix[p] = [at(p, 0), at(p, 1), at(p, 2)];
                    out.bias[p] = at(p, 3);
                }
            }
        }
        out
    }

    /// The mean of several, for a view that is none of the cameras; the identity of none.
    pub fn mean(all: &[Self]) -> Self {
        if all.is_empty() {
            return Self::IDENTITY;
        }
        let share = 1.0 / all.len() as f32;
        let mut out = Self { matrix: [[0.0; 3]; 3], bias: [0.0; 3] };
        for one in all {
            for p in 0..3 {
                (0..3).for_each(|q| out.matrix[p][q] += share * one.matrix[p][q]);
                out.bias[p] += share * one.bias[p];
            }
        }
        out
    }

    /// The transformed colour.
    pub fn apply(&self, c: [f32; 3]) -> [f32; 3] {
        [0, 1, 2].map(|p| {
            let m = &self.matrix[p];
            m[0] * c[0] + m[1] * c[1] + m[2] * c[2] + self.bias[p]
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gain_sums_rows_and_matrix_mixes() {
        let a: Vec<f32> = (1..=12).map(|x| x as f32).collect();
        assert_eq!(Affine::new(AffineKind::Gain, &a).apply([1.0, 2.0, 3.0]), [10.0, 52.0, 126.0]);
        assert_eq!(Affine::new(AffineKind::MatrixBias, &a).apply([1.0, 1.0, 1.0]), [10.0, 26.0, 42.0]);
        assert_eq!(Affine::mean(&[]).apply([0.1, 0.2, 0.3]), [0.1, 0.2, 0.3]);
        let two = [Affine::IDENTITY, Affine { bias: [2.0; 3], ..Affine::IDENTITY }];
        assert_eq!(Affine::mean(&two).apply([0.0; 3]), [1.0; 3]);
    }
}
