//! The configuration as people read it: commented YAML and the README's table, both made from the one struct.

use super::Config;

impl Config {
    /// YAML with every key at its default and its meaning above it; reading it back gives the defaults.
    pub fn documented_yaml() -> String {
        let mut text = String::from(
            "# Every key of the configuration, at its default. A ROS 2 parameter file: `storm node` takes it with\n# --ros-args --params-file, `storm replay` with --config.\n/**:\n  ros__parameters:\n",
        );
        let mut section = String::new();
        for p in Self::describe() {
            let (head, key) = p.name.split_once('.').unwrap_or(("", &p.name));
            if head != section {
                text.push_str(&format!("    {head}:\n"));
                section = head.to_string();
            }
            // JSON is YAML: lists and strings need no second writer.
            text.push_str(&format!("      # {}\n      {key}: {}\n", p.description, p.default));
        }
        text
    }

    /// The README's parameter table.
    pub fn markdown() -> String {
        let mut text = String::from("| key | default | meaning |\n|---|---|---|\n");
        for p in Self::describe() {
            text.push_str(&format!("| `{}` | `{}` | {} |\n", p.name, p.default, p.description));
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_documented_yaml_is_the_defaults() {
        assert_eq!(Config::from_yaml(&Config::documented_yaml()).unwrap(), Config::default());
    }

    #[test]
    fn every_key_is_described() {
        for p in Config::describe() {
            assert!(p.description.len() > 10, "{} lacks a description", p.name);
        }
    }
}
