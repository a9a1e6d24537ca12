//! A batch's clips learned from apart, several at a time.
//!
//! Kernels use all cores, but much of a step is candle's own element-wise work between them, on the thread that called it. Clips
//! are independent until their gradients meet, so each has a graph of its own, and as many threads as there are cores
//! take them one after the other: what one thread does alone, another's kernels run beside. Their tensors are a clip's and not a
//! batch's, small enough for the allocator to keep.
//!
//! Losses and gradients are summed in the clips' order whoever worked them out, so results do not depend on the threads.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use candle_core::{Tensor, Var};

use super::clips::TrainClip;
use super::error::TrainError;
use super::losses::Terms;
use super::raster::SharedRenderer;

/// What was learned of some clips.
pub(super) struct Learned {
    /// Every term, weight applied: means over the clips.
    pub(super) terms: Vec<(&'static str, f64)>,
    /// Of each variable; none where no term depends on it.
    pub(super) gradients: Vec<Option<Vec<f32>>>,
    /// Of the forward pass and losses, and of the backward pass, spread over the threads.
    pub(super) seconds: [f64; 2],
}

fn learn_one(
    clip: &TrainClip,
    vars: &[Var],
    losses: &(impl Fn(&TrainClip, &SharedRenderer) -> Result<Terms, TrainError> + Sync),
    renderer: &SharedRenderer,
) -> Result<Learned, TrainError> {
    let start = Instant::now();
    let terms = losses(clip, renderer)?;
    let values = terms.values()?;
    let total = terms.total()?;
    let forward_sec = start.elapsed().as_secs_f64();
    if values.iter().any(|(_, x)| !x.is_finite()) {
        // The caller names what is not finite; there is nothing to learn from it.
        return Ok(Learned { terms: values, gradients: vec![None; vars.len()], seconds: [forward_sec, 0.0] });
    }
    let start = Instant::now();
    let grads = total.backward()?;
    let take = |var: &Var| grads.get(var).map(|g: &Tensor| g.flatten_all()?.to_vec1::<f32>()).transpose();
    let gradients = vars.iter().map(take).collect::<candle_core::Result<_>>()?;
    Ok(Learned { terms: values, gradients, seconds: [forward_sec, start.elapsed().as_secs_f64()] })
}

/// Learns from every share with as many threads as there are renderers, each drawing with its own.
pub(super) fn learn(
    shares: &[TrainClip],
    vars: &[Var],
    losses: &(impl Fn(&TrainClip, &SharedRenderer) -> Result<Terms, TrainError> + Sync),
    renderers: &[SharedRenderer],
) -> Result<Learned, TrainError> {
    let results: Vec<Mutex<Option<Result<Learned, TrainError>>>> = shares.iter().map(|_| Mutex::new(None)).collect();
    let next = AtomicUsize::new(0);
    let work = |renderer: &SharedRenderer| {
        while let Some((clip, result)) = {
            let at = next.fetch_add(1, Ordering::Relaxed);
            shares.get(at).zip(results.get(at))
        } {
            let learned = learn_one(clip, vars, losses, renderer);
            *result.lock().unwrap_or_else(std::sync::PoisonError::into_inner) = Some(learned);
        }
    };
    let threads = renderers.len().min(shares.len());
    std::thread::scope(|scope| {
        let work = &work;
        for renderer in renderers.iter().take(threads).skip(1) {
            scope.spawn(move || work(renderer));
        }
        if let Some(renderer) = renderers.first() {
            work(renderer);
        }
    });
    let mut all = Vec::with_capacity(shares.len());
    for result in results {
        let result = result.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        all.extend(result.transpose()?);
    }
    Ok(mean(all, vars.len(), threads.max(1)))
}

/// The mean of what was learned of equal shares; a term or gradient that one lacks is 0 there.
fn mean(all: Vec<Learned>, vars: usize, threads: usize) -> Learned {
    let part = 1.0 / all.len().max(1) as f64;
    let mut mean = Learned { terms: Vec::new(), gradients: vec![None; vars], seconds: [0.0; 2] };
    for learned in all {
        for (name, value) in learned.terms {
            match mean.terms.iter_mut().find(|(known, _)| *known == name) {
                Some((_, sum)) => *sum += value * part,
                None => mean.terms.push((name, value * part)),
            }
        }
        for (sum, gradient) in mean.gradients.iter_mut().zip(learned.gradients) {
            let Some(mut gradient) = gradient else { continue };
            match sum {
                Some(sum) => sum.iter_mut().zip(&gradient).for_each(|(s, g)| *s += g * part as f32),
                None => {
                    gradient.iter_mut().for_each(|g| *g *= part as f32);
                    *sum = Some(gradient);
                }
            }
        }
        for (sum, seconds) in mean.seconds.iter_mut().zip(learned.seconds) {
            *sum += seconds / threads as f64;
        }
    }
    mean
}
