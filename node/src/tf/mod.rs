//! A transform tree over time (/tf and /tf_static), in f64.
