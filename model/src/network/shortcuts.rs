//! What a forward pass may leave out or round, chosen anew for every pass. The default leaves nothing out.

use crate::error::ModelError;
use crate::ops::Precision;

/// Largest side of a block of patches whose keys and values are pooled.
pub const MAX_KV_POOL: usize = 4;
/// Largest part of the image tokens that may be merged away.
pub const MAX_MERGE: f32 = 0.75;

/// What a forward pass may leave out. The default is exact; each field is one shortcut, and they combine.
#[derive(Debug, Clone, PartialEq)]
pub struct Shortcuts {
    /// Numbers of the transformer's products.
    pub precision: Precision,
    /// In the middle blocks (all but the first and the last) the keys and values of `kv_pool x kv_pool` patches of one
    /// picture are taken as one; queries stay one per patch, and tokens that are no patches are left alone. 1: off.
    pub kv_pool: usize,
    /// Part of the image tokens that is merged into a neighbour of the same picture before the blocks and given back
    /// after them, 0 to [`MAX_MERGE`]; what has edges or moves is kept longest. 0: off.
    pub merge: f32,
    /// Image tokens to compute, ordered (timestep, camera, patch row, patch column), the same in all windows of the
    /// batch; the others are neither queries nor keys, and their Gaussians come back with opacity 0. None: all.
    pub keep: Option<Vec<bool>>,
    /// The last block's queries and the heads are worked out for the newest timestep alone, and the output has that
    /// timestep only.
    pub newest_only: bool,
}

impl Default for Shortcuts {
    fn default() -> Self {
        Self { precision: Precision::F32, kv_pool: 1, merge: 0.0, keep: None, newest_only: false }
    }
}

impl Shortcuts {
    /// Whether nothing is left out or rounded.
    pub fn exact(&self) -> bool {
        *self == Self::default()
    }

    /// Whether the values are usable for windows of so many image tokens.
    pub(super) fn check(&self, image_tokens: usize) -> Result<(), ModelError> {
        if !(1..=MAX_KV_POOL).contains(&self.kv_pool) {
            return Err(ModelError::Input(format!("kv_pool is {}; use 1 to {MAX_KV_POOL}", self.kv_pool)));
        }
        if !(self.merge >= 0.0 && self.merge <= MAX_MERGE) {
            return Err(ModelError::Input(format!("merge is {}; use 0 to {MAX_MERGE}", self.merge)));
        }
        if let Some(keep) = &self.keep
            && keep.len() != image_tokens
        {
            let text = format!("keep has {} entries for {image_tokens} image tokens; give one for each", keep.len());
            return Err(ModelError::Input(text));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_that_do_not_fit_are_named() {
        assert!(Shortcuts::default().exact() && Shortcuts::default().check(7).is_ok());
        let wrong = |s: Shortcuts| s.check(7).unwrap_err().to_string();
        assert!(wrong(Shortcuts { kv_pool: 0, ..Shortcuts::default() }).contains("kv_pool is 0"));
        assert!(wrong(Shortcuts { merge: f32::NAN, ..Shortcuts::default() }).contains("NaN"));
        assert!(wrong(Shortcuts { merge: 0.9, ..Shortcuts::default() }).contains("0.9"));
        let error = wrong(Shortcuts { keep: Some(vec![true; 6]), ..Shortcuts::default() });
        assert!(error.contains('6') && error.contains('7'), "{error}");
    }
}
