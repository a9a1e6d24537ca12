//! How far every pixel's surface moves in an image while the shutter is open.

use glam::{DAffine3, Vec2, Vec3};
use storm_render::Intrinsics;
use storm_render::world::WorldFrame;

/// Where a camera is when its shutter opens and when it closes.
#[derive(Debug, Clone, Copy)]
pub(in crate::train) struct Shutter {
    pub intrinsics: Intrinsics,
    /// map_from_camera at both moments.
    pub opens: DAffine3,
    pub closes: DAffine3,
    /// Seconds between them.
    pub open_sec: f64,
}

/// Longest motion that is blurred, pixels: beyond it an image shows nothing but stripes.
const LONGEST_PX: f32 = 12.0;

impl Shutter {
    /// Motion of each pixel over the whole exposure, pixels across and down; at most [`LONGEST_PX`] long.
    pub(super) fn motion(&self, frame: &WorldFrame) -> Vec<Vec2> {
        let k = &self.intrinsics;
        let back = self.closes.matrix3.transpose();
        let turn = (back * self.opens.matrix3).as_mat3();
        let shift = (back * (self.opens.translation - self.closes.translation)).as_vec3();
        let flow_turn = back.as_mat3() * self.open_sec as f32;
        (0..frame.width * frame.height)
            .map(|i| {
                let at = Vec2::new((i % frame.width) as f32 + 0.5, (i / frame.width) as f32 + 0.5);
                let ray = k.ray(at.x, at.y);
                // What is infinitely far only turns.
                let later = match frame.depth[i] {
                    0.0 => turn * ray,
                    z => turn * (ray * z) + shift + flow_turn * Vec3::from(frame.flow[i]),
                };
                let Some((u, v)) = k.project(later) else { return Vec2::ZERO };
                (Vec2::new(u, v) - at).clamp_length_max(LONGEST_PX)
            })
            .collect()
    }
}

/// The mean of an image along each pixel's motion, the shutter's middle where the pixel is.
pub(super) fn blurred(image: &[Vec3], width: usize, height: usize, motion: &[Vec2]) -> Vec<Vec3> {
    let at = |x: f32, y: f32| {
        let (col, row) = (x.clamp(0.0, (width - 1) as f32), y.clamp(0.0, (height - 1) as f32));
        image[(row + 0.5) as usize * width + (col + 0.5) as usize]
    };
    motion
        .iter()
        .enumerate()
        .map(|(i, m)| {
            let steps = (m.length() * 1.5) as usize;
            if steps == 0 {
                return image[i];
            }
            let (x, y) = ((i % width) as f32, (i / width) as f32);
            let sum: Vec3 = (0..=steps)
                .map(|k| {
                    let f = k as f32 / steps as f32 - 0.5;
                    at(x + f * m.x, y + f * m.y)
                })
                .sum();
            sum / (steps + 1) as f32
        })
        .collect()
}
