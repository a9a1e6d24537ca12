//! Point trajectories chained from scene flow.
