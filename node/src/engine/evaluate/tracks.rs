//! Trajectories over a clip's context: points with their velocities, chained from timestep to timestep.
//!
//! As the paper's appendix describes it: a point is moved by its own flow to the next timestep and continues at the nearest
//! point there; if none lies within a gate, it keeps its place and velocity. It starts on the exact ray of the query at the
//! depth predicted for that pixel, and runs both ways from the query's timestep.

use anyhow::Result;
use glam::Vec3;
use storm_model::metrics::track::{TrackPoint, track_scores};
use storm_render::View;
use storm_render::world::Trajectories;

use super::Clip;
use crate::baselines::nearest::Cloud;
use crate::config::TracksConfig;
use crate::source::Frame;
use crate::window::Window;

/// One followed surface point.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackTruth {
    /// Camera it is chosen in and judged by.
    pub camera: usize,
    /// Timestep it is chosen at.
    pub step: usize,
    /// Where it is seen then, pixels (pixel centres at .5).
    pub pixel: [f32; 2],
    /// Its place at every timestep in that camera's optical frame, metres.
    pub places: Vec<[f32; 3]>,
    /// Whether that camera sees it.
    pub visible: Vec<bool>,
}

impl TrackTruth {
    /// Of a drive's trajectories at the window's timesteps.
    pub fn of_drive(all: &Trajectories, window: &Window<Frame>) -> Vec<Self> {
        let mut out = Vec::new();
        for point in &all.points {
            let (camera, step) = point.query;
            let place = |(k, p): (usize, &glam::DVec3)| {
                let frame = window.steps.get(k)?.frames.get(camera)?;
                Some(frame.map_from_camera.inverse().apply(*p).as_vec3().to_array())
            };
            let places: Option<Vec<[f32; 3]>> = point.positions.iter().enumerate().map(place).collect();
            let visible = point.visible.iter().map(|bits| bits >> camera & 1 == 1).collect();
            out.extend(places.map(|places| Self { camera, step, pixel: point.query_pixel, places, visible }));
        }
        out
    }
}

/// What a method says of one context timestep: a point with its velocities for every pixel of every camera, camera by camera,
/// in the window's frame.
#[derive(Debug, Clone, Default)]
pub struct StepCloud {
    /// Places, metres.
    pub places: Vec<Vec3>,
    /// Velocities towards earlier times, m/s.
    pub backward: Vec<Vec3>,
    /// Velocities towards later times, m/s.
    pub forward: Vec<Vec3>,
    /// Whether other points may continue there.
    pub solid: Vec<bool>,
}

impl StepCloud {
    /// Adds the next pixel.
    pub fn push(&mut self, place: Vec3, backward: Vec3, forward: Vec3, solid: bool) {
        self.places.push(place);
        self.backward.push(backward);
        self.forward.push(forward);
        self.solid.push(solid);
    }
}

/// Share of the followed points within a distance of the truth (TAPVid-3D's APD3D), over the visible points of all timesteps
/// but the query's; `None` where the clip has none.
pub(super) fn apd3d(clip: &Clip, clouds: &[StepCloud]) -> Result<Option<f64>> {
    if clouds.len() != clip.window.steps.len() || clip.tracks.is_empty() {
        return Ok(None);
    }
    let links: Vec<Links> = clouds.iter().map(Links::new).collect();
    let views: Vec<Vec<View>> = (0..clouds.len()).map(|step| clip.views(step)).collect();
    let (mut sum, mut count) = (0f64, 0usize);
    for (camera, intrinsics) in clip.cameras.iter().enumerate() {
        let mut points = Vec::new();
        for track in clip.tracks.iter().filter(|t| t.camera == camera) {
            let Some(places) = chain(clip, track, clouds, &links, &views) else { continue };
            for (step, place) in places.iter().enumerate().filter(|(step, _)| *step != track.step) {
                let pred = views[step][camera].camera_from_world.transform_point3(*place).to_array();
                let visible = track.visible[step];
                points.push(TrackPoint { pred, truth: track.places[step], pred_visible: true, visible });
            }
        }
        let scores = track_scores(&points, f64::from(intrinsics.fx * intrinsics.fy).sqrt())?;
        sum += scores.apd3d.unwrap_or(0.0) * scores.visible as f64;
        count += scores.visible;
    }
    Ok((count > 0).then(|| sum / count as f64))
}

/// The solid points of a timestep, ready to be asked for the nearest.
struct Links {
    cloud: Cloud,
    index: Vec<usize>,
}

impl Links {
    fn new(step: &StepCloud) -> Self {
        let index: Vec<usize> = (0..step.places.len()).filter(|&i| step.solid[i]).collect();
        Self { cloud: Cloud::new(index.iter().map(|&i| step.places[i].to_array()).collect()), index }
    }
}

/// Places of a query at every timestep, in the window's frame.
fn chain(
    clip: &Clip,
    track: &TrackTruth,
    clouds: &[StepCloud],
    links: &[Links],
    views: &[Vec<View>],
) -> Option<Vec<Vec3>> {
    let k = clip.cameras.get(track.camera)?;
    let (col, row) = ((track.pixel[0] as usize).min(k.width - 1), (track.pixel[1] as usize).min(k.height - 1));
    let pixels: usize = clip.cameras[..track.camera].iter().map(|c| c.width * c.height).sum();
    let at = pixels + row * k.width + col;
    let cloud = clouds.get(track.step)?;
    let view = views.get(track.step)?.get(track.camera)?;
    let depth = view.camera_from_world.transform_point3(*cloud.places.get(at)?).z;
    let start = view.world_from_camera().transform_point3(k.ray(track.pixel[0], track.pixel[1]) * depth);
    let mut places = vec![start; clouds.len()];
    let gate2 = TracksConfig::default().gate_m.powi(2) as f32;
    let time = |step: usize| clip.window.time_sec[step][track.camera] as f32;
    for later in [true, false] {
        let (mut place, mut velocity) = (start, if later { cloud.forward[at] } else { cloud.backward[at] });
        let steps: Vec<usize> =
            if later { (track.step + 1..clouds.len()).collect() } else { (0..track.step).rev().collect() };
        let mut before = track.step;
        for step in steps {
            place += velocity * (time(step) - time(before));
            let near = links[step].cloud.nearest(&place.to_array()).filter(|(_, d2)| *d2 <= gate2);
            if let Some(i) = near.and_then(|(i, _)| links[step].index.get(i).copied()) {
                place = clouds[step].places[i];
                velocity = if later { clouds[step].forward[i] } else { clouds[step].backward[i] };
            }
            places[step] = place;
            before = step;
        }
    }
    Some(places)
}
