//! Saves the map every so often of wall time: what a killed run loses is time somebody waited. When it happens changes
//! nothing in the map.

use std::time::Instant;

use tracing::warn;

use super::step::StepMaker;

/// Saves now and then.
pub struct Saver {
    every_sec: f64,
    last: Instant,
    failed: u64,
}

impl Saver {
    /// Every `every_sec` seconds; 0: only when [`Saver::save`] is called.
    pub fn new(every_sec: f64) -> Self {
        Self { every_sec, last: Instant::now(), failed: 0 }
    }

    /// Saves when it is time.
    pub fn offer(&mut self, maker: &mut StepMaker) {
        if self.every_sec > 0.0 && self.last.elapsed().as_secs_f64() >= self.every_sec {
            self.save(maker);
        }
    }

    /// Saves now. A save that fails is said and counted; the run goes on.
    pub fn save(&mut self, maker: &mut StepMaker) {
        if let Err(e) = maker.save_map() {
            self.failed += 1;
            warn!("the map could not be saved: {e}");
        }
        self.last = Instant::now();
    }

    /// Saves that failed.
    pub fn failed(&self) -> u64 {
        self.failed
    }
}
