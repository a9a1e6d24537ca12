//! Motion masks: foreground adjusted Rand index of the grouping, IoU of moving pixels.

use std::collections::BTreeMap;

use super::{MetricError, check_len, check_mask};

/// Pairs among `n` things.
fn pairs(n: u64) -> f64 {
    n as f64 * (n as f64 - 1.0) / 2.0
}

/// Adjusted Rand index (Hubert and Arabie, 1985) of two groupings of `mask`'s pixels; labels are names only.
///
/// 1 for the same grouping, about 0 for an unrelated one, `None` of no pixel. Two groupings that are both one single
/// group (or both all singletons) are the same: 1.
pub fn adjusted_rand_index(pred: &[u32], truth: &[u32], mask: Option<&[bool]>) -> Result<Option<f64>, MetricError> {
    check_len("predicted groups", pred.len(), truth.len())?;
    check_mask(mask, truth.len())?;
    let mut together: BTreeMap<(u32, u32), u64> = BTreeMap::new();
    let (mut by_pred, mut by_truth): (BTreeMap<u32, u64>, BTreeMap<u32, u64>) = Default::default();
    let mut n = 0u64;
    for (i, (&p, &t)) in pred.iter().zip(truth).enumerate() {
        if mask.is_none_or(|m| m[i]) {
            *together.entry((p, t)).or_default() += 1;
            *by_pred.entry(p).or_default() += 1;
            *by_truth.entry(t).or_default() += 1;
            n += 1;
        }
    }
    if n == 0 {
        return Ok(None);
    }
    if together.len() == by_pred.len() && together.len() == by_truth.len() {
        // Every group of one is a group of the other; also keeps 0 / 0 away from the formula.
        return Ok(Some(1.0));
    }
    let index: f64 = together.values().map(|&c| pairs(c)).sum();
    let in_pred: f64 = by_pred.values().map(|&c| pairs(c)).sum();
    let in_truth: f64 = by_truth.values().map(|&c| pairs(c)).sum();
    let expected = in_pred * in_truth / pairs(n);
    Ok(Some((index - expected) / (0.5 * (in_pred + in_truth) - expected)))
}

/// Foreground adjusted Rand index: over the pixels whose true group is not `background` (Greff et al., IODINE, 2019).
/// Predicted background is a group like any other. With a single true object it says only whether the prediction splits
/// that object, so read it next to [`iou`].
pub fn foreground_ari(pred: &[u32], truth: &[u32], background: u32) -> Result<Option<f64>, MetricError> {
    let foreground: Vec<bool> = truth.iter().map(|&t| t != background).collect();
    adjusted_rand_index(pred, truth, Some(&foreground))
}

/// Intersection over union of two sets of pixels, within `mask`; `None` when both are empty.
pub fn iou(pred: &[bool], truth: &[bool], mask: Option<&[bool]>) -> Result<Option<f64>, MetricError> {
    check_len("predicted mask", pred.len(), truth.len())?;
    check_mask(mask, truth.len())?;
    let (mut both, mut either) = (0usize, 0usize);
    for (i, (&p, &t)) in pred.iter().zip(truth).enumerate() {
        if mask.is_none_or(|m| m[i]) {
            both += usize::from(p && t);
            either += usize::from(p || t);
        }
    }
    Ok((either > 0).then(|| both as f64 / either as f64))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn known_values() {
        // Worked by hand: pairs together in both 2, in the prediction 2 + 0, in the truth 1 + 1 of 6.
        let ari = adjusted_rand_index(&[0, 0, 1, 2], &[0, 0, 1, 1], None).unwrap().unwrap();
        assert!((ari - (1.0 - 1.0 / 3.0) / (1.5 - 1.0 / 3.0)).abs() < 1e-12, "{ari}");
        assert_eq!(adjusted_rand_index(&[5, 5, 9], &[1, 1, 0], None).unwrap(), Some(1.0));
        assert_eq!(adjusted_rand_index(&[0; 4], &[0, 0, 1, 1], None).unwrap(), Some(0.0));
        assert_eq!(adjusted_rand_index(&[1; 4], &[3; 4], None).unwrap(), Some(1.0));
        assert_eq!(adjusted_rand_index(&[7], &[3], None).unwrap(), Some(1.0));
        assert_eq!(adjusted_rand_index(&[], &[], None).unwrap(), None);
        assert_eq!(foreground_ari(&[1, 2, 3, 3], &[0, 0, 8, 8], 0).unwrap(), Some(1.0));
        assert_eq!(foreground_ari(&[1, 2], &[0, 0], 0).unwrap(), None);
        assert_eq!(iou(&[true, true, false], &[true, false, false], None).unwrap(), Some(0.5));
        assert_eq!(iou(&[true, false], &[true, false], Some(&[false, true])).unwrap(), None);
        assert!(iou(&[true], &[], None).is_err() && adjusted_rand_index(&[1], &[], None).is_err());
    }

    proptest! {
        #[test]
        fn ari_is_symmetric_bounded_and_blind_to_names(labels in prop::collection::vec((0u32..4, 0u32..4), 1..60)) {
            let (a, b): (Vec<u32>, Vec<u32>) = labels.iter().copied().unzip();
            let ab = adjusted_rand_index(&a, &b, None).unwrap().unwrap();
            let ba = adjusted_rand_index(&b, &a, None).unwrap().unwrap();
            let renamed: Vec<u32> = a.iter().map(|x| 100 - 7 * x).collect();
            let other = adjusted_rand_index(&renamed, &b, None).unwrap().unwrap();
            prop_assert!((ab - ba).abs() < 1e-12 && (ab - other).abs() < 1e-12);
            prop_assert!((-1.0..=1.0 + 1e-12).contains(&ab));
            prop_assert_eq!(adjusted_rand_index(&a, &a, None).unwrap(), Some(1.0));
        }
    }
}
