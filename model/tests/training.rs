//! Training end to end on a minuscule network: exact resume, learning, and refusal of what is not a number.
#![allow(clippy::unwrap_used)]

use candle_core::Device;
use storm_model::ModelConfig;
use storm_model::train::{ClipOptions, Stage, TrainError, TrainOptions, Trainer};
use storm_model::weights::untrained;

fn config() -> ModelConfig {
    ModelConfig {
        embed_dim: 32,
        depth: 1,
        num_heads: 2,
        image_height: 16,
        image_width: 24,
        upsampler_widths: vec![16, 16, 8],
        key_hidden: 8,
        basis_hidden: 8,
        num_motion_tokens: 4,
        ..ModelConfig::preset("tiny").unwrap()
    }
}

fn options(steps: u64) -> TrainOptions {
    let clips = ClipOptions { cameras: 3, width: 24, height: 16, timesteps: 2, ..ClipOptions::default() };
    TrainOptions { clips, one_camera_steps: 3, ..TrainOptions::new(5, steps, 2, 2e-3) }
}

fn trainer(options: TrainOptions) -> Trainer {
    Trainer::new(&config(), &untrained(&config(), 1, &Device::Cpu).unwrap(), options, &Device::Cpu).unwrap()
}

fn train(trainer: &mut Trainer, steps: u64) -> Vec<f64> {
    let data = trainer.data();
    let config = trainer.config().clone();
    (0..steps)
        .map(|_| {
            let clip = data.batch(trainer.steps_done(), &config).unwrap();
            trainer.step(&clip).unwrap().total
        })
        .collect()
}

#[test]
fn clips_are_learned_from_alike_on_any_number_of_threads() {
    let run = |threads: usize| {
        let options = TrainOptions { batch: 5, stage: Stage::Both, one_camera_steps: 0, ..options(3) };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut trainer = trainer(options);
            let losses = train(&mut trainer, 3);
            let weights = trainer.weights(false).unwrap();
            let bits = |x: &candle_core::Tensor| x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            let weights: Vec<u32> = weights.values().flat_map(bits).map(f32::to_bits).collect();
            (losses, weights)
        })
    };
    let one = run(1);
    assert!(one.0.iter().all(|x| x.is_finite()) && one == run(3));
}

#[test]
fn resumed_training_is_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    let mut whole = trainer(options(50));
    let losses = train(&mut whole, 50);
    assert!(losses.iter().all(|x| x.is_finite()));
    whole.save_checkpoint(&path("whole")).unwrap();

    let mut half = trainer(options(50));
    train(&mut half, 25);
    half.save_checkpoint(&path("half")).unwrap();
    drop(half);
    let mut rest = Trainer::resume(&path("half"), &Device::Cpu).unwrap();
    assert_eq!(rest.steps_done(), 25);
    assert_eq!(train(&mut rest, 25), losses[25..]);
    rest.save_checkpoint(&path("rest")).unwrap();
    let read = |name: &str| std::fs::read(path(name)).unwrap();
    assert!(read("whole") == read("rest"), "50 steps differ from 25 + 25");
    assert!(read("whole") != read("half"));
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 3, "temporary files are left");
}

#[test]
fn a_batch_can_be_learned() {
    let mut options = options(60);
    options.one_camera_steps = 60;
    let mut trainer = trainer(options);
    let clip = trainer.data().batch(0, &config()).unwrap();
    let losses: Vec<f64> = (0..60).map(|_| trainer.step(&clip).unwrap().total).collect();
    assert!(losses[59] < 0.7 * losses[0], "{} to {}", losses[0], losses[59]);
}

#[test]
fn what_is_not_a_number_ends_the_run_by_name() {
    let mut trainer = trainer(options(4));
    let mut clip = trainer.data().batch(0, &config()).unwrap();
    train(&mut trainer, 1);
    clip.context_truth.flow = (clip.context_truth.flow * f64::INFINITY).unwrap();
    let before = trainer.weights(false).unwrap();
    match trainer.step(&clip) {
        Err(TrainError::NonFinite { step: 1, tensor, batch_seed: 5, .. }) => assert_eq!(tensor, "loss flow"),
        other => panic!("{other:?}"),
    }
    let dir = tempfile::tempdir().unwrap();
    trainer.save_checkpoint(&dir.path().join("stopped.ckpt")).unwrap();
    let mut again = Trainer::resume(&dir.path().join("stopped.ckpt"), &Device::Cpu).unwrap();
    assert_eq!(again.steps_done(), 1);
    assert!(again.step(&clip).is_err());
    assert!(train(&mut again, 1)[0].is_finite());
    for (name, x) in trainer.weights(false).unwrap() {
        let values = |x: &candle_core::Tensor| x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(values(&x), values(&before[&name]), "{name}");
    }
}

#[test]
fn broken_checkpoints_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.ckpt");
    let trainer = trainer(options(4));
    trainer.save_checkpoint(&path).unwrap();
    let whole = std::fs::read(&path).unwrap();
    for cut in [0, 7, 100, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&path, &whole[..cut]).unwrap();
        let error = Trainer::resume(&path, &Device::Cpu).err().unwrap();
        assert!(matches!(error, TrainError::Checkpoint { .. }), "{error}");
    }
}
