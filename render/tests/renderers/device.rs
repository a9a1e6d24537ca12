//! What only a device can do: keep buffers, grow them, run out of them, tell the time, be missing.

use super::backends::with_device;
use super::scenes::{Kind, Scene, bits, front_view, turned_view};
use storm_render::gpu::{GpuError, GpuOptions, GpuRasterizer, SOFTWARE_ADAPTER};
use storm_render::raster::{Channels, RasterError, RasterSettings};
use storm_render::renderer::{RenderError, Renderer};

fn new_with(adapter_name: &str) -> Result<GpuRasterizer, RenderError> {
    let options = GpuOptions { adapter_name: Some(adapter_name.into()), ..GpuOptions::default() };
    GpuRasterizer::new(RasterSettings::default(), &options)
}

#[test]
fn without_an_adapter_the_error_says_what_there_is_and_what_to_install() {
    let Err(error) = new_with("an adapter nobody makes") else { panic!("opened") };
    let message = error.to_string();
    println!("{message}");
    assert!(matches!(error, RenderError::Gpu(GpuError::NoAdapter { .. })));
    assert!(message.contains("an adapter nobody makes") && message.contains(SOFTWARE_ADAPTER));
    assert_eq!(message.lines().count(), 1);
    with_device(RasterSettings::default(), |gpu| {
        // There is one, so it is listed with the reason it was not taken.
        let name = gpu.describe();
        assert!(message.contains(name.split(" (").next().unwrap()), "{message}");
    });
}

#[test]
fn settings_that_mean_nothing_are_refused_before_any_adapter_is_looked_for() {
    let settings = RasterSettings { near: f32::NAN, ..RasterSettings::default() };
    let refused = GpuRasterizer::new(settings, &GpuOptions::default());
    assert!(matches!(refused, Err(RenderError::Raster(RasterError::Setting { name: "near", .. }))));
}

#[test]
fn equal_requests_give_equal_bits_and_reused_buffers_leave_no_trace() {
    with_device(RasterSettings::default(), |gpu| {
        let (big, small) = (Scene::random(8, Kind::Mixed, 9000, 4), Scene::random(9, Kind::Mixed, 300, 2));
        let small_first = gpu.render(&small.splats(), &[front_view(50, 30)]).unwrap();
        let views = [front_view(100, 80), front_view(33, 20)];
        let big_first = gpu.render(&big.splats(), &views).unwrap();
        let small_again = gpu.render(&small.splats(), &[front_view(50, 30)]).unwrap();
        let big_again = gpu.render(&big.splats(), &views).unwrap();
        assert_eq!(bits(&small_first), bits(&small_again));
        assert_eq!(bits(&big_first), bits(&big_again));
    });
}

#[test]
fn batches_of_views_equal_single_views() {
    with_device(RasterSettings::default(), |gpu| {
        let scene = Scene::random(12, Kind::Mixed, 600, 3);
        // More than one batch of commands, of different sizes.
        let views: Vec<_> = (0..21).map(|i| turned_view(17 + 3 * i, 40 - i, 0.05 * i as f32 - 0.5)).collect();
        gpu.upload(&scene.splats()).unwrap();
        let together = gpu.render_uploaded(&views).unwrap();
        let visible = gpu.stats().visible;
        let mut alone_visible = 0;
        for (view, picture) in views.iter().zip(&together) {
            let alone = gpu.render_uploaded(&[*view]).unwrap();
            alone_visible += gpu.stats().visible;
            assert_eq!(bits(&alone), bits(std::slice::from_ref(picture)));
        }
        assert_eq!(visible, alone_visible);
    });
}

#[test]
fn tile_lists_grow_when_a_view_needs_more() {
    with_device(RasterSettings::default(), |gpu| {
        // 3000 splats over all 40 x 30 tiles: 3.6 million entries, far more than there is room for at first.
        let mut scene = Scene::copies(3000, 1);
        scene.scales = vec![[1e4; 3]; 3000];
        scene.opacities = vec![0.8; 3000];
        scene.features = (0..3000).map(|i| if i < 5 { 1.0 } else { 0.0 }).collect();
        let pictures = gpu.render(&scene.splats(), &[front_view(640, 480)]).unwrap();
        assert_eq!(gpu.stats().pairs, 3000 * 40 * 30);
        // 0.2^5 > 1e-4 >= 0.2^6.
        let expected = 1.0 - 0.2f32.powi(5);
        assert!(pictures[0].alpha.iter().all(|&a| (a - expected).abs() < 1e-5), "{}", pictures[0].alpha[0]);
        // All are equally far, so the first five of the array are what every tile shows: long sorts are stable.
        assert!(pictures[0].features.iter().zip(&pictures[0].alpha).all(|(c, a)| (c - a).abs() < 1e-6));
    });
}

#[test]
fn what_does_not_fit_the_device_is_refused() {
    with_device(RasterSettings::default(), |gpu| {
        let scene = Scene::copies(1, 3);
        let error = gpu.render(&scene.splats(), &[front_view(8192, 4096)]).unwrap_err();
        println!("{error}");
        assert!(matches!(error, RenderError::Gpu(GpuError::TooLarge { .. })), "{error}");
        // More list entries than a buffer can hold: 40,000 splats over 64 x 64 tiles.
        let mut scene = Scene::copies(40_000, 0);
        scene.scales = vec![[1e4; 3]; 40_000];
        let error = gpu.render(&scene.splats(), &[front_view(1024, 1024)]).unwrap_err();
        println!("{error}");
        let RenderError::Gpu(GpuError::TooLarge { value, .. }) = error else { panic!("{error}") };
        assert_eq!(value, 40_000 * 64 * 64);
        assert!(gpu.render(&Scene::copies(1, 3).splats(), &[front_view(8, 8)]).is_ok());
    });
}

#[test]
fn channels_that_do_not_fit_a_binding_go_through_several() {
    let settings = RasterSettings::default();
    let mut scene = Scene::random(6, Kind::Mixed, 2000, 22);
    // One that only the last part of the features tells.
    scene.features[22 * 7 + 21] = f32::NAN;
    scene.features[22 * 7 + 1] = f32::INFINITY;
    let views = [front_view(120, 90), front_view(40, 30)];
    with_device(settings, |gpu| {
        let whole = gpu.render(&scene.splats(), &views).unwrap();
        let stats = gpu.stats();
        // 8,000 bytes a channel of the Gaussians, so two parts of 12 and 10; 43,200 a channel of the picture, so pairs.
        let options = GpuOptions { binding_bytes: Some(100_000), ..GpuOptions::default() };
        let mut small = GpuRasterizer::new(settings, &options).unwrap();
        let parts = small.render(&scene.splats(), &views).unwrap();
        assert_eq!(bits(&parts), bits(&whole));
        assert_eq!((small.stats(), stats.invalid), (stats, 1));
        // A range across the parts, after other numbers of channels.
        let name = small.load(&scene.splats(), None).unwrap();
        let some = small.draw(name, 0.0, &Channels(10..15), &views).unwrap();
        let wanted: Vec<f32> = whole[0].features.chunks_exact(22).flat_map(|row| &row[10..15]).copied().collect();
        assert_eq!(some[0].features, wanted);
        // Not even one channel of this picture fits.
        let error = small.draw(name, 0.0, &Channels(0..1), &[front_view(400, 300)]).unwrap_err();
        assert!(matches!(error, RenderError::Gpu(GpuError::TooLarge { .. })), "{error}");
    });
}

#[test]
fn timings_cover_the_stages_where_the_adapter_has_them() {
    with_device(RasterSettings::default(), |gpu| {
        gpu.render(&Scene::random(5, Kind::Mixed, 5000, 3).splats(), &[front_view(120, 80)]).unwrap();
        match gpu.timings() {
            Some(timings) => {
                println!("{timings:?}");
                assert!(timings.blend_ms > 0.0 && timings.project_ms > 0.0);
                assert!(timings.total_ms() < 60_000.0);
            }
            None => println!("SKIPPED: {} has no timestamps", gpu.describe()),
        }
    });
}

/// The size of STORM's own work: 460,800 pixel-aligned Gaussians into three views. Figures for a report, no judgement.
#[test]
#[ignore = "prints times; run with --ignored --nocapture"]
fn times_of_a_window() {
    use storm_render::raster::CpuRasterizer;
    let views = [turned_view(240, 160, -0.4), front_view(240, 160), turned_view(240, 160, 0.4)];
    for n in [10_000, 50_000, 460_800] {
        let mut scene = Scene::random(1, Kind::Mixed, n, 3);
        // As many Gaussians more, as much smaller.
        let shrink = (10_000.0 / n as f32).sqrt();
        scene.scales.iter_mut().flatten().for_each(|s| *s *= shrink);
        let mut cpu = CpuRasterizer::new(RasterSettings::default()).unwrap();
        with_device(RasterSettings::default(), |gpu| {
            for _ in 0..2 {
                let start = std::time::Instant::now();
                gpu.upload(&scene.splats()).unwrap();
                let uploaded = start.elapsed();
                gpu.render_uploaded(&views).unwrap();
                let device = start.elapsed() - uploaded;
                let start = std::time::Instant::now();
                cpu.render(&scene.splats(), &views).unwrap();
                println!("{n}: upload {uploaded:?}, device {device:?}, CPU {:?}", start.elapsed());
                println!("  {:?}, {} entries", gpu.timings(), gpu.stats().pairs);
            }
        });
    }
}
