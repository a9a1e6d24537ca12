//! Whether a bench repeats: its ratios beside those of an earlier one, from the JSON of both.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::Value;

/// Ratios that differ by no more than this repeat.
const NEAR: f64 = 0.1;

/// The ratios two benches have in common.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct Repeat {
    pub compared: usize,
    pub near: usize,
    /// What differs most, name, then the earlier and the present ratio; those that are not near, the worst first.
    pub far: Vec<(String, f64, f64)>,
}

/// Every ratio of a bench by a name of its own: settings over their network's default, drives with skipping over full steps, sizes
/// over the usual one, the largest network's default over its peers.
fn ratios(bench: &Value) -> BTreeMap<String, f64> {
    let list = |value: &Value, key: &str| value[key].as_array().cloned().unwrap_or_default();
    let text = |value: &Value, key: &str| value[key].as_str().unwrap_or_default().to_string();
    let mut all = BTreeMap::new();
    let mut put = |name: String, ratio: Option<f64>| {
        if let Some(ratio) = ratio.filter(|r| r.is_finite() && *r > 0.0) {
            all.insert(name, ratio);
        }
    };
    for s in list(bench, "settings") {
        put(format!("{}, {}", text(&s, "model"), text(&s, "setting")), s["times_less"].as_f64());
    }
    for setting in list(bench, "drives") {
        for row in list(&setting, "rows") {
            put(format!("{}, {} drive", text(&setting, "setting"), text(&row, "drive")), row["ratio"].as_f64());
        }
    }
    for p in list(bench, "sizes") {
        let name =
            format!("{}: {} timesteps, {} cameras, {}", text(&p, "curve"), p["timesteps"], p["cameras"], p["picture"]);
        put(name, p["times_usual"].as_f64());
    }
    for peer in list(bench, "peers") {
        put(format!("PyTorch, {}", text(&peer, "name")), peer["times_less"].as_f64());
    }
    all
}

/// Compares two benches; ratios that only one of them has are passed over.
pub(super) fn compare(earlier: &Value, now: &Value) -> Repeat {
    let (earlier, now) = (ratios(earlier), ratios(now));
    let apart = |(_, a, b): &(String, f64, f64)| (b / a).max(a / b) - 1.0;
    let both = now.into_iter().filter_map(|(name, now)| earlier.get(&name).map(|&before| (name, before, now)));
    let (near, mut far): (Vec<_>, Vec<_>) = both.partition(|ratio| apart(ratio) <= NEAR);
    far.sort_by(|a, b| apart(b).total_cmp(&apart(a)));
    Repeat { compared: near.len() + far.len(), near: near.len(), far }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn bench(int8: f64, standing: f64, peer: f64) -> Value {
        json!({
            "settings": [
                {"model": "b8", "setting": "default", "times_less": null, "step_ms": {"p50": 8000.0}},
                {"model": "b8", "setting": "int8", "times_less": int8, "step_ms": {"p50": 4000.0}},
            ],
            "drives": [{"setting": "default", "rows": [{"drive": "standing", "ratio": standing}]}],
            "peers": [{"name": "f32, eager", "times_less": peer}, {"name": "f32, compiled", "times_less": null}],
        })
    }

    #[test]
    fn ratios_are_compared_by_name_and_the_worst_comes_first() {
        let same = compare(&bench(2.0, 50.0, 16.0), &bench(2.1, 50.0, 16.0));
        assert_eq!(same, Repeat { compared: 3, near: 3, far: Vec::new() });
        let apart = compare(&bench(2.0, 50.0, 16.0), &bench(1.0, 58.0, 16.0));
        assert_eq!((apart.compared, apart.near), (3, 1));
        assert_eq!(apart.far[0], ("b8, int8".to_string(), 2.0, 1.0));
        assert_eq!(apart.far[1].0, "default, standing drive");
        assert_eq!(compare(&json!({}), &bench(2.0, 50.0, 16.0)).compared, 0);
    }
}
