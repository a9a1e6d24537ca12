//! The procedural drive: a seeded street with exact ground truth.
