//! QoS and parameters as values: tests that need r2r, but no other process. They stand here and not beside the code so that
//! checking the feature `ros` compiles the library once.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::sync::{Arc, Mutex};

use r2r::indexmap::IndexMap;
use r2r::{Parameter, ParameterValue, QosProfile, RosParams};
use storm_node::config::Config;
use storm_node::ros::parameters::{Served, read};
use storm_node::ros::qos::{mismatch, statics};

#[test]
fn mismatches_are_those_of_dds() {
    let best = QosProfile::sensor_data();
    let reliable = QosProfile::default().reliable();
    assert_eq!(mismatch(&best, &best), None);
    assert_eq!(mismatch(&best, &reliable), None);
    assert_eq!(mismatch(&reliable, &reliable), None);
    assert!(mismatch(&reliable, &best).is_some_and(|m| m.contains("live.reliability")));
    assert!(mismatch(&statics(), &reliable.volatile()).is_some_and(|m| m.contains("transient_local")));
    assert_eq!(mismatch(&statics(), &statics()), None);
}

fn given(pairs: &[(&str, ParameterValue)]) -> IndexMap<String, Parameter> {
    pairs.iter().map(|(name, value)| (name.to_string(), Parameter::new(value.clone()))).collect()
}

#[test]
fn parameters_become_the_configuration() {
    let c = read(&given(&[
        ("use_sim_time", ParameterValue::Bool(true)),
        ("window.stride_sec", ParameterValue::Integer(1)),
        ("input.camera_infos", ParameterValue::StringArray(vec!["/i".into()])),
        ("input.images", ParameterValue::StringArray(vec!["/a".into()])),
        ("input.image_time_offset_sec", ParameterValue::NotSet),
        ("input.base_from_camera", ParameterValue::DoubleArray(vec![0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0])),
    ]))
    .unwrap();
    assert_eq!((c.window.stride_sec, c.input.images.len(), c.input.base_from_camera.len()), (1.0, 1, 1));
    for (name, value) in
        [("window.strid_sec", ParameterValue::Double(1.0)), ("window.timesteps", ParameterValue::String("x".into()))]
    {
        assert!(read(&given(&[(name, value)])).unwrap_err().to_string().contains(name));
    }
}

#[test]
fn all_are_listed_with_meaning_and_some_may_change() {
    let changed = Arc::new(Mutex::new(None));
    let mut served = Served::new(Config::default(), false, changed.clone());
    let mut params = given(&[("left_over", ParameterValue::Bool(true))]);
    served.register_parameters("", None, &mut params).unwrap();
    assert_eq!(params.len(), Config::describe().len() + 1);
    assert!(params.values().all(|p| p.description.len() > 10 && p.value != ParameterValue::NotSet));
    assert_eq!(params["input.base_from_camera"].value, ParameterValue::DoubleArray(vec![]));
    assert_eq!(params["window.stride_sec"].value, ParameterValue::Double(0.5));
    served.set_parameter("window.hop_sec", &ParameterValue::Double(0.5)).unwrap();
    assert_eq!(changed.lock().unwrap().as_ref().unwrap().window.hop_sec, 0.5);
    for (name, value) in [
        ("window.stride_sec", ParameterValue::Double(0.4)),
        ("window.hop_sec", ParameterValue::Double(-1.0)),
        ("window.hop", ParameterValue::Double(1.0)),
        ("use_sim_time", ParameterValue::Bool(true)),
    ] {
        assert!(served.set_parameter(name, &value).is_err(), "{name}");
    }
    served.set_parameter("window.stride_sec", &ParameterValue::Double(0.5)).unwrap();
}
