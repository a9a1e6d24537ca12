use super::pack::split;
use super::*;
use crate::kernels::tests::noise;

/// Two panels of `depth`, from rows.
fn panels(parts: Parts, depth: usize, a: &[f32], b: &[f32]) -> (Vec<f32>, Vec<f32>) {
    let row = |x: &'static [f32], r: usize| x.get(r * depth..(r + 1) * depth);
    let (a, b): (&'static [f32], &'static [f32]) = (a.to_vec().leak(), b.to_vec().leak());
    let floats = parts.panel_floats(depth);
    let (mut left, mut right) = (vec![f32::NAN; floats], vec![f32::NAN; floats]);
    for half in 0..2 {
        // SAFETY: the machine has the units (asked by the test).
        unsafe {
            row_tiles(parts, half, depth, 1.0, |r| row(a, half * TILE + r), &mut left);
            row_tiles(parts, half, depth, 1.0, |r| row(b, half * TILE + r), &mut right);
        }
    }
    // SAFETY: as above.
    unsafe { transpose(&mut right) };
    (left, right)
}

fn machine_has_them() -> bool {
    if !available() {
        eprintln!("SKIPPED: this machine has no AMX tile units (or the system does not lend them)");
    }
    available()
}

#[test]
fn products_are_those_of_floats() {
    if !machine_has_them() {
        return;
    }
    for depth in [1, 2, 31, 32, 33, 100, 192] {
        let (a, b) = (noise(1, SIDE * depth, 1.0), noise(2, SIDE * depth, 1.0));
        for (parts, tolerance) in [(Parts::Three, 2e-6), (Parts::Two, 2e-5), (Parts::One, 2e-2)] {
            let (left, right) = panels(parts, depth, &a, &b);
            let mut c = vec![f32::NAN; SIDE * SIDE];
            let tiles = Configured::new();
            let steps = depth.div_ceil(STEP);
            // SAFETY: the panels have so many steps, `c` 32 rows of 32.
            unsafe {
                product(&tiles, parts, steps, (left.as_ptr(), right.as_ptr()), c.as_mut_ptr(), SIDE);
                product_onto(&tiles, parts, steps, (left.as_ptr(), right.as_ptr()), c.as_mut_ptr(), SIDE);
            }
            for i in 0..SIDE {
                for j in 0..SIDE {
                    let pair = |p: usize| f64::from(a[i * depth + p]) * f64::from(b[j * depth + p]);
                    let want = 2.0 * (0..depth).map(pair).sum::<f64>();
                    let apart = (f64::from(c[i * SIDE + j]) - want).abs() / (depth as f64).sqrt();
                    assert!(apart < tolerance, "{parts:?} {depth} ({i}, {j}): {apart:e}");
                }
            }
        }
    }
}

#[test]
fn columns_are_rows_transposed() {
    if !machine_has_them() {
        return;
    }
    for depth in [1, 5, 32, 70] {
        let values = noise(3, depth * TILE, 1.0);
        let turned: Vec<f32> =
            (0..TILE).flat_map(|c| (0..depth).map(move |p| (c, p))).map(|(c, p)| values[p * TILE + c]).collect();
        for parts in [Parts::One, Parts::Two, Parts::Three] {
            let floats = parts.panel_floats(depth);
            let (mut columns, mut rows) = (vec![0.0; floats], vec![0.0; floats]);
            // SAFETY: the machine has the units.
            unsafe {
                column_tiles(parts, 1, depth, |p| &values[p * TILE..][..TILE], &mut columns);
                row_tiles(parts, 1, depth, 1.0, |r| turned.get(r * depth..(r + 1) * depth), &mut rows);
                transpose(&mut rows);
            }
            assert!(columns.iter().zip(&rows).all(|(a, b)| a.to_bits() == b.to_bits()), "{parts:?} {depth}");
        }
    }
}

#[test]
fn three_parts_are_the_float() {
    if !machine_has_them() {
        return;
    }
    for x in [1.0f32, -0.1, 1e30, 1e-30, f32::MAX, std::f32::consts::PI, 16_777_215.0] {
        // SAFETY: the machine has the units.
        let parts =
            unsafe { split(std::arch::x86_64::_mm512_set1_ps(x)).map(|v| std::arch::x86_64::_mm512_cvtss_f32(v)) };
        assert_eq!(parts[0] + (parts[1] + parts[2]), x);
        assert!(parts.iter().all(|p| p.to_bits() & 0xffff == 0), "{parts:?}");
    }
}
