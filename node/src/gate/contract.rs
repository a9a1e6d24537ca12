//! The error contract of skipping: what was skipped or approximated is checked now and then against full, exact steps, and the
//! level goes down a notch where the two differ by more than agreed.

use serde::Serialize;

use crate::config::SkipConfig;

/// How a skipped step's result compares with the full step's of the same window.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Difference {
    /// PSNR of the full result's pictures less that of the skipped one's, against the cameras' pictures, dB.
    pub psnr_loss_db: f64,
    /// Mean velocity difference over the mean speed of what moves (and a floor), 0-1 and more.
    pub flow: f64,
    /// 1 less the intersection over union of the moving masks.
    pub mask: f64,
}

impl Difference {
    /// Whether it is within what is agreed.
    pub fn keeps(&self, config: &SkipConfig) -> bool {
        // So written that a NaN does not keep it.
        self.psnr_loss_db <= config.max_psnr_loss_db
            && self.flow <= config.max_flow_change
            && self.mask <= config.max_mask_change
    }
}

/// The ways to compute less, from exact to approximate: a ladder whose notches answer for themselves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Notch {
    /// Nothing has changed: the last result again.
    Still,
    /// What was seen, moved on, explains the new pictures: the last result, extrapolated.
    Predicted,
    /// The network with the configured approximations.
    Approximate,
}

impl Notch {
    /// From exact to approximate.
    pub const ALL: [Self; 3] = [Self::Still, Self::Predicted, Self::Approximate];

    /// Its name in metrics and diagnostics.
    pub fn name(self) -> &'static str {
        match self {
            Self::Still => "still",
            Self::Predicted => "predicted",
            Self::Approximate => "approximate",
        }
    }
}

/// What to do with a window that a notch could take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Take the notch's result.
    Skip,
    /// Compute it, and say how the notch's result would have compared ([`Contract::checked`]).
    Check,
    /// Compute it.
    Full,
}

/// What one notch did, for metrics and diagnostics.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct NotchCounts {
    /// Steps it took.
    pub steps: u64,
    /// Full steps that checked it.
    pub checks: u64,
    /// Checks that found more difference than agreed.
    pub broken: u64,
    /// Steps it may take between two checks at present; 0: it is not in force.
    pub level: u64,
    /// What the last check found.
    pub last: Option<Difference>,
}

/// The contract of one notch.
///
/// A broken check takes the notch out of force at once. After a while (`skip.check_every` windows that it could have taken) it is
/// tried again: one check, and if that is kept one step until the next, two, four, up to the configured number. So no more than
/// `skip.check_every` steps are ever taken unchecked, and a notch that does not hold costs next to nothing.
#[derive(Debug)]
pub struct Contract {
    config: SkipConfig,
    /// Steps until the next check, at the present level.
    allowed: u64,
    since_check: u64,
    /// Windows still to go before it is tried again.
    resting: u64,
    counts: NotchCounts,
}

impl Contract {
    /// `trusted`: begins at the configured level, as befits what is exact but for noise; else trust has to be earned.
    pub fn new(config: &SkipConfig, trusted: bool) -> Self {
        let allowed = if trusted { config.check_every as u64 } else { 0 };
        Self { config: config.clone(), allowed, since_check: 0, resting: 0, counts: NotchCounts::default() }
    }

    /// For a window that the notch could take.
    pub fn decide(&mut self) -> Verdict {
        if self.config.check_every == 0 {
            return Verdict::Full;
        }
        if self.resting > 0 {
            self.resting -= 1;
            return if self.resting == 0 { Verdict::Check } else { Verdict::Full };
        }
        if self.since_check < self.allowed {
            self.since_check += 1;
            self.counts.steps += 1;
            return Verdict::Skip;
        }
        Verdict::Check
    }

    /// Whether the next window is certain to be computed: nobody need ask what the notch would have given.
    pub fn rests(&self) -> bool {
        self.resting > 1 || self.config.check_every == 0
    }

    /// A window went by that nobody asked about because the notch [`rests`](Self::rests).
    pub fn pass(&mut self) {
        self.resting = self.resting.saturating_sub(1);
    }

    /// After a [`Verdict::Check`]; whether the contract was kept.
    pub fn checked(&mut self, difference: Difference) -> bool {
        self.since_check = 0;
        self.counts.checks += 1;
        self.counts.last = Some(difference);
        let most = (self.config.check_every as u64).max(1);
        let kept = difference.keeps(&self.config);
        if kept {
            self.allowed = (2 * self.allowed).clamp(1, most);
        } else {
            self.counts.broken += 1;
            self.allowed = 0;
            self.resting = most;
        }
        kept
    }

    /// So far.
    pub fn counts(&self) -> NotchCounts {
        NotchCounts { level: if self.resting > 0 { 0 } else { self.allowed }, ..self.counts }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn contract(check_every: usize, trusted: bool) -> Contract {
        Contract::new(&SkipConfig { check_every, ..SkipConfig::default() }, trusted)
    }

    const BAD: Difference = Difference { psnr_loss_db: 3.0, flow: 0.0, mask: 0.0 };

    /// Decisions on `n` windows that may be skipped, where every check finds this.
    fn drive(contract: &mut Contract, n: usize, found: Difference) -> Vec<Verdict> {
        (0..n)
            .map(|_| {
                let verdict = contract.decide();
                if verdict == Verdict::Check {
                    contract.checked(found);
                }
                verdict
            })
            .collect()
    }

    fn skips(verdicts: &[Verdict]) -> usize {
        verdicts.iter().filter(|v| **v == Verdict::Skip).count()
    }

    #[test]
    fn a_kept_contract_skips_all_but_the_checks() {
        let mut c = contract(10, true);
        assert_eq!(skips(&drive(&mut c, 110, Difference::default())), 100);
        let counts = c.counts();
        assert_eq!((counts.steps, counts.checks, counts.broken, counts.level), (100, 10, 0, 10));
    }

    #[test]
    fn a_broken_one_is_out_of_force_within_its_interval_and_comes_back_when_it_holds() {
        let mut c = contract(8, true);
        let verdicts = drive(&mut c, 9, BAD);
        assert_eq!(verdicts[8], Verdict::Check, "the first check comes after 8 skips: {verdicts:?}");
        assert_eq!(c.counts().level, 0);
        assert_eq!(skips(&drive(&mut c, 200, BAD)), 0, "no skip while every check fails");
        assert_eq!(c.counts().checks, 1 + 200 / 8, "tried again every 8 windows");
        drive(&mut c, 100, Difference::default());
        assert_eq!(c.counts().level, 8);
    }

    #[test]
    fn what_is_not_trusted_is_checked_first_and_earns_its_level() {
        let mut c = contract(8, false);
        assert_eq!(skips(&drive(&mut c, 100, BAD)), 0);
        let mut c = contract(8, false);
        let kept = drive(&mut c, 10, Difference::default());
        use Verdict::{Check, Skip};
        assert_eq!(kept, vec![Check, Skip, Check, Skip, Skip, Check, Skip, Skip, Skip, Skip]);
    }

    #[test]
    fn windows_that_pass_by_count_as_rest() {
        let mut c = contract(4, false);
        drive(&mut c, 1, BAD);
        let mut passed = 0;
        while c.rests() {
            c.pass();
            passed += 1;
        }
        assert_eq!(passed, 3);
        assert_eq!(c.decide(), Verdict::Check);
    }

    #[test]
    fn each_figure_and_a_nan_breaks_it() {
        let c = SkipConfig::default();
        assert!(Difference::default().keeps(&c));
        for bad in [
            Difference { psnr_loss_db: c.max_psnr_loss_db + 0.01, ..Difference::default() },
            Difference { flow: c.max_flow_change + 0.01, ..Difference::default() },
            Difference { mask: c.max_mask_change + 0.01, ..Difference::default() },
            Difference { flow: f64::NAN, ..Difference::default() },
        ] {
            assert!(!bad.keeps(&c), "{bad:?}");
        }
    }

    #[test]
    fn no_skips_allowed_means_none() {
        assert_eq!(drive(&mut contract(0, true), 50, Difference::default()), vec![Verdict::Full; 50]);
        assert!(contract(0, false).rests());
    }
}
