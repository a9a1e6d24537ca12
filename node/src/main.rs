//! The program `storm`.
fn main() {}
