//! `storm train` from end to end on a minuscule network: resuming, signals, what is not a number, recordings.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use candle_core::{Device, Tensor};
use common::{code, shared, stderr, storm, synth};
use storm_model::ModelConfig;
use storm_model::train::{Trainer, provenance};
use storm_model::weights::{SavedType, Tensors, save_safetensors, untrained};

/// How long a child may take to start training on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);

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

/// A weights file of the minuscule network, changed by `edit`.
fn weights(folder: &Path, edit: impl Fn(&mut Tensors)) -> PathBuf {
    let path = folder.join("start.safetensors");
    let mut tensors = untrained(&config(), 1, &Device::Cpu).unwrap();
    edit(&mut tensors);
    save_safetensors(&path, &config(), &tensors, SavedType::F32, "made by a test").unwrap();
    path
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// `storm train` into `out` without validation drives.
fn train(out: &Path, more: &[&str]) -> std::process::Output {
    let mut args = vec!["--quiet", "train", "--validate-drives", "0", "--out", text(out)];
    args.extend(more);
    storm(&args)
}

fn same(a: &Path, b: &Path) -> bool {
    std::fs::read(a).unwrap() == std::fs::read(b).unwrap()
}

fn steps_of(losses: &Path) -> Vec<u64> {
    let text = std::fs::read_to_string(losses).unwrap();
    text.lines().skip(1).map(|l| l.split(',').next().unwrap().parse().unwrap()).collect()
}

#[test]
fn a_resumed_run_ends_in_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let start = weights(dir.path(), |_| ());
    let (whole, parts) = (dir.path().join("whole"), dir.path().join("parts"));
    let options = ["--weights", text(&start), "--steps", "50", "--batch", "1", "--seed", "3", "--lr", "1e-3"];
    let output = train(&whole, &options);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let output = train(&parts, &[&options[..], &["--stop-at", "25"]].concat());
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    assert_eq!(steps_of(&parts.join("losses.csv")).len(), 25);
    assert!(!same(&whole.join("last.ckpt"), &parts.join("last.ckpt")));
    let output = train(&parts, &["--resume", text(&parts.join("last.ckpt"))]);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    for file in ["last.ckpt", "weights.safetensors"] {
        assert!(same(&whole.join(file), &parts.join(file)), "{file}: 50 steps differ from 25 + 25");
    }
    assert_eq!(steps_of(&parts.join("losses.csv")), (0..50).collect::<Vec<_>>());
}

#[cfg(unix)]
#[test]
fn sigterm_and_sigint_keep_what_was_done() {
    let dir = tempfile::tempdir().unwrap();
    let start = weights(dir.path(), |_| ());
    for signal in ["-TERM", "-INT"] {
        let out = dir.path().join(signal);
        let options = ["--weights", text(&start), "--steps", "100000", "--batch", "1", "--one-camera-steps", "100000"];
        let mut child = Command::new(env!("CARGO_BIN_EXE_storm"))
            .args(["--quiet", "train", "--loader-threads", "1", "--out", text(&out)])
            .args(options)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let begin = Instant::now();
        let losses = out.join("losses.csv");
        while !losses.exists() || steps_of(&losses).len() < 3 {
            assert!(begin.elapsed() < PATIENCE, "no step was done");
            assert!(child.try_wait().unwrap().is_none(), "the run ended by itself");
            std::thread::sleep(Duration::from_millis(20));
        }
        let sent = Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap();
        assert!(sent.success());
        assert_eq!(child.wait().unwrap().code(), Some(0), "{signal}");
        let steps = Trainer::resume(&out.join("last.ckpt"), &Device::Cpu).unwrap().steps_done();
        assert_eq!(steps, steps_of(&losses).len() as u64);
        // The same run ended there on purpose.
        let wanted = dir.path().join("wanted");
        let output = train(&wanted, &[&options[..], &["--stop-at", &steps.to_string()]].concat());
        assert_eq!(code(&output), 0, "{}", stderr(&output));
        for file in ["last.ckpt", "weights.safetensors"] {
            assert!(same(&out.join(file), &wanted.join(file)), "{signal}: {file}");
        }
    }
}

#[test]
fn what_is_not_a_number_ends_the_run_and_leaves_a_checkpoint() {
    let dir = tempfile::tempdir().unwrap();
    // Depths overflow in the first forward pass.
    let start = weights(dir.path(), |tensors| {
        let (name, x) = tensors.iter().find(|(name, _)| name.contains("gs_pred") && name.ends_with("weight")).unwrap();
        let (name, spoiled) = (name.clone(), (x.ones_like().unwrap() * 3e38).unwrap());
        tensors.insert(name, spoiled);
    });
    let out = dir.path().join("out");
    let output =
        train(&out, &["--weights", text(&start), "--lambda-reg", "0", "--steps", "5", "--batch", "1", "--seed", "77"]);
    assert_eq!(code(&output), 2, "{}", stderr(&output));
    let said = stderr(&output);
    for word in ["step 0", "non-finite", "batch seed 77", "--lr"] {
        assert!(said.contains(word), "{said}");
    }
    assert!(said.contains("loss ") || said.contains("gradient of "), "{said}");
    assert_eq!(Trainer::resume(&out.join("stopped.ckpt"), &Device::Cpu).unwrap().steps_done(), 0);
    assert!(!out.join("weights.safetensors").exists(), "broken weights were written");
}

#[test]
fn without_regulariser_a_run_trains_or_says_where_it_ended() {
    let dir = tempfile::tempdir().unwrap();
    let start = weights(dir.path(), |_| ());
    let out = dir.path().join("out");
    let output = train(
        &out,
        &[
            "--weights",
            text(&start),
            "--lambda-reg",
            "0",
            "--lr",
            "1",
            "--steps",
            "12",
            "--batch",
            "1",
            "--stage",
            "both",
            "--structure-from",
            "0",
        ],
    );
    let finite = |trainer: &Trainer| {
        let values = |x: &Tensor| x.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        trainer.weights(true).unwrap().values().all(|x| values(x).iter().all(|v| v.is_finite()))
    };
    let ended = match code(&output) {
        0 => "last.ckpt",
        2 => {
            assert!(stderr(&output).contains("non-finite value(s) in "), "{}", stderr(&output));
            "stopped.ckpt"
        }
        other => panic!("exit code {other}: {}", stderr(&output)),
    };
    assert!(finite(&Trainer::resume(&out.join(ended), &Device::Cpu).unwrap()));
}

#[test]
fn a_bag_with_ground_truth_is_learned_from_and_its_rest_is_scored() {
    let dir = tempfile::tempdir().unwrap();
    let start = weights(dir.path(), |_| ());
    let bag = dir.path().join("drive");
    synth(&bag, 5, "5", &[]);
    let options = [
        "--weights",
        text(&start),
        "--bag",
        text(&bag),
        "--stage",
        "render",
        "--steps",
        "4",
        "--batch",
        "2",
        "--to-sec",
        "2.2",
        "--targets",
        "2",
    ];
    let run = |name: &str, more: &[&str]| {
        let out = dir.path().join(name);
        let output = train(&out, &[&options[..], more].concat());
        assert_eq!(code(&output), 0, "{}", stderr(&output));
        out
    };
    let (one, two) = (run("one", &["--loader-threads", "1"]), run("two", &["--loader-threads", "3"]));
    assert!(same(&one.join("last.ckpt"), &two.join("last.ckpt")), "threads change the result");
    let text_of = |path: PathBuf| std::fs::read_to_string(path).unwrap();
    let losses = text_of(one.join("losses.csv"));
    let (names, first) = (losses.lines().next().unwrap(), losses.lines().nth(1).unwrap());
    let value = |name: &str| first.split(',').nth(names.split(',').position(|n| n == name).unwrap()).unwrap();
    for name in ["rgb", "depth", "sky_opacity", "velocity"] {
        assert!(value(name).parse::<f64>().unwrap() > 0.0, "{name}");
    }
    assert_eq!(value("flow"), "");
    let scored = text_of(one.join("bags.csv"));
    let row: Vec<f64> = scored.lines().last().unwrap().split(',').map(|x| x.parse().unwrap()).collect();
    assert!(row[0] == 4.0 && row[1] > 5.0 && row[2] > 5.0 && row[3] >= 3.0, "{scored}");
    let told = provenance(&one.join("weights.safetensors")).unwrap();
    assert!(told.contains("drive") && told.contains("100 %") && !told.contains(text(dir.path())), "{told}");

    // Stopped in the middle, mixed with drives, and gone on with: the bag is found again through the checkpoint.
    let mixed = run("mixed", &["--bag-share", "0.5"]);
    let half = run("half", &["--bag-share", "0.5", "--stop-at", "2"]);
    let output = train(&half, &["--resume", text(&half.join("last.ckpt"))]);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    assert!(same(&mixed.join("last.ckpt"), &half.join("last.ckpt")));
    assert!(!same(&mixed.join("last.ckpt"), &one.join("last.ckpt")));
}

#[test]
fn bags_that_cannot_be_learned_from_say_why() {
    let dir = tempfile::tempdir().unwrap();
    let start = weights(dir.path(), |_| ());
    let bag = dir.path().join("short");
    synth(&bag, 5, "1", &["--cameras", "1"]);
    let out = dir.path().join("out");
    let cases: [(&[&str], i32, &str); 6] = [
        (&[], 2, "no clip of 4 timesteps"),
        (&["--timesteps", "2", "--from-sec", "0.8"], 2, "no clip of 2 timesteps"),
        (&["--timesteps", "2", "--bag-cameras", "2"], 1, "1 camera"),
        (&["--from-sec", "3", "--to-sec", "2"], 1, "to-sec"),
        (&["--bag-share", "0"], 1, "bag-share"),
        (&["--bag", "no_such_bag"], 2, "no_such_bag"),
    ];
    for (more, exit, word) in cases {
        let options = ["--weights", text(&start), "--bag", text(&bag), "--stage", "render", "--steps", "2"];
        let output = train(&out, &[&options[..], more].concat());
        assert_eq!(code(&output), exit, "{more:?}: {}", stderr(&output));
        assert!(stderr(&output).contains(word), "{more:?}: {}", stderr(&output));
    }
}

#[test]
fn a_real_recording_is_learned_from_without_labels() {
    let Some(bag) = shared("bags/kitti_ramp_stereo_sqlite") else { return };
    let dir = tempfile::tempdir().unwrap();
    let start = weights(dir.path(), |_| ());
    let out = dir.path().join("out");
    let options = ["--weights", text(&start), "--bag", text(&bag), "--steps", "2", "--batch", "1", "--targets", "1"];
    let output = train(&out, &[&options[..], &["--stage", "pixel"]].concat());
    assert_eq!(code(&output), 1, "{}", stderr(&output));
    assert!(stderr(&output).contains("--stage render"), "{}", stderr(&output));
    let output = train(&out, &[&options[..], &["--stage", "render"]].concat());
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let losses = std::fs::read_to_string(out.join("losses.csv")).unwrap();
    let (names, first) = (losses.lines().next().unwrap(), losses.lines().nth(1).unwrap());
    let value = |name: &str| first.split(',').nth(names.split(',').position(|n| n == name).unwrap()).unwrap();
    assert_eq!((value("depth"), value("flow"), value("sky_color")), ("", "", ""));
    assert!(value("rgb").parse::<f64>().unwrap() > 0.0 && value("sky_opacity").parse::<f64>().unwrap() > 0.0);
}

#[test]
fn a_feature_network_takes_the_stand_ins_place() {
    let dir = tempfile::tempdir().unwrap();
    let start = weights(dir.path(), |_| ());
    let lpips = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/fixtures/lpips_vgg.safetensors");
    let options = [
        "--weights",
        text(&start),
        "--stage",
        "render",
        "--steps",
        "2",
        "--batch",
        "1",
        "--targets",
        "1",
        "--structure-from",
        "1",
    ];
    let column = |out: &Path, name: &str| -> Vec<String> {
        let losses = std::fs::read_to_string(out.join("losses.csv")).unwrap();
        let at = losses.lines().next().unwrap().split(',').position(|n| n == name).unwrap();
        losses.lines().skip(1).map(|l| l.split(',').nth(at).unwrap().to_string()).collect()
    };
    let (with, without) = (dir.path().join("with"), dir.path().join("without"));
    let output = train(&without, &options);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    assert!(column(&without, "structure")[1].parse::<f64>().unwrap() > 0.0);
    assert!(provenance(&without.join("weights.safetensors")).unwrap().contains("standing in for LPIPS"));
    let output = train(&with, &[&options[..], &["--lpips", text(&lpips)]].concat());
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    assert_eq!(column(&with, "structure"), ["", ""]);
    let terms = column(&with, "lpips");
    assert!(terms[0].is_empty() && terms[1].parse::<f64>().unwrap() > 0.0, "{terms:?}");
    assert!(provenance(&with.join("weights.safetensors")).unwrap().contains("LPIPS with lpips_vgg.safetensors"));
    let output = train(&with, &[&options[..], &["--lpips", text(&start)]].concat());
    assert_eq!(code(&output), 2, "{}", stderr(&output));
    assert!(stderr(&output).contains("features.0.weight"), "{}", stderr(&output));
}
