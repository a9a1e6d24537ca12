//! Error figures, one definition for the whole program: pictures, depth, scene flow, motion masks, tracks.
//!
//! Plain slices in, `f64` out. A figure over nothing (an empty mask, no moving point) is `None`, never NaN; input that
//! is not finite, or of another size than it should be, is an error. The definitions are those of the paper's own
//! evaluation where there is one, checked against numbers it produced (`tests/fixtures/*_metrics*`).

pub mod bases;
pub mod flow;
#[cfg(test)]
mod goldens;
pub mod image;
pub mod mask;
pub mod mends;
pub mod movers;
pub mod track;

/// Why a figure cannot be computed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MetricError {
    /// Two inputs that belong together have different sizes.
    #[error("{name} has {found} elements where {expected} belong: give both at the same resolution")]
    Size {
        /// The input at fault.
        name: &'static str,
        /// Its size.
        found: usize,
        /// The size of what it is compared with.
        expected: usize,
    },
    /// An input has a NaN or an infinity where a number is compared.
    #[error("{name} is not finite at element {index}: drop or mask such values before scoring")]
    NonFinite {
        /// The input at fault.
        name: &'static str,
        /// Its first such element.
        index: usize,
    },
}

/// The mean of the figures that exist.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Mean {
    sum: f64,
    count: usize,
}

impl Mean {
    /// Counts `value` if there is one.
    pub fn add(&mut self, value: Option<f64>) {
        if let Some(value) = value {
            self.sum += value;
            self.count += 1;
        }
    }

    /// Counts what the other counted too.
    pub fn join(&mut self, other: &Self) {
        self.sum += other.sum;
        self.count += other.count;
    }

    /// The mean, or `None` of nothing.
    pub fn value(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum / self.count as f64)
    }

    /// How many figures were counted.
    pub fn count(&self) -> usize {
        self.count
    }
}

fn check_len(name: &'static str, found: usize, expected: usize) -> Result<(), MetricError> {
    if found == expected { Ok(()) } else { Err(MetricError::Size { name, found, expected }) }
}

fn check_mask(mask: Option<&[bool]>, expected: usize) -> Result<(), MetricError> {
    mask.map_or(Ok(()), |mask| check_len("mask", mask.len(), expected))
}

fn check_finite(name: &'static str, index: usize, value: f64) -> Result<f64, MetricError> {
    if value.is_finite() { Ok(value) } else { Err(MetricError::NonFinite { name, index }) }
}
