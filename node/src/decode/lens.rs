//! Lens models: where a ray of the camera lands on its normalised image plane.
//!
//! The formulas are those of ROS (`sensor_msgs/distortion_models.hpp`) and OpenCV's calib3d documentation.

use glam::DVec3;

use super::error::DecodeError;
use crate::msg::CameraInfo;

/// Models [`Lens::from_info`] knows.
pub const MODELS: &str = "plumb_bob or rational_polynomial (4, 5, 8, or 12 with thin prism coefficients), \
     equidistant or fisheye (4), any other name when all coefficients are zero";
/// Parts of names of models that are no pinhole without coefficients either.
const WIDE_MODELS: [&str; 6] = ["fish", "kannala", "sphere", "unified", "omni", "ftheta"];

/// How far out (tangent of the ray's angle, or the angle itself) the search for a model's fold goes; tan 86.4 degrees.
const FOLD_SEARCH_END: f64 = 16.0;
/// Steps of that search per unit: a fold is located to 0.002, well under a pixel of any wide lens.
const FOLD_SEARCH_STEPS: usize = 512;

/// A lens, ready to project rays.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Lens {
    /// A pinhole.
    Pinhole,
    /// Brown-Conrady with up to six radial, two tangential and four thin-prism coefficients.
    Polynomial {
        /// `k1..k6`: numerator `k1 k2 k3`, denominator `k4 k5 k6`.
        k: [f64; 6],
        /// Tangential `p1 p2`.
        p: [f64; 2],
        /// Thin prism `s1..s4`.
        s: [f64; 4],
    },
    /// Equidistant fisheye (Kannala-Brandt), `k1..k4`.
    Equidistant {
        /// Odd powers of the angle from the third on.
        k: [f64; 4],
    },
}

impl Lens {
    /// The lens of a camera_info.
    ///
    /// # Errors
    /// An unknown model, a number of coefficients the model does not have, or a coefficient that is not finite.
    pub fn from_info(info: &CameraInfo) -> Result<Self, DecodeError> {
        let d = info.d.as_slice();
        let model = info.distortion_model.trim();
        if let Some(bad) = d.iter().find(|x| !x.is_finite()) {
            return Err(DecodeError::Camera {
                frame_id: info.header.frame_id.clone(),
                why: format!("distortion coefficient {bad} is not finite"),
            });
        }
        let unknown = |found: String| Err(DecodeError::Model { found, accepted: MODELS });
        let known = match model {
            // OpenCV tells these two apart by the number of coefficients alone, and so do the tools built on it.
            "plumb_bob" | "rational_polynomial" => &[0, 4, 5, 8, 12][..],
            "equidistant" | "fisheye" => &[0, 4],
            _ if d.iter().any(|x| *x != 0.0) => return unknown(model.to_owned()),
            _ if WIDE_MODELS.iter().any(|part| model.to_ascii_lowercase().contains(part)) => {
                return unknown(model.to_owned());
            }
            // Whatever the model is called, a lens whose coefficients are all zero does nothing.
            _ => return Ok(Self::Pinhole),
        };
        // Some drivers pad with zeros: only coefficients that do something count.
        let used = d.iter().rposition(|x| *x != 0.0).map_or(0, |last| last + 1);
        let most = known.iter().copied().max().unwrap_or(0);
        if used > most || (used > 0 && !known.contains(&d.len()) && d.len() < most) {
            return unknown(format!("{model}` with {} coefficients `{d:?}", d.len()));
        }
        let c = |i: usize| d.get(i).copied().unwrap_or(0.0);
        Ok(match model {
            "equidistant" | "fisheye" => Self::Equidistant { k: [c(0), c(1), c(2), c(3)] },
            _ if used == 0 => Self::Pinhole,
            _ => Self::Polynomial {
                k: [c(0), c(1), c(4), c(5), c(6), c(7)],
                p: [c(2), c(3)],
                s: [c(8), c(9), c(10), c(11)],
            },
        })
    }

    /// Point of the normalised image plane (x right, y down, focal length 1) a ray of the optical frame lands on; `None`
    /// behind a lens that cannot see there. Past [`Self::limit`] the formula folds back and its answer means nothing.
    pub fn project(&self, ray: DVec3) -> Option<(f64, f64)> {
        if let Self::Equidistant { k } = self {
            let r = ray.x.hypot(ray.y);
            if r == 0.0 {
                return (ray.z > 0.0).then_some((0.0, 0.0));
            }
            let scale = equidistant_radius(k, r.atan2(ray.z)) / r;
            return scale.is_finite().then_some((ray.x * scale, ray.y * scale));
        }
        let (x, y) = if ray.z > 0.0 { (ray.x / ray.z, ray.y / ray.z) } else { return None };
        let Self::Polynomial { k, p: [p1, p2], s: [s1, s2, s3, s4] } = self else { return Some((x, y)) };
        let r2 = x * x + y * y;
        let radial = radial_factor(k, r2);
        let u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (s1 + s2 * r2);
        let v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (s3 + s4 * r2);
        (u.is_finite() && v.is_finite()).then_some((u, v))
    }

    /// How far from the axis the model holds, in the measure of [`Self::off_axis`]: up to where a ray further out no longer
    /// lands further out.
    pub fn limit(&self) -> f64 {
        let radius = |r: f64| match self {
            Self::Pinhole => r,
            Self::Polynomial { k, .. } => r * radial_factor(k, r * r),
            Self::Equidistant { k } => equidistant_radius(k, r),
        };
        let end = match self {
            Self::Pinhole => return f64::INFINITY,
            Self::Polynomial { .. } => FOLD_SEARCH_END,
            Self::Equidistant { .. } => std::f64::consts::PI,
        };
        let step = |i: usize| i as f64 / FOLD_SEARCH_STEPS as f64;
        let mut last = 0.0;
        for i in 1.. {
            if step(i) >= end {
                break;
            }
            let next = radius(step(i));
            let rises = next > last;
            if !rises {
                return step(i - 1);
            }
            last = next;
        }
        if matches!(self, Self::Equidistant { .. }) { end } else { f64::INFINITY }
    }

    /// How far from the axis a ray is: the tangent of its angle, for a fisheye the angle (radians).
    pub fn off_axis(&self, ray: DVec3) -> f64 {
        let r = ray.x.hypot(ray.y);
        match self {
            Self::Equidistant { .. } => r.atan2(ray.z),
            _ => r / ray.z,
        }
    }
}

fn radial_factor(k: &[f64; 6], r2: f64) -> f64 {
    let [k1, k2, k3, k4, k5, k6] = k;
    let denominator = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
    // A pole: nothing beyond it can be trusted, and NaN never passes the checks for rising.
    if denominator > 0.0 { (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / denominator } else { f64::NAN }
}

fn equidistant_radius(k: &[f64; 4], theta: f64) -> f64 {
    let t2 = theta * theta;
    let [k1, k2, k3, k4] = k;
    theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn info(model: &str, d: &[f64]) -> CameraInfo {
        CameraInfo { distortion_model: model.to_owned(), d: d.to_vec(), ..CameraInfo::default() }
    }

    /// OpenCV 4's `projectPoints` and `fisheye.projectPoints` with K the identity and no motion, in double precision.
    #[test]
    fn projections_agree_with_opencv() {
        const TOLERANCE: f64 = 1e-12;
        let rays = [DVec3::new(0.3, -0.2, 1.0), DVec3::new(-0.6, 0.45, 1.0), DVec3::new(0.05, 0.9, 1.2)];
        let rational = [0.7, -0.2, 0.001, -0.002, 0.05, 1.05, -0.05, 0.03, 0.004, -0.003, 0.002, 0.001];
        for (model, d, want) in [
            (
                "plumb_bob",
                &[-0.31, 0.12, 0.0011, -0.0023, -0.02][..],
                [
                    (0.287_660_217_999_999_97, -0.191_829_812_000_000_02),
                    (-0.519_564_257_812_499_9, 0.389_321_630_859_375_05),
                    (0.034_583_756_713_273_15, 0.646_487_655_561_156_8),
                ],
            ),
            (
                "rational_polynomial",
                &rational[..8],
                [
                    (0.286_583_190_166_499_6, -0.191_098_793_444_333_11),
                    (-0.511_679_271_468_897_4, 0.383_478_203_601_673_05),
                    (0.034_229_001_308_583_765, 0.636_998_759_665_618_8),
                ],
            ),
            (
                "rational_polynomial",
                &rational[..],
                [
                    (0.287_052_490_166_499_6, -0.190_821_893_444_333_12),
                    (-0.510_378_490_218_897_4, 0.384_919_609_851_673_05),
                    (0.035_530_858_585_782_84, 0.638_445_594_276_922_8),
                ],
            ),
            (
                "equidistant",
                &[0.08, -0.03, 0.012, -0.002],
                [
                    (0.290_568_720_606_493_8, -0.193_712_480_404_329_2),
                    (-0.529_615_082_589_656_2, 0.397_211_311_942_242_2),
                    (0.036_766_481_937_188_31, 0.661_796_674_869_389_5),
                ],
            ),
        ] {
            let lens = Lens::from_info(&info(model, d)).unwrap();
            for (ray, (x, y)) in rays.iter().zip(want) {
                let got = lens.project(*ray).unwrap();
                assert!((got.0 - x).abs() < TOLERANCE && (got.1 - y).abs() < TOLERANCE, "{model} {got:?} {x} {y}");
            }
        }
    }

    #[test]
    fn unknown_models_and_counts_are_refused_by_name() {
        for (model, d, says) in [
            ("thin_prism_fisheye", &[0.1][..], "`thin_prism_fisheye`"),
            ("plumb_bob", &[0.1, 0.2, 0.3][..], "`plumb_bob` with 3 coefficients"),
            ("plumb_bob", &[0.1, 0.2, 0.0, 0.0, 0.0, 0.4, 0.0], "with 7 coefficients"),
            ("rational_polynomial", &[0.1; 14], "with 14 coefficients"),
            ("equidistant", &[0.1, 0.2], "with 2 coefficients"),
            ("equidistant", &[0.1, 0.0, 0.0, 0.0, 0.2], "with 5 coefficients"),
            ("double_sphere", &[0.0; 5], "`double_sphere`"),
            ("kannala_brandt8", &[], "`kannala_brandt8`"),
            ("", &[0.1, 0.0, 0.0, 0.0], "``"),
        ] {
            let e = Lens::from_info(&info(model, d)).unwrap_err().to_string();
            assert!(e.contains(says) && e.contains("rational_polynomial"), "{e}");
        }
        let e = Lens::from_info(&info("plumb_bob", &[f64::NAN; 5])).unwrap_err().to_string();
        assert!(e.contains("NaN is not finite"), "{e}");
        for (model, d) in [
            ("plumb_bob", &[0.0; 5][..]),
            ("plumb_bob", &[]),
            ("", &[]),
            ("rational_polynomial", &[0.0; 14]),
            ("pinhole", &[0.0; 5]),
            ("perspective", &[]),
        ] {
            assert_eq!(Lens::from_info(&info(model, d)).unwrap(), Lens::Pinhole);
        }
        let rational =
            Lens::from_info(&info("rational_polynomial", &[0.1, 0.2, 0.0, 0.0, 0.0, 0.4, 0.0, 0.0])).unwrap();
        assert_eq!(Lens::from_info(&info("plumb_bob", &[0.1, 0.2, 0.0, 0.0, 0.0, 0.4, 0.0, 0.0])).unwrap(), rational);
        let long = [0.08, -0.03, 0.012, -0.002, 0.0, 0.0];
        assert_eq!(
            Lens::from_info(&info("equidistant", &long)).unwrap(),
            Lens::Equidistant { k: [0.08, -0.03, 0.012, -0.002] }
        );
        assert!(Lens::from_info(&info("plumb_bob", &[0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])).is_ok());
    }

    #[test]
    fn folds_are_found_and_fishes_see_sideways() {
        // r - 0.3 r^3 turns back at r = 1 / sqrt(0.9).
        let lens = Lens::from_info(&info("plumb_bob", &[-0.3, 0.0, 0.0, 0.0, 0.0])).unwrap();
        assert!((lens.limit() - 1.0 / 0.9f64.sqrt()).abs() < 0.003, "{}", lens.limit());
        let lens = Lens::from_info(&info("plumb_bob", &[0.2, 0.0, 0.0, 0.0, 0.0])).unwrap();
        assert_eq!(lens.limit(), f64::INFINITY);
        assert_eq!(lens.project(DVec3::new(0.1, 0.0, -1.0)), None);
        let fish = Lens::from_info(&info("equidistant", &[0.0; 4])).unwrap();
        let (x, y) = fish.project(DVec3::new(1.0, 0.0, -1.0)).unwrap();
        assert!((x - 0.75 * std::f64::consts::PI).abs() < 1e-12 && y == 0.0);
        assert!(fish.limit() > 3.1);
    }
}
