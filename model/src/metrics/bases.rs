//! Whether the velocity bases are motions of the scene at hand, or the same fixed classes for every scene.

use serde::Serialize;

use crate::config::{ModelConfig, VelocityBases, VelocityKind, spread_bases};

/// The velocity bases of many windows.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct BaseSpread {
    /// Per window all bases' numbers in a row, m/s.
    windows: Vec<Vec<f64>>,
    /// Numbers per base.
    width: usize,
    from_fan: Option<f64>,
}

/// Figures of [`BaseSpread`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct BaseFigures {
    /// The largest distance of any base of any window from where it started ([`spread_bases`]), m/s; none for networks whose bases
    /// did not start from the fan.
    pub from_fan: Option<f64>,
    /// How far a base is from its own mean over the windows, root of the mean square over windows and bases, m/s; none of fewer
    /// than two windows.
    pub between_clips: Option<f64>,
}

impl BaseSpread {
    /// Adds a window's bases, one row of 3 or 6 numbers per motion token as [`crate::Scene`] has them.
    pub fn add(&mut self, bases: &[Vec<f32>], config: &ModelConfig) {
        let Some(first) = bases.first() else { return };
        self.width = first.len();
        if config.velocity_bases == VelocityBases::Spread {
            for (base, start) in bases.iter().zip(spread_bases(bases.len())) {
                let halves = base.chunks_exact(3).enumerate().map(|(k, half)| {
                    // `v-`, the first of two, has its sign turned.
                    let sign = if k == 0 && config.velocity == VelocityKind::ForwardBackward { -1.0 } else { 1.0 };
                    let apart = half.iter().zip(start).map(|(x, s)| f64::from(*x) - sign * f64::from(s));
                    apart.map(|d| d * d).sum::<f64>().sqrt()
                });
                self.from_fan = halves.chain(self.from_fan).reduce(f64::max);
            }
        }
        self.windows.push(bases.iter().flatten().map(|&x| f64::from(x)).collect());
    }

    /// Counts what the other counted too.
    pub fn join(&mut self, other: &Self) {
        self.windows.extend_from_slice(&other.windows);
        self.width = self.width.max(other.width);
        self.from_fan = other.from_fan.into_iter().chain(self.from_fan).reduce(f64::max);
    }

    /// The figures so far.
    pub fn figures(&self) -> BaseFigures {
        let numbers = self.windows.iter().map(Vec::len).min().unwrap_or(0);
        let count = self.windows.len();
        let bases = numbers / self.width.max(1);
        let square = |k: usize| {
            let mean = self.windows.iter().map(|w| w[k]).sum::<f64>() / count as f64;
            self.windows.iter().map(|w| (w[k] - mean).powi(2)).sum::<f64>() / count as f64
        };
        let squares: f64 = (0..numbers).map(square).sum();
        let between_clips = (count > 1 && bases > 0).then(|| (squares / bases as f64).sqrt());
        BaseFigures { from_fan: self.from_fan, between_clips }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(velocity_bases: VelocityBases, velocity: VelocityKind) -> ModelConfig {
        ModelConfig { velocity_bases, velocity, ..ModelConfig::preset("tiny").unwrap() }
    }

    fn fan(sign: Option<f32>) -> Vec<Vec<f32>> {
        let row = |v: [f32; 3]| sign.map_or(v.to_vec(), |s| [v.map(|x| s * x), v].concat());
        spread_bases(16).into_iter().map(row).collect()
    }

    #[test]
    fn an_untouched_fan_is_nowhere_and_the_same_everywhere() {
        for (kind, sign) in [(VelocityKind::One, None), (VelocityKind::ForwardBackward, Some(-1.0))] {
            let mut spread = BaseSpread::default();
            let config = config(VelocityBases::Spread, kind);
            spread.add(&fan(sign), &config);
            assert_eq!(spread.figures(), BaseFigures { from_fan: Some(0.0), between_clips: None });
            spread.add(&fan(sign), &config);
            assert_eq!(spread.figures(), BaseFigures { from_fan: Some(0.0), between_clips: Some(0.0) });
        }
    }

    #[test]
    fn one_base_that_follows_the_scene_is_seen() {
        let config = config(VelocityBases::Spread, VelocityKind::One);
        let mut moved = fan(None);
        moved[3][0] += 3.0;
        moved[3][1] += 4.0;
        let (mut a, mut b) = (BaseSpread::default(), BaseSpread::default());
        a.add(&fan(None), &config);
        b.add(&moved, &config);
        a.join(&b);
        let f = a.figures();
        assert_eq!(f.from_fan, Some(5.0));
        // Both windows lie 2.5 m/s from the mean, in one of 16 bases.
        assert!((f.between_clips.unwrap() - (2.5f64 * 2.5 / 16.0).sqrt()).abs() < 1e-6, "{f:?}");
    }

    #[test]
    fn learned_bases_have_no_fan_and_no_bases_no_figures() {
        let mut spread = BaseSpread::default();
        spread.add(&fan(None), &config(VelocityBases::Learned, VelocityKind::One));
        assert_eq!(spread.figures(), BaseFigures::default());
        let mut none = BaseSpread::default();
        none.add(&[], &config(VelocityBases::Spread, VelocityKind::One));
        assert_eq!(none.figures(), BaseFigures::default());
    }
}
