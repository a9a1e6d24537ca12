//! Reading and writing the configuration as YAML: plain, or as a ROS 2 parameter file. The only file that names the
//! YAML library, so that another can take its place.

use std::path::Path;

use thiserror::Error;

use super::Config;
use super::nearest::{no_parameter, with_suggestion};

/// What can be wrong with a configuration.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read configuration {path}: {source}")]
    Read {
        /// The file.
        path: String,
        /// Why.
        source: std::io::Error,
    },
    /// Not YAML, an unknown key, or a value of the wrong type.
    #[error("configuration {path}: {message}")]
    Parse {
        /// The file.
        path: String,
        /// What the parser said, with line and column.
        message: String,
    },
    /// A value out of range.
    #[error("{key} = {value}: {expected}")]
    Value {
        /// Dotted name of the parameter.
        key: &'static str,
        /// The value given.
        value: String,
        /// What is accepted.
        expected: String,
    },
}

/// Deepest nesting of brackets in any YAML that is read.
const MAX_DEPTH: usize = 128;

/// Whether brackets nest so deep that the YAML library is not to see the text: its time grows with the square of the depth, so
/// that 100 kB of brackets would keep it busy for minutes. Brackets in quotes count too, which no sound text notices.
pub(crate) fn nests_too_deep(text: &[u8]) -> bool {
    let mut depth = 0usize;
    text.iter().any(|byte| {
        match byte {
            b'[' | b'{' => depth += 1,
            b']' | b'}' => depth = depth.saturating_sub(1),
            _ => {}
        }
        depth > MAX_DEPTH
    })
}

pub(super) fn check_depth(path: &str, text: &str) -> Result<(), ConfigError> {
    let message = || format!("brackets nest deeper than {MAX_DEPTH}");
    match nests_too_deep(text.as_bytes()) {
        true => Err(ConfigError::Parse { path: path.into(), message: message() }),
        false => Ok(()),
    }
}

impl Config {
    /// Reads a YAML file and checks it. A ROS 2 parameter file (`/**: ros__parameters:`) is accepted too.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let name = path.display().to_string();
        let text = std::fs::read_to_string(path).map_err(|source| ConfigError::Read { path: name.clone(), source })?;
        Self::from_yaml(&text).map_err(|e| match e {
            ConfigError::Parse { message, .. } => ConfigError::Parse { path: name, message },
            other => other,
        })
    }

    /// Parses and checks YAML text.
    pub fn from_yaml(text: &str) -> Result<Self, ConfigError> {
        check_depth("text", text)?;
        let parse =
            |e: serde_yaml::Error| ConfigError::Parse { path: "text".into(), message: with_suggestion(&e.to_string()) };
        let value: serde_yaml::Value = serde_yaml::from_str(text).map_err(parse)?;
        let config: Self = match ros_parameters(&value) {
            Some(inner) => serde_yaml::from_value(inner.clone()).map_err(parse)?,
            // Parsed from the text again and not from the value: only then do errors carry line and column.
            None if !value.is_null() => serde_yaml::from_str(text).map_err(parse)?,
            None => Self::default(),
        };
        config.validate()?;
        Ok(config)
    }

    /// From a command line: a file, if there is one, with single keys changed.
    pub fn from_arguments(file: Option<&Path>, assignments: &[String]) -> Result<Self, ConfigError> {
        let mut config = match file {
            Some(path) => Self::load(path)?,
            None => Self::default(),
        };
        for assignment in assignments {
            config = config.with_override(assignment)?;
        }
        config.validate()?;
        Ok(config)
    }

    /// This configuration with one key changed: `section.key=value`, the value as YAML.
    pub fn with_override(&self, assignment: &str) -> Result<Self, ConfigError> {
        let wrong = |message: String| ConfigError::Parse { path: format!("--set {assignment}"), message };
        let (name, value) = assignment.split_once('=').ok_or_else(|| wrong("wants KEY=VALUE".into()))?;
        let (section, key) = name.trim().split_once('.').ok_or_else(|| wrong("the key wants section.key".into()))?;
        let parse = |e: serde_yaml::Error| wrong(e.to_string());
        check_depth(&format!("--set {name}"), value)?;
        let mut tree = serde_yaml::to_value(self).map_err(parse)?;
        let value: serde_yaml::Value = serde_yaml::from_str(value).map_err(parse)?;
        match tree.get_mut(section).and_then(|s| s.get_mut(key)) {
            Some(place) => *place = value,
            None => return Err(wrong(no_parameter(name.trim()))),
        }
        let config: Self = serde_yaml::from_value(tree).map_err(parse)?;
        config.validate()?;
        Ok(config)
    }

    /// The configuration as YAML, every key shown.
    pub fn to_yaml(&self) -> String {
        serde_yaml::to_string(self).unwrap_or_default()
    }
}

/// The mapping under `<any node>: ros__parameters:`, if the text is a ROS 2 parameter file.
fn ros_parameters(value: &serde_yaml::Value) -> Option<&serde_yaml::Value> {
    let map = value.as_mapping()?;
    map.values().find_map(|v| v.as_mapping()?.get("ros__parameters"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_survive_a_round_trip_and_unknown_keys_do_not() {
        assert_eq!(Config::from_yaml(&Config::default().to_yaml()).unwrap(), Config::default());
        assert_eq!(Config::from_yaml("").unwrap(), Config::default());
        let e = Config::from_yaml("window: {strid_sec: 0.4}").unwrap_err().to_string();
        assert!(e.contains("strid_sec"), "{e}");
    }

    #[test]
    fn one_key_can_be_overridden() {
        let c = Config::default().with_override("window.stride_sec=0.4").unwrap();
        assert_eq!(c.window.stride_sec, 0.4);
        let c = c.with_override("input.images=[/a, /b]").unwrap();
        assert_eq!((c.window.stride_sec, c.input.images.len()), (0.4, 2));
        for bad in ["window.stride=0.4", "window.stride_sec", "window.stride_sec=fast", "window.timesteps=-1"] {
            assert!(Config::default().with_override(bad).is_err(), "{bad}");
        }
    }

    /// Two names of brackets, one closed before the other begins in the order of the text but not in that of the keys: found
    /// by fuzzing.
    #[test]
    fn what_is_read_can_be_written_and_read() {
        let (open, close) = ("[".repeat(100), "]".repeat(100));
        let text = |closed: &str| format!("model: {{weights: '{open}'}}\ninput: {{base_frame: '{closed}{open}'}}\n");
        let read = Config::from_yaml(&text("")).unwrap_err().to_string();
        assert!(read.contains("brackets"), "{read}");
        let written = Config::from_yaml(&text(&close)).unwrap_err().to_string();
        assert!(written.contains("brackets"), "{written}");
    }

    /// Aliases of aliases, ten at a time, and brackets without end: small texts that would be large values.
    #[test]
    fn texts_that_explode_are_refused() {
        let mut bomb = String::from("a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n");
        for i in 1..9 {
            bomb += &format!("a{i}: &a{i} [{}]\n", vec![format!("*a{}", i - 1); 10].join(", "));
        }
        bomb += "input: *a8\n";
        for text in [bomb, "input: {images: ".to_owned() + &"[".repeat(100_000), "[".repeat(100_000)] {
            assert!(matches!(Config::from_yaml(&text), Err(ConfigError::Parse { .. })));
            assert!(Config::default().with_override(&format!("input.images={text}")).is_err());
        }
    }

    #[test]
    fn ros_parameter_files_are_read() {
        let c = Config::from_yaml("/**:\n  ros__parameters:\n    window:\n      stride_sec: 0.25\n").unwrap();
        assert_eq!(c.window.stride_sec, 0.25);
    }
}
