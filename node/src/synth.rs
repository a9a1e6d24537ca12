//! A procedural drive written as a bag, ground truth included.
