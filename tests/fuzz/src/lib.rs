//! Everything that reads bytes from outside, driven by bytes nobody meant.
//!
//! [`targets`] holds one function per reader, which calls what the program calls; [`seeds`] makes sound input for each with
//! the program's own writers. `fuzz_targets/` puts libFuzzer in front of them; `tests/fuzz_seeds.rs` of the main workspace
//! runs the same functions over the seeds and some thousands of mutations, without a nightly compiler.

pub mod seeds;
pub mod targets;

/// A target.
pub type Target = fn(&[u8]);
/// What makes its seeds.
pub type Seeds = fn() -> Vec<Vec<u8>>;

/// Every target with its name and its seeds.
pub const TARGETS: [(&str, Target, Seeds); 7] = [
    ("bag", targets::bag, seeds::bag),
    ("cdr", targets::cdr, seeds::cdr),
    ("image", targets::image, seeds::image),
    ("weights", targets::weights, seeds::weights),
    ("map", targets::map, seeds::map),
    ("config", targets::config, seeds::config),
    ("front", targets::front, seeds::front),
];
