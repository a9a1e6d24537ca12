//! The program when things go wrong around it: a disk that is full, a process that is killed, names that are paths.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;
#[path = "common/maker.rs"]
mod maker;

use std::collections::BTreeSet;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use common::{code, metrics, replay, stderr, storm};
use maker::Maker;
use storm_node::bag::Bag;

/// Longest wait for a save to appear on a busy machine.
const PATIENCE: Duration = Duration::from_secs(120);

/// Everything below a folder, by path.
fn below(dir: &Path) -> BTreeSet<String> {
    let mut all = BTreeSet::new();
    for entry in std::fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        all.insert(path.display().to_string());
        if path.is_dir() {
            all.extend(below(&path));
        }
    }
    all
}

#[test]
fn topic_names_never_become_paths_or_markup() {
    let dir = tempfile::tempdir().unwrap();
    let (bag, out) = (dir.path().join("bag.mcap"), dir.path().join("deep/er/out"));
    Maker { prefix: "/../../../evil<script>alert(1)</script>".into(), ..Maker::default() }.write(&bag);
    std::fs::create_dir_all(out.parent().unwrap()).unwrap();
    let before = below(dir.path());
    let output = replay(&bag, &out, &[]);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let inside = out.display().to_string();
    let strays: Vec<String> =
        below(dir.path()).difference(&before).filter(|p| !p.starts_with(&inside)).cloned().collect();
    assert!(strays.is_empty(), "{strays:?}");
    assert!(below(&out).iter().all(|p| !p.contains("evil")), "{:?}", below(&out));
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(page.contains("evil&lt;script&gt;") && !page.contains("<script>alert"), "the name is text");
}

/// What there is of a bag that broke off: its messages so far, and a word that it has no end.
fn broken_off(path: &Path) -> usize {
    let bag = Bag::open(path).unwrap();
    let topic = bag.topic("/storm/output/gaussians").unwrap();
    bag.messages(&[topic]).unwrap().filter(Result::is_ok).count()
}

/// No file may grow beyond 1 MB: what the system refuses then is what it refuses on a full disk.
#[cfg(unix)]
#[test]
fn a_file_that_cannot_grow_is_given_up_and_everything_else_is_whole() {
    let dir = tempfile::tempdir().unwrap();
    let (bag, out) = (dir.path().join("bag.mcap"), dir.path().join("out"));
    Maker::default().write(&bag);
    let script = format!(
        "trap '' XFSZ; ulimit -f 1000; exec {} --quiet replay {} --out {} --set model.image_width=48 --set model.image_height=32 \
         --set map.static_speed_mps=100 --set output.report_steps=0",
        env!("CARGO_BIN_EXE_storm"),
        bag.display(),
        out.display()
    );
    // In bash the unit is 1024 bytes.
    let output = Command::new("bash").args(["-c", &script]).output().unwrap();
    let said = stderr(&output);
    assert_eq!(code(&output), 3, "{said}");
    assert!(said.contains("outputs.mcap") && !said.contains("panicked"), "{said}");
    let m = metrics(&out);
    assert!(m["problems"].to_string().contains("outputs.mcap"), "{m}");
    let whole = replay(&bag, &dir.path().join("whole"), &["--set", "map.static_speed_mps=100"]);
    assert_eq!(code(&whole), 0, "{}", stderr(&whole));
    assert_eq!(m["steps"], metrics(&dir.path().join("whole"))["steps"], "every step was run");
    assert!(out.join("tracks.csv").exists() && out.join("trajectory.tum").exists());
    assert!(broken_off(&out.join("outputs.mcap")) > 0, "what was written before can be read");
    assert_eq!(code(&storm(&["map", out.join("map").to_str().unwrap()])), 0);
}

/// Its own words are the least a run can lose: a log on a full disk, a pipe nobody reads any more.
#[cfg(target_os = "linux")]
#[test]
fn what_cannot_be_said_ends_no_run() {
    let dir = tempfile::tempdir().unwrap();
    let (bag, out) = (dir.path().join("bag.mcap"), dir.path().join("out"));
    Maker::default().write(&bag);
    let full = || Stdio::from(std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap());
    let run = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_storm"));
        command.args(arguments).env("RUST_LOG", "debug").stdout(full()).stderr(full());
        command.status().unwrap().code()
    };
    let (bag, out_text) = (bag.to_str().unwrap(), out.to_str().unwrap());
    assert_eq!(run(&["replay", bag, "--out", out_text]), Some(0));
    assert!(out.join("metrics.json").exists() && out.join("map.ply").exists());
    assert_eq!(run(&["info", bag]), Some(0));
    assert_eq!(run(&["config"]), Some(2), "what is printed to be kept is no word: its loss is an error");
    let other = dir.path().join("other");
    assert_eq!(run(&["replay", "nothing.mcap", "--out", other.to_str().unwrap()]), Some(2), "errors keep their code");
}

/// A real file system of 3 MB, where mounting one is allowed.
#[cfg(target_os = "linux")]
#[test]
fn a_disk_that_fills_up_is_said_and_what_was_saved_stays_whole() {
    let dir = tempfile::tempdir().unwrap();
    let (bag, disk) = (dir.path().join("bag.mcap"), dir.path().join("disk"));
    Maker::default().write(&bag);
    std::fs::create_dir(&disk).unwrap();
    // In a mount namespace of its own, which ends with the command.
    let script = format!(
        "mount -t tmpfs -o size=3m tmpfs {disk} || exit 77; {storm} --quiet replay {bag} --out {disk}/out \
         --set model.image_width=48 --set model.image_height=32 --set map.static_speed_mps=100 --set map.save_every_sec=0.05; \
         code=$?; df -k {disk} >&2; rm -f {disk}/out/outputs.mcap; {storm} map {disk}/out/map || exit 50; exit $code",
        disk = disk.display(),
        storm = env!("CARGO_BIN_EXE_storm"),
        bag = bag.display(),
    );
    let output = Command::new("unshare").args(["-rm", "bash", "-c", &script]).output();
    let Ok(output) = output else { return println!("SKIPPED: there is no unshare") };
    let said = stderr(&output);
    if code(&output) == 77 || said.contains("unshare") {
        return println!("SKIPPED: no file system can be mounted here: {said}");
    }
    assert_eq!(code(&output), 3, "{said}");
    assert!(said.contains("outputs.mcap") && said.contains("No space left") && !said.contains("panicked"), "{said}");
}

/// A soak with faults of one small camera.
const SOAK: [&str; 7] = ["--quiet", "soak", "--faults", "--size", "24x16", "--cameras", "1"];

#[test]
fn a_live_run_that_is_killed_goes_on_from_its_map() {
    let dir = tempfile::tempdir().unwrap();
    let map = dir.path().join("map");
    let soak = |seconds: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_storm"));
        command.args(SOAK).args(["--seconds", seconds, "--map"]).arg(&map).args(["--set", "map.save_every_sec=0.05"]);
        command.args(["--set", "map.static_speed_mps=100"]);
        command
    };
    let mut child = soak("3600").stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let start = Instant::now();
    let saved = || std::fs::metadata(map.join("map.index")).is_ok_and(|m| m.len() > 100);
    while !saved() && start.elapsed() < PATIENCE {
        std::thread::sleep(Duration::from_millis(5));
    }
    std::thread::sleep(Duration::from_millis(500));
    // SIGKILL, as kill -9 sends it.
    child.kill().unwrap();
    assert!(child.wait().unwrap().code().is_none(), "an hour is not over yet");
    let shown = storm(&["map", map.to_str().unwrap()]);
    assert_eq!(code(&shown), 0, "{}", stderr(&shown));
    // A start that would empty it is refused; one that goes on from it works.
    assert!(stderr(&soak("4").output().unwrap()).contains("map.load"));
    let load = format!("map.load={}", map.display());
    let again = soak("4").args(["--set", &load]).output().unwrap();
    let said = String::from_utf8_lossy(&again.stdout).into_owned() + &stderr(&again);
    assert_eq!(code(&again), 0, "{said}");
}

#[test]
fn a_soak_with_faults_writes_what_it_counted() {
    let dir = tempfile::tempdir().unwrap();
    let json = dir.path().join("soak.json");
    let more = ["--seconds", "40", "--seed", "3", "--json", json.to_str().unwrap()];
    let output = storm(&[&SOAK[..], &more].concat());
    assert_eq!(code(&output), 0, "{}\n{}", String::from_utf8_lossy(&output.stdout), stderr(&output));
    let report: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&json).unwrap()).unwrap();
    assert_eq!(report["nonfinite"], 0);
    assert!(report["checks"].as_array().unwrap().len() >= 8 && report["quarters"].as_array().unwrap().len() == 4);
}
