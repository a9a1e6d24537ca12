//! The stages wired together: `front` (sync, poses, window), the engine, and the sink (map, tracks, files).

pub mod front;
pub mod metrics;
pub mod posed;
pub mod replay;
pub mod sink;
pub mod step;
pub mod timing;
