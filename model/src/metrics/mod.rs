//! Error figures, one definition for the whole program.
