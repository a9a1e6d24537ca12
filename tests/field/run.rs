//! Replays a recording and compares what came of it with the control drive.

use std::path::Path;
use std::process::Command;
use std::sync::OnceLock;

use serde_json::Value;

use super::recording::Recording;

/// Counts that must be the control drive's.
const COUNTS: [&str; 8] = [
    "images_in",
    "frames_in",
    "steps",
    "messages_lost",
    "poses_rejected",
    "non_finite_windows",
    "stage_panics",
    "epochs",
];

/// What came of a replay.
pub struct Ran {
    pub code: i32,
    pub stderr: String,
    /// `metrics.json`; null where there is none.
    pub metrics: Value,
    /// Results folder; gone with this value.
    pub dir: tempfile::TempDir,
}

impl Ran {
    /// PSNR of held-out pictures, dB.
    pub fn psnr(&self) -> f64 {
        let psnr = self.metrics["held_out"]["storm"]["psnr"].as_f64();
        psnr.unwrap_or_else(|| panic!("no PSNR; exit code {}: {}", self.code, self.stderr))
    }

    /// Ended well, nothing lost, with the control drive's counts and its PSNR within `tolerance_db`.
    #[track_caller]
    pub fn like_control(&self, tolerance_db: f64) -> &Self {
        self.like(control(), tolerance_db)
    }

    /// The same against another run.
    #[track_caller]
    pub fn like(&self, other: &Self, tolerance_db: f64) -> &Self {
        assert_eq!(self.code, 0, "{}", self.stderr);
        for count in COUNTS {
            assert_eq!(self.metrics[count], other.metrics[count], "{count}: {}", self.stderr);
        }
        assert_eq!(self.metrics["dropped"], other.metrics["dropped"], "{}", self.stderr);
        let (got, want) = (self.psnr(), other.psnr());
        println!("PSNR {got:.3} dB against {want:.3} dB, {tolerance_db} allowed");
        assert!((got - want).abs() <= tolerance_db, "PSNR {got:.3} dB against {want:.3} dB, {tolerance_db} allowed");
        self
    }

    /// Refused as input that cannot be read: exit code 2 and one line with all of `words`, nothing run.
    #[track_caller]
    pub fn refused(&self, words: &[&str]) -> &Self {
        assert_eq!(self.code, 2, "{}", self.stderr);
        let errors: Vec<&str> = self.stderr.lines().filter(|l| l.starts_with("error:")).collect();
        assert_eq!(errors.len(), 1, "{}", self.stderr);
        println!("{}", errors[0]);
        for word in words {
            assert!(errors[0].contains(word), "'{word}' missing in: {}", self.stderr);
        }
        assert!(self.metrics.is_null(), "it ran all the same");
        self
    }

    /// The log says all of `words`.
    #[track_caller]
    pub fn says(&self, words: &[&str]) -> &Self {
        for word in words {
            assert!(self.stderr.contains(word), "'{word}' missing in: {}", self.stderr);
        }
        self
    }
}

/// Replays `recording` with pictures as large as they were recorded; `set` is KEY=VALUE pairs.
pub fn replay(recording: Recording, set: &[&str]) -> Ran {
    let dir = tempfile::tempdir().unwrap();
    let bag = dir.path().join("bag.mcap");
    recording.write(&bag);
    let out = dir.path().join("out");
    let mut command = Command::new(env!("CARGO_BIN_EXE_storm"));
    command.arg("replay").arg(&bag).arg("--out").arg(&out).env_remove("RUST_LOG");
    // A picture of 72x48 is the network's own here, so that nothing is resampled; and little is written.
    for pair in ["model.image_width=72", "model.image_height=48", "output.bag=false", "output.report_steps=1"] {
        command.args(["--set", pair]);
    }
    set.iter().for_each(|pair| {
        command.args(["--set", pair]);
    });
    let output = command.output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!stderr.contains("panicked"), "{stderr}");
    Ran { code: output.status.code().unwrap_or(-1), stderr, metrics: metrics(&out), dir }
}

fn metrics(out: &Path) -> Value {
    let text = std::fs::read_to_string(out.join("metrics.json"));
    text.map_or(Value::Null, |t| serde_json::from_str(&t).unwrap())
}

/// The control drive's run, made once.
pub fn control() -> &'static Ran {
    static CONTROL: OnceLock<Ran> = OnceLock::new();
    CONTROL.get_or_init(|| replay(Recording::control(), &[]))
}
