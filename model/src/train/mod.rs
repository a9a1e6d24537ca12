//! Training: data from procedural drives, losses, optimiser, checkpoints, validation.

mod adamw;
mod bases;
mod checkpoint;
#[cfg(test)]
mod clip_tests;
mod clips;
mod error;
mod groups;
mod guard;
mod held_pictures;
mod loader;
mod looks;
pub mod losses;
mod lpips;
mod muon;
mod options;
mod perceptual;
mod pixel;
mod raster;
mod recorded;
mod render_stage;
#[cfg(test)]
mod render_tests;
mod schedule;
mod shares;
mod source;
mod trainer;
mod truth;
mod validate;
mod views;

pub use adamw::AdamOptions;
pub use checkpoint::provenance;
pub use clips::{ClipOptions, ClipPlan, HELD_OUT_SEEDS, TrainClip};
pub use error::TrainError;
pub use held_pictures::{HeldPictures, held_pictures};
pub use loader::{DataOptions, Loader};
pub use looks::LookOptions;
pub use lpips::FeatureNetwork;
pub use muon::Optimizer;
pub use options::{Stage, TrainOptions};
pub use perceptual::structure_loss;
pub use pixel::{PixelLossOptions, pixel_losses};
pub use raster::{SceneGradient, SharedRenderer};
pub use recorded::{RecordedPicture, SkyLabel, recorded_clip};
pub use render_stage::{draw_targets, render_stage_losses};
pub use schedule::Schedule;
pub use source::{Batches, ClipSource, MixedData, RecordingOptions};
pub use trainer::{StepReport, Trainer};
pub use truth::{SkySamples, Truth};
pub use validate::{VALIDATION_SEEDS, Validation, validate};
