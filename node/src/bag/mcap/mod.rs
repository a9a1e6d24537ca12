//! MCAP files: an index made at opening (from the summary when it is whole, else from the data itself), then messages in
//! log-time order with a bounded number of chunks in memory.
//!
//! The record layout is <https://mcap.dev/spec>. Records are parsed here rather than with the `mcap` crate because a
//! damaged file must give everything before and after the damage, and no claimed length may be believed before it is checked.

mod chunk;
mod index;
mod records;
mod stream;
mod summary;
#[cfg(test)]
mod tests;

pub(crate) use index::McapIndex;
pub(crate) use stream::McapStream;
