//! Products on AMX tile units (Sapphire Rapids and later): 16x16 sums of products of bf16, a whole tile per instruction.
//!
//! A float of 24 bits is, exactly, the sum of three bf16 of 8: its leading bits, those after, and the rest ([`split`]).
//! Products of floats are therefore sums of products of parts. With [`Parts::Three`] the six products that are not below a
//! float's own rounding are taken (high x high, high x middle, middle x high, high x low, middle x middle, low x high), and
//! what is left out is at most `2^-21` of each product: results are those of f32 arithmetic, to its own rounding (Henry, Tang and Heinecke,
//! "Leveraging the bfloat16 Artificial Intelligence Datatype For Higher-Precision Computations", 2019). With [`Parts::One`]
//! operands are rounded to bf16 and multiplied once. Between them lie [`Parts::Two`], for gradients: a bf16 and what it
//! is off by, rounded to another, three products; each product is within `2^-16` of the floats' (TF32, which others train with, has `2^-10`).
//!
//! The left operand lies in panels of 32 rows, the right one in panels of 32 columns; either is a sequence of steps of 32
//! of the summed dimension, each step one pair of 1 KiB tiles per part. A row of a left tile is 32 values of one row; a
//! row of a right tile is two values, neighbours along the summed dimension, of each of 16 columns. Seen as 16x16 words of
//! 32 bits, one is the other's transpose ([`pack`]).
//!
//! bf16 units take numbers below `2^-126` as zeros, so what float arithmetic would have kept below about `2^-110` in
//! operands is lost. An infinite operand of three parts gives NaN where f32 would have given an infinity.

mod detect;
mod pack;
mod product;
#[cfg(test)]
mod tests;

pub(crate) use detect::available;
pub(super) use pack::{column_tiles, interleaved, put, row_tiles, transpose, words_of};
pub(super) use product::{Configured, product, product_onto};

/// Rows of a left panel, columns of a right one.
pub(super) const SIDE: usize = 32;
/// Rows, and words of a row, of a tile.
pub(super) const TILE: usize = 16;
/// Values of the summed dimension to a step.
pub(super) const STEP: usize = 32;
/// Floats as large as a tile.
pub(super) const TILE_FLOATS: usize = TILE * TILE;

/// How many bf16 a float is taken as.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Parts {
    /// Rounded to one.
    One,
    /// Rounded to the sum of two.
    Two,
    /// Split into three, nothing lost.
    Three,
}

impl Parts {
    pub(super) const fn count(self) -> usize {
        match self {
            Self::One => 1,
            Self::Two => 2,
            Self::Three => 3,
        }
    }

    /// Floats that hold a panel of `SIDE` rows or columns of `depth` values each.
    pub(super) const fn panel_floats(self, depth: usize) -> usize {
        depth.div_ceil(STEP) * self.step_floats()
    }

    /// Floats that hold one step of a panel.
    pub(super) const fn step_floats(self) -> usize {
        2 * TILE_FLOATS * self.count()
    }
}
