//! Scene flow, m/s: EPE3D, accuracies, angle; the paper's evaluation over frames; the three-way split of Argoverse 2.
//!
//! Per point, with `e = |pred - truth|` and `r = e / (|truth| + 1e-20)` (Li et al., "Neural Scene Flow Prior", 2021, whose
//! figures the paper reports in m/s instead of metres per frame).

use super::{Mean, MetricError, check_finite, check_len, check_mask};

/// Keeps `r` defined for points that do not move.
const TINY: f64 = 1e-20;
/// Acc5: below 0.05 m/s or 5 %.
const STRICT: f64 = 0.05;
/// Acc10: below 0.1 m/s or 10 %.
const RELAXED: f64 = 0.1;
/// Outliers: above 0.3 m/s or 10 %.
const OUTLIER_MPS: f64 = 0.3;
const OUTLIER_RATIO: f64 = 0.1;
/// Directions are compared where the true speed is above this, m/s.
const ANGLE_MIN_SPEED_MPS: f64 = 0.1;
/// Added to a speed before dividing by it.
const DIRECTION_EPS: f64 = 1e-7;
/// Cosines are kept this far inside -1 to 1: 1e-7 in the paper's program, which rounds to this in its f32.
const COSINE_MARGIN: f64 = 2.0 * 5.960_464_477_539_063e-8;
/// A frame counts when something in its sample moves faster than this, m/s.
const SAMPLE_MIN_SPEED_MPS: f64 = 1.0;
/// Argoverse 2 calls a point dynamic from 0.05 m per 0.1 s on.
pub const AV2_DYNAMIC_MPS: f64 = 0.5;

/// A flow vector, m/s.
pub type Flow = [f32; 3];

pub(crate) fn norm(v: [f64; 3]) -> f64 {
    (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt()
}

pub(super) fn widen(name: &'static str, index: usize, v: Flow) -> Result<[f64; 3], MetricError> {
    check_finite(name, index, v.iter().map(|&x| f64::from(x)).sum())?;
    Ok(v.map(f64::from))
}

/// Predicted and true flow of a point.
type Pair = ([f64; 3], [f64; 3]);

/// The counted points.
fn pairs<'a>(
    pred: &'a [Flow],
    truth: &'a [Flow],
    mask: Option<&'a [bool]>,
) -> Result<impl Iterator<Item = Result<Pair, MetricError>> + 'a, MetricError> {
    check_len("predicted flow", pred.len(), truth.len())?;
    check_mask(mask, truth.len())?;
    let counted = (0..pred.len()).filter(move |&i| mask.is_none_or(|m| m[i]));
    Ok(counted.map(|i| Ok((widen("predicted flow", i, pred[i])?, widen("true flow", i, truth[i])?))))
}

pub(super) fn difference(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// The figures of a set of points.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct FlowScores {
    /// Mean end-point error, m/s.
    pub epe3d: f64,
    /// Share of points with `e < 0.05` or `r < 0.05`, 0-1.
    pub acc5: f64,
    /// Share of points with `e < 0.1` or `r < 0.1`, 0-1.
    pub acc10: f64,
    /// Share of points with `e > 0.3` or `r > 0.1`, 0-1.
    pub outliers: f64,
    /// Mean angle between the directions where the true speed is above 0.1 m/s, radians; `None` where nothing is.
    pub theta: Option<f64>,
    /// Points counted.
    pub points: usize,
}

/// The figures over `mask`'s points; `None` of none.
pub fn flow_scores(pred: &[Flow], truth: &[Flow], mask: Option<&[bool]>) -> Result<Option<FlowScores>, MetricError> {
    let (mut points, mut sum, mut strict, mut relaxed, mut outliers) = (0usize, 0f64, 0usize, 0usize, 0usize);
    let mut angles = Mean::default();
    for pair in pairs(pred, truth, mask)? {
        let (p, t) = pair?;
        let (error, speed) = (norm(difference(p, t)), norm(t));
        let ratio = error / (speed + TINY);
        points += 1;
        sum += error;
        strict += usize::from(error < STRICT || ratio < STRICT);
        relaxed += usize::from(error < RELAXED || ratio < RELAXED);
        outliers += usize::from(error > OUTLIER_MPS || ratio > OUTLIER_RATIO);
        if speed > ANGLE_MIN_SPEED_MPS {
            let dot = p[0] * t[0] + p[1] * t[1] + p[2] * t[2];
            let cosine = dot / ((norm(p) + DIRECTION_EPS) * (speed + DIRECTION_EPS));
            angles.add(Some(cosine.clamp(COSINE_MARGIN - 1.0, 1.0 - COSINE_MARGIN).acos()));
        }
    }
    let share = |count: usize| count as f64 / points as f64;
    Ok((points > 0).then(|| FlowScores {
        epe3d: sum / points as f64,
        acc5: share(strict),
        acc10: share(relaxed),
        outliers: share(outliers),
        theta: angles.value(),
        points,
    }))
}

/// One context timestep, all cameras together.
#[derive(Debug, Clone, Copy)]
pub struct FlowFrame<'a> {
    /// Rendered flow (alpha-weighted, not normalised; Gaussians below 1 m/s zeroed).
    pub pred: &'a [Flow],
    /// True flow.
    pub truth: &'a [Flow],
    /// True z-depth, metres, 0 where unknown.
    pub depth: &'a [f32],
    /// Points of the ground, which are left out.
    pub ground: Option<&'a [bool]>,
}

/// The paper's flow figures over the timesteps of many samples.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct FlowEvaluation {
    epe3d: Mean,
    acc5: Mean,
    acc10: Mean,
    outliers: Mean,
    theta: Mean,
    rmse: Mean,
}

/// Means of [`FlowEvaluation`].
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct FlowMeans {
    /// m/s.
    pub epe3d: Option<f64>,
    /// 0-1.
    pub acc5: Option<f64>,
    /// 0-1.
    pub acc10: Option<f64>,
    /// 0-1.
    pub outliers: Option<f64>,
    /// Radians. A timestep without a moving point counts as 0, as in the paper's program.
    pub theta: Option<f64>,
    /// Root mean squared error of the components, m/s, over the points of known depth, ground included; mean over timesteps.
    pub rmse: Option<f64>,
    /// Timesteps counted.
    pub timesteps: usize,
}

impl FlowEvaluation {
    /// Adds the timesteps of one sample, if anything in it moves faster than 1 m/s. Figures are over the points of known
    /// depth that are not ground, per timestep.
    pub fn add(&mut self, frames: &[FlowFrame<'_>]) -> Result<(), MetricError> {
        // Unknown points (not finite) say nothing about speed; those that are scored are checked below.
        let speeds = frames.iter().flat_map(|f| f.truth).map(|t| norm(t.map(f64::from)));
        let fastest = speeds.filter(|s| s.is_finite()).fold(0.0, f64::max);
        if fastest > SAMPLE_MIN_SPEED_MPS {
            for frame in frames {
                let mut squares = Mean::default();
                check_len("true depth", frame.depth.len(), frame.truth.len())?;
                check_mask(frame.ground, frame.truth.len())?;
                let known: Vec<bool> = frame.depth.iter().map(|&d| d > 0.0).collect();
                for pair in pairs(frame.pred, frame.truth, Some(&known))? {
                    let (p, t) = pair?;
                    difference(p, t).iter().for_each(|d| squares.add(Some(d * d)));
                }
                self.rmse.add(squares.value().map(f64::sqrt));
                let counted: Vec<bool> =
                    known.iter().enumerate().map(|(i, &k)| k && frame.ground.is_none_or(|g| !g[i])).collect();
                if let Some(scores) = flow_scores(frame.pred, frame.truth, Some(&counted))? {
                    self.epe3d.add(Some(scores.epe3d));
                    self.acc5.add(Some(scores.acc5));
                    self.acc10.add(Some(scores.acc10));
                    self.outliers.add(Some(scores.outliers));
                    self.theta.add(Some(scores.theta.unwrap_or(0.0)));
                }
            }
        }
        Ok(())
    }

    /// Counts what the other counted too.
    pub fn join(&mut self, other: &Self) {
        self.epe3d.join(&other.epe3d);
        self.acc5.join(&other.acc5);
        self.acc10.join(&other.acc10);
        self.outliers.join(&other.outliers);
        self.theta.join(&other.theta);
        self.rmse.join(&other.rmse);
    }

    /// The means so far.
    pub fn means(&self) -> FlowMeans {
        FlowMeans {
            epe3d: self.epe3d.value(),
            acc5: self.acc5.value(),
            acc10: self.acc10.value(),
            outliers: self.outliers.value(),
            theta: self.theta.value(),
            rmse: self.rmse.value(),
            timesteps: self.epe3d.count(),
        }
    }
}

/// End-point errors of three kinds of points, m/s (times 0.1 s they are Argoverse 2's metres per sweep).
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct ThreeWay {
    /// Foreground that moves.
    pub foreground_dynamic: Option<f64>,
    /// Foreground that stands still.
    pub foreground_static: Option<f64>,
    /// Background.
    pub background_static: Option<f64>,
    /// Mean of those that exist.
    pub mean: Option<f64>,
}

/// The three-way end-point error of the Argoverse 2 scene flow challenge: foreground at `dynamic_mps` or faster
/// ([`AV2_DYNAMIC_MPS`]), other foreground, and background, each averaged over its points, then over the kinds.
pub fn three_way_epe(
    pred: &[Flow],
    truth: &[Flow],
    foreground: &[bool],
    valid: Option<&[bool]>,
    dynamic_mps: f64,
) -> Result<ThreeWay, MetricError> {
    check_len("foreground", foreground.len(), truth.len())?;
    check_mask(valid, truth.len())?;
    let (mut dynamic, mut still, mut background) = (Mean::default(), Mean::default(), Mean::default());
    let counted = (0..truth.len()).filter(|&i| valid.is_none_or(|v| v[i]));
    for (i, pair) in counted.zip(pairs(pred, truth, valid)?) {
        let (p, t) = pair?;
        let kind = match (foreground[i], norm(t) >= dynamic_mps) {
            (true, true) => &mut dynamic,
            (true, false) => &mut still,
            (false, _) => &mut background,
        };
        kind.add(Some(norm(difference(p, t))));
    }
    let kinds = [dynamic.value(), still.value(), background.value()];
    let mut mean = Mean::default();
    kinds.iter().for_each(|&k| mean.add(k));
    let [foreground_dynamic, foreground_static, background_static] = kinds;
    Ok(ThreeWay { foreground_dynamic, foreground_static, background_static, mean: mean.value() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_values() {
        let truth = [[10.0, 0.0, 0.0], [0.0, 0.0, 0.0], [2.0, 0.0, 0.0]];
        let pred = [[10.4, 0.0, 0.0], [0.08, 0.0, 0.0], [0.0, 2.0, 0.0]];
        let s = flow_scores(&pred, &truth, None).unwrap().unwrap();
        // Tolerance: f32 inputs such as 10.4 are off by 4e-7.
        assert!((s.epe3d - (0.4 + 0.08 + 8f64.sqrt()) / 3.0).abs() < 1e-6);
        assert!((s.acc5 - 1.0 / 3.0).abs() < 1e-12 && (s.acc10 - 2.0 / 3.0).abs() < 1e-12);
        assert_eq!(s.outliers, 1.0);
        let quarter = std::f64::consts::FRAC_PI_2 / 2.0;
        assert!((s.theta.unwrap() - quarter).abs() < 1e-3, "the clamp alone is 4.5e-4 rad at 0");
        assert_eq!(flow_scores(&pred, &truth, Some(&[false; 3])).unwrap(), None);
        assert_eq!(flow_scores(&[], &[], None).unwrap(), None);
        let still = flow_scores(&pred[1..2], &truth[1..2], None).unwrap().unwrap();
        assert_eq!(still.theta, None);
    }

    #[test]
    fn three_kinds() {
        let truth = [[1.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0; 3]];
        let pred = [[0.0; 3]; 4];
        let t = three_way_epe(&pred, &truth, &[true, true, true, false], None, AV2_DYNAMIC_MPS).unwrap();
        assert_eq!(t.foreground_dynamic, Some(0.75));
        assert!((t.foreground_static.unwrap() - 0.1).abs() < 1e-7);
        assert_eq!(t.background_static, Some(0.0));
        assert!((t.mean.unwrap() - 0.85 / 3.0).abs() < 1e-7);
        let t = three_way_epe(&pred, &truth, &[true; 4], Some(&[true, false, false, false]), 0.5).unwrap();
        assert_eq!((t.foreground_dynamic, t.foreground_static, t.mean), (Some(1.0), None, Some(1.0)));
        let t = three_way_epe(&[], &[], &[], None, 0.5).unwrap();
        assert_eq!(t, ThreeWay::default());
    }

    #[test]
    fn slow_samples_do_not_count() {
        let mut e = FlowEvaluation::default();
        let frame =
            FlowFrame { pred: &[[0.0; 3]; 2], truth: &[[0.9, 0.0, 0.0], [0.0; 3]], depth: &[1.0, 1.0], ground: None };
        e.add(&[frame]).unwrap();
        assert_eq!(e.means(), FlowMeans::default());
        let fast = FlowFrame { truth: &[[1.1, 0.0, 0.0], [0.0; 3]], ..frame };
        e.add(&[frame, fast]).unwrap();
        assert_eq!(e.means().timesteps, 2);
    }

    #[test]
    fn wrong_sizes_and_nan_are_errors() {
        let t = [[1.0f32, 0.0, 0.0]; 2];
        assert!(matches!(flow_scores(&t[..1], &t, None), Err(MetricError::Size { .. })));
        assert!(matches!(flow_scores(&t, &t, Some(&[true])), Err(MetricError::Size { .. })));
        assert!(matches!(
            flow_scores(&[[0.0, f32::NAN, 0.0]; 2], &t, None),
            Err(MetricError::NonFinite { index: 0, .. })
        ));
        assert!(matches!(three_way_epe(&t, &t, &[true], None, 0.5), Err(MetricError::Size { .. })));
        let frame = FlowFrame { pred: &t, truth: &[[2.0, 0.0, 0.0]; 2], depth: &[1.0], ground: None };
        assert!(matches!(FlowEvaluation::default().add(&[frame]), Err(MetricError::Size { .. })));
    }
}
