//! Which Gaussians enter the map, and with what confidence.

use crate::config::MapConfig;

/// Depths below this count as this, metres: closer by is not more certain, and the confidence stays bounded.
const MIN_CONFIDENCE_DEPTH_M: f32 = 1.0;

/// Opacity over squared depth. The error of a depth seen from a moving vehicle grows about as its square, so near views
/// outweigh far ones of the same place.
pub fn confidence(opacity: f32, depth_m: f32) -> f32 {
    let d = depth_m.max(MIN_CONFIDENCE_DEPTH_M);
    opacity / (d * d)
}

/// The weight of a Gaussian of the static scene; none for one that moves, is too transparent, too far, or not finite.
pub fn static_weight(config: &MapConfig, opacity: f32, speed_mps: f32, depth_m: f32) -> Option<f32> {
    let is_static = f64::from(speed_mps) <= config.static_speed_mps;
    let seen = f64::from(opacity) >= config.min_opacity && opacity > 0.0;
    let near = depth_m > 0.0 && f64::from(depth_m) <= config.max_depth_m;
    (is_static && seen && near).then(|| confidence(opacity, depth_m)).filter(|w| w.is_finite())
}

/// A network colour (-1 to 1) as 0 to 1.
pub fn color01(color: &[f32; 3]) -> [f32; 3] {
    color.map(|c| (0.5 * c + 0.5).clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_static_opaque_near_finite_ones_enter() {
        let c = MapConfig::default();
        assert_eq!(static_weight(&c, 0.5, 0.2, 10.0), Some(0.005));
        assert_eq!(static_weight(&c, 0.5, 0.2, 0.3), Some(0.5));
        let nan = f32::NAN;
        for (opacity, speed, depth) in [
            (0.05, 0.2, 10.0),
            (0.5, 1.2, 10.0),
            (0.5, 0.2, 90.0),
            (0.5, 0.2, -1.0),
            (nan, 0.2, 10.0),
            (0.5, nan, 10.0),
            (0.5, 0.2, nan),
        ] {
            assert_eq!(static_weight(&c, opacity, speed, depth), None);
        }
        assert_eq!(color01(&[-1.0, 0.0, 1.5]), [0.0, 0.5, 1.0]);
    }
}
