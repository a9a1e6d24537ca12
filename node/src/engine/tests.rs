use storm_model::scene::Scene;

use super::evaluate::clip::Clip;
use super::*;

/// One by one and in one forward pass the same sums are done, perhaps in another order.
const BATCH_TOLERANCE: f32 = 1e-4;

fn numbers(scene: &Scene) -> Vec<(&'static str, Vec<f32>)> {
    let g = &scene.gaussians;
    vec![
        ("means", g.means.concat()),
        ("quats", g.quats.concat()),
        ("scales", g.scales.concat()),
        ("opacities", g.opacities.clone()),
        ("colors", g.colors.concat()),
        ("velocity_backward", g.velocity_backward.concat()),
        ("velocity_forward", g.velocity_forward.concat()),
        ("motion_weights", g.motion_weights.clone()),
        ("time_sec", g.time_sec.clone()),
        ("depths", scene.depths.clone()),
    ]
}

#[test]
fn a_batch_of_windows_gives_what_they_give_one_by_one() {
    let section = ModelConfigSection::default();
    let mut engine = Engine::new(ModelSource::open(&section).unwrap(), &section, 3, 2.0).unwrap();
    let clips: Vec<Clip> = (3..6).map(|seed| Clip::of_seed(seed, (48, 32), 0.0).unwrap()).collect();
    let windows: Vec<&Window<Frame>> = clips.iter().map(|c| &c.window).collect();
    // The drives' cameras differ from seed to seed; a replay's do not.
    let cameras = &clips[0].cameras;
    let together = engine.steps(&windows, cameras).unwrap();
    assert_eq!(together.len(), 3);
    let mut means = Vec::new();
    for (window, batched) in windows.iter().zip(together) {
        let (alone, batched) = (engine.step(window, cameras).unwrap(), batched.unwrap());
        for ((name, a), (_, b)) in numbers(&alone).iter().zip(numbers(&batched)) {
            assert_eq!(a.len(), b.len(), "{name}");
            let scale = |x: f32| x.abs().max(1.0);
            let worst = a.iter().zip(&b).map(|(x, y)| (x - y).abs() / scale(*x)).fold(0.0, f32::max);
            assert!(worst <= BATCH_TOLERANCE, "{name}: {worst}");
        }
        assert_eq!(alone.affine.len(), batched.affine.len());
        means.push(alone.gaussians.means);
    }
    assert!(means[0] != means[1] && means[1] != means[2], "different windows");
    assert!(engine.steps(&[], cameras).unwrap().is_empty());
}
