//! What the README and the configuration file promise is what the program does.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::path::{Path, PathBuf};

use common::{code, stderr, storm};
use storm_node::config::Config;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn read(name: &str) -> String {
    std::fs::read_to_string(root().join(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
}

#[test]
fn the_readme_table_is_the_configuration() {
    let readme = read("README.md");
    let (_, rest) = readme.split_once("<!-- parameters:begin -->\n").expect("the table's begin mark");
    let (table, _) = rest.split_once("<!-- parameters:end -->").expect("the table's end mark");
    assert_eq!(table.trim(), Config::markdown().trim(), "run: storm config --markdown");
}

#[test]
fn the_shipped_configuration_is_the_defaults() {
    assert_eq!(read("config/storm.yaml"), Config::documented_yaml(), "run: storm config > config/storm.yaml");
}

#[test]
fn ci_runs_the_readme_test_command() {
    let readme = read("README.md");
    let command = readme.lines().find(|l| l.starts_with("cargo test")).expect("the README's test command");
    assert!(command.contains("--workspace"), "{command}");
    assert!(read(".ci/run").contains("^cargo test' README.md"), "CI takes the command from the README");
}

#[test]
fn wrong_usage_is_exit_code_1_and_names_what_is_wrong() {
    let dir = tempfile::tempdir().unwrap();
    let config = dir.path().join("c.yaml");
    std::fs::write(&config, "window: {strid_sec: 0.5}\n").unwrap();
    let config = config.to_str().unwrap();
    let cases: [(&[&str], &str); 7] = [
        (&["frobnicate"], "frobnicate"),
        (&["replay"], "BAG"),
        (&["replay", "x.mcap", "--config", config], "strid_sec"),
        (&["replay", "x.mcap", "--config", "no_such.yaml"], "no_such.yaml"),
        (&["replay", "x.mcap", "--set", "window.timesteps=11"], "11"),
        (&["replay", "x.mcap", "--set", "model.preset=huge"], "huge"),
        (&["synth", "--seed", "1", "--seconds", "-3", "--out", "x"], "-3"),
    ];
    for (args, word) in cases {
        let output = storm(args);
        assert_eq!(code(&output), 1, "{args:?}: {}", stderr(&output));
        assert!(stderr(&output).contains(word), "{args:?}: {}", stderr(&output));
    }
    assert_eq!(code(&storm(&["--help"])), 0);
    assert_eq!(code(&storm(&["--version"])), 0);
}

#[test]
fn an_instruction_set_that_is_not_there_is_refused() {
    let config = |isa| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_storm"));
        command.arg("config").env("STORM_ISA", isa).output().expect("the program starts")
    };
    let refused = config("mmx");
    assert_eq!(code(&refused), 1);
    assert!(stderr(&refused).contains("STORM_ISA=mmx: this machine has portable"), "{}", stderr(&refused));
    assert_eq!(code(&config("portable")), 0);
    assert_eq!(code(&config("")), 0);
}

/// Built without ROS 2 the program says how to come by it.
#[cfg(not(feature = "ros"))]
#[test]
fn the_node_without_ros_explains_what_to_source() {
    let output = storm(&["node", "--ros-args", "-p", "live.cameras:=3"]);
    assert_eq!(code(&output), 1);
    for words in ["setup.bash", ".ci/ros-prefix", "--features ros -- node --ros-args -p live.cameras:=3"] {
        assert!(stderr(&output).contains(words), "{}", stderr(&output));
    }
}
