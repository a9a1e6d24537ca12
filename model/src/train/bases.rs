//! Velocity bases taught to be the motions of their own scene.
//!
//! Cross-entropy and velocity error leave the bases where they start (a fixed fan): choosing between 16 fixed classes is easier than
//! moving them. So the true motions of a window's objects are found, each is given the nearest basis, and that basis is pulled there.

use candle_core::{D, Tensor};

use crate::config::VelocityKind;
use crate::error::ModelError;
use crate::network::ClipOutput;

/// Velocities this near to each other are one motion, m/s: less than half the distance between neighbours of the initial fan.
const SAME_MOTION_MPS: f32 = 1.0;

/// Moving pixels looked at per window: enough to find every object that covers a thousandth of them.
const SAMPLES: usize = 4096;

/// Fewest sampled pixels of a motion that is worth a basis.
const LEAST_SAMPLES: usize = 4;

/// The motions of a window: mean velocity, m/s, and number of samples; the most frequent first.
fn motions(flow: &[f32], moving: &[f32]) -> Vec<([f32; 3], usize)> {
    let movers: Vec<usize> = (0..moving.len()).filter(|&i| moving[i] > 0.0).collect();
    let step = movers.len().div_ceil(SAMPLES).max(1);
    let mut found: Vec<([f32; 3], usize)> = Vec::new();
    for &i in movers.iter().step_by(step) {
        let Some(&[x, y, z]) = flow.get(3 * i..3 * i + 3).and_then(|v| v.first_chunk::<3>()) else { continue };
        let distance = |m: &[f32; 3]| ((m[0] - x).powi(2) + (m[1] - y).powi(2) + (m[2] - z).powi(2)).sqrt();
        let nearest = found.iter_mut().min_by(|a, b| distance(&a.0).total_cmp(&distance(&b.0)));
        match nearest.filter(|m| distance(&m.0) < SAME_MOTION_MPS) {
            Some((mean, count)) => {
                *count += 1;
                let share = 1.0 / *count as f32;
                mean.iter_mut().zip([x, y, z]).for_each(|(m, v)| *m += (v - *m) * share);
            }
            None => found.push(([x, y, z], 1)),
        }
    }
    found.retain(|(_, count)| *count >= LEAST_SAMPLES);
    found.sort_by_key(|(_, count)| std::cmp::Reverse(*count));
    found
}

/// Which basis learns which motion: the nearest free one, frequent motions first; the first basis stands for standing still.
fn assign(bases: &[[f32; 3]], motions: &[([f32; 3], usize)]) -> Vec<(usize, [f32; 3], usize)> {
    let mut free: Vec<usize> = (1..bases.len()).collect();
    let mut pairs = Vec::new();
    for &(motion, count) in motions {
        let distance = |k: usize| (0..3).map(|c| (bases[k][c] - motion[c]).powi(2)).sum::<f32>();
        let Some(at) = (0..free.len()).min_by(|&a, &b| distance(free[a]).total_cmp(&distance(free[b]))) else { break };
        pairs.push((free.swap_remove(at), motion, count));
    }
    pairs
}

/// Mean absolute difference, m/s, between matched bases and motions, each weighted by the root of its pixels; the first basis to
/// standing still. `flow` is `(b, t, v, h, w, 3)`, `moving` `(b, t, v, h, w)`: above 0 where the surface is known to move. None
/// without motion tokens.
pub(super) fn bases_loss(output: &ClipOutput, flow: &Tensor, moving: &Tensor) -> Result<Option<Tensor>, ModelError> {
    let Some(bases) = &output.motion_bases else { return Ok(None) };
    let (b, m, channels) = bases.dims3()?;
    let (mut wanted, mut weights) = (vec![0f32; b * m * channels], vec![0f32; b * m * channels]);
    for window in 0..b {
        let host = bases.get(window)?.narrow(D::Minus1, channels - 3, 3)?.detach().contiguous()?;
        let host: Vec<[f32; 3]> = host.flatten_all()?.to_vec1::<f32>()?.as_chunks::<3>().0.to_vec();
        let flow = flow.get(window)?.flatten_all()?.to_vec1::<f32>()?;
        let moving = moving.get(window)?.flatten_all()?.to_vec1::<f32>()?;
        let still = std::iter::once((0, [0.0; 3], 1));
        for (k, motion, count) in still.chain(assign(&host, &motions(&flow, &moving))) {
            let row: Vec<f32> = match output.config.velocity {
                VelocityKind::One => motion.to_vec(),
                VelocityKind::ForwardBackward => [motion.map(|x| -x), motion].concat(),
            };
            let at = (window * m + k) * channels;
            wanted[at..at + channels].copy_from_slice(&row);
            weights[at..at + channels].fill((count as f32).sqrt());
        }
    }
    let tensor = |x: Vec<f32>| Tensor::from_vec(x, (b, m, channels), bases.device());
    super::losses::masked_mean(&(bases - tensor(wanted)?)?.abs()?, &tensor(weights)?).map_err(ModelError::from)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_object_is_one_motion_and_noise_is_none() {
        let mut flow = Vec::new();
        let mut push =
            |n: usize, v: [f32; 3]| (0..n).for_each(|i| flow.extend([v[0] + 0.02 * i as f32 / n as f32, v[1], v[2]]));
        push(100, [8.0, 0.0, 0.0]);
        push(40, [0.0, -1.4, 0.0]);
        push(2, [30.0, 0.0, 0.0]);
        push(50, [0.0; 3]);
        let moving: Vec<f32> = (0..192).map(|i| if i < 142 { 10.0 } else { 0.0 }).collect();
        let found = motions(&flow, &moving);
        assert_eq!(found.iter().map(|m| m.1).collect::<Vec<_>>(), [100, 40]);
        assert!((found[0].0[0] - 8.01).abs() < 1e-3 && (found[1].0[1] + 1.4).abs() < 1e-3);
    }

    #[test]
    fn frequent_motions_take_the_nearest_basis_and_never_the_first() {
        let bases = [[0.0; 3], [6.0, 0.0, 0.0], [-6.0, 0.0, 0.0]];
        let motions = [([7.0, 0.0, 0.0], 9), ([0.1, 0.0, 0.0], 5), ([5.0, 0.0, 0.0], 4)];
        let pairs: Vec<(usize, f32)> = assign(&bases, &motions).iter().map(|p| (p.0, p.1[0])).collect();
        assert_eq!(pairs, [(1, 7.0), (2, 0.1)]);
    }
}
