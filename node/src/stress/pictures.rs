//! What cameras deliver: darkness, glare, noise, exposure that jumps, frozen and missing pictures, numbers that are none.

use anyhow::Result;
use candle_core::Device;
use storm_model::{ClipBatch, PixelLayout, ViewInput};

use super::subject::{Subject, refused, refused_by_model, repainted};
use super::windows::F32;
use super::{Case, Finding, Sheet};
use crate::decode::image_to_rgb;
use crate::msg::Image;

pub fn run(subject: &mut Subject, found: &mut dyn FnMut(Case)) -> Result<()> {
    let cameras = subject.cameras.clone();
    let sets = subject.sets.clone();
    let stride = 0.5;
    let mut sheet = Sheet { group: "pictures", against: "f64 network, relative", limit: F32, found };
    let gain = |x: &[u8], gain: f32| x.iter().map(|&v| (gain * f32::from(v)) as u8).collect::<Vec<u8>>();
    type Change = Box<dyn Fn(usize, usize, &[u8]) -> Vec<u8>>;
    let changes: Vec<(&str, Change)> = vec![
        ("all 0 (a tunnel without light)", Box::new(|_, _, x| vec![0; x.len()])),
        ("all 255 (sun glare)", Box::new(|_, _, x| vec![255; x.len()])),
        (
            "one hot pixel on black",
            Box::new(|_, _, x| {
                let mut y = vec![0; x.len()];
                let middle = y.len() / 6 * 3;
                y[middle..middle + 3].fill(255);
                y
            }),
        ),
        (
            "every pixel black or white",
            Box::new(|c, t, x| {
                let noise = |k: usize| (k.wrapping_mul(2_654_435_761).wrapping_add(97 * c + 13 * t) >> 7) & 1;
                (0..x.len()).map(|k| if noise(k / 3) == 0 { 0 } else { 255 }).collect()
            }),
        ),
        ("exposure 1/16 and 8 times between cameras", Box::new(move |c, _, x| gain(x, [0.0625, 8.0][c % 2]))),
        ("exposure 1/16 and 8 times between timesteps", Box::new(move |_, t, x| gain(x, [0.0625, 8.0][t % 2]))),
        (
            "one camera white, the others as they are",
            Box::new(|c, _, x| if c == 0 { vec![255; x.len()] } else { x.to_vec() }),
        ),
    ];
    for (name, change) in changes {
        let window = subject.window(&repainted(&sets, change), stride)?;
        sheet.add(name, subject.compare(&window, &cameras));
    }
    let frozen: Vec<_> = sets
        .iter()
        .map(|set| {
            let mut set = set.clone();
            for (frame, first) in set.frames.iter_mut().zip(&sets[0].frames) {
                (frame.item, frame.map_from_camera) = (first.item.clone(), first.map_from_camera);
            }
            set
        })
        .collect();
    let window = subject.window(&frozen, stride)?;
    sheet.add("identical frames from a vehicle at rest", subject.compare(&window, &cameras));

    // A timestep that lacks a camera: the synchronizer never lets it through; if it did, the network must not guess.
    if cameras.len() > 1 {
        let mut window = subject.plain_window()?;
        let last = window.steps.len() - 1;
        let mut set = (*window.steps[last]).clone();
        set.frames.pop();
        window.steps[last] = set.into();
        sheet.add_refused("a timestep without one of its cameras", subject.compare(&window, &cameras));
    }
    let k = cameras[0];
    for (name, value) in [("NaN", f32::NAN), ("infinity", f32::INFINITY), ("-infinity", f32::NEG_INFINITY)] {
        let mut rgb = vec![0.0; 3 * k.width * k.height];
        rgb[7] = value;
        let view = ViewInput {
            rgb: &rgb,
            intrinsics: k,
            world_from_camera: glam::Affine3A::IDENTITY,
            time_sec: 0.0,
            valid: None,
        };
        let batch = ClipBatch::from_views(&[vec![view]], PixelLayout::Hwc, 2.0, &Device::Cpu);
        sheet.add_refused(
            format!("{name} in a picture of floats"),
            batch.map_or_else(refused_by_model, |_| Finding::default()),
        );
    }
    let floats = Image {
        encoding: "32FC3".into(),
        width: 2,
        height: 1,
        step: 24,
        data: f32::NAN.to_le_bytes().repeat(6),
        ..Image::default()
    };
    let decoded = image_to_rgb(&floats).map_err(anyhow::Error::from);
    sheet.add_refused("an image message of floats", decoded.map_or_else(|e| refused(&e), |_| Finding::default()));
    Ok(())
}
