//! Gaussians as PLY in the layout 3D Gaussian viewers read, both ways.
//!
//! Binary little-endian `float` columns: `x y z nx ny nz f_dc_0..2 opacity scale_0..2 rot_0..3`. As in the original 3DGS
//! files, opacity is stored as its logit, scales as natural logarithms, rotations as w x y z, and colour as the degree-0
//! spherical-harmonics coefficient. Positions are relative to `origin_m` of the header, so that maps far from their
//! frame's origin (UTM) keep millimetres in `f32`.

mod header;
mod read;
mod write;

pub use read::{PlyFile, read_ply};
pub use write::write_ply;

use storm_render::Gaussians;

use super::OutputError;

/// Value of the constant spherical-harmonics basis function, `1 / (2 sqrt(pi))`: colour = 0.5 + SH_C0 * f_dc.
pub const SH_C0: f64 = 0.28209479177387814;

/// Opacities are kept this far from 0 and 1, where the logit is infinite; 1/255 is what a picture can show.
pub const OPACITY_MARGIN: f32 = 1e-6;

/// Scales below this (metres) are written as this: the logarithm of 0 is infinite, and nothing seen is thinner.
pub const MIN_SCALE_M: f32 = 1e-7;

/// Gaussians at rest, as arrays of one length.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PlyCloud {
    /// Centres relative to the file's origin, metres.
    pub positions: Vec<[f32; 3]>,
    /// Colours, 0 to 1 (they may lie outside).
    pub colors01: Vec<[f32; 3]>,
    /// Opacities, 0 to 1.
    pub opacities: Vec<f32>,
    /// Standard deviations along the local axes, metres (linear).
    pub scales: Vec<[f32; 3]>,
    /// Orientations, w x y z; need not be unit when written, are unit when read.
    pub quats: Vec<[f32; 4]>,
}

impl PlyCloud {
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// True when there are none.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Moving Gaussians frozen at `time_sec` of their window; colours go from the network's -1..1 to 0..1.
    pub fn from_gaussians(gaussians: &Gaussians, time_sec: f32) -> Self {
        Self {
            positions: (0..gaussians.len()).map(|i| gaussians.mean_at(i, time_sec)).collect(),
            colors01: gaussians.colors.iter().map(|c| c.map(|v| 0.5 * (v + 1.0))).collect(),
            opacities: gaussians.opacities.clone(),
            scales: gaussians.scales.clone(),
            quats: gaussians.quats.clone(),
        }
    }

    /// Errors unless all arrays have the length of `positions`.
    pub fn check_lengths(&self) -> Result<(), OutputError> {
        let expected = self.len();
        let lengths = [
            ("colors01", self.colors01.len()),
            ("opacities", self.opacities.len()),
            ("scales", self.scales.len()),
            ("quats", self.quats.len()),
        ];
        match lengths.into_iter().find(|&(_, got)| got != expected) {
            Some((what, got)) => Err(OutputError::Length { what, expected, got }),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use proptest::prelude::*;

    use super::*;

    /// Opacity and scale go through a logarithm and back in f32.
    const RELATIVE_TOLERANCE: f32 = 2e-5;

    /// Position, colour, opacity, scale, quaternion.
    type Row = ([f32; 3], [f32; 3], f32, [f32; 3], [f32; 4]);

    fn cloud(rows: &[Row]) -> PlyCloud {
        PlyCloud {
            positions: rows.iter().map(|r| r.0).collect(),
            colors01: rows.iter().map(|r| r.1).collect(),
            opacities: rows.iter().map(|r| r.2).collect(),
            scales: rows.iter().map(|r| r.3).collect(),
            quats: rows.iter().map(|r| r.4).collect(),
        }
    }

    fn one() -> PlyCloud {
        cloud(&[([1.0, 2.0, 3.0], [0.5, 0.0, 1.0], 0.25, [0.1, 0.2, 1.0], [1.0, 0.0, 0.0, 0.0])])
    }

    fn write_to(dir: &Path, cloud: &PlyCloud) -> std::path::PathBuf {
        let path = dir.join("m.ply");
        write_ply(&path, cloud, [500_000.125, 4_000_000.5, 12.0], &["made by a test".into(), "two\nlines".into()])
            .unwrap();
        path
    }

    #[test]
    fn the_layout_is_what_viewers_expect() {
        let dir = tempfile::tempdir().unwrap();
        let bytes = std::fs::read(write_to(dir.path(), &one())).unwrap();
        let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let header = std::str::from_utf8(&bytes[..end]).unwrap();
        let names: Vec<&str> = header.lines().filter_map(|l| l.strip_prefix("property float ")).collect();
        let expected = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
        assert_eq!(names.join(" "), expected);
        assert!(header.starts_with("ply\nformat binary_little_endian 1.0\n"));
        assert!(header.contains("comment origin_m 500000.125 4000000.5 12\n"), "{header}");
        let row: Vec<f32> = bytes[end..].chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
        assert_eq!(row.len(), 17);
        assert_eq!(row[..6], [1.0, 2.0, 3.0, 0.0, 0.0, 0.0]);
        assert!(row[6].abs() < 1e-7 && (row[7] + 1.772_453_9).abs() < 1e-5, "f_dc = (c - 0.5) / C0");
        assert!((row[9] - (0.25f32 / 0.75).ln()).abs() < 1e-6, "logit");
        assert!((row[10] - 0.1f32.ln()).abs() < 1e-6, "log scale");
        assert_eq!(row[13..], [1.0, 0.0, 0.0, 0.0], "w first");
    }

    #[test]
    fn extra_columns_are_skipped_and_notes_come_back() {
        let dir = tempfile::tempdir().unwrap();
        let path = write_to(dir.path(), &one());
        let bytes = std::fs::read(&path).unwrap();
        let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap();
        let header = std::str::from_utf8(&bytes[..end]).unwrap();
        let wide = header
            .replace("property float opacity", "property float f_rest_0\nproperty uchar tag\nproperty float opacity");
        let mut data = bytes[end + 11..].to_vec();
        data.splice(36..36, [1, 2, 3, 4, 9]);
        let wide_path = dir.path().join("wide.ply");
        std::fs::write(&wide_path, [wide.as_bytes(), b"end_header\r\n", &data].concat()).unwrap();
        let (plain, wide) = (read_ply(&path).unwrap(), read_ply(&wide_path).unwrap());
        assert_eq!(plain, wide);
        assert_eq!(plain.origin_m, [500_000.125, 4_000_000.5, 12.0]);
        assert_eq!(plain.comments, ["made by a test", "two lines"]);
    }

    #[test]
    fn files_that_lie_are_refused_without_allocating_for_them() {
        let dir = tempfile::tempdir().unwrap();
        let path = write_to(dir.path(), &one());
        let bytes = std::fs::read(&path).unwrap();
        let text = String::from_utf8_lossy(&bytes[..300]).into_owned();
        assert!(text.contains("element vertex 1\n"));
        let replace = |from: &str, to: &str| {
            let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
            [&bytes[..at], to.as_bytes(), &bytes[at + from.len()..]].concat()
        };
        let end = bytes.len();
        let cases = [
            (replace("element vertex 1\n", "element vertex 99999999999\n"), "bytes"),
            (replace("element vertex 1\n", "element vertex 18446744073709551615\n"), "bytes"),
            (replace("element vertex 1\n", "element vertex -1\n"), "vertex"),
            (replace("binary_little_endian", "ascii"), "binary_little_endian"),
            (replace("property float opacity", "property float opacitx"), "opacity"),
            (replace("property float rot_0", "property list uchar int q\nproperty float rot_0"), "list"),
            (replace("property float opacity", "property double opacity"), "float"),
            (bytes[..end - 1].to_vec(), "bytes"),
            ([&bytes[..], &[0]].concat(), "bytes"),
            ([&bytes[..end - 4], &f32::NAN.to_le_bytes()].concat(), "finite"),
            ([&bytes[..end - 16], &[0; 16]].concat(), "rot"),
            (bytes[..50].to_vec(), "end_header"),
            (b"plx\n".to_vec(), "ply"),
            (Vec::new(), "ply"),
        ];
        for (i, (content, word)) in cases.into_iter().enumerate() {
            std::fs::write(&path, content).unwrap();
            let error = read_ply(&path).unwrap_err().to_string();
            assert!(error.contains(word), "case {i}: {error}");
        }
    }

    #[test]
    fn nothing_non_finite_is_written() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("m.ply");
        let mut bad = one();
        bad.scales[0][1] = f32::NAN;
        assert!(matches!(write_ply(&path, &bad, [0.0; 3], &[]), Err(OutputError::NonFinite { index: 0, .. })));
        bad = one();
        bad.quats.clear();
        assert!(matches!(write_ply(&path, &bad, [0.0; 3], &[]), Err(OutputError::Length { what: "quats", .. })));
        assert!(write_ply(&path, &one(), [f64::NAN, 0.0, 0.0], &[]).is_err());
        assert!(!path.exists());
        let mut edge = one();
        (edge.opacities[0], edge.scales[0]) = (1.0, [0.0; 3]);
        write_ply(&path, &edge, [0.0; 3], &[]).unwrap();
        let back = read_ply(&path).unwrap().cloud;
        assert!((back.opacities[0] - 1.0).abs() < 1e-5 && back.scales[0][0] > 0.0);
    }

    proptest! {
        #[test]
        fn what_is_written_is_read_back(
            rows in prop::collection::vec((
                prop::array::uniform3(-1e4f32..1e4),
                prop::array::uniform3(-0.5f32..1.5),
                0.001f32..0.999,
                prop::array::uniform3(1e-4f32..50.0),
                prop::array::uniform4(0.1f32..1.0),
            ), 0..40),
            origin in prop::array::uniform3(-1e7f64..1e7),
        ) {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("m.ply");
            let cloud = cloud(&rows);
            write_ply(&path, &cloud, origin, &[]).unwrap();
            let back = read_ply(&path).unwrap();
            prop_assert_eq!(back.origin_m, origin);
            prop_assert_eq!(&back.cloud.positions, &cloud.positions);
            for i in 0..cloud.len() {
                let o = cloud.opacities[i];
                prop_assert!((back.cloud.opacities[i] - o).abs() <= RELATIVE_TOLERANCE * o);
                for k in 0..3 {
                    let s = cloud.scales[i][k];
                    prop_assert!((back.cloud.scales[i][k] - s).abs() <= RELATIVE_TOLERANCE * s);
                    prop_assert!((back.cloud.colors01[i][k] - cloud.colors01[i][k]).abs() <= 1e-6);
                }
                let norm = cloud.quats[i].iter().map(|v| v * v).sum::<f32>().sqrt();
                for k in 0..4 {
                    prop_assert!((back.cloud.quats[i][k] - cloud.quats[i][k] / norm).abs() <= 1e-6);
                }
            }
        }

        #[test]
        fn no_bytes_make_the_reader_panic(bytes in prop::collection::vec(any::<u8>(), 0..300), cut in 0usize..600) {
            let dir = tempfile::tempdir().unwrap();
            let path = write_to(dir.path(), &one());
            let good = std::fs::read(&path).unwrap();
            let mut mixed = good[..cut.min(good.len())].to_vec();
            mixed.extend(bytes);
            std::fs::write(&path, &mixed).unwrap();
            // Whatever the answer is, it is an answer.
            if let Ok(file) = read_ply(&path) {
                prop_assert!(file.cloud.check_lengths().is_ok());
            }
        }
    }
}
