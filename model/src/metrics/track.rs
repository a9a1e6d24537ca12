//! Tracks: TAPVid-3D's share of points within a distance (APD3D) and occlusion accuracy (OA).
//!
//! Koppula et al., "TAPVid-3D: A Benchmark for Tracking Any Point in 3D", 2024: a point counts as right at `d` pixels when it
//! is closer to the truth than `d` pixels are wide at the true depth, `d * z / f` with `f = sqrt(fx fy)`. No scale is
//! fitted, since the depth here is metric.

use super::{Mean, MetricError, check_finite};

/// Distances APD3D averages over, pixels.
pub const PIXELS: [f64; 5] = [1.0, 2.0, 4.0, 8.0, 16.0];

/// One point of a track at one time, in the camera's optical frame (metres, z forward).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackPoint {
    /// Where the program says it is.
    pub pred: [f32; 3],
    /// Where it is.
    pub truth: [f32; 3],
    /// Whether the program says it can be seen.
    pub pred_visible: bool,
    /// Whether it can be seen.
    pub visible: bool,
}

/// The figures of a set of points.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct TrackScores {
    /// Mean of `within` (0-1); `None` if no point can be seen.
    pub apd3d: Option<f64>,
    /// Share of the points that can be seen which are within each of [`PIXELS`], 0-1.
    pub within: [Option<f64>; 5],
    /// Share of all points whose visibility is right, 0-1; `None` of none.
    pub occlusion_accuracy: Option<f64>,
    /// Points that can be seen.
    pub visible: usize,
}

/// APD3D and OA of `points` (every point of every track at every time except the queries, which are given).
///
/// `focal_px` is `sqrt(fx fy)` of the camera the points are seen by.
pub fn track_scores(points: &[TrackPoint], focal_px: f64) -> Result<TrackScores, MetricError> {
    if !(focal_px > 0.0 && focal_px.is_finite()) {
        return Err(MetricError::NonFinite { name: "focal length", index: 0 });
    }
    let mut within = [Mean::default(); 5];
    let mut right = Mean::default();
    for (i, point) in points.iter().enumerate() {
        right.add(Some(f64::from(u8::from(point.pred_visible == point.visible))));
        if point.visible {
            let mut square = 0f64;
            for c in 0..3 {
                let p = check_finite("predicted track", i, point.pred[c].into())?;
                let t = check_finite("true track", i, point.truth[c].into())?;
                square += (p - t) * (p - t);
            }
            let pixel = f64::from(point.truth[2]) / focal_px;
            for (share, pixels) in within.iter_mut().zip(PIXELS) {
                share.add(Some(f64::from(u8::from(square.sqrt() < pixels * pixel))));
            }
        }
    }
    let within_values = within.map(|w| w.value());
    let mut mean = Mean::default();
    within_values.iter().for_each(|&w| mean.add(w));
    Ok(TrackScores {
        apd3d: mean.value(),
        within: within_values,
        occlusion_accuracy: right.value(),
        visible: within[0].count(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_values() {
        // At 10 m and 100 px focal length a pixel is 0.1 m wide.
        let at = |error: f32, pred_visible: bool, visible: bool| TrackPoint {
            pred: [1.0, 2.0 + error, 10.0],
            truth: [1.0, 2.0, 10.0],
            pred_visible,
            visible,
        };
        let points = [at(0.05, true, true), at(0.3, false, true), at(5.0, true, true), at(0.0, false, false)];
        let s = track_scores(&points, 100.0).unwrap();
        let third = 1.0 / 3.0;
        assert_eq!(s.within, [Some(third), Some(third), Some(2.0 * third), Some(2.0 * third), Some(2.0 * third)]);
        assert!((s.apd3d.unwrap() - 8.0 / 15.0).abs() < 1e-12);
        assert_eq!((s.occlusion_accuracy, s.visible), (Some(0.75), 3));
    }

    #[test]
    fn nothing_to_score_and_bad_input() {
        assert_eq!(track_scores(&[], 100.0).unwrap(), TrackScores::default());
        let hidden = TrackPoint { pred: [f32::NAN; 3], truth: [0.0, 0.0, 1.0], pred_visible: false, visible: false };
        let s = track_scores(&[hidden], 100.0).unwrap();
        assert_eq!((s.apd3d, s.occlusion_accuracy), (None, Some(1.0)));
        assert!(track_scores(&[TrackPoint { visible: true, ..hidden }], 100.0).is_err());
        for focal in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(track_scores(&[], focal).is_err());
        }
    }
}
