//! The perceptual term of the paper (LPIPS, Zhang et al. 2018) with a feature network from a file.
//!
//! The file is a safetensors file with torchvision's names of a VGG-16, VGG-19 or AlexNet, `features.{i}.weight` and
//! `features.{i}.bias`, and the learned channel weights `lin{k}.model.1.weight` of shape `(1, channels, 1, 1)`. Widths and
//! number of layers are those of the file: index `i` tells where its poolings are (a convolution and its ReLU take two
//! numbers, a pooling one more). VGGs are compared after the last ReLU of every block, AlexNets after every ReLU.

use std::collections::HashMap;
use std::path::Path;

use candle_core::{D, DType, Device, Result, Tensor, Var};

use super::error::TrainError;
use crate::ops::{Activation, Linear, linear};

/// LPIPS's scaling of colours in -1..1 before the first layer: mean and deviation of ImageNet in that range.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];

/// Added to the length a feature is divided by, and (squared) under its root, so that a zero feature has a gradient.
const EPS: f64 = 1e-10;

/// Kernel side of AlexNet's first convolution, which tells it from a VGG.
const ALEX_KERNEL: usize = 11;

/// Widest layer accepted.
const MAX_CHANNELS: usize = 4096;

/// A convolution with its ReLU.
struct Conv {
    /// `(out, kernel * kernel * in)`.
    layer: Linear,
    kernel: usize,
    stride: usize,
    pad: usize,
    /// Side of the pooling (stride 2) in front of it.
    pool: Option<usize>,
    /// Channel weights `(channels)` where its features are compared.
    tap: Option<Tensor>,
}

/// A feature network that says how different two pictures look.
pub struct FeatureNetwork {
    convs: Vec<Conv>,
    device: Device,
}

impl FeatureNetwork {
    /// Reads a file; see the module for the names.
    ///
    /// # Errors
    /// A file that cannot be read, a missing or mis-shaped tensor, or a value that is not finite.
    pub fn load(path: &Path, device: &Device) -> std::result::Result<Self, TrainError> {
        let bad = |reason: String| TrainError::Source(format!("feature network {}: {reason}", path.display()));
        let tensors = candle_core::safetensors::load(path, &Device::Cpu).map_err(|e| bad(e.to_string()))?;
        // The first line: a backtrace may follow where one was asked for.
        Self::new(&tensors, device).map_err(|e| bad(e.to_string().lines().next().unwrap_or_default().to_owned()))
    }

    /// From named tensors.
    pub fn new(tensors: &HashMap<String, Tensor>, device: &Device) -> Result<Self> {
        let index = |name: &String| name.strip_prefix("features.")?.strip_suffix(".weight")?.parse::<usize>().ok();
        let mut places: Vec<usize> = tensors.keys().filter_map(index).collect();
        places.sort_unstable();
        let get = |name: String| -> Result<Tensor> {
            let Some(x) = tensors.get(&name) else { candle_core::bail!("no tensor {name}") };
            let x = x.to_dtype(DType::F32)?;
            let bad = x.flatten_all()?.to_vec1::<f32>()?.iter().filter(|x| !x.is_finite()).count();
            if bad > 0 {
                candle_core::bail!("{name} holds {bad} value(s) that are not finite");
            }
            x.to_device(device)
        };
        if places.first() != Some(&0) {
            candle_core::bail!("no tensor features.0.weight; it needs torchvision's names of a VGG or AlexNet");
        }
        let mut convs: Vec<Conv> = Vec::with_capacity(places.len());
        let (mut channels, mut taps, mut alex) = (3, 0, false);
        for (k, &place) in places.iter().enumerate() {
            let name = format!("features.{place}.weight");
            let weight = get(name.clone())?;
            let (out, into, kernel, width) = weight.dims4()?;
            let fits = into == channels && kernel == width && kernel % 2 == 1 && kernel <= ALEX_KERNEL;
            if !(fits && (1..=MAX_CHANNELS).contains(&out)) {
                candle_core::bail!("{name} has shape {:?} where {channels} channels come in", weight.dims());
            }
            alex = alex || (k == 0 && kernel == ALEX_KERNEL);
            let step = |from: usize, to: Option<&usize>| to.map(|to| to - from);
            let pooled = match k.checked_sub(1).map(|before| place - places[before]) {
                None | Some(2) => false,
                Some(3) => true,
                Some(gap) => {
                    candle_core::bail!("{name} comes {gap} layers after the convolution before it, not 2 or 3")
                }
            };
            let compared = alex || step(place, places.get(k + 1)) != Some(2);
            let tap = if compared {
                let name = format!("lin{taps}.model.1.weight");
                let weights = get(name.clone())?;
                if weights.dims() != [1, out, 1, 1] {
                    candle_core::bail!("{name} has shape {:?}, expected [1, {out}, 1, 1]", weights.dims());
                }
                taps += 1;
                Some(weights.reshape(out)?)
            } else {
                None
            };
            let name = format!("features.{place}.bias");
            let bias = get(name.clone())?;
            if bias.dims() != [out] {
                candle_core::bail!("{name} has shape {:?} for {out} channels", bias.dims());
            }
            let rows = weight.permute((0, 2, 3, 1))?.contiguous()?.reshape((out, kernel * kernel * into))?;
            let first = kernel == ALEX_KERNEL;
            convs.push(Conv {
                layer: Linear::new(rows, Some(bias)),
                kernel,
                stride: if first { 4 } else { 1 },
                pad: if first { 2 } else { kernel / 2 },
                pool: pooled.then_some(if alex { 3 } else { 2 }),
                tap,
            });
            channels = out;
        }
        if tensors.contains_key(&format!("lin{taps}.model.1.weight")) {
            candle_core::bail!("lin{taps}.model.1.weight is one more than the {taps} places features are compared at");
        }
        Ok(Self { convs, device: device.clone() })
    }

    /// Mean distance of pictures `(b, t, v, h, w, 3)` in the network range. The gradient flows into `pred` only.
    ///
    /// One picture at a time, its gradient taken at once: the features of a batch would not fit in memory.
    pub fn distance(&self, pred: &Tensor, truth: &Tensor) -> Result<Tensor> {
        let &[b, t, v, h, w, 3] = pred.dims() else {
            candle_core::bail!("perceptual term: pictures have shape {:?}, expected (b, t, v, h, w, 3)", pred.dims());
        };
        let count = b * t * v;
        let flat = |x: &Tensor| x.detach().reshape((count, h, w, 3));
        let (seen, wanted) = (flat(pred)?, flat(truth)?);
        let mut sum = Tensor::zeros((), DType::F32, &self.device)?;
        let mut gradients = Vec::with_capacity(count);
        for k in 0..count {
            let picture = Var::from_tensor(&seen.narrow(0, k, 1)?)?;
            let loss = self.of_picture(&picture, &wanted.narrow(0, k, 1)?)?;
            sum = (sum + loss.detach())?;
            let gradient = loss.backward()?.remove(&picture);
            gradients.push(gradient.map_or_else(|| picture.zeros_like(), Ok)?.detach());
        }
        let share = 1.0 / count.max(1) as f64;
        let gradient = (Tensor::cat(&gradients, 0)?.reshape(pred.dims())? * share)?;
        // Zero in value, and its derivative is the gradient found above.
        let carrier = ((pred - pred.detach())? * gradient)?.sum_all()?;
        (sum * share)? + carrier
    }

    fn of_picture(&self, pred: &Tensor, truth: &Tensor) -> Result<Tensor> {
        let (mut a, mut b) = (scaled(pred)?, scaled(truth)?);
        let mut sum: Option<Tensor> = None;
        for conv in &self.convs {
            (a, b) = (conv.forward(&a)?, conv.forward(&b)?);
            let Some(weights) = &conv.tap else { continue };
            let error = (unit(&a)? - unit(&b)?)?.sqr()?;
            let here = error.broadcast_mul(weights)?.sum(D::Minus1)?.mean_all()?;
            sum = Some(match sum {
                Some(sum) => (sum + here)?,
                None => here,
            });
        }
        match sum {
            Some(sum) => Ok(sum),
            None => candle_core::bail!("the feature network compares nothing"),
        }
    }
}

fn scaled(x: &Tensor) -> Result<Tensor> {
    let row = |values: [f32; 3]| Tensor::new(&values, x.device());
    x.broadcast_sub(&row(SHIFT)?)?.broadcast_mul(&row(SCALE.map(|s| 1.0 / s))?)
}

/// Features over their length.
fn unit(x: &Tensor) -> Result<Tensor> {
    let length = (x.sqr()?.sum_keepdim(D::Minus1)? + EPS * EPS)?.sqrt()?;
    x.broadcast_div(&(length + EPS)?)
}

impl Conv {
    /// `(n, h, w, c)` to `(n, h', w', out)`.
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let x = match self.pool {
            Some(side) => pool(&pool(x, 1, side)?, 2, side)?,
            None => x.clone(),
        };
        let x = x.pad_with_zeros(1, self.pad, self.pad)?.pad_with_zeros(2, self.pad, self.pad)?;
        let mut parts = Vec::with_capacity(self.kernel * self.kernel);
        for dy in 0..self.kernel {
            let rows = every(&x, 1, dy, self.kernel, self.stride)?;
            for dx in 0..self.kernel {
                parts.push(every(&rows, 2, dx, self.kernel, self.stride)?);
            }
        }
        linear(&Tensor::cat(&parts, 3)?.contiguous()?, &self.layer, Activation::None, None)?.relu()
    }
}

/// Every `stride`-th slice along `axis` from `from` on, as many as windows of `side` fit.
fn every(x: &Tensor, axis: usize, from: usize, side: usize, stride: usize) -> Result<Tensor> {
    let n = x.dim(axis)?;
    if n < side {
        candle_core::bail!("pictures are too small for the feature network: a window of {side} on {n} pixels");
    }
    let count = (n - side) / stride + 1;
    if stride == 1 {
        return x.narrow(axis, from, count);
    }
    let places: Vec<u32> = (0..count).map(|k| (from + k * stride) as u32).collect();
    x.contiguous()?.index_select(&Tensor::new(places, x.device())?, axis)
}

/// Largest of `side` neighbours along `axis`, two steps apart.
fn pool(x: &Tensor, axis: usize, side: usize) -> Result<Tensor> {
    let mut most = every(x, axis, 0, side, 2)?;
    for k in 1..side {
        most = most.maximum(&every(x, axis, k, side, 2)?)?;
    }
    Ok(most)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two f32 programs of the same sums.
    const SAME_DISTANCE: f32 = 2e-5;

    /// Their gradients, over the largest.
    const SAME_GRADIENT: f32 = 1e-4;

    /// Central differences in f32 against the gradient, over the largest: a step of 1e-2 crosses edges of ReLUs and poolings.
    const DIFFERENCES: f64 = 0.05;

    fn fixture(name: &str) -> HashMap<String, Tensor> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/fixtures").join(name);
        candle_core::safetensors::load(path, &Device::Cpu).unwrap()
    }

    /// `(1, 3, h, w)` as `(1, 1, 1, h, w, 3)`.
    fn picture(x: &Tensor) -> Tensor {
        x.permute((0, 2, 3, 1)).unwrap().unsqueeze(0).unwrap().unsqueeze(0).unwrap().contiguous().unwrap()
    }

    fn numbers(x: &Tensor) -> Vec<f32> {
        x.flatten_all().unwrap().to_vec1().unwrap()
    }

    #[test]
    fn distance_and_gradient_are_those_of_pytorch() {
        for name in ["lpips_vgg.safetensors", "lpips_alex.safetensors"] {
            let stored = fixture(name);
            let network = FeatureNetwork::new(&stored, &Device::Cpu).unwrap();
            let (pred, truth) = (Var::from_tensor(&picture(&stored["pred"])).unwrap(), picture(&stored["truth"]));
            // Twice the picture: the mean is the same, each gradient half.
            let two = Tensor::cat(&[pred.as_tensor(), pred.as_tensor()], 2).unwrap();
            let distance = network.distance(&two, &Tensor::cat(&[&truth, &truth], 2).unwrap()).unwrap();
            let (got, want) = (distance.to_scalar::<f32>().unwrap(), numbers(&stored["distance"])[0]);
            assert!((got - want).abs() <= SAME_DISTANCE * want, "{name}: {got} for {want}");
            let grads = distance.backward().unwrap();
            let (got, want) = (numbers(grads.get(&pred).unwrap()), numbers(&picture(&stored["gradient"])));
            let largest = want.iter().fold(0f32, |m, x| m.max(x.abs()));
            let worst = got.iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0f32, f32::max);
            assert!(largest > 0.0 && worst <= SAME_GRADIENT * largest, "{name}: off by {worst} of {largest}");
            assert_eq!(network.distance(&truth, &truth).unwrap().to_scalar::<f32>().unwrap(), 0.0);
        }
    }

    #[test]
    fn gradients_are_the_differences_of_the_distance() {
        let stored = fixture("lpips_vgg.safetensors");
        let network = FeatureNetwork::new(&stored, &Device::Cpu).unwrap();
        let (pred, truth) = (Var::from_tensor(&picture(&stored["pred"])).unwrap(), picture(&stored["truth"]));
        let value = |x: &Tensor| f64::from(network.distance(x, &truth).unwrap().to_scalar::<f32>().unwrap());
        let grads = network.distance(pred.as_tensor(), &truth).unwrap().backward().unwrap();
        let gradient = grads.get(&pred).unwrap().clone();
        let norm = gradient.sqr().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap().sqrt();
        // Along the gradient the slope is its length; across it (every second component flipped) what is left.
        let signs: Vec<f32> = (0..gradient.elem_count()).map(|i| if i % 3 == 0 { 1.0 } else { -1.0 }).collect();
        let signs = Tensor::from_vec(signs, gradient.dims(), &Device::Cpu).unwrap();
        for direction in [gradient.clone(), (&gradient * &signs).unwrap()] {
            let direction = (direction / f64::from(norm)).unwrap();
            let slope = f64::from((&gradient * &direction).unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap());
            let step = (&direction * 0.01).unwrap();
            let (up, down) = (value(&(pred.as_tensor() + &step).unwrap()), value(&(pred.as_tensor() - &step).unwrap()));
            let found = (up - down) / 0.02;
            assert!((found - slope).abs() <= DIFFERENCES * f64::from(norm), "{found} for {slope} of {norm}");
        }
    }

    #[test]
    fn unfit_files_are_refused_by_name() {
        let whole = fixture("lpips_vgg.safetensors");
        let refuse = |change: &dyn Fn(&mut HashMap<String, Tensor>), word: &str| {
            let mut tensors = whole.clone();
            change(&mut tensors);
            let error = FeatureNetwork::new(&tensors, &Device::Cpu).err().unwrap().to_string();
            assert!(error.contains(word), "{error}");
        };
        refuse(&|t| drop(t.remove("features.0.weight")), "features.0.weight");
        refuse(&|t| drop(t.remove("features.2.bias")), "features.2.bias");
        refuse(&|t| drop(t.remove("lin3.model.1.weight")), "lin3.model.1.weight");
        refuse(&|t| drop(t.remove("features.12.weight")), "features.14.weight comes 4 layers");
        refuse(
            &|t| {
                let x = t["features.5.weight"].clone();
                t.insert("features.2.weight".into(), x);
            },
            "lin0.model.1.weight has shape",
        );
        refuse(
            &|t| {
                let x = (&t["lin0.model.1.weight"] * f64::NAN).unwrap();
                t.insert("lin0.model.1.weight".into(), x);
            },
            "not finite",
        );
        refuse(
            &|t| {
                let x = t["lin0.model.1.weight"].clone();
                t.insert("lin5.model.1.weight".into(), x);
            },
            "lin5",
        );
        let network = FeatureNetwork::new(&whole, &Device::Cpu).unwrap();
        let tiny = Tensor::zeros((1, 1, 1, 8, 8, 3), DType::F32, &Device::Cpu).unwrap();
        assert!(network.distance(&tiny, &tiny).unwrap_err().to_string().contains("too small"));
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("x.safetensors");
        std::fs::write(&path, b"not a network").unwrap();
        let error = FeatureNetwork::load(&path, &Device::Cpu).err().unwrap().to_string();
        assert!(error.contains("x.safetensors"), "{error}");
    }
}
