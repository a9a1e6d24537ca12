//! The sliding window the network sees.
