//! The stages wired together: `front` (sync, poses, window), the engine, and what takes the results: files
//! (`sink`, driven by `replay`) or whoever listens (`live`).

pub mod demand;
pub mod front;
pub mod guard;
pub mod live;
pub mod map_updates;
pub mod messages;
pub mod metrics;
pub mod posed;
pub mod replay;
pub mod saver;
pub mod sink;
pub mod step;
pub mod timing;
