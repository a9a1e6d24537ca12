//! Patches the network need not look at: those it last found to be sky, far from anything else, that still look the same.
//!
//! What the network said of a set of pictures is remembered by its stamp. A set that was seen before is judged by what was
//! said of it; a new one by the nearest set before, with a margin of one patch all round, because the cameras have moved a
//! little, and only where the mean colour has stayed. After some steps everything is looked at again, so that what nobody
//! looked at cannot stay hidden.

use std::collections::VecDeque;

use storm_model::scene::Scene;
use storm_render::Intrinsics;

use crate::config::SkipConfig;
use crate::source::Frame;
use crate::window::{PosedSet, Window};

/// Two sets nearer than this in time show nearly the same, nanoseconds.
const NEAR_NS: u64 = 250_000_000;
/// A patch whose mean colour is off by more than this many 8-bit levels in any channel has changed.
const CHANGED_LEVELS: f32 = 8.0;
/// Sets that are remembered: those of ten timesteps at 10 Hz and strides of a second.
const REMEMBERED: usize = 128;

/// What was said of a patch.
#[derive(Debug, Clone, Copy)]
struct Patch {
    sky: bool,
    /// Mean colour when the network last looked at it, 8-bit levels.
    color: [f32; 3],
}

/// One set of pictures, as judged: patches per camera, row by row.
#[derive(Debug)]
struct Judged {
    stamp_ns: i64,
    epoch: u32,
    cameras: Vec<Vec<Patch>>,
}

/// Remembers what was sky.
#[derive(Debug)]
pub struct SkyPatches {
    enabled: bool,
    opacity: f32,
    every: usize,
    patch: usize,
    /// Steps since all was looked at.
    steps: usize,
    sets: VecDeque<Judged>,
    intrinsics: Vec<Intrinsics>,
}

impl SkyPatches {
    /// For a network with patches of so many pixels a side.
    pub fn new(skip: &SkipConfig, patch: usize) -> Self {
        Self {
            enabled: skip.sky,
            opacity: skip.sky_opacity as f32,
            every: skip.sky_every,
            patch,
            steps: 0,
            sets: VecDeque::new(),
            intrinsics: Vec::new(),
        }
    }

    /// Whether patches may be left out at all.
    pub fn enabled(&self) -> bool {
        self.enabled
    }

    /// Forgets what was seen.
    pub fn forget(&mut self) {
        self.sets.clear();
        self.steps = 0;
    }

    /// Patches of this window to compute, as the network's shortcuts take them; none: all.
    pub fn keep(&mut self, window: &Window<Frame>, cameras: &[Intrinsics]) -> Option<Vec<bool>> {
        if !self.enabled {
            return None;
        }
        if self.intrinsics != cameras {
            // Other cameras: nothing is known of them.
            self.sets.clear();
            self.intrinsics = cameras.to_vec();
        }
        if self.steps >= self.every {
            self.steps = 0;
            return None;
        }
        let mut keep = Vec::new();
        for set in &window.steps {
            let judged = self.nearest(set);
            for (camera, frame) in set.frames.iter().enumerate() {
                let (width, height) = (frame.item.rgb.width, frame.item.rgb.height);
                let (cols, rows) = (width / self.patch, height / self.patch);
                let patches =
                    judged.and_then(|j| Some((j, j.cameras.get(camera)?))).filter(|(_, p)| p.len() == rows * cols);
                for at in 0..rows * cols {
                    let gone = patches.is_some_and(|(judged, patches)| {
                        patches[at].sky
                            && (judged.stamp_ns == set.stamp_ns
                                || (alone(patches, at, (rows, cols))
                                    && unchanged(patches[at].color, self.mean(frame_colors(frame), width, cols, at))))
                    });
                    keep.push(!gone);
                }
            }
        }
        // A window without any patch left would be nothing to compute.
        let some = keep.contains(&false) && keep.contains(&true);
        self.steps += usize::from(some);
        some.then_some(keep)
    }

    /// The network has said this of the window's last timesteps; `keep` is what it was told to compute.
    pub fn judge(&mut self, window: &Window<Frame>, scene: &Scene, keep: Option<&[bool]>) {
        if !self.enabled {
            return;
        }
        let shape = scene.shape;
        let (rows, cols) = (shape.height / self.patch, shape.width / self.patch);
        let first = window.steps.len().saturating_sub(shape.timesteps);
        for (t, set) in window.steps.iter().enumerate().skip(first) {
            let before = self.nearest(set);
            let judge = |camera: usize| -> Vec<Patch> {
                let pixels = &scene.gaussians.opacities[shape.picture(t - first, camera)];
                let one = |at: usize| {
                    let index = (t * shape.cameras + camera) * rows * cols + at;
                    if keep.is_some_and(|keep| !keep[index])
                        && let Some(known) = before.and_then(|b| b.cameras.get(camera)?.get(at))
                    {
                        // Not looked at: still what it was, with the colour it was judged by.
                        return *known;
                    }
                    let corner = at / cols * self.patch * shape.width + at % cols * self.patch;
                    let mut lines = (0..self.patch).map(|r| &pixels[corner + r * shape.width..][..self.patch]);
                    let sky = lines.all(|line| line.iter().all(|&o| o <= self.opacity));
                    Patch { sky, color: self.mean(frame_colors(&set.frames[camera]), shape.width, cols, at) }
                };
                (0..rows * cols).map(one).collect()
            };
            let cameras = (0..shape.cameras.min(set.frames.len())).map(judge).collect();
            let judged = Judged { stamp_ns: set.stamp_ns, epoch: set.epoch, cameras };
            self.sets.retain(|s| s.stamp_ns != judged.stamp_ns);
            if self.sets.len() >= REMEMBERED {
                self.sets.pop_front();
            }
            self.sets.push_back(judged);
        }
    }

    /// The judged set nearest in time.
    fn nearest(&self, set: &PosedSet<Frame>) -> Option<&Judged> {
        let apart = |s: &&Judged| s.stamp_ns.abs_diff(set.stamp_ns);
        self.sets.iter().filter(|s| s.epoch == set.epoch && apart(s) <= NEAR_NS).min_by_key(apart)
    }

    /// Mean colour of a patch.
    fn mean(&self, rgb: &[u8], width: usize, cols: usize, at: usize) -> [f32; 3] {
        let mut sums = [0u32; 3];
        for line in 0..self.patch {
            let first = (at / cols * self.patch + line) * width + at % cols * self.patch;
            for pixel in rgb[3 * first..3 * (first + self.patch)].chunks_exact(3) {
                sums.iter_mut().zip(pixel).for_each(|(s, &x)| *s += u32::from(x));
            }
        }
        sums.map(|s| s as f32 / (self.patch * self.patch) as f32)
    }
}

fn frame_colors(frame: &crate::window::PosedFrame<Frame>) -> &[u8] {
    &frame.item.rgb.data
}

/// Whether all patches around this one are sky too.
fn alone(patches: &[Patch], at: usize, (rows, cols): (usize, usize)) -> bool {
    let (row, col) = (at / cols, at % cols);
    let near = |x: usize, end: usize| x.saturating_sub(1)..(x + 2).min(end);
    near(row, rows).all(|r| near(col, cols).all(|c| patches[r * cols + c].sky))
}

fn unchanged(a: [f32; 3], b: [f32; 3]) -> bool {
    a.iter().zip(b).all(|(x, y)| (x - y).abs() <= CHANGED_LEVELS)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use storm_model::scene::SceneShape;
    use storm_model::{ModelConfig, Storm};

    use super::*;
    use crate::decode::RgbPicture;
    use crate::rigid::Rigid;
    use crate::window::PosedFrame;

    const PATCH: usize = 8;
    const WIDTH: usize = 40;
    const HEIGHT: usize = 40;
    /// A patch with patches all around it.
    const INSIDE: usize = 5 + 2;

    fn set(stamp_ns: i64, paint: impl Fn(usize) -> u8) -> Arc<PosedSet<Frame>> {
        let data = (0..WIDTH * HEIGHT * 3).map(|i| paint(i / 3)).collect();
        let rgb = RgbPicture { width: WIDTH, height: HEIGHT, data };
        let map_from_camera = Rigid::new(glam::DQuat::IDENTITY, glam::DVec3::ZERO);
        let frame = PosedFrame { stamp_ns, map_from_camera, item: Frame::whole(rgb) };
        Arc::new(PosedSet { stamp_ns, epoch: 0, frames: vec![frame] })
    }

    fn window(steps: Vec<Arc<PosedSet<Frame>>>) -> Window<Frame> {
        Window {
            epoch: 0,
            stamp_ns: steps.last().unwrap().stamp_ns,
            map_from_anchor: Rigid::new(glam::DQuat::IDENTITY, glam::DVec3::ZERO),
            prior: Vec::new(),
            time_sec: vec![vec![0.0]; steps.len()],
            steps,
        }
    }

    fn cameras() -> Vec<Intrinsics> {
        vec![Intrinsics { fx: 40.0, fy: 40.0, cx: 20.0, cy: 20.0, width: WIDTH, height: HEIGHT }]
    }

    /// A scene of one timestep whose upper three rows of patches are sky.
    fn scene(engine_clip: &Window<Frame>) -> Scene {
        let config = ModelConfig { image_width: WIDTH, image_height: HEIGHT, ..ModelConfig::preset("tiny").unwrap() };
        let storm = Storm::untrained(&config, 1, &candle_core::Device::Cpu).unwrap();
        let pixels = vec![0.0; WIDTH * HEIGHT * 3];
        let view = storm_model::ViewInput {
            rgb: &pixels,
            intrinsics: cameras()[0],
            world_from_camera: glam::Affine3A::IDENTITY,
            time_sec: 0.0,
            valid: None,
        };
        let clip = storm_model::ClipBatch::from_views(
            &[vec![view]],
            storm_model::PixelLayout::Hwc,
            2.0,
            &candle_core::Device::Cpu,
        );
        let mut scene = storm.forward(&clip.unwrap()).unwrap().scene(0).unwrap();
        assert_eq!(engine_clip.steps.len(), 1);
        assert_eq!(scene.shape, SceneShape { timesteps: 1, cameras: 1, height: HEIGHT, width: WIDTH });
        for (i, o) in scene.gaussians.opacities.iter_mut().enumerate() {
            *o = if i / WIDTH < 3 * PATCH { 0.01 } else { 0.9 };
        }
        scene
    }

    fn sky(every: usize) -> SkyPatches {
        SkyPatches::new(&SkipConfig { sky: true, sky_every: every, ..SkipConfig::default() }, PATCH)
    }

    #[test]
    fn what_was_sky_and_has_not_changed_is_left_out() {
        let first = window(vec![set(0, |_| 200)]);
        let mut sky = sky(10);
        assert!(sky.keep(&first, &cameras()).is_none(), "nothing is known yet");
        sky.judge(&first, &scene(&first), None);
        // A tenth of a second on: two rows of patches, the third borders on what is no sky.
        let keep = sky.keep(&window(vec![set(100_000_000, |_| 203)]), &cameras()).unwrap();
        assert!(keep.iter().enumerate().all(|(i, &k)| k == (i >= 10)), "{keep:?}");
        // The same set again: all three.
        let keep = sky.keep(&first, &cameras()).unwrap();
        assert!(keep.iter().enumerate().all(|(i, &k)| k == (i >= 15)), "{keep:?}");
    }

    #[test]
    fn what_changes_or_is_unknown_is_computed() {
        let first = window(vec![set(0, |_| 200)]);
        let mut sky = sky(10);
        sky.keep(&first, &cameras());
        sky.judge(&first, &scene(&first), None);
        // Something flies into one patch.
        let bird = |pixel: usize| {
            let (row, col) = (pixel / WIDTH / PATCH, pixel % WIDTH / PATCH);
            if row * 5 + col == INSIDE { 120 } else { 200 }
        };
        let keep = sky.keep(&window(vec![set(100_000_000, bird)]), &cameras()).unwrap();
        assert!(keep[INSIDE] && !keep[INSIDE + 1]);
        assert!(sky.keep(&window(vec![set(900_000_000, |_| 200)]), &cameras()).is_none(), "too long ago");
        let mut other = cameras();
        other[0].fx = 50.0;
        assert!(sky.keep(&window(vec![set(100_000_000, |_| 200)]), &other).is_none(), "another camera");
    }

    #[test]
    fn now_and_then_everything_is_computed() {
        let first = window(vec![set(0, |_| 200)]);
        let mut sky = sky(2);
        sky.keep(&first, &cameras());
        sky.judge(&first, &scene(&first), None);
        let next = window(vec![set(100_000_000, |_| 200)]);
        let left_out: Vec<bool> = (0..6).map(|_| sky.keep(&next, &cameras()).is_some()).collect();
        assert_eq!(left_out, [true, true, false, true, true, false]);
        let mut never = SkyPatches::new(&SkipConfig { sky_every: 0, sky: true, ..SkipConfig::default() }, PATCH);
        never.keep(&first, &cameras());
        never.judge(&first, &scene(&first), None);
        assert!(never.keep(&next, &cameras()).is_none());
    }
}
