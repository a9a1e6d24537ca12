//! Writes images of training clips as PNG files and prints how fast clips are made.
//!
//! `cargo run --release -p storm-model --example training_clips -- [OUT [LOOKS [CLIPS [CAMERAS [SEED [WIDTH HEIGHT]]]]]]`
//!
//! LOOKS as `storm train --looks` takes them. Per clip one file, the context images: cameras side by side, timesteps below each
//! other; the rate counts context and target images with their truth.

use std::error::Error;
use std::path::PathBuf;
use std::time::Instant;

use candle_core::Tensor;
use image::RgbImage;
use storm_model::ModelConfig;
use storm_model::train::{ClipOptions, ClipPlan, LookOptions};

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let out = PathBuf::from(args.next().unwrap_or_else(|| "training_clips".to_owned()));
    let looks = LookOptions::parse(&args.next().unwrap_or_else(|| "varied".to_owned()))?;
    let mut number = |default: u64| args.next().map_or(Ok(default), |a| a.parse::<u64>());
    let (clips, cameras, seed) = (number(12)?, number(1)? as usize, number(0)?);
    let (width, height) = (number(240)? as usize, number(160)? as usize);
    std::fs::create_dir_all(&out)?;
    let options = ClipOptions { cameras, width, height, looks, ..ClipOptions::default() };
    let config = ModelConfig::preset("tiny")?;
    let (mut images, mut seconds) = (0, 0.0);
    for index in 0..clips {
        let plan = ClipPlan::training(seed, index, &options);
        let start = Instant::now();
        let clip = plan.make(&options, &config)?;
        let took = start.elapsed().as_secs_f64();
        let count = cameras * (options.timesteps + options.targets);
        println!("clip {index}: drive {}, {:.1} images/s", plan.drive_seed, count as f64 / took);
        (images, seconds) = (images + count, seconds + took);
        save(&clip.context.image.get(0)?, &out.join(format!("clip{index:03}.png")))?;
    }
    println!(
        "{images} images of {width}x{height} with truth in {seconds:.2} s: {:.1} images/s",
        images as f64 / seconds
    );
    Ok(())
}

/// `(t, v, 3, h, w)` in the network's range as one image.
fn save(context: &Tensor, path: &std::path::Path) -> Result<(), Box<dyn Error>> {
    let (t, v, _, h, w) = context.dims5()?;
    let values: Vec<f32> = context.flatten_all()?.to_vec1()?;
    let side = |n: usize| u32::try_from(n);
    let mut image = RgbImage::new(side(v * w)?, side(t * h)?);
    for (x, y, pixel) in image.enumerate_pixels_mut() {
        let (x, y) = (x as usize, y as usize);
        let first = (y / h * v + x / w) * 3 * h * w + y % h * w + x % w;
        pixel.0 = std::array::from_fn(|c| ((values[first + c * h * w] + 1.0) * 127.5).round().clamp(0.0, 255.0) as u8);
    }
    Ok(image.save(path)?)
}
