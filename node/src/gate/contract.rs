//! The error contract of skipping: skipped steps are checked now and then against full ones, and skipping stops where the two
//! differ by more than agreed.

use crate::config::SkipConfig;

/// How a skipped step's result compares with the full step's of the same window.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Difference {
    /// PSNR of the full result's pictures less that of the skipped one's, against the cameras' pictures, dB.
    pub psnr_loss_db: f64,
    /// Mean velocity difference over the mean speed of what moves (and a floor), 0-1 and more.
    pub flow: f64,
    /// 1 less the intersection over union of the moving masks.
    pub mask: f64,
}

impl Difference {
    fn keeps(&self, config: &SkipConfig) -> bool {
        // So written that a NaN does not keep it.
        self.psnr_loss_db <= config.max_psnr_loss_db
            && self.flow <= config.max_flow_change
            && self.mask <= config.max_mask_change
    }
}

/// What to do with a window that may be skipped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Take the last result.
    Skip,
    /// Compute it, and say how the last result would have compared ([`Contract::checked`]).
    Check,
    /// Compute it.
    Full,
}

/// What the contract did, for metrics and diagnostics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct ContractCounts {
    /// Full steps that checked a skipped one.
    pub checks: u64,
    /// Checks that found more difference than agreed.
    pub broken: u64,
}

/// Skips between checks are halved by every broken check and doubled by every kept one, up to the configured number; at none, a
/// while of full steps goes by before the next try.
#[derive(Debug)]
pub struct Contract {
    config: SkipConfig,
    /// Skips until the next check, at the present level.
    allowed: u64,
    since_check: u64,
    /// Full steps still to go before skipping is tried again.
    resting: u64,
    counts: ContractCounts,
}

impl Contract {
    /// Begins at the configured level.
    pub fn new(config: &SkipConfig) -> Self {
        let allowed = config.check_every as u64;
        Self { config: config.clone(), allowed, since_check: 0, resting: 0, counts: ContractCounts::default() }
    }

    /// For a window that may be skipped.
    pub fn decide(&mut self) -> Verdict {
        if self.resting > 0 {
            self.resting -= 1;
            return if self.resting == 0 { Verdict::Check } else { Verdict::Full };
        }
        if self.config.check_every == 0 {
            return Verdict::Full;
        }
        if self.since_check < self.allowed {
            self.since_check += 1;
            return Verdict::Skip;
        }
        Verdict::Check
    }

    /// After a [`Verdict::Check`].
    pub fn checked(&mut self, difference: Difference) {
        self.since_check = 0;
        self.counts.checks += 1;
        let most = self.config.check_every as u64;
        if difference.keeps(&self.config) {
            self.allowed = (2 * self.allowed).clamp(1, most.max(1));
            return;
        }
        self.counts.broken += 1;
        self.allowed /= 2;
        if self.allowed == 0 {
            self.resting = most.max(1);
        }
    }

    /// So far.
    pub fn counts(&self) -> ContractCounts {
        self.counts
    }

    /// Skips allowed between two checks at present; 0: none.
    pub fn level(&self) -> u64 {
        if self.resting > 0 { 0 } else { self.allowed }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn contract(check_every: usize) -> Contract {
        Contract::new(&SkipConfig { check_every, ..SkipConfig::default() })
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

    #[test]
    fn a_kept_contract_skips_all_but_the_checks() {
        let mut c = contract(10);
        let verdicts = drive(&mut c, 110, Difference::default());
        assert_eq!(verdicts.iter().filter(|v| **v == Verdict::Skip).count(), 100);
        assert_eq!(c.counts(), ContractCounts { checks: 10, broken: 0 });
    }

    #[test]
    fn a_broken_one_falls_within_its_interval_and_comes_back_when_it_holds() {
        let mut c = contract(8);
        let verdicts = drive(&mut c, 9, BAD);
        assert_eq!(verdicts[8], Verdict::Check, "the first check comes after 8 skips: {verdicts:?}");
        assert_eq!(c.level(), 4);
        drive(&mut c, 40, BAD);
        let verdicts = drive(&mut c, 200, BAD);
        let skips = verdicts.iter().filter(|v| **v == Verdict::Skip).count();
        assert!(skips < 10, "{skips} skips of 200 while broken");
        drive(&mut c, 100, Difference::default());
        assert_eq!(c.level(), 8);
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
        assert_eq!(drive(&mut contract(0), 50, Difference::default()), vec![Verdict::Full; 50]);
    }
}
