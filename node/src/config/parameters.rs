//! Single keys by their dotted name, with JSON values: what ROS parameters are read and set through.

use serde_json::Value;

use super::nearest::no_parameter;
use super::{Config, ConfigError};

/// Keys that take effect while a node runs; the others at its start alone.
pub const RUN_TIME: [&str; 9] = [
    "window.hop_sec",
    "map.load",
    "output.min_opacity",
    "output.max_gaussians",
    "live.silence_sec",
    "live.degrade",
    "live.map",
    "live.map_every_sec",
    "live.map_max_mb",
];

/// Numbers of one camera mounting.
const MOUNT: usize = 7;

impl Config {
    /// The value of `section.key`; none when there is no such key. A list of mountings is one flat list of numbers, since
    /// ROS parameters know no lists of lists.
    pub fn get(&self, name: &str) -> Option<Value> {
        let (section, key) = name.split_once('.')?;
        let tree = serde_json::to_value(self).ok()?;
        let value = tree.get(section)?.get(key)?;
        Some(match value.as_array() {
            Some(items) if items.iter().any(Value::is_array) => {
                items.iter().filter_map(Value::as_array).flatten().cloned().collect()
            }
            _ => value.clone(),
        })
    }

    /// This configuration with one key changed, checked.
    ///
    /// # Errors
    /// No such key, a value of another type, or one that is not accepted.
    pub fn with(&self, name: &str, value: Value) -> Result<Self, ConfigError> {
        let wrong = |message: String| ConfigError::Parse { path: format!("{name} = {value}"), message };
        let mut tree = serde_json::to_value(self).map_err(|e| wrong(e.to_string()))?;
        let place = name.split_once('.').and_then(|(section, key)| tree.get_mut(section)?.get_mut(key));
        let Some(place) = place else {
            return Err(wrong(no_parameter(name)));
        };
        *place = match value.as_array() {
            Some(flat) if name == "input.base_from_camera" && !flat.iter().any(Value::is_array) => {
                if !flat.len().is_multiple_of(MOUNT) {
                    return Err(wrong(format!("wants {MOUNT} numbers a camera, has {}", flat.len())));
                }
                flat.chunks(MOUNT).map(|mount| Value::from(mount.to_vec())).collect()
            }
            _ => value.clone(),
        };
        let config: Self = serde_json::from_value(tree).map_err(|e| wrong(e.to_string()))?;
        config.validate()?;
        Ok(config)
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn every_key_is_read_and_set_by_its_name() {
        let defaults = Config::default();
        for p in Config::describe() {
            let value = defaults.get(&p.name).unwrap_or_else(|| panic!("{}", p.name));
            assert_eq!(defaults.with(&p.name, value).unwrap(), defaults, "{}", p.name);
        }
        assert!(RUN_TIME.iter().all(|name| defaults.get(name).is_some()));
    }

    #[test]
    fn mountings_are_one_flat_list() {
        let flat = json!([1, 2, 3, 1, 0, 0, 0, 4.5, 5.0, 6.0, 1.0, 0.0, 0.0, 0.0]);
        let c = Config::default().with("input.base_from_camera", flat).unwrap();
        assert_eq!(
            c.input.base_from_camera,
            [[1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0], [4.5, 5.0, 6.0, 1.0, 0.0, 0.0, 0.0]]
        );
        assert_eq!(c.get("input.base_from_camera").unwrap().as_array().map(Vec::len), Some(14));
        let e = Config::default().with("input.base_from_camera", json!([1.0, 2.0])).unwrap_err().to_string();
        assert!(e.contains("7 numbers"), "{e}");
    }

    #[test]
    fn what_does_not_fit_is_refused_and_named() {
        for (name, value) in [
            ("window.strid_sec", json!(1.0)),
            ("window", json!(1.0)),
            ("window.stride_sec", json!("fast")),
            ("window.stride_sec", json!(-1.0)),
            ("window.timesteps", json!(2.5)),
            ("live.reliability", json!("best")),
        ] {
            let e = Config::default().with(name, value).unwrap_err().to_string();
            assert!(e.contains(name), "{e}");
        }
        let c = Config::default().with("window.stride_sec", json!(1)).unwrap();
        assert_eq!(c.window.stride_sec, 1.0, "an integer is a number too");
    }
}
