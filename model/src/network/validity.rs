//! Pixels that no camera saw, in the network: patches without any other pixel are neither queries nor keys.

use candle_core::DType;

use super::shortcuts::Shortcuts;
use super::tokens::Grid;
use crate::clip::ClipBatch;
use crate::error::ModelError;

/// The shortcuts, leaving out besides what they leave out every patch that shows nothing in all windows of the batch; none where
/// that changes nothing. A patch that only another window needs is computed for all, and no window goes without any patch.
pub(super) fn without_unseen(
    shortcuts: &Shortcuts,
    batch: &ClipBatch,
    grid: Grid,
    patch: usize,
) -> Result<Option<Shortcuts>, ModelError> {
    let Some(valid) = &batch.valid else { return Ok(None) };
    let seen = seen_patches(&valid.to_dtype(DType::F32)?.flatten_all()?.to_vec1::<f32>()?, grid, patch);
    if !seen.contains(&false) || !seen.contains(&true) {
        return Ok(None);
    }
    let keep = match &shortcuts.keep {
        Some(keep) => {
            let both: Vec<bool> = keep.iter().zip(&seen).map(|(keep, seen)| *keep && *seen).collect();
            if both.contains(&true) { both } else { seen }
        }
        None => seen,
    };
    Ok(Some(Shortcuts { keep: Some(keep), ..shortcuts.clone() }))
}

/// Whether a patch has a pixel that some window saw; `valid` holds 0 or 1 per pixel, window by window.
fn seen_patches(valid: &[f32], grid: Grid, patch: usize) -> Vec<bool> {
    let mut seen = vec![false; grid.patches()];
    let (w, picture) = (grid.cols * patch, grid.rows * grid.cols * patch * patch);
    let window = grid.timesteps * grid.cameras * picture;
    for (i, _) in valid.iter().enumerate().filter(|(_, x)| **x > 0.5) {
        let (at, pixel) = (i % window / picture, i % picture);
        seen[(at * grid.rows + pixel / w / patch) * grid.cols + pixel % w / patch] = true;
    }
    seen
}

#[cfg(test)]
mod tests {
    use candle_core::Device;
    use glam::{Affine3A, Vec3};
    use storm_render::Intrinsics;

    use super::*;
    use crate::clip::{PixelLayout, ViewInput};
    use crate::config::ModelConfig;
    use crate::network::Storm;
    use crate::scene::Scene;

    const SIZE: (usize, usize) = (32, 24);

    fn storm() -> Storm {
        let config = ModelConfig { image_width: SIZE.0, image_height: SIZE.1, ..ModelConfig::preset("tiny").unwrap() };
        Storm::untrained(&config, 5, &Device::Cpu).unwrap()
    }

    /// Two timesteps; `unseen` pixels have this colour.
    fn clip(unseen: Option<&dyn Fn(usize) -> bool>, marked: bool, colour: f32) -> ClipBatch {
        let pixels = SIZE.0 * SIZE.1;
        let hidden: Vec<bool> = (0..pixels).map(|i| unseen.is_some_and(|unseen| unseen(i))).collect();
        let valid: Vec<bool> = hidden.iter().map(|h| !h).collect();
        let picture = |t: usize| -> Vec<f32> {
            let value = |i: usize| if hidden[i / 3] { colour } else { ((i * 7 + t) as f32 * 0.13).sin() };
            (0..3 * pixels).map(value).collect()
        };
        let pictures = [picture(0), picture(1)];
        let intrinsics = Intrinsics { fx: 20.0, fy: 20.0, cx: 16.0, cy: 12.0, width: SIZE.0, height: SIZE.1 };
        let view = |t: usize| ViewInput {
            rgb: &pictures[t],
            intrinsics,
            world_from_camera: Affine3A::from_translation(Vec3::X * t as f32),
            time_sec: 0.5 * t as f32,
            valid: marked.then_some(&valid[..]),
        };
        ClipBatch::from_views(&[vec![view(0)], vec![view(1)]], PixelLayout::Hwc, 2.0, &Device::Cpu).unwrap()
    }

    fn scene(clip: &ClipBatch) -> Scene {
        storm().forward(clip).unwrap().scene(0).unwrap()
    }

    #[test]
    fn a_window_whose_pixels_are_all_valid_gives_the_same_numbers() {
        let (plain, marked) = (scene(&clip(None, false, 0.0)), scene(&clip(None, true, 0.0)));
        assert!(plain.valid.is_empty() && marked.valid.iter().all(|v| *v));
        assert_eq!(plain.gaussians.means, marked.gaussians.means);
        assert_eq!(plain.gaussians.opacities, marked.gaussians.opacities);
        assert_eq!(plain.gaussians.velocity_forward, marked.gaussians.velocity_forward);
    }

    #[test]
    fn unseen_pixels_give_nothing_and_whole_patches_of_them_change_nothing() {
        // The upper patch row, and three pixels of a patch below it.
        let unseen = |i: usize| i / SIZE.0 < 8 || (i / SIZE.0 == 8 && i % SIZE.0 < 3);
        let whole_patches = |i: usize| i / SIZE.0 < 8;
        let black = scene(&clip(Some(&unseen), true, -1.0));
        for i in 0..black.shape.len() {
            let hidden = unseen(i % (SIZE.0 * SIZE.1));
            assert_eq!(black.is_valid(i), !hidden);
            if hidden {
                assert_eq!((black.gaussians.opacities[i], black.gaussians.velocity_forward[i]), (0.0, [0.0; 3]));
            } else {
                assert!(black.gaussians.opacities[i] > 0.0);
            }
        }
        // What stands in wholly unseen patches reaches no other pixel; without the mask it does.
        let apart = |marked: bool| {
            let (a, b) = (clip(Some(&whole_patches), marked, -1.0), clip(Some(&whole_patches), marked, 0.7));
            let (a, b) = (scene(&a), scene(&b));
            (0..a.shape.len())
                .filter(|i| !whole_patches(i % (SIZE.0 * SIZE.1)))
                .map(|i| (a.gaussians.opacities[i] - b.gaussians.opacities[i]).abs())
                .fold(0.0, f32::max)
        };
        assert_eq!(apart(true), 0.0);
        assert!(apart(false) > 1e-6, "the network looks at its neighbours");
    }

    #[test]
    fn windows_of_a_batch_and_other_shortcuts_go_with_it() {
        let unseen = |i: usize| i / SIZE.0 < 8;
        let one = clip(Some(&unseen), true, 0.0);
        let single = scene(&one);
        let both = ClipBatch::stack(&[one.clone(), clip(None, false, 0.0)]).unwrap();
        let output = storm().forward(&both).unwrap();
        let (first, second) = (output.scene(0).unwrap(), output.scene(1).unwrap());
        assert_eq!(first.valid, single.valid);
        assert!(second.valid.iter().all(|v| *v));
        assert!(first.gaussians.opacities.iter().zip(&first.valid).all(|(o, v)| *v || *o == 0.0));
        let newest = Shortcuts { newest_only: true, ..Shortcuts::default() };
        let output = storm().forward_with(&one, &newest).unwrap().scene(0).unwrap();
        assert_eq!((output.valid.len(), output.shape.timesteps), (SIZE.0 * SIZE.1, 1));
        assert_eq!(output.gaussians.opacities, single.gaussians.opacities[SIZE.0 * SIZE.1..]);
        let (kept, _) = storm().forward_keeping(&one, crate::ops::Precision::F32).unwrap();
        assert_eq!(kept.scene(0).unwrap().valid, single.valid);
    }

    #[test]
    fn a_window_that_shows_nothing_is_computed_all_the_same() {
        let grid = Grid { timesteps: 2, cameras: 1, rows: 3, cols: 4 };
        let nothing = clip(Some(&|_| true), true, 0.0);
        assert!(without_unseen(&Shortcuts::default(), &nothing, grid, 8).unwrap().is_none());
        assert!(scene(&nothing).gaussians.opacities.iter().all(|o| *o == 0.0));
    }
}
