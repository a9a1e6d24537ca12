//! Batches made ahead on threads, in an order that does not depend on them.
//!
//! Each clip is shown `reuse` times, because driving one costs a good part of learning from it: a run of [`BLOCK`] batches'
//! worth of clips is shown once in order, then again in other orders, then the next run begins. With `k` threads, thread
//! `n mod k` makes batch `n` and hands it over through a channel of its own, and the channels are read in turn.

use std::collections::BTreeMap;
use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};

use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::clips::{ClipOptions, ClipPlan, TrainClip};
use super::error::TrainError;
use super::source::Batches;
use crate::config::ModelConfig;

/// Which samples.
#[derive(Debug, Clone)]
pub struct DataOptions {
    /// The training data's seed.
    pub seed: u64,
    /// Samples per batch.
    pub batch: usize,
    /// What clips look like.
    pub clips: ClipOptions,
    /// Before this batch, clips have one camera.
    pub one_camera_batches: u64,
    /// Before this batch, clips have no target pictures.
    pub targets_from: u64,
    /// How many times each clip is shown, at least 1.
    pub reuse: u64,
}

/// Batches of different clips before any is shown again; so many are kept in memory.
const BLOCK: u64 = 32;

/// Clips made so far in the block that is being shown, by sample, number of cameras and of targets.
type Kept = Mutex<BTreeMap<(u64, usize, usize), Arc<TrainClip>>>;

impl DataOptions {
    /// The samples of batch `index` of the run.
    pub fn samples(&self, index: u64) -> Vec<u64> {
        let (size, reuse) = (self.batch as u64, self.reuse.max(1));
        let (block, within) = (index / (BLOCK * reuse), index % (BLOCK * reuse));
        let (round, batch) = (within / BLOCK, within % BLOCK);
        let mut order: Vec<u64> = (block * BLOCK * size..(block + 1) * BLOCK * size).collect();
        if round > 0 {
            // The index of the round's first batch names the round.
            order.shuffle(&mut ChaCha8Rng::seed_from_u64(self.seed ^ (index - batch)));
        }
        order.into_iter().skip((batch * size) as usize).take(self.batch).collect()
    }

    /// The number of cameras of batch `index`: where it varies, one block of batches in six has one camera less than all, and
    /// another one in six two less.
    fn cameras(&self, index: u64) -> usize {
        if index < self.one_camera_batches {
            return 1;
        }
        let block = index / (BLOCK * self.reuse.max(1));
        let all = self.clips.cameras;
        if !self.clips.variety {
            return all;
        }
        match ChaCha8Rng::seed_from_u64(self.seed ^ !block).random_range(0..6) {
            less @ 1..=2 => all.saturating_sub(less).max(1),
            _ => all,
        }
    }

    /// How long before its timesteps batch `index` has prior images, seconds; 0: it has none.
    fn prior_sec(&self, index: u64) -> f64 {
        let block = index / (BLOCK * self.reuse.max(1));
        // Apart from the choice of cameras, which has the same seed.
        let draw: f64 = ChaCha8Rng::seed_from_u64(self.seed ^ !block.rotate_left(32)).random();
        if draw < self.clips.prior_dropout { 0.0 } else { self.clips.prior_sec }
    }

    /// The number of target times of batch `index`.
    pub(super) fn targets(&self, index: u64) -> usize {
        if index < self.targets_from { 0 } else { self.clips.targets }
    }

    /// Batch `index` of the run.
    pub fn batch(&self, index: u64, config: &ModelConfig) -> Result<TrainClip, TrainError> {
        self.batch_with(index, config, &Kept::default())
    }

    fn batch_with(&self, index: u64, config: &ModelConfig, kept: &Kept) -> Result<TrainClip, TrainError> {
        let cameras = self.cameras(index);
        let targets = self.targets(index);
        let clips = ClipOptions { cameras, targets, prior_sec: self.prior_sec(index), ..self.clips };
        let samples = self.samples(index);
        let lock = || kept.lock().unwrap_or_else(PoisonError::into_inner);
        let block = BLOCK * self.reuse.max(1);
        // Another thread may still be at the block before; then its clips are made once more, which costs time only.
        let first_kept = index / block * BLOCK * self.batch as u64;
        lock().retain(|&(sample, seen_by, drawn), _| sample >= first_kept && (seen_by, drawn) == (cameras, targets));
        let made = samples.into_iter().map(|sample| {
            let key = (sample, cameras, targets);
            let known = lock().get(&key).cloned();
            if let Some(clip) = known {
                return Ok(clip);
            }
            let clip = Arc::new(ClipPlan::training(self.seed, sample, &clips).make(&clips, config)?);
            if self.reuse > 1 {
                lock().insert(key, Arc::clone(&clip));
            }
            Ok(clip)
        });
        TrainClip::stack(&made.collect::<Result<Vec<_>, TrainError>>()?)
    }
}

/// What [`Batches::batch_with`] keeps from one batch to the next.
pub(super) type KeptClips = Kept;

impl Batches for DataOptions {
    fn batch_with(&self, index: u64, config: &ModelConfig, kept: &KeptClips) -> Result<TrainClip, TrainError> {
        DataOptions::batch_with(self, index, config, kept)
    }
}

type Made = Result<TrainClip, TrainError>;

/// Makes batches ahead.
pub struct Loader {
    lanes: Vec<Receiver<Made>>,
    next: usize,
}

impl Loader {
    /// Starts at batch `first` with `threads` threads (0: as many as there are cores, at most 4). They end when the
    /// loader is dropped.
    pub fn new(options: impl Batches + Clone + 'static, config: Arc<ModelConfig>, first: u64, threads: usize) -> Self {
        let cores = std::thread::available_parallelism().map_or(1, usize::from).min(4);
        let threads = if threads == 0 { cores } else { threads };
        let kept = Arc::new(Kept::default());
        let lane = |k: usize| {
            let (sender, receiver) = sync_channel(1);
            let (options, config, kept) = (options.clone(), Arc::clone(&config), Arc::clone(&kept));
            std::thread::spawn(move || {
                // A pool of its own: the drive's rows must not wait for the tensor library's work.
                let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().ok();
                for index in (first + k as u64..).step_by(threads) {
                    let made = match &pool {
                        Some(pool) => pool.install(|| options.batch_with(index, &config, &kept)),
                        None => options.batch_with(index, &config, &kept),
                    };
                    let failed = made.is_err();
                    if sender.send(made).is_err() || failed {
                        break;
                    }
                }
            });
            receiver
        };
        Self { lanes: (0..threads).map(lane).collect(), next: 0 }
    }

    /// The next batch; waits for it.
    pub fn next_batch(&mut self) -> Result<TrainClip, TrainError> {
        let lane = self.lanes.get(self.next).ok_or(TrainError::Loader)?;
        self.next = (self.next + 1) % self.lanes.len();
        lane.recv().map_err(|_| TrainError::Loader)?
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options(batch: usize, reuse: u64) -> DataOptions {
        DataOptions { seed: 3, batch, clips: ClipOptions::default(), one_camera_batches: 0, targets_from: 0, reuse }
    }

    #[test]
    fn every_sample_is_shown_as_often_as_asked_and_each_order_differs() {
        for (batch, reuse) in [(1, 1), (3, 1), (2, 3), (4, 2)] {
            let data = options(batch, reuse);
            let all: Vec<Vec<u64>> = (0..2 * BLOCK * reuse).map(|n| data.samples(n)).collect();
            let mut counts = BTreeMap::<u64, u64>::new();
            all.iter().flatten().for_each(|&s| *counts.entry(s).or_default() += 1);
            assert_eq!(counts.len() as u64, 2 * BLOCK * batch as u64);
            assert!(counts.values().all(|&n| n == reuse));
            assert!(all.iter().all(|b| b.len() == batch));
            let round = |r: u64| all[(r * BLOCK) as usize..((r + 1) * BLOCK) as usize].concat();
            assert!((1..reuse).all(|r| round(r) != round(0)));
        }
    }

    #[test]
    fn once_each_is_simply_in_order() {
        let data = options(4, 1);
        assert_eq!(data.samples(0), [0, 1, 2, 3]);
        assert_eq!(data.samples(BLOCK + 1), (4 * BLOCK + 4..4 * BLOCK + 8).collect::<Vec<_>>());
    }
}
