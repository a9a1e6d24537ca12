//! The configuration as ROS parameters: every key with its description, checked, unknown ones refused.

use std::sync::{Arc, Mutex, PoisonError};

use r2r::indexmap::IndexMap;
use r2r::{Error, Parameter, ParameterValue, RosParams};
use serde_json::{Value, json};

use crate::config::{Config, ConfigError, RUN_TIME};

/// Parameters that belong to ROS and not to us.
const SIM_TIME: &str = "use_sim_time";
const FOREIGN: [&str; 2] = ["qos_overrides.", "start_type_description_service"];
/// Empty lists of numbers; all other empty lists are of text.
const NUMBER_LISTS: [&str; 2] = ["input.image_time_offset_sec", "input.base_from_camera"];

/// The configuration from the parameters given on the command line and in files; use_sim_time is left alone.
///
/// # Errors
/// An unknown parameter, or a value that is not accepted: the message names it.
pub fn read(given: &IndexMap<String, Parameter>) -> Result<Config, ConfigError> {
    let mut config = Config::default();
    // Whole lists depend on each other's length: a second pass sees all of them.
    let mut later = Vec::new();
    for (name, parameter) in given.iter().filter(|(name, _)| is_ours(name)) {
        let value = to_json(&parameter.value, config.get(name).as_ref());
        match config.with(name, value.clone()) {
            Ok(changed) => config = changed,
            Err(_) => later.push((name, value)),
        }
    }
    for (name, value) in later {
        config = config.with(name, value)?;
    }
    Ok(config)
}

fn is_ours(name: &str) -> bool {
    name != SIM_TIME && !FOREIGN.iter().any(|f| name.starts_with(f))
}

/// The parameters behind r2r's parameter services.
pub struct Served {
    config: Config,
    sim_time: bool,
    changed: Arc<Mutex<Option<Config>>>,
}

impl Served {
    /// Serves `config`; whoever holds `changed` finds the newest accepted configuration there.
    pub fn new(config: Config, sim_time: bool, changed: Arc<Mutex<Option<Config>>>) -> Self {
        Self { config, sim_time, changed }
    }

    fn try_with(&self, name: &str, value: &ParameterValue) -> r2r::Result<Config> {
        let refused = |msg: String| Error::ParameterValueConv { name: name.into(), msg };
        if name == SIM_TIME {
            return Err(refused("takes effect at start alone".into()));
        }
        let Some(present) = self.config.get(name) else {
            return Err(Error::InvalidParameterName { name: name.into() });
        };
        let wanted = self.config.with(name, to_json(value, Some(&present))).map_err(|e| refused(e.to_string()))?;
        if wanted != self.config && !RUN_TIME.contains(&name) {
            return Err(refused(format!("takes effect at start alone; these may change: {}", RUN_TIME.join(", "))));
        }
        Ok(wanted)
    }
}

impl RosParams for Served {
    fn register_parameters(
        &mut self,
        _: &str,
        _: Option<Parameter>,
        params: &mut IndexMap<String, Parameter>,
    ) -> r2r::Result<()> {
        params.clear();
        for doc in Config::describe() {
            let value = self.get_parameter(&doc.name)?;
            // r2r keeps descriptions for the life of the program; there are as many as keys.
            let description: &'static str = Box::leak(doc.description.into_boxed_str());
            params.insert(doc.name, Parameter { value, description });
        }
        let description = "Whether time is what /clock says.";
        params.insert(SIM_TIME.into(), Parameter { value: ParameterValue::Bool(self.sim_time), description });
        Ok(())
    }

    fn get_parameter(&mut self, name: &str) -> r2r::Result<ParameterValue> {
        if name == SIM_TIME {
            return Ok(ParameterValue::Bool(self.sim_time));
        }
        let value = self.config.get(name).ok_or_else(|| Error::InvalidParameterName { name: name.into() })?;
        Ok(from_json(name, &value))
    }

    fn set_parameter(&mut self, name: &str, value: &ParameterValue) -> r2r::Result<()> {
        self.config = self.try_with(name, value)?;
        *self.changed.lock().unwrap_or_else(PoisonError::into_inner) = Some(self.config.clone());
        Ok(())
    }

    fn check_parameter(&self, name: &str, value: &ParameterValue) -> r2r::Result<()> {
        self.try_with(name, value).map(|_| ())
    }
}

/// `present` says what is meant where ROS cannot: an empty list has no type in a parameter file.
fn to_json(value: &ParameterValue, present: Option<&Value>) -> Value {
    match value {
        ParameterValue::NotSet if present.is_some_and(Value::is_array) => json!([]),
        ParameterValue::NotSet => Value::Null,
        ParameterValue::Bool(x) => json!(x),
        ParameterValue::Integer(x) => json!(x),
        ParameterValue::Double(x) => json!(x),
        ParameterValue::String(x) => json!(x),
        ParameterValue::BoolArray(x) => json!(x),
        ParameterValue::ByteArray(x) => json!(x),
        ParameterValue::IntegerArray(x) => json!(x),
        ParameterValue::DoubleArray(x) => json!(x),
        ParameterValue::StringArray(x) => json!(x),
    }
}

fn from_json(name: &str, value: &Value) -> ParameterValue {
    let numbers = |items: &[Value]| items.iter().filter_map(Value::as_f64).collect();
    let texts = |items: &[Value]| items.iter().filter_map(Value::as_str).map(str::to_owned).collect();
    match value {
        Value::Bool(x) => ParameterValue::Bool(*x),
        Value::Number(x) => match x.as_i64() {
            Some(x) => ParameterValue::Integer(x),
            None => ParameterValue::Double(x.as_f64().unwrap_or(f64::NAN)),
        },
        Value::String(x) => ParameterValue::String(x.clone()),
        Value::Array(items) if NUMBER_LISTS.contains(&name) => ParameterValue::DoubleArray(numbers(items)),
        Value::Array(items) => ParameterValue::StringArray(texts(items)),
        Value::Null | Value::Object(_) => ParameterValue::NotSet,
    }
}
