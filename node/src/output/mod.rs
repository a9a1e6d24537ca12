//! What a run leaves behind: PLY, CSV, TUM, MCAP, pictures and the report.

pub mod atomic;
pub mod bag_metadata;
pub mod bag_writer;
pub mod cloud;
pub mod cloud_live;
pub mod error;
pub mod objects_csv;
pub mod picture;
pub mod plot;
pub mod ply;
pub mod qos;
pub mod report;
pub mod tracks_csv;
pub mod tum;

pub use error::OutputError;
