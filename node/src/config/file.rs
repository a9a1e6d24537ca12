//! Reading and writing the configuration as YAML: plain, or as a ROS 2 parameter file. The only file that names the
//! YAML library, so that another can take its place.

use std::path::Path;

use thiserror::Error;

use super::Config;

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
        let parse = |e: serde_yaml::Error| ConfigError::Parse { path: "text".into(), message: e.to_string() };
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
    fn ros_parameter_files_are_read() {
        let c = Config::from_yaml("/**:\n  ros__parameters:\n    window:\n      stride_sec: 0.25\n").unwrap();
        assert_eq!(c.window.stride_sec, 0.25);
    }
}
