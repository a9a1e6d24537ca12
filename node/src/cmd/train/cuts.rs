//! Where clips can be cut from a recording, by the stamps of its synchronized sets.

use std::ops::Range;

use storm_model::train::ClipOptions;

use crate::sync::clock::seconds_between;

/// Largest distance of a context set from its place, as a part of the stride (replay's window has the same default).
const TOLERANCE: f64 = 0.25;

/// Clips kept of the part that is not learned from: a score, not a run.
const OUTSIDE: usize = 8;

/// One clip, as numbers of sets.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cut {
    /// Context timesteps, ascending.
    pub context: Vec<usize>,
    /// Sets target pictures may be taken from, the context among them.
    pub moments: Range<usize>,
}

/// Clips of sets `(stamp, epoch)` in time order: those wholly inside `range` (seconds after the first set), and, of those
/// wholly outside, at most [`OUTSIDE`] that are spread evenly.
pub fn cuts(sets: &[(i64, u32)], range: (f64, f64), options: &ClipOptions) -> (Vec<Cut>, Vec<Cut>) {
    let Some(&(first_ns, _)) = sets.first() else { return (Vec::new(), Vec::new()) };
    let at = |k: usize| seconds_between(first_ns, sets[k].0);
    let (mut inside, mut outside) = (Vec::new(), Vec::new());
    for start in 0..sets.len() {
        let Some(context) = context(sets, start, options) else { continue };
        let newest = context.last().copied().unwrap_or(start);
        let (from_sec, to_sec) = range;
        let learn = at(start) >= from_sec && at(newest) <= to_sec;
        let apart = at(start) > to_sec || at(newest) + options.span_sec < from_sec;
        let end_sec = if learn { to_sec } else { f64::INFINITY };
        let last = (start..sets.len())
            .take_while(|&k| {
                let since = seconds_between(sets[start].0, sets[k].0);
                sets[k].1 == sets[start].1 && since < options.span_sec && at(k) <= end_sec
            })
            .last();
        let cut = Cut { context, moments: start..last.map_or(start, |k| k) + 1 };
        if learn {
            inside.push(cut);
        } else if apart {
            outside.push(cut);
        }
    }
    let want = OUTSIDE.min(outside.len());
    let spread = (0..want).map(|i| outside[i * outside.len() / want].clone()).collect();
    (inside, spread)
}

/// The sets nearest to the places of a window that starts at set `start`; `None` where one is too far off.
fn context(sets: &[(i64, u32)], start: usize, options: &ClipOptions) -> Option<Vec<usize>> {
    let (start_ns, epoch) = sets[start];
    let tolerance_sec = TOLERANCE * options.stride_sec;
    let off = |k: usize, place_sec: f64| (seconds_between(start_ns, sets[k].0) - place_sec).abs();
    let mut picked = Vec::with_capacity(options.timesteps);
    let mut from = start;
    for step in 0..options.timesteps {
        let place_sec = step as f64 * options.stride_sec;
        let near = (from..sets.len())
            .take_while(|&k| sets[k].1 == epoch && seconds_between(start_ns, sets[k].0) <= place_sec + tolerance_sec)
            .min_by(|&a, &b| off(a, place_sec).total_cmp(&off(b, place_sec)))?;
        if off(near, place_sec) > tolerance_sec {
            return None;
        }
        picked.push(near);
        from = near + 1;
    }
    Some(picked)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sets(n: usize) -> Vec<(i64, u32)> {
        (0..n).map(|k| (1_000_000_000_000 + k as i64 * 100_000_000, 0)).collect()
    }

    #[test]
    fn clips_start_wherever_a_context_fits() {
        let all = (0.0, f64::INFINITY);
        let (inside, outside) = cuts(&sets(51), all, &ClipOptions::default());
        // The last one's newest set is 0.1 s early, within the tolerance.
        assert_eq!((inside.len(), outside.len()), (37, 0));
        assert_eq!(inside[0], Cut { context: vec![0, 5, 10, 15], moments: 0..20 });
        assert_eq!(inside[35], Cut { context: vec![35, 40, 45, 50], moments: 35..51 });
        assert!(cuts(&sets(14), all, &ClipOptions::default()).0.is_empty());
        assert!(cuts(&[], all, &ClipOptions::default()).0.is_empty());
        let (one, _) = cuts(&sets(15), all, &ClipOptions::default());
        assert_eq!(one.len(), 1);
    }

    #[test]
    fn no_clip_to_learn_from_touches_the_rest() {
        let (inside, outside) = cuts(&sets(51), (0.0, 2.5), &ClipOptions::default());
        assert_eq!(inside.len(), 11);
        for cut in &inside {
            assert!(cut.moments.end <= 26 && cut.context.iter().all(|&k| k < 26), "{cut:?}");
            assert!(cut.context.iter().all(|k| cut.moments.contains(k)));
        }
        assert_eq!(outside.len(), 8);
        assert!(outside.iter().all(|cut| cut.context[0] >= 26), "{outside:?}");
        let (inside, outside) = cuts(&sets(51), (2.5, f64::INFINITY), &ClipOptions::default());
        assert!(inside.iter().all(|cut| cut.context[0] >= 25) && inside.len() == 12);
        assert!(outside.iter().all(|cut| cut.moments.end <= 25), "{outside:?}");
    }

    #[test]
    fn gaps_and_epochs_break_clips() {
        let mut broken = sets(40);
        broken.drain(14..17);
        let (inside, _) = cuts(&broken, (0.0, f64::INFINITY), &ClipOptions::default());
        // Set 15 is gone, set 13 is 0.2 s from its place: more than the tolerance.
        assert!(inside.iter().all(|cut| cut.context[0] != 0), "{inside:?}");
        let mut two = sets(20);
        two.iter_mut().skip(10).for_each(|s| s.1 = 1);
        assert!(cuts(&two, (0.0, f64::INFINITY), &ClipOptions::default()).0.is_empty());
        let short = ClipOptions { timesteps: 2, ..ClipOptions::default() };
        for cut in cuts(&two, (0.0, f64::INFINITY), &short).0 {
            assert_eq!(cut.moments.start < 10, cut.moments.end <= 10, "{cut:?}");
        }
    }
}
