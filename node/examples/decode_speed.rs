//! Times decoding and rectification of a bag's camera pictures, one thread for decoding as the pipeline has it.
//!
//! `cargo run --release -p storm-node --example decode_speed -- BAG [WIDTH HEIGHT]`

use std::collections::HashMap;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use storm_node::bag::Bag;
use storm_node::cdr::decode;
use storm_node::decode::{Rectifier, compressed_to_rgb, image_to_rgb};

fn main() -> Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let path = args.first().context("usage: decode_speed BAG [WIDTH HEIGHT]")?;
    let size = |i: usize, default: usize| args.get(i).map_or(Ok(default), |s| s.parse::<usize>());
    let (width, height) = (size(1, 96)?, size(2, 64)?);
    let bag = Bag::open(Path::new(path))?;
    let of_type =
        |t: &str| -> Vec<usize> { (0..bag.topics().len()).filter(|i| bag.topics()[*i].type_name == t).collect() };
    let mut infos = HashMap::new();
    for m in bag.messages(&of_type("sensor_msgs/msg/CameraInfo"))? {
        let info = decode::camera_info(&m?.data)?;
        infos.entry(info.header.frame_id.clone()).or_insert(info);
    }
    let (compressed, raw) = (of_type("sensor_msgs/msg/CompressedImage"), of_type("sensor_msgs/msg/Image"));
    let mut rectifiers: HashMap<(String, bool), Rectifier> = HashMap::new();
    let (mut decoding, mut lensless, mut warped, mut n) = (Vec::new(), Vec::new(), Vec::new(), 0);
    for m in bag.messages(&[compressed.clone(), raw].concat())? {
        let m = m?;
        let start = Instant::now();
        let (header, picture) = if compressed.contains(&m.topic) {
            let image = decode::compressed_image(&m.data)?;
            (image.header.clone(), compressed_to_rgb(&image)?)
        } else {
            let image = decode::image(&m.data)?;
            (image.header.clone(), image_to_rgb(&image)?)
        };
        decoding.push(start.elapsed());
        let Some(info) = infos.get(&header.frame_id) else { continue };
        for (distorted, times) in [(false, &mut lensless), (true, &mut warped)] {
            let key = (header.frame_id.clone(), distorted);
            if !rectifiers.contains_key(&key) {
                let mut info = info.clone();
                if distorted {
                    // A made-up lens, to time the general path on the same pictures.
                    info.distortion_model = "plumb_bob".to_owned();
                    info.d = vec![-0.3, 0.1, 0.001, 0.001, 0.0];
                }
                let start = Instant::now();
                let made = Rectifier::new(&info, !distorted, width, height)?;
                println!(
                    "{} distorted {distorted}: {:?}, map in {:?}",
                    header.frame_id,
                    made.intrinsics(),
                    start.elapsed()
                );
                rectifiers.insert(key.clone(), made);
            }
            let start = Instant::now();
            let out = rectifiers[&key].apply(&picture)?;
            times.push(start.elapsed());
            n += out.data.len();
        }
    }
    for (name, times) in [("decode", &mut decoding), ("resize", &mut lensless), ("undistort + resize", &mut warped)] {
        times.sort();
        let at = |q: usize| times.get(times.len() * q / 100).copied().unwrap_or(Duration::ZERO).as_secs_f64() * 1e3;
        println!("{name:20} {} pictures  min {:.2}  median {:.2}  p90 {:.2} ms", times.len(), at(0), at(50), at(90));
    }
    println!("{n} bytes out");
    Ok(())
}
