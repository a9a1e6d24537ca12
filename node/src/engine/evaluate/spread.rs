//! How much of a figure is the choice of clips: its standard error, from what it would be without each one of them (the jackknife of
//! Quenouille and Tukey), which holds for means over clips, pictures and timesteps alike and needs no dice.

use super::Tally;
use crate::engine::figures::Figures;

/// Of one method: what every clip scored.
pub(super) fn whole(clips: &[Tally]) -> Tally {
    without(clips, None)
}

fn without(clips: &[Tally], left_out: Option<usize>) -> Tally {
    let mut all = Tally::default();
    clips.iter().enumerate().filter(|(i, _)| Some(*i) != left_out).for_each(|(_, clip)| all.join(clip));
    all
}

/// The standard error of each figure over the clips; `None` of fewer than two clips, and where a figure hangs on one clip alone.
pub(super) fn standard_errors(clips: &[Tally]) -> Figures {
    let mut errors = Figures::default();
    if clips.len() < 2 {
        return errors;
    }
    let left: Vec<_> = (0..clips.len()).map(|i| without(clips, Some(i)).figures().rows()).collect();
    for (k, error) in errors.values_mut().into_iter().enumerate() {
        let values: Option<Vec<f64>> = left.iter().map(|rows| rows[k].2).collect();
        *error = values.map(|values| jackknife(&values));
    }
    errors
}

/// Of a figure's values with each one of the samples left out.
fn jackknife(values: &[f64]) -> f64 {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let square: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
    ((n - 1.0) / n * square).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::evaluate::{Clip, Prediction};

    #[test]
    fn of_a_mean_it_is_the_deviation_over_the_root_of_the_number() {
        let samples = [3.0, 1.0, 4.0, 1.0, 5.0, 9.0];
        let (n, sum) = (samples.len() as f64, samples.iter().sum::<f64>());
        let left: Vec<f64> = samples.iter().map(|x| (sum - x) / (n - 1.0)).collect();
        let variance = samples.iter().map(|x| (x - sum / n).powi(2)).sum::<f64>() / (n - 1.0);
        assert!((jackknife(&left) - (variance / n).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn clips_scored_apart_join_to_the_figures_of_all() {
        let clips: Vec<Clip> = (0..3).map(|seed| Clip::of_seed(seed, (32, 16), 0.0).unwrap()).collect();
        let scored = |clips: &[Clip]| {
            let mut tally = Tally::default();
            clips.iter().for_each(|clip| tally.add(clip, &Prediction::NearestContext, Some(2.0)).unwrap());
            tally
        };
        let apart: Vec<Tally> = clips.chunks(1).map(scored).collect();
        assert_eq!(whole(&apart).figures(), scored(&clips).figures());
        let errors = standard_errors(&apart);
        assert!(errors.psnr.is_some_and(|e| e > 0.0 && e < 10.0), "{errors:?}");
        assert_eq!((errors.ms, errors.epe3d), (Some(0.0), None));
        assert_eq!(standard_errors(&apart[..1]), Figures::default());
    }
}
