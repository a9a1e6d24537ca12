//! Pixels that show nothing, through everything that follows the pictures.

use super::*;
use crate::engine::ModelSource;
use crate::engine::evaluate::clip::Clip;
use crate::map::MapCloud;
use crate::pipeline::messages::{self, Published};

const SIZE: (usize, usize) = (48, 32);
/// The upper two patch rows show nothing.
const HIDDEN_ROWS: usize = 16;

/// The window of a clip whose upper rows show `color` of a pixel and timestep; `masked`: these rows are marked.
fn window(clip: &Clip, masked: bool, color: &dyn Fn(usize, usize) -> u8) -> Window<Frame> {
    let valid: Arc<[bool]> = (0..SIZE.0 * SIZE.1).map(|i| i / SIZE.0 >= HIDDEN_ROWS).collect();
    let mut window = clip.window.clone();
    for (t, set) in window.steps.iter_mut().enumerate() {
        let mut copy = (**set).clone();
        for frame in &mut copy.frames {
            let mut rgb = (*frame.item.rgb).clone();
            (0..3 * SIZE.0 * HIDDEN_ROWS).for_each(|i| rgb.data[i] = color(i / 3, t));
            frame.item = Frame { rgb: Arc::new(rgb), valid: masked.then(|| valid.clone()) };
        }
        *set = Arc::new(copy);
    }
    window
}

struct Left {
    flow: Vec<u8>,
    map: MapCloud,
    tracks: Vec<[f64; 3]>,
    scene: Arc<Scene>,
}

fn run(clip: &Clip, window: Window<Frame>) -> Left {
    let mut config = Config::default();
    // Whatever moves at all is followed.
    config.tracks.min_speed_mps = 0.05;
    let source = ModelSource::open(&config.model).unwrap();
    let engine = Engine::new(source, &config.model, 3, config.window.timespan_sec).unwrap();
    let mut maker = StepMaker::new(engine, clip.cameras.clone(), &config, None).unwrap();
    let step = maker.run(window).unwrap().unwrap();
    let flow = messages::flow(&step, &mut Published::default()).unwrap();
    let tracks = maker.tracks().iter().map(|t| t.end().position_map.to_array()).collect();
    Left { flow: flow.data, map: maker.map().cloud().unwrap(), tracks, scene: step.scene }
}

#[test]
fn what_stands_in_masked_pixels_reaches_nothing() {
    let clip = Clip::of_seed(3, SIZE, 0.0).unwrap();
    let noise = |i: usize, t: usize| ((i * 31 + t * 97) % 251) as u8;
    let (black, other) = (run(&clip, window(&clip, true, &|_, _| 0)), run(&clip, window(&clip, true, &noise)));
    assert_eq!(black.flow, other.flow);
    assert_eq!((&black.map.positions, &black.map.opacities), (&other.map.positions, &other.map.opacities));
    assert_eq!(black.tracks, other.tracks);
    assert!(!black.map.positions.is_empty());
    // One point a pixel of the newest pictures, cameras stacked; validity is the byte after six floats.
    let point_step = black.flow.len() / (3 * SIZE.0 * SIZE.1);
    let valid: Vec<u8> = black.flow.chunks_exact(point_step).map(|point| point[24]).collect();
    let hidden = |i: usize| i / SIZE.0 % SIZE.1 < HIDDEN_ROWS;
    assert!(valid.iter().enumerate().all(|(i, v)| *v == 0 || !hidden(i)));
    assert!(valid.contains(&1));
    // Without the mask it does reach everything.
    let (black, other) = (run(&clip, window(&clip, false, &|_, _| 0)), run(&clip, window(&clip, false, &noise)));
    assert_ne!(black.flow, other.flow);
    assert_ne!(black.map.positions, other.map.positions);
}

#[test]
fn masked_pixels_have_no_gaussians_and_are_no_sky() {
    let clip = Clip::of_seed(4, SIZE, 0.0).unwrap();
    let left = run(&clip, window(&clip, true, &|_, _| 90));
    let (scene, pixels) = (&left.scene, SIZE.0 * SIZE.1);
    for i in 0..scene.shape.len() {
        let hidden = i % pixels / SIZE.0 < HIDDEN_ROWS;
        assert_eq!(scene.is_valid(i), !hidden);
        assert!(!hidden || (scene.gaussians.opacities[i] == 0.0 && scene.gaussians.velocity_forward[i] == [0.0; 3]));
    }
}

#[test]
fn a_mask_that_hides_nothing_gives_the_same_bytes() {
    let clip = Clip::of_seed(3, SIZE, 0.0).unwrap();
    let mut marked = clip.window.clone();
    let valid: Arc<[bool]> = vec![true; SIZE.0 * SIZE.1].into();
    for set in &mut marked.steps {
        let mut copy = (**set).clone();
        copy.frames.iter_mut().for_each(|frame| frame.item.valid = Some(valid.clone()));
        *set = Arc::new(copy);
    }
    let (plain, marked) = (run(&clip, clip.window.clone()), run(&clip, marked));
    assert!(plain.scene.valid.is_empty(), "nothing is done where there is no mask");
    assert_eq!(plain.flow, marked.flow);
    assert_eq!(plain.map.positions, marked.map.positions);
    assert_eq!(plain.map.colors01, marked.map.colors01);
    assert_eq!(plain.tracks, marked.tracks);
}
