//! The procedural drive: a seeded street, traced ray by ray, with exact ground truth for every pixel.
//!
//! Everything follows from [`DriveOptions`]: the street plan (`layout`), what stands along it (`buildings`, `street`), who moves
//! (`stream`, `traffic`), the ego's motion (`ego`), the light (`sky`) and the cameras (`rig`). Any moment can be asked for
//! directly; nothing is simulated step by step. Geometry is kept in `f64` and made relative to the eye before it is traced in
//! `f32`, so pictures do not depend on where in the map the drive lies.

mod buildings;
mod dice;
mod drive;
mod ego;
mod ground;
mod layout;
mod leg;
mod light;
mod looks;
mod material;
mod noise;
mod options;
mod paint;
mod part;
mod path;
mod people;
mod picture;
mod pull_out;
mod rig;
mod road;
mod scene;
mod sensor;
mod shadow;
mod shapes;
mod site;
mod skin;
mod sky;
mod solids;
mod stream;
mod street;
mod texture;
mod tiles;
mod trace;
mod traffic;
mod truth;
mod vehicles;

pub use drive::Drive;
pub use looks::DriveLooks;
pub use options::{CAMERAS_MAX, DriveOptions, SECONDS_MAX, SIDE_MAX, WorldError};
pub use picture::WorldFrame;
pub use rig::DriveCamera;
pub use road::District;
pub use sensor::light_of_count;
pub use stream::MoverClass;
pub use truth::{Mover, Trajectories, Trajectory, TrajectoryOptions};

/// Surface points slower than this count as standing: the tread of a rolling wheel on the road, a planted foot.
pub const MOVING_MPS: f32 = 0.01;

#[cfg(test)]
mod tests;
#[cfg(all(test, target_os = "linux", target_env = "gnu", target_arch = "x86_64"))]
mod usual;
