//! Another image size with the same patches.

use super::take;
use crate::config::ModelConfig;
use crate::error::ModelError;
use crate::network::resample;
use crate::weights::Tensors;

/// The position embedding on the patch grid of `to`, resampled as the network does for every image of that size.
pub(super) fn resize(config: &mut ModelConfig, tensors: &mut Tensors, to: &ModelConfig) -> Result<(), ModelError> {
    if !config.disable_pos_embed && config.grid() != to.grid() {
        let embedding = take(tensors, "pos_embed")?;
        tensors.insert("pos_embed".into(), resample(&embedding, config.grid(), to.grid())?);
    }
    (config.image_height, config.image_width) = (to.image_height, to.image_width);
    Ok(())
}
