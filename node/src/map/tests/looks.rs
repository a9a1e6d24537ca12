//! Looks at a wall: exposure, noise, nearer looks, and what rays pass through.

use super::*;

/// Two cameras see one wall, each with its own exposure; the network's colours are before exposure, and how bright those are
/// is its own choice in every window. Merged, the wall has the colour that the cameras show on average.
#[test]
fn exposure_is_undone_before_colours_merge() {
    let gain = |x: f32| Affine { matrix: [[x, 0.0, 0.0], [0.0, x, 0.0], [0.0, 0.0, x]], bias: [0.0; 3] };
    let (one, k) = wall(24, 8.0, |_| 0.0);
    // As the pictures have it, the mean of both cameras: -1 to 1.
    let shown = [0.5f32, -0.2, 0.1];
    let pose = Rigid::IDENTITY;
    let camera = pose * crate::window::camera_from_flu().inverse();
    let fuse = |map: &mut StaticMap, step: i64, gains: [f32; 2]| {
        let mean = 0.5 * (gains[0] + gains[1]);
        let mut g = Gaussians::default();
        for _ in gains {
            g.means.extend(&one.means);
            g.quats.extend(&one.quats);
            g.scales.extend(&one.scales);
            g.opacities.extend(&one.opacities);
            g.colors.extend(one.colors.iter().map(|_| shown.map(|c| c / mean)));
        }
        let still = vec![[0.0; 3]; g.len()];
        (g.velocity_backward, g.velocity_forward, g.time_sec) = (still.clone(), still, vec![0.0; g.len()]);
        let scene = Scene {
            depths: vec![8.0; g.len()],
            gaussians: g,
            shape: SceneShape { timesteps: 1, cameras: 2, height: 24, width: 24 },
            valid: Vec::new(),
            sky: None,
            affine: gains.map(gain).to_vec(),
            motion_bases: Vec::new(),
            config: ModelConfig::preset("tiny").unwrap().into(),
        };
        let counts = map.fuse_scene(&SceneLook {
            stamp_ns: step * 100_000_000,
            map_from_anchor: &pose,
            scene: &scene,
            cameras: &[k, k],
            poses: &[camera, camera],
            rendered: &[],
            confidence: &[],
            first_new: 0,
        });
        assert!(counts.created + counts.merged > 500, "{counts:?}");
    };
    let mut map = StaticMap::new(&MapConfig::default());
    // The second camera much brighter; then the network takes everything for darker, then for brighter.
    for (step, gains) in [[0.6, 1.4], [0.9, 2.1], [0.5, 0.7]].into_iter().enumerate() {
        fuse(&mut map, step as i64, gains);
    }
    let wanted = color01(&shown);
    let cloud = map.cloud().unwrap();
    let worst = cloud.colors01.iter().flat_map(|c| (0..3).map(|k| (c[k] - wanted[k]).abs())).fold(0.0, f32::max);
    assert!(cloud.len() > 100 && worst < 1e-4, "{worst}");
}

#[test]
fn repeated_noisy_looks_sharpen_instead_of_thicken() {
    let mut map = StaticMap::new(&MapConfig::default());
    // 1 % of noise in depth, inside the gate of 2 % for 19 in 20.
    // By confidence: what was seen once counts once.
    let spread = |map: &StaticMap| {
        let c = bare_cloud(map);
        let mass: f64 = c.confidences.iter().map(|w| f64::from(*w)).sum();
        let off = c.positions.iter().zip(&c.confidences).map(|(p, w)| f64::from(*w) * f64::from(p[0] - 10.0).powi(2));
        (off.sum::<f64>() / mass).sqrt()
    };
    let mut first = (0.0, 0);
    for step in 0..40 {
        let mut r = Numbers(1000 + step);
        let noise: Vec<f32> = (0..4096).map(|_| 0.1 * (r.next() + r.next() + r.next() - 1.5) * 2.0).collect();
        let (g, k) = wall(64, 10.0, |i| noise[i]);
        look(&mut map, 100 * step as i64, DVec3::ZERO, &g, &k);
        if step == 0 {
            first = (spread(&map), map.len());
        }
    }
    assert!(first.0 > 0.05 && spread(&map) < 0.5 * first.0, "{} then {}", first.0, spread(&map));
    assert!(map.len() < 3 * first.1 / 2, "{} then {}", first.1, map.len());
    check(&map);
}

#[test]
fn near_looks_replace_far_ones() {
    let mut map = StaticMap::new(&MapConfig::default());
    // The same wall at x = 40 m, seen from 40 m and from 5 m.
    let (far, k) = wall(64, 40.0, |_| 0.0);
    look(&mut map, 0, DVec3::ZERO, &far, &k);
    let before = map.cloud().unwrap();
    let (near, k) = wall(64, 5.0, |_| 0.0);
    let counts = look(&mut map, 100, DVec3::new(35.0, 0.0, 0.0), &near, &k);
    assert!(counts.refined > 10, "{counts:?}");
    let c = map.cloud().unwrap();
    let inside = |p: &[f32; 3]| p[1].abs() < 4.0 && p[2].abs() < 4.0;
    let sizes: Vec<f32> = (0..c.len()).filter(|&i| inside(&c.positions[i])).map(|i| c.scales[i][0]).collect();
    let largest = sizes.iter().copied().fold(0.0, f32::max);
    let smallest = before.scales.iter().map(|s| s[0]).fold(f32::INFINITY, f32::min);
    assert!(largest < 0.25 && smallest > 0.5 && sizes.len() > 500, "{largest} {smallest} {}", sizes.len());
    // And a far look afterwards neither coarsens nor multiplies.
    let n = map.len();
    look(&mut map, 200, DVec3::ZERO, &far, &k);
    assert!(map.len() <= n + n / 20, "{n} then {}", map.len());
    check(&map);
}

#[test]
fn what_rays_pass_through_goes_and_what_nobody_sees_stays() {
    let mut map = StaticMap::new(&MapConfig::default());
    let (car, k) = wall(64, 8.0, |_| 0.0);
    // It stood for a minute.
    (0..600).for_each(|i| {
        look(&mut map, 100 * i, DVec3::ZERO, &car, &k);
    });
    let stood = map.len();
    // Nobody looks for an hour: somewhere else the same is seen.
    (0..5).for_each(|i| {
        look(&mut map, 3_600_000 + 100 * i, DVec3::new(0.0, 500.0, 0.0), &car, &k);
    });
    assert_eq!(map.len(), 2 * stood);
    let (wall_behind, k) = wall(64, 20.0, |_| 0.0);
    let mut carved = 0;
    (0..8).for_each(|i| carved += look(&mut map, 3_700_000 + 100 * i, DVec3::ZERO, &wall_behind, &k).carved);
    let left = map.cloud().unwrap();
    let ghosts = left.positions.iter().filter(|p| p[0] < 12.0 && p[1] < 100.0).count();
    // What is at the picture's border is not judged.
    assert!(ghosts * 10 < stood && carved > 0, "{ghosts} of {stood} left");
    check(&map);
}
