//! The value of `input.rectified`: one word for all cameras, or one per camera.

use serde::{Deserialize, Serialize};

/// What is accepted, for messages.
const ACCEPTED: &str = "auto, true or false, or a list with one of them per camera";

/// Whether pictures are rectified already: not said (`auto`), true or false; one value for all cameras or one for each.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "Written", into = "Written")]
pub struct RectifiedSetting(Vec<Option<bool>>);

/// One value as it is written: YAML reads some words as truth values.
#[derive(Clone, Serialize, Deserialize)]
#[serde(untagged, expecting = "input.rectified wants auto, true or false, or a list with one of them per camera")]
enum Word {
    Truth(bool),
    Text(String),
}

#[derive(Clone, Serialize, Deserialize)]
#[serde(untagged, expecting = "input.rectified wants auto, true or false, or a list with one of them per camera")]
enum Written {
    All(Word),
    Each(Vec<Word>),
}

impl Default for RectifiedSetting {
    fn default() -> Self {
        Self(vec![None])
    }
}

impl RectifiedSetting {
    /// What it says of one camera; `None` for `auto`.
    pub fn of(&self, camera: usize) -> Option<bool> {
        let place = if self.0.len() == 1 { 0 } else { camera };
        self.0.get(place).copied().flatten()
    }

    /// Values given: 1 stands for all cameras.
    pub fn values(&self) -> usize {
        self.0.len()
    }
}

impl TryFrom<Written> for RectifiedSetting {
    type Error = String;

    fn try_from(written: Written) -> Result<Self, String> {
        let words = match written {
            Written::All(word) => vec![word],
            Written::Each(words) => words,
        };
        if words.is_empty() {
            return Err(format!("input.rectified is an empty list; wants {ACCEPTED}"));
        }
        words.into_iter().map(from_word).collect::<Result<_, _>>().map(Self)
    }
}

impl From<RectifiedSetting> for Written {
    fn from(setting: RectifiedSetting) -> Self {
        match setting.0.as_slice() {
            [one] => Self::All(to_word(*one)),
            many => Self::Each(many.iter().map(|value| to_word(*value)).collect()),
        }
    }
}

fn from_word(word: Word) -> Result<Option<bool>, String> {
    match word {
        Word::Truth(value) => Ok(Some(value)),
        Word::Text(text) => match text.trim().to_ascii_lowercase().as_str() {
            "auto" => Ok(None),
            "true" | "yes" => Ok(Some(true)),
            "false" | "no" => Ok(Some(false)),
            _ => Err(format!("input.rectified is `{text}`; wants {ACCEPTED}")),
        },
    }
}

fn to_word(value: Option<bool>) -> Word {
    Word::Text(value.map_or_else(|| "auto".into(), |value| value.to_string()))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use crate::config::Config;

    #[test]
    fn words_truth_values_and_lists_are_read_and_written() {
        for (value, want) in [
            (json!("auto"), [None, None]),
            (json!(true), [Some(true), Some(true)]),
            (json!("no"), [Some(false), Some(false)]),
            (json!([true, "auto"]), [Some(true), None]),
            (json!(["false", "yes"]), [Some(false), Some(true)]),
        ] {
            let config = Config::default().with("input.rectified", value.clone()).unwrap();
            assert_eq!([config.input.rectified.of(0), config.input.rectified.of(1)], want, "{value}");
            assert_eq!(Config::from_yaml(&config.to_yaml()).unwrap(), config, "{value}");
        }
        let config = Config::from_yaml("input: {rectified: true}").unwrap();
        assert_eq!(config.input.rectified.of(3), Some(true));
        assert_eq!(
            Config::default().with_override("input.rectified=false").unwrap().input.rectified.of(0),
            Some(false)
        );
        for wrong in [json!("maybe"), json!(1), json!([]), json!([["auto"]]), json!([["auto", "auto"]])] {
            let e = Config::default().with("input.rectified", wrong.clone()).unwrap_err().to_string();
            assert!(e.contains("input.rectified") && e.contains("true or false"), "{wrong}: {e}");
        }
    }
}
