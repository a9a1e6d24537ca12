//! What methods answer with.

use storm_model::scene::Scene;

use super::Clip;
use crate::rigid::Rigid;

/// A scene, the frame it is in, and the time it is best for. Its clock starts at the window's first timestep.
pub struct Placed {
    /// Where times nearest to this are drawn from it.
    pub stamp_ns: i64,
    /// Its frame.
    pub map_from_anchor: Rigid,
    /// The scene.
    pub scene: Scene,
    /// Whether Gaussian `i` is what pixel `i` of the window shows.
    pub pixel_aligned: bool,
}

impl Placed {
    /// A scene in the window's own frame.
    pub fn in_window(clip: &Clip, scene: Scene, pixel_aligned: bool) -> Self {
        let window = &clip.window;
        Self { stamp_ns: window.stamp_ns, map_from_anchor: window.map_from_anchor, scene, pixel_aligned }
    }
}

/// A method's answer for one clip.
pub enum Prediction {
    /// Scenes to draw; each frame from the one nearest in time.
    Scenes(Vec<Placed>),
    /// Scene flow of every context pixel in map axes, m/s, `[timestep][camera][pixel]`; geometry is the true one.
    Flow(Vec<Vec<Vec<[f32; 3]>>>),
    /// The nearest context picture.
    NearestContext,
}

/// The same scene without motion.
pub(super) fn still(mut scene: Scene) -> Scene {
    scene.gaussians.velocity_backward.fill([0.0; 3]);
    scene.gaussians.velocity_forward.fill([0.0; 3]);
    scene
}
