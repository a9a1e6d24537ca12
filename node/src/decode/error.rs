//! Why a picture or a camera cannot be used. Errors name values and what would be accepted; the caller adds topic and stamp.

/// Why a picture or a camera cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// An encoding that cannot be read as what was asked for.
    #[error("encoding `{found}` cannot be read as {wanted}; accepted: {accepted}")]
    Encoding {
        /// Encoding of the message.
        found: String,
        /// What it was to become.
        wanted: &'static str,
        /// Encodings accepted.
        accepted: &'static str,
    },
    /// Width, height, step and data do not fit each other.
    #[error("{width}x{height} `{encoding}` with step {step} and {bytes} bytes: {why}")]
    Layout {
        /// Columns claimed.
        width: u32,
        /// Rows claimed.
        height: u32,
        /// Bytes per row claimed.
        step: u32,
        /// Encoding of the message.
        encoding: String,
        /// Bytes there are.
        bytes: usize,
        /// What does not fit.
        why: String,
    },
    /// A compressed file that cannot be decoded.
    #[error("compressed image (format `{format}`, {bytes} bytes): {why}")]
    Compressed {
        /// Format the message names.
        format: String,
        /// Bytes of the file.
        bytes: usize,
        /// What the decoder says.
        why: String,
    },
    /// A picture whose size is not that of its camera_info.
    #[error(
        "picture is {width}x{height}, its camera_info is for {want_width}x{want_height} (region of interest and binning applied)"
    )]
    Size {
        /// Columns of the picture.
        width: usize,
        /// Rows of the picture.
        height: usize,
        /// Columns the camera_info gives.
        want_width: usize,
        /// Rows the camera_info gives.
        want_height: usize,
    },
    /// A lens model nobody here can undo.
    #[error("distortion model `{found}` is not supported; accepted: {accepted}")]
    Model {
        /// Model of the camera_info.
        found: String,
        /// Models accepted.
        accepted: &'static str,
    },
    /// A camera_info that does not describe a camera.
    #[error("camera_info of frame `{frame_id}`: {why}")]
    Camera {
        /// Frame of the camera_info.
        frame_id: String,
        /// What is wrong, with the value.
        why: String,
    },
}
