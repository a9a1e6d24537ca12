//! What can go wrong in this crate, with the offending name, value and the fix in one line.

use crate::weights::WeightsError;

/// Errors of configuration, inputs, weights and results.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// A configuration value that no network can be built from.
    #[error("model configuration: {field} is {value}; {fix}")]
    Config {
        /// Name of the field as written in the file.
        field: &'static str,
        /// The value it has.
        value: String,
        /// What would be accepted.
        fix: String,
    },
    /// A preset name that is not known.
    #[error("unknown model preset '{name}'; known: tiny, base, b8, l8, xl8, h8, b16, l16, xl16, h16")]
    UnknownPreset {
        /// The name asked for.
        name: String,
    },
    /// A network that cannot be grown into another.
    #[error("cannot grow {field} from {from} to {to}: {fix}")]
    Growth {
        /// Name of the field as written in the file.
        field: String,
        /// The value it has.
        from: String,
        /// The value that was asked for.
        to: String,
        /// What would be accepted.
        fix: String,
    },
    /// A clip whose shapes or counts do not fit the network.
    #[error("clip input: {0}")]
    Input(String),
    /// A clip that holds a NaN or an infinity.
    #[error(
        "clip input: {count} non-finite value(s) in the {what} of camera {camera} at timestep {timestep}; drop that frame"
    )]
    NonFiniteInput {
        /// Image, intrinsics, pose or time.
        what: &'static str,
        /// Camera number inside the window.
        camera: usize,
        /// Timestep number inside the window.
        timestep: usize,
        /// How many values are not finite.
        count: usize,
    },
    /// A result that holds a NaN or an infinity; nothing of it is used.
    #[error("network output: {count} non-finite value(s) in '{tensor}'; the weights or the inputs are broken")]
    NonFinite {
        /// Name of the tensor.
        tensor: String,
        /// How many values are not finite.
        count: usize,
    },
    /// A weight file that cannot be used.
    #[error(transparent)]
    Weights(#[from] WeightsError),
    /// The tensor library failed (shape bug or out of memory).
    #[error("tensor operation: {0}")]
    Tensor(#[from] candle_core::Error),
    /// The rasteriser refused the scene.
    #[error("rendering: {0}")]
    Render(String),
}
