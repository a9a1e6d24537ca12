//! Eigenvalues and eigenvectors of a symmetric 3x3 matrix, by cyclic Jacobi rotations.

use glam::{DMat3, DQuat, DVec3};

/// Sweeps over the three off-diagonal elements. Convergence is quadratic: six reach f64 precision from any start, the
/// rest is margin.
const MAX_SWEEPS: usize = 12;

/// Off-diagonal part, relative to the whole, that counts as zero: below f64's resolution of the squares.
const CONVERGED: f64 = 1e-32;

/// A covariance as a rotation and the standard deviations along its axes, largest first, none below `min_scale`.
///
/// `cov` is xx, xy, xz, yy, yz, zz. The quaternion has w >= 0, so that equal input gives equal bytes.
pub(super) fn rotation_and_scales(cov: &[f64; 6], min_scale: f64) -> (DQuat, DVec3) {
    let (values, mut axes) = symmetric_eigen(cov);
    // A mirror image is no rotation; turning one axis round changes nothing else.
    if axes.determinant() < 0.0 {
        axes.z_axis = -axes.z_axis;
    }
    let q = DQuat::from_mat3(&axes).normalize();
    let q = if q.w < 0.0 { -q } else { q };
    (q, values.max(DVec3::splat(min_scale * min_scale)).map(f64::sqrt))
}

/// Eigenvalues, largest first, and the unit eigenvectors as columns in the same order.
pub(super) fn symmetric_eigen(cov: &[f64; 6]) -> (DVec3, DMat3) {
    let &[xx, xy, xz, yy, yz, zz] = cov;
    let mut a = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]];
    let mut v = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let all: f64 = a.iter().flatten().map(|x| x * x).sum();
    for _ in 0..MAX_SWEEPS {
        let off = a[0][1] * a[0][1] + a[0][2] * a[0][2] + a[1][2] * a[1][2];
        if off <= CONVERGED * all {
            break;
        }
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            rotate(&mut a, &mut v, p, q);
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&i, &j| a[j][j].total_cmp(&a[i][i]));
    let column = |i: usize| DVec3::new(v[0][i], v[1][i], v[2][i]);
    (DVec3::from(order.map(|i| a[i][i])), DMat3::from_cols(column(order[0]), column(order[1]), column(order[2])))
}

/// One Jacobi rotation: makes `a[p][q]` zero and turns the eigenvector columns along.
fn rotate(a: &mut [[f64; 3]; 3], v: &mut [[f64; 3]; 3], p: usize, q: usize) {
    if a[p][q] == 0.0 {
        return;
    }
    // The smaller root of t^2 + 2 theta t - 1 = 0, in the form that does not cancel (theta too large to square gives t = 0,
    // which is right: there is nothing left to turn).
    let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
    let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
    let c = 1.0 / (t * t + 1.0).sqrt();
    let s = t * c;
    for k in 0..3 {
        (a[k][p], a[k][q]) = (c * a[k][p] - s * a[k][q], s * a[k][p] + c * a[k][q]);
    }
    for k in 0..3 {
        (a[p][k], a[q][k]) = (c * a[p][k] - s * a[q][k], s * a[p][k] + c * a[q][k]);
    }
    for row in v {
        (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
    }
}

#[cfg(test)]
mod tests {
    use glam::EulerRot;
    use proptest::prelude::*;

    use super::*;

    fn covariance(r: DMat3, s: DVec3) -> DMat3 {
        r * DMat3::from_diagonal(s * s) * r.transpose()
    }

    fn six(m: &DMat3) -> [f64; 6] {
        [m.x_axis.x, m.x_axis.y, m.x_axis.z, m.y_axis.y, m.y_axis.z, m.z_axis.z]
    }

    #[test]
    fn round_flat_and_empty_shapes_are_no_special_case() {
        for d in [DVec3::ZERO, DVec3::ONE, DVec3::new(1.0, 1.0, 0.0), DVec3::new(0.0, 0.0, 4.0)] {
            let (q, s) = rotation_and_scales(&six(&DMat3::from_diagonal(d)), 1e-4);
            assert!(q.is_normalized() && s.is_finite());
            let back = covariance(DMat3::from_quat(q), s);
            assert!((back - DMat3::from_diagonal(d)).abs_diff_eq(DMat3::ZERO, 1.1e-8));
        }
    }

    proptest! {
        #[test]
        fn the_parts_multiply_back(
            a in -3.2f64..3.2, b in -1.6f64..1.6, c in -3.2f64..3.2,
            s in proptest::array::uniform3(-4.0f64..2.0), same in any::<bool>(),
        ) {
            let s = DVec3::from(s.map(|x| 10f64.powf(x)));
            let s = if same { DVec3::new(s.x, s.x, s.z) } else { s };
            let m = covariance(DMat3::from_quat(DQuat::from_euler(EulerRot::ZYX, a, b, c)), s);
            let (q, out) = rotation_and_scales(&six(&m), 0.0);
            let size = s.max_element().powi(2);
            prop_assert!(covariance(DMat3::from_quat(q), out).abs_diff_eq(m, 1e-13 * size));
            prop_assert!(out.x >= out.y && out.y >= out.z && q.w >= 0.0 && (q.length() - 1.0).abs() < 1e-12);
        }
    }
}
