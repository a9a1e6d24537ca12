//! Long drives without a network: the map and the trajectories fed with the procedural drive's truth, and measured
//! against it. What falls short here is the map's or the trackers' fault alone. `faults` is another matter: the same drives
//! as messages through the live pipeline, network and all, with everything going wrong that goes wrong on a vehicle.

mod faults;
mod map_quality;
mod memory;
mod motion_quality;
mod object_quality;
mod oracle;
mod run;
mod track_quality;

pub use faults::{Check, FaultReport, FaultSoak, LiveQuarter, run_with_faults};
pub use map_quality::MapFigures;
pub use memory::Memory;
pub use motion_quality::{MotionFigures, MotionShare};
pub use object_quality::ObjectFigures;
pub use oracle::{OracleErrors, OracleSet, OracleStep, OracleWindow};
pub use run::{Growth, Quarter, SoakOptions, SoakReport, Spread, run};
pub use track_quality::TrackFigures;
