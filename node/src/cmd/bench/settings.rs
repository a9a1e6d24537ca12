//! The rows of the table, as data: a name and the configuration keys it changes. Any other row comes from the command line.

use anyhow::Result;

use crate::cmd::UsageError;
use crate::config::Config;

/// One setting.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Named {
    /// As the table calls it.
    pub name: String,
    /// `KEY=VALUE`, as `--set` takes them.
    pub set: Vec<String>,
    /// Whether the largest network is measured with it too.
    pub large: bool,
}

type Row = (&'static str, &'static [&'static str], bool);

/// Settings of the network. The first is the configuration's default.
const NETWORK: [Row; 18] = [
    ("default", &[], true),
    ("bf16", &["model.precision=bf16"], true),
    ("int16", &["model.precision=int16"], true),
    ("int8", &["model.precision=int8"], true),
    ("keys pooled 2x2", &["skip.kv_pool=2"], false),
    ("keys pooled 4x4", &["skip.kv_pool=4"], false),
    ("tokens merged 25 %", &["skip.merge=0.25"], false),
    ("tokens merged 50 %", &["skip.merge=0.5"], false),
    ("newest timestep only", &["skip.newest_only=true"], false),
    ("int8, keys pooled 2x2", &["model.precision=int8", "skip.kv_pool=2"], false),
    ("int8, tokens merged 25 %", &["model.precision=int8", "skip.merge=0.25"], false),
    ("int8, keys pooled 2x2, merged 25 %", &["model.precision=int8", "skip.kv_pool=2", "skip.merge=0.25"], false),
    ("int8, newest timestep only", &["model.precision=int8", "skip.newest_only=true"], false),
    ("bf16, newest timestep only", &["model.precision=bf16", "skip.newest_only=true"], false),
    ("bf16, keys pooled 2x2, merged 25 %", &["model.precision=bf16", "skip.kv_pool=2", "skip.merge=0.25"], false),
    ("3 timesteps", &["window.timesteps=3"], false),
    ("2 timesteps", &["window.timesteps=2"], false),
    ("1 timestep", &["window.timesteps=1"], false),
];

/// Settings of whole drives: what is skipped, and under which contract.
const DRIVES: [Row; 6] = [
    ("default", &[], false),
    ("prediction", &["skip.predict=true"], false),
    ("bf16", &["model.precision=bf16"], false),
    (
        "prediction, contract 1 dB, flow and masks free",
        &["skip.predict=true", "skip.max_psnr_loss_db=1", "skip.max_flow_change=100", "skip.max_mask_change=1"],
        false,
    ),
    (
        "older timesteps taken again, contract 1 dB, flow and masks free",
        &["skip.reuse=3", "skip.max_psnr_loss_db=1", "skip.max_flow_change=100", "skip.max_mask_change=1"],
        false,
    ),
    (
        "prediction whatever the pictures show, no contract",
        &[
            "skip.predict=true",
            "skip.predict_levels=255",
            "skip.predict_px=10",
            "skip.still_levels=255",
            "skip.still=false",
            "skip.max_psnr_loss_db=100",
            "skip.max_flow_change=100",
            "skip.max_mask_change=1",
        ],
        false,
    ),
];

fn named(rows: &[Row]) -> Vec<Named> {
    let one = |&(name, set, large): &Row| Named {
        name: name.into(),
        set: set.iter().map(|s| (*s).to_string()).collect(),
        large,
    };
    rows.iter().map(one).collect()
}

/// Settings of the network.
pub(super) fn network() -> Vec<Named> {
    named(&NETWORK)
}

/// Settings of whole drives.
pub(super) fn drives() -> Vec<Named> {
    named(&DRIVES)
}

impl Named {
    /// From the command line: `NAME: KEY=VALUE, KEY=VALUE`.
    ///
    /// # Errors
    /// What is not of that form.
    pub fn parse(text: &str) -> Result<Self, String> {
        let wrong = || format!("'{text}' is not NAME: KEY=VALUE, KEY=VALUE");
        let (name, set) = text.split_once(':').ok_or_else(wrong)?;
        let set: Vec<String> = set.split(',').map(|s| s.trim().to_string()).filter(|s| !s.is_empty()).collect();
        if name.trim().is_empty() || set.iter().any(|s| !s.contains('=')) {
            return Err(wrong());
        }
        Ok(Self { name: name.trim().into(), set, large: false })
    }

    /// The configuration with it, of a network of this preset.
    ///
    /// # Errors
    /// A key or a value that is not accepted.
    pub fn config(&self, preset: &str) -> Result<Config> {
        let preset = format!("model.preset={preset}");
        let all: Vec<String> = std::iter::once(preset).chain(self.set.iter().cloned()).collect();
        Config::from_arguments(None, &all).map_err(|e| UsageError(format!("setting '{}': {e}", self.name)).into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_settings_are_accepted_and_differ() {
        let mut seen = Vec::new();
        for rows in [network(), drives()] {
            seen.clear();
            for row in rows {
                let config = row.config("tiny").unwrap();
                assert!(!seen.contains(&config), "{}", row.name);
                seen.push(config);
            }
        }
        assert!(network().len() >= 12);
        assert_eq!(network()[0].config("tiny").unwrap(), Config::default());
    }

    #[test]
    fn settings_from_the_command_line() {
        let row = Named::parse("mine: skip.merge=0.1, model.precision=int8").unwrap();
        assert_eq!((row.name.as_str(), row.set.len()), ("mine", 2));
        assert!((row.config("tiny").unwrap().skip.merge - 0.1).abs() < 1e-12);
        assert!(Named::parse("no colon").is_err() && Named::parse("x: y").is_err());
        let odd = Named::parse("odd: skip.no_such=1").unwrap().config("tiny").unwrap_err().to_string();
        assert!(odd.contains("odd") && odd.contains("no_such"), "{odd}");
    }
}
