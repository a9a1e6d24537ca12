//! Numbers at their limits: what a vehicle meets in hours of driving, and worse, through the engine that drives it.
//!
//! Every case runs the same code as a replay does and compares with the same thing computed in f64 (the network, the
//! rasteriser), with the same window somewhere harmless, or with a closed form. It reports the worst error it saw and how many
//! numbers that would have been published were not finite. Input that no sensible result exists for has to be refused with an
//! error that says why: that is a result too.

mod map;
mod network;
mod pictures;
mod raster;
mod subject;
mod training;
mod windows;

use anyhow::Result;
use serde::Serialize;

pub use subject::Size;

/// What a case found.
#[derive(Debug, Clone, Serialize)]
pub struct Case {
    /// What was done.
    pub name: String,
    /// Part of the program.
    pub group: &'static str,
    /// Largest error; what it measures is `against`. 0 where the input was refused.
    pub worst_error: f64,
    /// Largest error that passes.
    pub limit: f64,
    /// What the error is measured against, and in what.
    pub against: &'static str,
    /// Numbers that would have been published and are not finite.
    pub nonfinite: u64,
    /// Why the input was refused, where it was.
    pub refused: Option<String>,
    /// Whether it had to be refused.
    pub must_refuse: bool,
}

impl Case {
    /// Within its limit, nothing non-finite, and refused if and only if it had to be.
    pub fn passed(&self) -> bool {
        self.nonfinite == 0 && self.worst_error <= self.limit && self.refused.is_some() == self.must_refuse
    }
}

/// What one run of a case gives.
#[derive(Debug, Clone, Default)]
struct Finding {
    worst_error: f64,
    nonfinite: u64,
    refused: Option<String>,
}

impl Finding {
    /// Takes another finding of the same case in.
    fn join(&mut self, other: Self) {
        self.worst_error = worst(self.worst_error, other.worst_error);
        self.nonfinite += other.nonfinite;
        self.refused = self.refused.take().or(other.refused);
    }
}

/// The larger one, where a NaN is larger than everything.
fn worst(a: f64, b: f64) -> f64 {
    if a.is_nan() || b.is_nan() { f64::INFINITY } else { a.max(b) }
}

/// Collects the cases of one part.
struct Sheet<'a> {
    group: &'static str,
    against: &'static str,
    limit: f64,
    found: &'a mut dyn FnMut(Case),
}

impl Sheet<'_> {
    fn add(&mut self, name: impl Into<String>, finding: Finding) {
        self.add_within(name, self.limit, finding);
    }

    fn add_within(&mut self, name: impl Into<String>, limit: f64, finding: Finding) {
        self.put(name.into(), limit, false, finding);
    }

    fn add_refused(&mut self, name: impl Into<String>, finding: Finding) {
        self.put(name.into(), self.limit, true, finding);
    }

    fn put(&mut self, name: String, limit: f64, must_refuse: bool, finding: Finding) {
        let Finding { worst_error, nonfinite, refused } = finding;
        let (group, against) = (self.group, self.against);
        (self.found)(Case { name, group, worst_error, limit, against, nonfinite, refused, must_refuse });
    }
}

/// Number of cases, for a progress bar; [`run`] gives about so many.
pub const CASES: u64 = 96;

/// Runs every case; `found` gets each as it is done.
///
/// # Errors
/// What keeps the suite itself from running. A case that goes wrong is a case.
pub fn run(size: Size, found: &mut dyn FnMut(Case)) -> Result<()> {
    let mut subject = subject::Subject::new(size)?;
    windows::run(&mut subject, found)?;
    pictures::run(&mut subject, found)?;
    network::run(&subject, found)?;
    raster::run(size, found)?;
    map::run(size, found)?;
    training::run(size, found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_case_fails_for_each_of_its_reasons() {
        let good = Case {
            name: "x".into(),
            group: "g",
            worst_error: 0.1,
            limit: 0.2,
            against: "f64",
            nonfinite: 0,
            refused: None,
            must_refuse: false,
        };
        assert!(good.passed());
        assert!(!Case { worst_error: 0.3, ..good.clone() }.passed());
        assert!(!Case { worst_error: f64::NAN, ..good.clone() }.passed());
        assert!(!Case { nonfinite: 1, ..good.clone() }.passed());
        assert!(!Case { refused: Some("no".into()), ..good.clone() }.passed());
        assert!(!Case { must_refuse: true, ..good }.passed());
        assert_eq!(worst(1.0, f64::NAN), f64::INFINITY);
    }
}
