//! Vehicle poses over time, interpolated and never extrapolated.
