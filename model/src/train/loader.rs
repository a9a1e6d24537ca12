//! Batches made ahead on threads, in an order that does not depend on them.
//!
//! Batch `n` holds samples `n * size ..`; with `k` threads, thread `n mod k` makes batch `n` and hands it over through a
//! channel of its own, and the channels are read in turn.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};

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
}

impl DataOptions {
    /// Batch `index` of the run.
    pub fn batch(&self, index: u64, config: &ModelConfig) -> Result<TrainClip, TrainError> {
        let cameras = if index < self.one_camera_batches { 1 } else { self.clips.cameras };
        let clips = ClipOptions { cameras, ..self.clips };
        let size = self.batch as u64;
        let made = (index * size..(index + 1) * size)
            .map(|sample| ClipPlan::training(self.seed, sample, &clips).make(&clips, config))
            .collect::<Result<Vec<_>, _>>()?;
        TrainClip::stack(&made)
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
        let lane = |k: usize| {
            let (sender, receiver) = sync_channel(1);
            let (options, config) = (options.clone(), Arc::clone(&config));
            std::thread::spawn(move || {
                // A pool of its own: the drive's rows must not wait for the tensor library's work.
                let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().ok();
                for index in (first + k as u64..).step_by(threads) {
                    let made = match &pool {
                        Some(pool) => pool.install(|| options.batch(index, &config)),
                        None => options.batch(index, &config),
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
