//! What is true of one picture, at the picture's size.

use std::borrow::Cow;
use std::sync::Arc;

use anyhow::Result;
use storm_model::metrics::image::{Held, Image, ImageScores};
use storm_render::world::WorldFrame;

use crate::pipeline::front::TruthImage;
use crate::source::event::Truth;
use crate::source::topics::TruthKind;

/// Ground truth of one picture, row-major at the picture's size; `None` where the recording has none.
#[derive(Debug, Clone, PartialEq)]
pub struct TruthAt {
    /// Width and height.
    pub size: (usize, usize),
    /// z-depth, metres, 0 for sky.
    pub depth: Option<Vec<f32>>,
    /// Scene flow, m/s in map axes.
    pub flow: Option<Vec<[f32; 3]>>,
    /// Not 0 where the surface moves.
    pub moving: Option<Vec<u16>>,
    /// Not 0 in the sky.
    pub sky: Option<Vec<u16>>,
    /// Object number, 0 for the static scene.
    pub instance: Option<Vec<u16>>,
    /// Pixels the camera saw: no other is compared. `None`: it saw all.
    pub valid: Option<Arc<[bool]>>,
}

impl TruthAt {
    /// Nothing known.
    pub fn none(size: (usize, usize)) -> Self {
        Self { size, depth: None, flow: None, moving: None, sky: None, instance: None, valid: None }
    }

    /// Of a drawn frame, at its own size.
    pub fn of_frame(frame: WorldFrame) -> Self {
        let mask = |m: Vec<u8>| Some(m.into_iter().map(u16::from).collect());
        Self {
            size: (frame.width, frame.height),
            depth: Some(frame.depth),
            flow: Some(frame.flow),
            moving: mask(frame.moving),
            sky: mask(frame.sky),
            instance: Some(frame.instance),
            valid: None,
        }
    }

    /// The same of the pixels alone that a camera saw: elsewhere no depth is known, and nothing moves.
    #[must_use]
    pub fn seen(mut self, valid: Option<&Arc<[bool]>>) -> Self {
        if let Some(valid) = valid {
            let depths = self.depth.iter_mut().flatten().zip(valid.iter());
            depths.filter(|(_, valid)| !**valid).for_each(|(depth, _)| *depth = 0.0);
            for labels in [&mut self.moving, &mut self.instance].into_iter().flatten() {
                labels.iter_mut().zip(valid.iter()).filter(|(_, valid)| !**valid).for_each(|(x, _)| *x = 0);
            }
        }
        Self { valid: valid.cloned(), ..self }
    }

    /// Whether the camera saw pixel `i`.
    pub fn is_valid(&self, i: usize) -> bool {
        self.valid.as_ref().is_none_or(|valid| valid.get(i).copied().unwrap_or(true))
    }

    /// A picture with the camera's own colours where it saw nothing, and the share of the pixels it saw, 0 to 1.
    pub fn or_true<'a>(&self, pred01: &'a [f32], true01: &[f32]) -> (Cow<'a, [f32]>, f64) {
        let Some(valid) = &self.valid else { return (pred01.into(), 1.0) };
        let pixels = pred01.iter().zip(true01).enumerate();
        let shown = pixels.map(|(i, (pred, truth))| if self.is_valid(i / 3) { *pred } else { *truth }).collect();
        (Cow::Owned(shown), valid.iter().filter(|valid| **valid).count() as f64 / valid.len().max(1) as f64)
    }

    /// Takes one kind from a recorded image, sampled at pixel centres; an image whose length does not fit its size is none.
    pub fn set(&mut self, kind: TruthKind, image: &TruthImage) {
        let size = self.size;
        match (&*image.data, kind) {
            (Truth::Depth(d), _) => self.depth = sample(d, image, size),
            (Truth::Flow(f), _) => self.flow = sample(f, image, size),
            (Truth::Mask(m), TruthKind::Moving) => self.moving = sample(m, image, size),
            (Truth::Mask(m), TruthKind::Sky) => self.sky = sample(m, image, size),
            (Truth::Mask(m), _) => self.instance = sample(m, image, size),
        }
    }

    /// Scores of a picture against what the camera saw; `depth` is the prediction, where the method has one.
    pub fn compare(&self, pred01: &[f32], true01: &[f32], depth: Option<&[f32]>) -> Result<ImageScores> {
        let image = |values| Image { values, width: self.size.0, height: self.size.1, channels: 3 };
        let flags = |mask: &Option<Vec<u16>>| mask.as_ref().map(|m| m.iter().map(|&x| x != 0).collect::<Vec<bool>>());
        let (sky, dynamic) = (flags(&self.sky), flags(&self.moving));
        let held = Held {
            pred: image(pred01),
            truth: image(true01),
            depth: depth.zip(self.depth.as_deref()),
            sky: sky.as_deref(),
            dynamic: dynamic.as_deref(),
            valid: self.valid.as_deref(),
        };
        Ok(held.scores()?)
    }
}

/// 8-bit values as 0 to 1.
pub fn unit(bytes: &[u8]) -> Vec<f32> {
    bytes.iter().map(|&b| b as f32 / 255.0).collect()
}

/// `data` at the centres of a `width x height` picture's pixels; `None` when its length does not fit its size.
pub(crate) fn sample<T: Copy>(data: &[T], image: &TruthImage, (width, height): (usize, usize)) -> Option<Vec<T>> {
    if data.len() != image.width * image.height || data.is_empty() {
        return None;
    }
    let at = |i: usize, from: usize, to: usize| ((2 * i + 1) * from / (2 * to)).min(from - 1);
    let pixel = |k: usize| data[at(k / width, image.height, height) * image.width + at(k % width, image.width, width)];
    Some((0..width * height).map(pixel).collect())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[test]
    fn pixels_nobody_saw_are_compared_in_no_figure() {
        let valid: Arc<[bool]> = (0..200).map(|i| i >= 60).collect();
        let mut truth = TruthAt::none((20, 10));
        (truth.depth, truth.moving) = (Some(vec![4.0; 200]), Some(vec![1; 200]));
        let truth = truth.seen(Some(&valid));
        assert_eq!(truth.depth.as_ref().unwrap().iter().filter(|d| **d > 0.0).count(), 140);
        assert_eq!(truth.moving.as_ref().unwrap().iter().filter(|m| **m > 0).count(), 140);
        let true01: Vec<f32> = (0..600).map(|i| (i % 7) as f32 / 7.0).collect();
        let drawn = |unseen: f32| -> Vec<f32> {
            true01.iter().enumerate().map(|(i, t)| if i < 180 { unseen } else { t * 0.8 }).collect()
        };
        let score = |unseen: f32| truth.compare(&drawn(unseen), &true01, Some(&[5.0; 200])).unwrap();
        assert_eq!(score(0.0), score(1.0));
        assert_eq!(score(0.0).depth_rmse, Some(1.0));
        let (known, share) = truth.or_true(&[0.5; 600], &true01);
        assert_eq!((share, known[0], known[599]), (0.7, true01[0], 0.5));
    }

    #[test]
    fn truth_is_sampled_at_pixel_centres() {
        let image = TruthImage { width: 4, height: 2, data: Arc::new(Truth::Mask(Vec::new())) };
        assert_eq!(sample(&[0, 1, 2, 3, 4, 5, 6, 7], &image, (2, 1)), Some(vec![5, 7]));
        assert_eq!(sample(&[0, 1, 2, 3, 4, 5, 6, 7], &image, (4, 2)), Some(vec![0, 1, 2, 3, 4, 5, 6, 7]));
        assert_eq!(sample(&[0, 1], &image, (4, 2)), None);
    }
}
