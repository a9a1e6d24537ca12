//! What can be wrong with a request to render.

/// Why nothing was rendered.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RasterError {
    /// A setting has no meaning.
    #[error("raster setting `{name}` is {value}; it must be {need}")]
    Setting {
        /// The setting.
        name: &'static str,
        /// Its value.
        value: f32,
        /// What it must be.
        need: &'static str,
    },
    /// Two arrays of the splats disagree in length.
    #[error("splat array `{name}` holds {len} values but {expected} were expected for {splats} means")]
    Length {
        /// The array.
        name: &'static str,
        /// Its length.
        len: usize,
        /// The length that fits `means`.
        expected: usize,
        /// Length of `means`.
        splats: usize,
    },
    /// More splats or channels than the index types hold.
    #[error("{value} {name} are more than the {limit} that can be rendered at once; render in parts")]
    TooMany {
        /// What there is too much of.
        name: &'static str,
        /// How many.
        value: usize,
        /// The limit.
        limit: usize,
    },
    /// A camera that cannot take a picture.
    #[error("view {view}: {what}")]
    View {
        /// Index of the view.
        view: usize,
        /// What is wrong, the value and the fix.
        what: String,
    },
    /// A backward pass that does not belong to the last render.
    #[error("the last render drew {what}; call `render` with these Gaussians and views before `backward`")]
    NotRendered {
        /// What it drew instead.
        what: &'static str,
    },
    /// Loaded Gaussians that are gone, or another renderer's.
    #[error("these Gaussians are not loaded here (any more): a `load` is good until the next `load` or `render`")]
    NotLoaded,
    /// Channels that the loaded Gaussians do not have.
    #[error("channels {start}..{end} of Gaussians with {feature_count}; name a range inside")]
    Channels {
        /// First channel.
        start: usize,
        /// One past the last.
        end: usize,
        /// What there is.
        feature_count: usize,
    },
}
