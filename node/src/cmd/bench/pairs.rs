//! Two things timed in turn, so that what slows the machine for a while slows both: their ratio repeats where their times do not.
//!
//! What else the machine does only ever lengthens a run, by a tenth or by half, and not both of a turn alike. So the ratio is of the
//! lower quartiles: over three benches of six settings of a second a step it moved by 7 % at most, the median of the turns' own
//! ratios by 11 %.

use std::time::Instant;

use anyhow::Result;
use serde::Serialize;

/// Turns at least and at most, and the time after which no further one beyond the least is taken.
#[derive(Debug, Clone, Copy)]
pub(super) struct Turns {
    pub least: usize,
    pub most: usize,
    pub seconds: f64,
}

/// Something timed: milliseconds of its run of this number.
pub(super) type Timed<'a> = &'a mut dyn FnMut(usize) -> Result<f64>;

/// Milliseconds of two things run in turn.
#[derive(Debug, Default, Clone, Serialize)]
pub(in crate::cmd) struct Pairs {
    pub one: Vec<f64>,
    pub other: Vec<f64>,
}

impl Pairs {
    /// Takes turns. Who is first changes at each, for what one leaves behind (caches, clock) is met by the other.
    ///
    /// # Errors
    /// Of the two.
    pub(super) fn take(turns: Turns, one: Timed, mut other: Option<Timed>) -> Result<Self> {
        let (start, mut pairs) = (Instant::now(), Self::default());
        for turn in 0..turns.most.max(1) {
            if turn >= turns.least && start.elapsed().as_secs_f64() > turns.seconds {
                break;
            }
            if turn.is_multiple_of(2) {
                pairs.one.push(one(turn)?);
            }
            if let Some(other) = &mut other {
                pairs.other.push(other(turn)?);
            }
            if !turn.is_multiple_of(2) {
                pairs.one.push(one(turn)?);
            }
        }
        Ok(pairs)
    }

    /// How many times longer the other takes, by their lower quartiles. None without another.
    pub fn times_less(&self) -> Option<f64> {
        Some(lower_quartile(self.other.clone())? / lower_quartile(self.one.clone())?)
    }
}

/// The lower of the middle two of an even number.
pub(super) fn median(values: Vec<f64>) -> Option<f64> {
    ranked(values, 2)
}

fn lower_quartile(values: Vec<f64>) -> Option<f64> {
    ranked(values, 4)
}

/// The value with one of so many parts of the others below it.
fn ranked(mut values: Vec<f64>, parts: usize) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len().saturating_sub(1) / parts).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_that_slows_down_or_is_interrupted_leaves_the_ratio_as_it_is() {
        let slow = |turn: usize| if turn < 4 { 1.0 } else { 3.0 };
        let order = std::cell::RefCell::new(String::new());
        let mut one = |turn| {
            order.borrow_mut().push('a');
            Ok(10.0 * slow(turn) * if turn == 2 { 1.5 } else { 1.0 })
        };
        let mut other = |turn| {
            order.borrow_mut().push('b');
            Ok(25.0 * slow(turn))
        };
        let turns = Turns { least: 7, most: 9, seconds: 0.0 };
        let pairs = Pairs::take(turns, &mut one, Some(&mut other)).unwrap();
        assert_eq!((pairs.one.len(), pairs.other.len(), pairs.times_less()), (7, 7, Some(2.5)));
        assert_eq!(*order.borrow(), "abbaabbaabbaab");
        let alone = Pairs::take(Turns { seconds: 1e9, ..turns }, &mut |_| Ok(1.0), None).unwrap();
        assert_eq!((alone.one.len(), alone.times_less()), (9, None));
        let failing = Pairs::take(turns, &mut |_| Ok(1.0), Some(&mut |_| anyhow::bail!("no")));
        assert!(failing.is_err());
    }

    #[test]
    fn medians_and_quartiles() {
        assert_eq!(
            [median(vec![3.0, 1.0, 2.0]), median(vec![4.0, 1.0, 2.0, 3.0]), median(vec![])],
            [Some(2.0), Some(2.0), None]
        );
        let numbers = |n: u8| (0..n).rev().map(f64::from).collect::<Vec<_>>();
        assert_eq!(
            [0, 2, 4, 5, 9].map(|n| lower_quartile(numbers(n))),
            [None, Some(0.0), Some(0.0), Some(1.0), Some(2.0)]
        );
    }
}
