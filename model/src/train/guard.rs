//! What an update that was not finite leaves behind.

use super::adamw::Slot;

fn not_finite(values: &[f32]) -> usize {
    values.iter().filter(|x| !x.is_finite()).count()
}

impl Slot {
    /// Name and number of values that are no longer finite, in weights, moments and average together; `None` if all are.
    pub(super) fn spoiled(&self) -> Option<(String, usize)> {
        let bad: usize =
            [&self.weight, &self.first, &self.second, &self.average].into_iter().map(|x| not_finite(x)).sum();
        (bad > 0).then(|| (self.name.clone(), bad))
    }

    /// Takes the weights of before; moments and averages that were spoiled start anew from them.
    pub(super) fn restore(&mut self, weight: Vec<f32>) {
        for moment in [&mut self.first, &mut self.second] {
            if not_finite(moment) > 0 {
                moment.fill(0.0);
            }
        }
        if not_finite(&self.average) > 0 {
            self.average.clone_from(&weight);
        }
        self.weight = weight;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::Optimizer;
    use crate::train::adamw::{AdamOptions, step};

    #[test]
    fn a_spoiled_update_is_named_and_undone() {
        let options = AdamOptions { clip_norm: 0.0, ..AdamOptions::default() };
        let mut slots = [Slot::new("a.weight", &[1, 2], vec![1.0, 2.0]), Slot::new("b.weight", &[1, 1], vec![3.0])];
        // Its square is no f32.
        let gradients = [Some(vec![1e30, 1.0]), Some(vec![1.0])];
        step(&mut slots, &gradients, 0, 0.1, 0.9, Optimizer::AdamW, &options).unwrap();
        assert_eq!(slots[0].spoiled(), Some(("a.weight".to_string(), 1)));
        assert_eq!(slots[1].spoiled(), None);
        slots[0].restore(vec![1.0, 2.0]);
        assert_eq!(slots[0].spoiled(), None);
        assert_eq!(slots[0].weight, [1.0, 2.0]);
    }
}
