//! Pictures with their ground truth.

use super::MOVING_MPS;
use super::drive::Drive;
use super::sensor::Sensor;
use super::trace::{Hit, Tracer};
use glam::Vec3;
use rayon::prelude::*;

/// One camera's picture and what is true in it, row by row. All but the colours belong to exactly the ray through the pixel's
/// centre `(col + 0.5, row + 0.5)`.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldFrame {
    /// Picture width, pixels.
    pub width: usize,
    /// Picture height, pixels.
    pub height: usize,
    /// Red, green, blue; `height * width * 3`.
    pub rgb: Vec<u8>,
    /// z-depth, metres; 0 in the sky.
    pub depth: Vec<f32>,
    /// Velocity of the surface point in map axes, m/s; exactly 0 for static surfaces and sky.
    pub flow: Vec<[f32; 3]>,
    /// Road user's number; 0 for static surroundings and sky.
    pub instance: Vec<u16>,
    /// 1 in the sky.
    pub sky: Vec<u8>,
    /// 1 where the surface point is faster than [`MOVING_MPS`].
    pub moving: Vec<u8>,
}

/// What the first pass learns of a pixel.
#[derive(Clone, Copy)]
struct Sample {
    label: u32,
    depth: f32,
    flow: [f32; 3],
    instance: u16,
    color: Vec3,
}

/// Where the extra rays of an edge pixel go, pixels off its centre.
const EXTRA: [(f32, f32); 3] = [(-0.12, 0.37), (0.37, -0.12), (-0.28, -0.28)];

impl Drive {
    /// The picture of a camera at a time (any time, not only frame times). Cameras beyond the rig's last mean the last.
    ///
    /// The same bytes whatever the number of threads; rows are traced in parallel on the current rayon pool.
    pub fn render(&self, camera: usize, time_sec: f64) -> WorldFrame {
        let camera = camera.min(self.cameras().len().saturating_sub(1));
        let view = self.view(camera, time_sec);
        let tracer = view.tracer(self.sky());
        let (width, height) = (view.camera.width, view.camera.height);
        let samples: Vec<Sample> = (0..height)
            .into_par_iter()
            .flat_map_iter(|row| {
                let tracer = &tracer;
                (0..width).map(move |col| sample(tracer, col, row))
            })
            .collect();
        let stamp_ns = (time_sec * 1e9).round() as i64;
        let key = [self.options().seed, camera as u64, stamp_ns as u64];
        let sensor = Sensor::new(&self.cameras()[camera], self.brightness(), self.options().noise, key);
        let smooth = self.options().smooth_edges;
        let mut rgb = vec![0u8; width * height * 3];
        rgb.par_chunks_exact_mut(width * 3).enumerate().for_each(|(row, line)| {
            for (col, pixel) in line.chunks_exact_mut(3).enumerate() {
                let i = row * width + col;
                let mut light = samples[i].color;
                if smooth && on_edge(&samples, width, height, col, row) {
                    light = smoothed(&tracer, col, row, light);
                }
                pixel.copy_from_slice(&sensor.expose(light, i));
            }
        });
        WorldFrame {
            width,
            height,
            rgb,
            depth: samples.iter().map(|s| s.depth).collect(),
            flow: samples.iter().map(|s| s.flow).collect(),
            instance: samples.iter().map(|s| s.instance).collect(),
            sky: samples.iter().map(|s| u8::from(s.label == 0)).collect(),
            moving: samples.iter().map(|s| u8::from(Vec3::from(s.flow).length() > MOVING_MPS)).collect(),
        }
    }
}

fn sample(tracer: &Tracer, col: usize, row: usize) -> Sample {
    let (u, v) = (col as f32 + 0.5, row as f32 + 0.5);
    let hit = tracer.hit(u, v);
    let (mut flow, mut instance) = ([0.0; 3], 0);
    if let Hit::Part { t, part, .. } = hit {
        let part = &tracer.scene.parts[part as usize];
        instance = part.instance;
        if part.moves {
            let p = tracer.view_from_camera * tracer.camera.ray(u, v) * t;
            flow = part.velocity(p).to_array();
        }
    }
    let (color, lit) = tracer.color(u, v, &hit);
    Sample { label: 2 * hit.label() + u32::from(lit), depth: hit.depth(), flow, instance, color }
}

/// Whether a neighbour shows another surface, or the border of a shadow runs between.
fn on_edge(samples: &[Sample], width: usize, height: usize, col: usize, row: usize) -> bool {
    let i = row * width + col;
    let label = samples[i].label;
    let differs = |j: usize| samples[j].label != label;
    col > 0 && differs(i - 1)
        || col + 1 < width && differs(i + 1)
        || row > 0 && differs(i - width)
        || row + 1 < height && differs(i + width)
}

/// The mean over the pixel's centre and three more rays. Light far above white is cut first, as a lens would not keep it to a pixel.
fn smoothed(tracer: &Tracer, col: usize, row: usize, centre: Vec3) -> Vec3 {
    let cut = |c: Vec3| c.min(Vec3::splat(4.0));
    let mut sum = cut(centre);
    for (du, dv) in EXTRA {
        let (u, v) = (col as f32 + 0.5 + du, row as f32 + 0.5 + dv);
        let hit = tracer.hit(u, v);
        sum += cut(tracer.color(u, v, &hit).0);
    }
    sum / (1 + EXTRA.len()) as f32
}
