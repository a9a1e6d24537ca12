//! The mean of several trained networks. Networks that went on from the same weights lie in one valley: their mean takes out
//! of each what its last clips left in it (Wortsman et al., "Model soups", ICML 2022).

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};

use super::variants::Beginning;
use crate::cmd::UsageError;

/// The mean of the networks of these files, each loaded by `load`; of one, that network.
///
/// # Errors
/// A file that cannot be used, and networks that are not of the same shape and meaning.
pub fn mean(paths: &[PathBuf], load: &dyn Fn(&Path) -> Result<Beginning>) -> Result<Beginning> {
    let (first, rest) = paths.split_first().context("no weights to start from")?;
    let mut sum = load(first)?;
    let mut histories = vec![std::mem::take(&mut sum.history)];
    for path in rest {
        let next = load(path)?;
        if next.config != sum.config {
            let (a, b) = (first.display(), path.display());
            return Err(
                UsageError(format!("--weights: {a} and {b} are not of the same network; no mean of them")).into()
            );
        }
        for (name, tensor) in &mut sum.weights {
            let other = next.weights.get(name).with_context(|| format!("{} has no tensor {name}", path.display()))?;
            *tensor = (&*tensor + other)?;
        }
        histories.push(next.history);
    }
    for tensor in sum.weights.values_mut().filter(|_| !rest.is_empty()) {
        *tensor = (&*tensor / paths.len() as f64)?;
    }
    sum.history = told(&histories);
    Ok(sum)
}

/// What happened to all of them, then to each.
fn told(histories: &[String]) -> String {
    let stages: Vec<Vec<&str>> = histories.iter().map(|h| h.split("; ").collect()).collect();
    let [first, rest @ ..] = stages.as_slice() else { return String::new() };
    if rest.is_empty() {
        return first.join("; ");
    }
    let shared = (0..first.len()).take_while(|&i| rest.iter().all(|h| h.get(i) == first.get(i))).count();
    let own: Vec<String> = stages.iter().map(|h| h[shared..].join("; ")).collect();
    let own: Vec<&str> = own.iter().map(|h| if h.is_empty() { "these" } else { h.as_str() }).collect();
    let mean = format!("the mean of {}: ({})", own.len(), own.join(") and ("));
    first[..shared].iter().copied().chain([mean.as_str()]).collect::<Vec<_>>().join("; ")
}

#[cfg(test)]
mod tests {
    use candle_core::Device;
    use storm_model::config::ModelConfig;
    use storm_model::weights;

    use super::*;

    fn network(name: &str) -> Result<Beginning> {
        let mut config = ModelConfig::preset("tiny")?;
        config.depth = 1;
        if name == "other" {
            config.num_motion_tokens = 4;
        }
        let seed = u64::from(name.as_bytes()[0]);
        let weights = weights::untrained(&config, seed, &Device::Cpu)?;
        Ok(Beginning { config, weights, history: format!("born; raised; {name}") })
    }

    #[test]
    fn means_are_of_every_tensor() {
        let load = |path: &Path| network(&path.to_string_lossy());
        let of = |names: &[&str]| mean(&names.iter().map(PathBuf::from).collect::<Vec<_>>(), &load);
        let (a, b, both) = (of(&["a"]).unwrap(), of(&["b"]).unwrap(), of(&["a", "b"]).unwrap());
        assert_eq!(a.history, "born; raised; a");
        assert_eq!(both.history, "born; raised; the mean of 2: (a) and (b)");
        let flat = |x: &Beginning, name: &str| x.weights[name].flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let mut differ = 0;
        for name in a.weights.keys() {
            let (x, y, z) = (flat(&a, name), flat(&b, name), flat(&both, name));
            differ += usize::from(x != y);
            for i in 0..x.len() {
                assert!((z[i] - (x[i] + y[i]) / 2.0).abs() <= 1e-6 * x[i].abs().max(y[i].abs()), "{name} {i}");
            }
        }
        assert!(differ > 5);
        let e = of(&["a", "other"]).err().unwrap().to_string();
        assert!(e.contains("other") && e.contains("not of the same network"), "{e}");
        assert!(of(&[]).is_err());
    }

    #[test]
    fn what_was_shared_is_told_once() {
        let told = |all: &[&str]| told(&all.iter().map(|s| (*s).to_owned()).collect::<Vec<_>>());
        assert_eq!(told(&["a; b", "a; b; c"]), "a; b; the mean of 2: (these) and (c)");
        assert_eq!(told(&["x", "y"]), "the mean of 2: (x) and (y)");
    }
}
