//! Draws pictures of procedural drives as PPM files and prints the rate.
//!
//! `cargo run --release -p storm-render --example world_pictures -- [OUT [SEEDS [CAMERAS [FIRST_SEED]]]]`
//!
//! Per seed one picture that stacks camera pictures side by side: colour on top, then depth, flow, instances.

use std::io::Write;
use std::path::PathBuf;
use std::time::Instant;
use storm_render::world::{Drive, DriveOptions, WorldFrame};

/// Depth shown as white, metres; speed shown as full colour, m/s.
const DEPTH_WHITE_M: f32 = 60.0;
const FLOW_FULL_MPS: f32 = 12.0;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let out = PathBuf::from(args.next().unwrap_or_else(|| "world_pictures".to_owned()));
    let mut number = |default: u64| args.next().map_or(Ok(default), |a| a.parse::<u64>());
    let (seeds, cameras, first) = (number(6)?, number(3)? as usize, number(0)?);
    std::fs::create_dir_all(&out)?;
    let (mut pictures, mut seconds) = (0usize, 0.0);
    for seed in first..first + seeds {
        let start = Instant::now();
        let drive = Drive::new(&DriveOptions { seed, cameras, seconds: 2.0, ..Default::default() })?;
        let planned = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let steps = [0usize, 5, 10, 15];
        let frames: Vec<Vec<WorldFrame>> = steps
            .iter()
            .map(|f| (0..cameras).map(|c| drive.render(c, drive.frame_time_sec(*f, c))).collect())
            .collect();
        let took = start.elapsed().as_secs_f64();
        pictures += steps.len() * cameras;
        seconds += took;
        let moving: usize = frames.iter().flatten().flat_map(|f| &f.moving).map(|m| usize::from(*m)).sum();
        let pixels: usize = frames.iter().flatten().map(|f| f.moving.len()).sum();
        println!(
            "seed {seed}: {:?}, ego {:.1} m/s, {:.1} % moving, plan {:.1} ms, {:.1} images/s",
            drive.district(),
            drive.ego_speed(0.0).0,
            100.0 * moving as f64 / pixels as f64,
            planned * 1e3,
            (steps.len() * cameras) as f64 / took
        );
        for (k, row) in frames.iter().enumerate().filter(|(k, _)| k % 2 == 0) {
            std::fs::write(out.join(format!("seed{seed:03}_{k}.ppm")), sheet(row))?;
        }
    }
    println!("{pictures} images in {seconds:.2} s: {:.1} images/s", pictures as f64 / seconds);
    std::io::stdout().flush()?;
    Ok(())
}

/// Colour, depth, flow and instances of several cameras as one PPM.
fn sheet(frames: &[WorldFrame]) -> Vec<u8> {
    let width: usize = frames.iter().map(|f| f.width).sum();
    let height = frames.first().map_or(0, |f| f.height);
    let mut out = format!("P6\n{width} {}\n255\n", 4 * height).into_bytes();
    let byte = |x: f32| (x.clamp(0.0, 1.0) * 255.0) as u8;
    for band in 0..4 {
        for row in 0..height {
            for f in frames {
                for i in row * f.width..(row + 1) * f.width {
                    let pixel = match band {
                        0 => [f.rgb[3 * i], f.rgb[3 * i + 1], f.rgb[3 * i + 2]],
                        1 => [byte((f.depth[i] / DEPTH_WHITE_M).sqrt()); 3],
                        2 => f.flow[i].map(|v| byte(0.5 + 0.5 * v / FLOW_FULL_MPS)),
                        _ => {
                            let h = u32::from(f.instance[i]).wrapping_mul(2_654_435_761);
                            if f.instance[i] == 0 {
                                [0; 3]
                            } else {
                                [(h >> 24) as u8 | 64, (h >> 16) as u8, (h >> 8) as u8]
                            }
                        }
                    };
                    out.extend_from_slice(&pixel);
                }
            }
        }
    }
    out
}
