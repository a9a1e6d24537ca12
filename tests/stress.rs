//! The stress suite at reduced size: every case within its limit, nothing non-finite, and JSON as acceptance reads it.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use common::{code, stderr, storm};
use serde_json::Value;

#[test]
fn every_case_of_the_stress_suite_passes() {
    let dir = tempfile::tempdir().unwrap();
    let json = dir.path().join("stress.json");
    let output = storm(&["stress", "--quick", "--json", json.to_str().unwrap()]);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let report: Value = serde_json::from_slice(&std::fs::read(&json).unwrap()).unwrap();
    let cases = report["cases"].as_array().unwrap();
    assert!(cases.len() > 80, "{} cases", cases.len());
    let mut names = std::collections::BTreeSet::new();
    for case in cases {
        assert_eq!(case["nonfinite"], 0, "{case}");
        let (error, limit) = (case["worst_error"].as_f64().unwrap(), case["limit"].as_f64().unwrap());
        assert!(error <= limit, "{case}");
        assert_eq!(case["refused"].is_string(), case["must_refuse"].as_bool().unwrap(), "{case}");
        assert!(names.insert((case["group"].to_string(), case["name"].to_string())), "{case} is there twice");
    }
    let groups: std::collections::BTreeSet<_> = names.iter().map(|(group, _)| group).collect();
    assert!(groups.len() >= 7, "{groups:?}");
}
