//! Rectification against pictures whose every ray is known.

use proptest::prelude::*;

use super::*;
use crate::msg::Header;

const WIDTH: usize = 640;
const HEIGHT: usize = 400;
/// How far (output pixels) a rectified picture may sit from where its intrinsics say: 8-bit noise over 10,000 pixels and
/// the map's 1/256 pixel leave 0.01.
const SHIFT_TOLERANCE_PX: f64 = 0.01;
/// Root-mean-square grey levels: rounding twice (0.4) and bilinear sampling of the pattern's curvature.
const RMS_TOLERANCE: f64 = 1.0;

fn camera(model: &str, d: &[f64]) -> CameraInfo {
    CameraInfo {
        header: Header { stamp_ns: 0, frame_id: "cam".to_owned() },
        width: WIDTH as u32,
        height: HEIGHT as u32,
        distortion_model: model.to_owned(),
        d: d.to_vec(),
        k: [420.0, 0.0, 325.3, 0.0, 410.0, 196.2, 0.0, 0.0, 1.0],
        ..CameraInfo::default()
    }
}

fn with_p(mut info: CameraInfo, r: DQuat) -> CameraInfo {
    info.p = [380.0, 0.0, 310.0, 0.0, 0.0, 385.0, 205.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    info.r = DMat3::from_quat(r).transpose().to_cols_array();
    info
}

/// Grey level seen along rectified direction `(x, y, 1)`: periods of 60 pixels and more, so bilinear sampling is exact
/// to a fraction of a level.
fn pattern(x: f64, y: f64) -> f64 {
    128.0 + 55.0 * (30.0 * x + 4.0 * y).sin() + 50.0 * (26.0 * y - 7.0 * x + 1.0).sin()
}

/// The ray (z = 1) that lands on a point of the normalised plane: Newton steps with a numeric Jacobian.
fn unproject(lens: &Lens, target: (f64, f64)) -> DVec3 {
    let at = |x: f64, y: f64| lens.project(DVec3::new(x, y, 1.0)).unwrap();
    let (mut x, mut y) = target;
    // Quadratic convergence from the distorted point, which is close.
    for _ in 0..7 {
        let (fx, fy) = at(x, y);
        let h = 1e-6;
        let (ax, ay) = at(x + h, y);
        let (bx, by) = at(x, y + h);
        let (j00, j10, j01, j11) = ((ax - fx) / h, (ay - fy) / h, (bx - fx) / h, (by - fy) / h);
        let det = j00 * j11 - j01 * j10;
        let (ex, ey) = (target.0 - fx, target.1 - fy);
        x += (j11 * ex - j01 * ey) / det;
        y += (j00 * ey - j10 * ex) / det;
    }
    DVec3::new(x, y, 1.0)
}

/// What the camera sees: pixel (col, row) looks along OpenCV's point (col, row).
fn photograph(info: &CameraInfo, rectified_from_camera: DQuat) -> RgbPicture {
    let lens = Lens::from_info(info).unwrap();
    let mut data = Vec::with_capacity(WIDTH * HEIGHT * 3);
    for row in 0..HEIGHT {
        for col in 0..WIDTH {
            let plane = ((col as f64 - info.k[2]) / info.k[0], (row as f64 - info.k[5]) / info.k[4]);
            let ray = rectified_from_camera * unproject(&lens, plane);
            data.extend([pattern(ray.x / ray.z, ray.y / ray.z).round() as u8; 3]);
        }
    }
    RgbPicture { width: WIDTH, height: HEIGHT, data }
}

/// Offset of the picture from what `intrinsics` promise (output pixels) and the root-mean-square error, over the pixels
/// that are not black.
fn misfit(out: &RgbPicture, intrinsics: &Intrinsics) -> (f64, f64, f64) {
    let k = intrinsics;
    let mean = |col: f64, row: f64| {
        let n = 4;
        let sum: f64 = (0..n * n)
            .map(|s| {
                let u = col + (f64::from(s % n) + 0.5) / f64::from(n);
                let v = row + (f64::from(s / n) + 0.5) / f64::from(n);
                pattern((u - f64::from(k.cx)) / f64::from(k.fx), (v - f64::from(k.cy)) / f64::from(k.fy))
            })
            .sum();
        sum / f64::from(n * n)
    };
    let (mut a, mut b, mut c, mut p, mut q, mut square, mut n) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
    // Away from the border, where the camera may not see the whole pixel.
    // About 10,000 pixels are plenty.
    let stride = (out.width / 120).max(1);
    for row in (3..out.height - 3).step_by(stride) {
        for col in (3..out.width - 3).step_by(stride) {
            let around =
                [-3isize, 0, 3].iter().flat_map(|dr| [-3isize, 0, 3].map(|dc| (row as isize + dr, col as isize + dc)));
            if around.into_iter().any(|(r, c)| out.data[(r as usize * out.width + c as usize) * 3] == 0) {
                continue;
            }
            let (u, v) = (col as f64, row as f64);
            let (gx, gy) = (mean(u + 0.5, v) - mean(u - 0.5, v), mean(u, v + 0.5) - mean(u, v - 0.5));
            let e = f64::from(out.data[(row * out.width + col) * 3]) - mean(u, v);
            a += gx * gx;
            b += gx * gy;
            c += gy * gy;
            p += gx * e;
            q += gy * e;
            square += e * e;
            n += 1.0;
        }
    }
    assert!(n > 0.3 * (out.width * out.height / (stride * stride)) as f64, "only {n} pixels see anything");
    let det = a * c - b * b;
    ((c * p - b * q) / det, (a * q - b * p) / det, (square / n).sqrt())
}

#[test]
fn every_model_lands_where_its_intrinsics_say() {
    let turn = DQuat::from_euler(glam::EulerRot::ZYX, 0.02, -0.05, 0.03);
    let plumb = [-0.22, 0.06, 0.0011, -0.0013, -0.005];
    let rational = [0.4, -0.1, 0.001, -0.002, 0.02, 0.62, -0.02, 0.01];
    let fish = [0.03, -0.01, 0.004, -0.0005];
    for (name, info, turn) in [
        ("plumb_bob", camera("plumb_bob", &plumb), DQuat::IDENTITY),
        ("plumb_bob with P and R", with_p(camera("plumb_bob", &plumb), turn), turn),
        ("rational", camera("rational_polynomial", &rational), DQuat::IDENTITY),
        ("equidistant", camera("equidistant", &fish), DQuat::IDENTITY),
        ("equidistant with P and R", with_p(camera("equidistant", &fish), turn), turn),
        ("pinhole", camera("plumb_bob", &[0.0; 5]), DQuat::IDENTITY),
        ("pinhole with P", with_p(camera("", &[]), DQuat::IDENTITY), DQuat::IDENTITY),
        ("pinhole with P and R", with_p(camera("", &[]), turn), turn),
    ] {
        let photo = photograph(&info, turn);
        for (width, height) in [(160, 100), (96, 64), (333, 201), (700, 450)] {
            let rectifier = Rectifier::new(&info, false, width, height).unwrap();
            let out = rectifier.apply(&photo).unwrap();
            let (dx, dy, rms) = misfit(&out, &rectifier.intrinsics());
            assert!(dx.abs() < SHIFT_TOLERANCE_PX && dy.abs() < SHIFT_TOLERANCE_PX, "{name} {width}: {dx} {dy} {rms}");
            assert!(rms < RMS_TOLERANCE, "{name} {width}: {rms}");
            // The measure is no pushover: an eighth of a pixel is seen as such.
            let k = rectifier.intrinsics();
            let (dx, _, _) = misfit(&out, &Intrinsics { cx: k.cx + 0.125, ..k });
            assert!((dx.abs() - 0.125).abs() < 0.01, "{name} {width}: {dx}");
            match rectifier.rectification() {
                Some(q) => assert!(q.dot(turn).abs() > 1.0 - 1e-9 && turn != DQuat::IDENTITY),
                None => assert_eq!(turn, DQuat::IDENTITY, "{name}"),
            }
        }
    }
}

#[test]
fn both_paths_give_the_same_picture() {
    // A lens too weak to matter takes the general path.
    let weak = camera("plumb_bob", &[1e-12, 0.0, 0.0, 0.0, 0.0]);
    let none = camera("plumb_bob", &[0.0; 5]);
    let photo = photograph(&none, DQuat::IDENTITY);
    for (width, height) in [(160, 100), (96, 64)] {
        let general = Rectifier::new(&weak, false, width, height).unwrap();
        let separable = Rectifier::new(&none, false, width, height).unwrap();
        assert!(matches!((&general.path, &separable.path), (Path::Warp(_), Path::Separable { .. })));
        let (a, b) = (general.apply(&photo).unwrap(), separable.apply(&photo).unwrap());
        assert!(a.data.iter().zip(&b.data).all(|(a, b)| a.abs_diff(*b) <= 2));
        assert_eq!(general.intrinsics(), separable.intrinsics());
    }
}

#[test]
fn intrinsics_follow_window_binning_and_convention() {
    let mut info = camera("plumb_bob", &[0.0; 5]);
    let k = Rectifier::new(&info, false, 320, 100).unwrap().intrinsics();
    assert_eq!((k.fx, k.fy, k.cx, k.cy), (210.0, 102.5, ((325.3 + 0.5) / 2.0) as f32, ((196.2 + 0.5) / 4.0) as f32));
    info.roi = [100, 40, 200, 400];
    info.binning_x = 2;
    info.binning_y = 4;
    let r = Rectifier::new(&info, false, 200, 50).unwrap();
    assert_eq!(r.source_size(), (200, 50));
    let k = r.intrinsics();
    assert_eq!((k.fx, k.fy), (210.0, 102.5));
    assert!(
        (f64::from(k.cx) - (325.8 - 100.0) / 2.0).abs() < 1e-4 && (f64::from(k.cy) - (196.7 - 40.0) / 4.0).abs() < 1e-4
    );

    let rectified = with_p(camera("a_model_nobody_knows", &[1.0; 3]), DQuat::from_rotation_x(0.1));
    let r = Rectifier::new(&rectified, true, WIDTH, HEIGHT).unwrap();
    assert_eq!((r.intrinsics().fx, r.intrinsics().cy, r.rectification()), (380.0, 205.5, None));
    let picture = photograph(&camera("", &[]), DQuat::IDENTITY);
    assert_eq!(r.apply(&picture).unwrap(), picture, "a rectified picture at its own size is copied");
}

#[test]
fn cameras_that_are_none_are_refused_with_the_value() {
    let good = camera("plumb_bob", &[0.0; 5]);
    let says = |info: &CameraInfo, w: usize, h: usize, text: &str| {
        let e = Rectifier::new(info, false, w, h).unwrap_err().to_string();
        assert!(e.contains(text), "{e} should say {text}");
    };
    says(&CameraInfo { k: [0.0; 9], ..good.clone() }, 8, 8, "not calibrated");
    says(&CameraInfo { k: [f64::NAN; 9], ..good.clone() }, 8, 8, "fx NaN");
    says(&CameraInfo { k: [-5.0, 0.0, 1.0, 0.0, 5.0, 1.0, 0.0, 0.0, 1.0], ..good.clone() }, 8, 8, "fx -5");
    says(&CameraInfo { width: 0, ..good.clone() }, 8, 8, "size 0x400");
    says(&CameraInfo { width: u32::MAX, ..good.clone() }, 8, 8, "size 4294967295x400");
    says(&CameraInfo { roi: [600, 0, 100, 100], ..good.clone() }, 8, 8, "region of interest 100x100 at 600,0");
    says(&CameraInfo { roi: [u32::MAX, 0, 100, 100], ..good.clone() }, 8, 8, "region of interest");
    says(&CameraInfo { binning_x: 1000, ..good.clone() }, 8, 8, "binning 1000x1");
    says(&CameraInfo { distortion_model: "omni".to_owned(), ..good.clone() }, 8, 8, "`omni`");
    // Sound in f64, and infinite or nothing in the f32 of the network.
    let huge = CameraInfo { k: [20.0, 0.0, 1e300, 0.0, 20.0, 8.0, 0.0, 0.0, 1.0], ..good.clone() };
    says(&huge, 8, 8, "no camera's");
    let tiny = CameraInfo { k: [1e-300, 0.0, 9.0, 0.0, 20.0, 8.0, 0.0, 0.0, 1.0], ..good.clone() };
    says(&tiny, 8, 8, "no camera's");
    says(&good, 0, 8, "output size 0x8");
    says(&good, 8, usize::MAX, "output size 8x");
    let mut bad_r = with_p(good.clone(), DQuat::IDENTITY);
    bad_r.r[0] = 2.0;
    says(&bad_r, 8, 8, "R is not a rotation");
    bad_r.r[0] = f64::NAN;
    says(&bad_r, 8, 8, "R is not a rotation");
    let mut skewed = good.clone();
    skewed.k[1] = 3.0;
    says(&skewed, 8, 8, "skew 3");
    skewed.k[1] = f64::NAN;
    says(&skewed, 8, 8, "skew NaN");
    skewed.k[1] = 0.0;
    skewed.k[3] = -2.0;
    says(&skewed, 8, 8, "skew -2");
    // What a solver leaves behind is none: 2.8e-14 moves no pixel.
    let mut rounding = with_p(good.clone(), DQuat::IDENTITY);
    (rounding.p[1], rounding.k[1]) = (-2.842_170_943_040_401e-14, 1e-9);
    let exact = Rectifier::new(&with_p(good.clone(), DQuat::IDENTITY), false, 8, 8).unwrap();
    assert_eq!(Rectifier::new(&rounding, false, 8, 8).unwrap().intrinsics(), exact.intrinsics());
    // P alone describes rectified pictures; raw ones want K.
    let no_k = CameraInfo { k: [0.0; 9], ..with_p(good.clone(), DQuat::IDENTITY) };
    assert_eq!(Rectifier::new(&no_k, true, 8, 8).unwrap().intrinsics(), exact.intrinsics());
    says(&no_k, 8, 8, "input.rectified");
    // A P with nothing but its last 1 is unset.
    let mut no_p = good.clone();
    no_p.p[10] = 1.0;
    let plain = Rectifier::new(&good, false, 8, 8).unwrap();
    assert_eq!(Rectifier::new(&no_p, false, 8, 8).unwrap().intrinsics(), plain.intrinsics());

    let r = Rectifier::new(&good, false, 8, 8).unwrap();
    let e = r.apply(&RgbPicture { width: 320, height: 200, data: vec![0; 192_000] }).unwrap_err().to_string();
    assert!(e.contains("320x200") && e.contains("640x400"), "{e}");
    assert!(r.apply(&RgbPicture { width: WIDTH, height: HEIGHT, data: vec![0; 3] }).is_err());
}

#[test]
fn beyond_the_fold_and_outside_is_black() {
    // Folds back at a tangent of 0.58: the corners of a wide output would show a ghost ring.
    let mut info = camera("plumb_bob", &[-1.0, 0.0, 0.0, 0.0, 0.0]);
    info.p = [120.0, 0.0, 319.5, 0.0, 0.0, 120.0, 199.5, 0.0, 0.0, 0.0, 1.0, 0.0];
    let white = RgbPicture { width: WIDTH, height: HEIGHT, data: vec![255; WIDTH * HEIGHT * 3] };
    let r = Rectifier::new(&info, false, 64, 40).unwrap();
    let out = r.apply(&white).unwrap();
    let k = r.intrinsics();
    for (i, p) in out.data.chunks(3).enumerate() {
        let ray = k.ray((i % 64) as f32 + 0.5, (i / 64) as f32 + 0.5);
        let tan = ray.x.hypot(ray.y);
        if tan > 0.7 {
            assert_eq!(p, [0; 3], "{tan}");
        } else if tan < 0.5 {
            assert_eq!(p, [255; 3], "{tan}");
        }
    }
}

/// Where a point of the output (pixel edges at integers) lies in the source picture; none where the lens does not see it.
fn source_point(
    info: &CameraInfo,
    lens: &Lens,
    (u, v): (f64, f64),
    (width, height): (usize, usize),
) -> Option<(f64, f64)> {
    let (u, v) = (u * WIDTH as f64 / width as f64, v * HEIGHT as f64 / height as f64);
    let x = (u - info.p[2] - HALF_PIXEL) / info.p[0];
    let y = (v - info.p[6] - HALF_PIXEL) / info.p[5];
    let r = DMat3::from_cols_array(&info.r).transpose();
    let ray = r.transpose() * DVec3::new(x, y, 1.0);
    let (x, y) = lens.project(ray).filter(|_| lens.off_axis(ray) <= lens.limit())?;
    Some((info.k[0] * x + info.k[2] + HALF_PIXEL, info.k[4] * y + info.k[5] + HALF_PIXEL))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// A pixel is valid exactly when its source lies within the source picture; pixels that straddle its edge may be either.
    #[test]
    fn valid_pixels_are_those_whose_source_is_in_the_picture(
        model in 0usize..3, bend in -0.3f64..0.3, zoom in 0.5f64..1.3, turn in -0.1f64..0.1,
        shift in -60.0f64..60.0, (width, height) in (8usize..70, 8usize..50),
    ) {
        let mut info = match model {
            0 => camera("plumb_bob", &[bend, 0.0, 0.001, -0.001, 0.0]),
            1 => camera("equidistant", &[0.1 * bend, 0.0, 0.0, 0.0]),
            _ => camera("", &[]),
        };
        info.p = [420.0 * zoom, 0.0, 320.0 + shift, 0.0, 0.0, 410.0 * zoom, 200.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        let turn = if model == 2 { DQuat::IDENTITY } else { DQuat::from_rotation_y(turn) };
        info.r = DMat3::from_quat(turn).transpose().to_cols_array();
        let lens = Lens::from_info(&info).unwrap();
        let rectifier = Rectifier::new(&info, false, width, height).unwrap();
        let inside = rectifier.inside();
        prop_assert_eq!(inside.len(), width * height);
        let within = |p: Option<(f64, f64)>| {
            p.is_some_and(|(x, y)| (0.0..=WIDTH as f64).contains(&x) && (0.0..=HEIGHT as f64).contains(&y))
        };
        // Rectifying white shows what rectifying looked at.
        let white = RgbPicture { width: WIDTH, height: HEIGHT, data: vec![255; WIDTH * HEIGHT * 3] };
        let out = rectifier.apply(&white).unwrap();
        for (i, &valid) in inside.iter().enumerate() {
            let (col, row) = ((i % width) as f64, (i / width) as f64);
            let looks = |step: f64| (0..9).map(move |k| (col + 0.5 + step * f64::from(k % 3 - 1), row + 0.5 + step * f64::from(k / 3 - 1)));
            let seen = |p: (f64, f64)| within(source_point(&info, &lens, p, (width, height)));
            if looks(0.5).all(seen) {
                prop_assert!(valid, "pixel {} of {}x{}", i, width, height);
            } else if !looks(0.5).any(seen) {
                prop_assert!(!valid, "pixel {} of {}x{}", i, width, height);
            }
            prop_assert!(!valid || out.data[3 * i] == 255, "a valid pixel is seen");
        }
        // A mask over the source's left half hides what comes from there and nothing else.
        let right: Vec<bool> = (0..WIDTH * HEIGHT).map(|i| i % WIDTH >= WIDTH / 2).collect();
        for (i, shown) in rectifier.carry(&right).into_iter().enumerate() {
            let at = source_point(&info, &lens, ((i % width) as f64 + 0.5, (i / width) as f64 + 0.5), (width, height));
            // A footprint's width away from the edge of the mask.
            let (Some((x, _)), reach) = (at, 2.0 * WIDTH as f64 / width as f64 / zoom.min(1.0)) else { continue };
            if inside[i] && (x - WIDTH as f64 / 2.0).abs() > reach {
                prop_assert_eq!(shown, x > WIDTH as f64 / 2.0, "pixel {}", i);
            }
        }
    }
}

proptest! {
    /// Region of interest and binning against the definition: a ray's pixel under the full picture's P, cut out and scaled.
    #[test]
    fn rays_land_where_window_and_binning_put_them(
        x in 0u32..300, y in 0u32..200, cut_w in 60u32..300, cut_h in 60u32..200, bx in 1u32..5, by in 1u32..5,
        out in (8usize..300, 8usize..300), ray in (-0.6..0.6f64, -0.4..0.4f64), whole in any::<bool>(), already in any::<bool>(),
    ) {
        let mut info = with_p(camera("plumb_bob", &[-0.2, 0.05, 0.0, 0.0, 0.0]), DQuat::from_rotation_y(0.02));
        info.roi = if whole { [0; 4] } else { [x, y, cut_h, cut_w] };
        (info.binning_x, info.binning_y) = (bx, by);
        let (x, y, w, h) = if whole { (0, 0, WIDTH as u32, HEIGHT as u32) } else { (x, y, cut_w, cut_h) };
        let r = Rectifier::new(&info, already, out.0, out.1).unwrap();
        prop_assert_eq!(r.source_size(), ((w / bx) as usize, (h / by) as usize));
        let k = r.intrinsics();
        let at = |p: f64, c: f64, ray: f64, start: u32, binning: u32, size: usize, source: usize| {
            // OpenCV's pixel centres are whole numbers, ours lie half a pixel on.
            (p * ray + c + 0.5 - f64::from(start)) / f64::from(binning) * size as f64 / source as f64
        };
        let want = (
            at(info.p[0], info.p[2], ray.0, x, bx, out.0, r.source_size().0),
            at(info.p[5], info.p[6], ray.1, y, by, out.1, r.source_size().1),
        );
        let got = (f64::from(k.fx) * ray.0 + f64::from(k.cx), f64::from(k.fy) * ray.1 + f64::from(k.cy));
        prop_assert!((got.0 - want.0).abs() < 1e-3 && (got.1 - want.1).abs() < 1e-3, "{:?} {:?}", got, want);
    }
}

/// Cut first or rectify first: the same picture where both see it.
#[test]
fn a_cut_picture_is_rectified_as_its_part_of_the_whole() {
    let turn = DQuat::from_euler(glam::EulerRot::ZYX, 0.01, -0.02, 0.015);
    let whole = with_p(camera("plumb_bob", &[-0.22, 0.06, 0.0011, -0.0013, -0.005]), turn);
    let photo = photograph(&whole, turn);
    let [x, y, h, w] = [96usize, 48, 280, 420];
    let cut = CameraInfo { roi: [x as u32, y as u32, h as u32, w as u32], ..whole.clone() };
    let rows = (y..y + h).flat_map(|row| photo.data[(row * WIDTH + x) * 3..(row * WIDTH + x + w) * 3].iter().copied());
    let part = RgbPicture { width: w, height: h, data: rows.collect() };
    let all = Rectifier::new(&whole, false, WIDTH, HEIGHT).unwrap().apply(&photo).unwrap();
    let got = Rectifier::new(&cut, false, w, h).unwrap().apply(&part).unwrap();
    let mut compared = 0;
    // Away from the cut's border, beyond which only the whole picture sees.
    for (row, col) in (30..h - 30).flat_map(|row| (40..w - 40).map(move |col| (row, col))) {
        let (a, b) = (got.data[(row * w + col) * 3], all.data[((row + y) * WIDTH + col + x) * 3]);
        assert!(a.abs_diff(b) <= 1, "{row} {col}: {a} {b}");
        compared += 1;
    }
    assert!(compared > 70_000);
}
