//! Entries of a tensor put into a larger one.

use candle_core::{Device, Result, Tensor};

/// Where the entries along one axis of a tensor lie in a longer one.
#[derive(Debug, Clone)]
pub(super) struct Axis {
    /// For each new entry, which old one it is.
    old: Vec<Option<usize>>,
    /// New entries are zero, whatever stands there otherwise.
    zero: bool,
}

impl Axis {
    /// `parts` equal parts, each longer at its end: `from` entries become `to`.
    pub fn parts(parts: usize, from: usize, to: usize, zero: bool) -> Self {
        let (short, long) = (from / parts.max(1), to / parts.max(1));
        let part = |part: usize| (0..long).map(move |i| (i < short).then_some(part * short + i));
        Self { old: (0..parts).flat_map(part).collect(), zero }
    }
}

/// `fresh` with the entries of `old` in their places and zeros where an axis asks for them.
pub(super) fn place(old: &Tensor, fresh: &Tensor, axes: &[Axis]) -> Result<Tensor> {
    let lengths: Vec<usize> = axes.iter().map(|axis| axis.old.len()).collect();
    if fresh.dims() != lengths || old.rank() != axes.len() {
        candle_core::bail!("{:?} into {:?} by axes of {lengths:?}", old.dims(), fresh.dims());
    }
    let shape = old.dims().to_vec();
    let (old, mut out) = (old.flatten_all()?.to_vec1::<f32>()?, fresh.flatten_all()?.to_vec1::<f32>()?);
    for (index, out) in out.iter_mut().enumerate() {
        let (mut rest, mut stride, mut at, mut zero) = (index, 1, Some(0), false);
        for (axis, length) in axes.iter().zip(&shape).rev() {
            let place = axis.old[rest % axis.old.len()];
            rest /= axis.old.len();
            zero |= place.is_none() && axis.zero;
            at = at.zip(place).map(|(at, place)| at + place * stride);
            stride *= length;
        }
        match at.and_then(|at| old.get(at)) {
            Some(value) => *out = *value,
            None if zero => *out = 0.0,
            None => (),
        }
    }
    Tensor::from_vec(out, lengths, &Device::Cpu)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_grow_at_their_ends_and_zeros_are_where_they_are_wanted() {
        let old = Tensor::arange(1f32, 9.0, &Device::Cpu).unwrap().reshape((4, 2)).unwrap();
        let fresh = Tensor::full(-1f32, (6, 3), &Device::Cpu).unwrap();
        let axes = [Axis::parts(2, 4, 6, false), Axis::parts(1, 2, 3, true)];
        let got = place(&old, &fresh, &axes).unwrap().to_vec2::<f32>().unwrap();
        let want =
            [[1.0, 2.0, 0.0], [3.0, 4.0, 0.0], [-1.0, -1.0, 0.0], [5.0, 6.0, 0.0], [7.0, 8.0, 0.0], [-1.0, -1.0, 0.0]];
        assert_eq!(got, want);
        assert!(place(&old, &fresh, &axes[..1]).is_err());
    }
}
