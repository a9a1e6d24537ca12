//! Rendered pictures at target times against what the cameras saw, in one figure; needs no labels.

use candle_core::{Device, Tensor};
use serde::Serialize;
use storm_render::View;
use storm_render::raster::CpuRasterizer;

use super::clips::TrainClip;
use super::error::TrainError;
use super::views::views;
use crate::clip::ClipBatch;
use crate::error::ModelError;
use crate::metrics::image::{Image, psnr, unit_from_signed};
use crate::metrics::{Mean, MetricError};
use crate::network::Storm;
use crate::scene::{Scene, Want};

/// Means over the target pictures of some clips.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct HeldPictures {
    /// Peak signal-to-noise ratio of the rendered pictures, sky included, dB.
    pub psnr: Option<f64>,
    /// The same for the camera's context picture nearest in time: what a network has to beat, dB.
    pub psnr_nearest: Option<f64>,
    /// Pictures compared.
    pub pictures: u64,
}

/// Scores a network on the target pictures of `clips`. Weights must not be variables (inference kernels).
pub fn held_pictures<'a>(
    model: &Storm,
    clips: impl IntoIterator<Item = &'a TrainClip>,
    device: &Device,
) -> Result<HeldPictures, TrainError> {
    let settings = model.config().raster_settings();
    let mut raster = CpuRasterizer::new(settings).map_err(|e| ModelError::Render(e.to_string()))?;
    let (mut ours, mut nearest, mut pictures) = (Mean::default(), Mean::default(), 0);
    for clip in clips {
        let Some((target, _)) = &clip.target else { continue };
        let scene = model.forward(&clip.to_device(device)?.context)?.scene(0)?;
        add_psnr(&scene, target, &mut raster, &mut ours)?;
        let (context, wanted) = (images(&clip.context)?, images(target)?);
        let valid = validity(target)?;
        let (context_sec, target_sec) = (numbers(&clip.context.time_sec)?, numbers(&target.time_sec)?);
        let cameras = scene.shape.cameras;
        for (k, want) in wanted.iter().enumerate() {
            let same_camera = (0..context.len()).filter(|i| i % cameras == k % cameras);
            let away = |i: &usize| (context_sec[*i] - target_sec[k]).abs();
            let Some(near) = same_camera.min_by(|a, b| away(a).total_cmp(&away(b))) else { continue };
            let valid = valid.get(k).map(Vec::as_slice);
            nearest.add(psnr(&image(&context[near], &scene), &image(want, &scene), valid).map_err(metric)?);
            pictures += 1;
        }
    }
    Ok(HeldPictures { psnr: ours.value(), psnr_nearest: nearest.value(), pictures })
}

/// Adds the figure of every target picture of one window.
pub(super) fn add_psnr(
    scene: &Scene,
    target: &ClipBatch,
    raster: &mut CpuRasterizer,
    mean: &mut Mean,
) -> Result<(), TrainError> {
    let (pictures, times) = (images(target)?, numbers(&target.time_sec)?);
    let (views, valid) = (views(target)?, validity(target)?);
    let cameras = scene.shape.cameras;
    for (t, row) in views.chunks(cameras).enumerate() {
        let targets: Vec<(View, Option<usize>)> = row.iter().enumerate().map(|(c, v)| (*v, Some(c))).collect();
        let drawn = scene.render(raster, &targets, times[t * cameras], Want::default())?;
        for (c, view) in drawn.iter().enumerate() {
            let got: Vec<f32> = view.color.iter().flatten().map(|&x| unit_from_signed(x)).collect();
            let want = &pictures[t * cameras + c];
            let valid = valid.get(t * cameras + c).map(Vec::as_slice);
            mean.add(psnr(&image(&got, scene), &image(want, scene), valid).map_err(metric)?);
        }
    }
    Ok(())
}

/// The pictures of a batch of one window, by timestep and camera, channel last, 0 to 1.
fn images(clip: &ClipBatch) -> Result<Vec<Vec<f32>>, TrainError> {
    let [_, _, _, height, width] = clip.dims()?;
    let (values, size) = (numbers(&clip.image)?, height * width);
    let unit = |picture: &[f32]| (0..3 * size).map(|i| unit_from_signed(picture[(i % 3) * size + i / 3])).collect();
    Ok(values.chunks_exact(3 * size).map(unit).collect())
}

/// Pixels each of those pictures' cameras saw; empty: all.
fn validity(clip: &ClipBatch) -> Result<Vec<Vec<bool>>, TrainError> {
    let [_, _, _, height, width] = clip.dims()?;
    let Some(valid) = &clip.valid else { return Ok(Vec::new()) };
    Ok(numbers(valid)?.chunks_exact(height * width).map(|x| x.iter().map(|x| *x > 0.5).collect()).collect())
}

fn image<'a>(values: &'a [f32], scene: &Scene) -> Image<'a> {
    Image { width: scene.shape.width, height: scene.shape.height, channels: 3, values }
}

fn numbers(x: &Tensor) -> Result<Vec<f32>, TrainError> {
    Ok(x.to_device(&Device::Cpu)?.flatten_all()?.to_vec1::<f32>()?)
}

fn metric(e: MetricError) -> TrainError {
    ModelError::Input(e.to_string()).into()
}
