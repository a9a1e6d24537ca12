//! Two things timed in turn, so that what slows the machine for a while slows both: their ratio repeats where their times do not.
//!
//! What else the machine does only ever lengthens a run, by a tenth or by half, and not both of a turn alike; and a slow while may
//! lengthen one of the two by more than the other. So the ratio is of the faster half of the turns: of the 54
//! ratios of two benches, which chose it, that differed by 2.1 % in the mean, that of the lower quartiles by 2.6 %, of the fastest runs
//! by 2.7 %.

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

    /// How many times longer the other takes, in the faster half of the turns. None without another.
    pub fn times_less(&self) -> Option<f64> {
        let usual = [median(self.one.clone())?, median(self.other.clone())?];
        // Each is beside its own median, or the longer of the two alone would say which turns are fast.
        let slowness = |&(one, other): &(f64, f64)| one / usual[0] + other / usual[1];
        let mut turns: Vec<(f64, f64)> = self.one.iter().copied().zip(self.other.iter().copied()).collect();
        turns.sort_by(|a, b| slowness(a).total_cmp(&slowness(b)));
        turns.truncate(turns.len().div_ceil(2));
        let sums = turns.iter().fold((0.0, 0.0), |sum, turn| (sum.0 + turn.0, sum.1 + turn.1));
        Some(sums.1 / sums.0)
    }
}

/// The lower of the middle two of an even number.
pub(super) fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len().saturating_sub(1) / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_that_slows_down_or_is_interrupted_leaves_the_ratio_as_it_is() {
        let slow = |turn: usize| if turn < 5 { 1.0 } else { 3.0 };
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
    fn turns_of_which_one_half_was_slow_do_not_count() {
        let one = vec![10.0, 30.0, 11.0, 10.0, 29.0];
        let other = vec![20.0, 40.0, 21.0, 31.0, 40.0];
        assert_eq!(Pairs { one, other }.times_less(), Some((20.0 + 21.0 + 31.0) / (10.0 + 11.0 + 10.0)));
        assert_eq!(Pairs { one: vec![10.0, 11.0], other: vec![20.0, 40.0] }.times_less(), Some(2.0));
    }

    #[test]
    fn medians() {
        assert_eq!(
            [median(vec![3.0, 1.0, 2.0]), median(vec![4.0, 1.0, 2.0, 3.0]), median(vec![])],
            [Some(2.0), Some(2.0), None]
        );
    }
}
