//! Learning rate over a run: linear warm-up, then a cosine down to a share of the peak.

use serde::{Deserialize, Serialize};

/// The schedule.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Schedule {
    /// Highest learning rate.
    pub peak: f64,
    /// Steps of warm-up.
    pub warmup_steps: u64,
    /// Steps of the whole run; the rate stays at its end value afterwards.
    pub steps: u64,
    /// Learning rate at the end over the highest.
    pub end_share: f64,
}

impl Schedule {
    /// Learning rate of step `step` (from 0).
    pub fn at(&self, step: u64) -> f64 {
        if step < self.warmup_steps {
            return self.peak * (step + 1) as f64 / self.warmup_steps as f64;
        }
        let length = self.steps.saturating_sub(self.warmup_steps).max(1);
        let done = ((step - self.warmup_steps) as f64 / length as f64).min(1.0);
        let wave = 0.5 * (1.0 + (std::f64::consts::PI * done).cos());
        self.peak * (self.end_share + (1.0 - self.end_share) * wave)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rises_then_falls_and_never_leaves_its_range() {
        let s = Schedule { peak: 4e-4, warmup_steps: 10, steps: 110, end_share: 0.1 };
        assert!((s.at(0) - 4e-5).abs() < 1e-12);
        assert_eq!(s.at(9), 4e-4);
        assert_eq!(s.at(10), 4e-4);
        assert!((s.at(60) - 4e-4 * 0.55).abs() < 1e-12);
        assert!((s.at(110) - 4e-5).abs() < 1e-12);
        assert_eq!(s.at(100_000), s.at(110));
        assert!((0..110).all(|k| s.at(k) > 0.0 && s.at(k) <= 4e-4));
        let none = Schedule { peak: 1.0, warmup_steps: 0, steps: 0, end_share: 0.0 };
        assert!(none.at(0).is_finite() && none.at(7).is_finite());
    }
}
