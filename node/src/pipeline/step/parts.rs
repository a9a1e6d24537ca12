//! The parts of a step, each of which may panic without taking the run with it.

use anyhow::Result;
use tracing::warn;

use super::StepMaker;
use crate::pipeline::guard::{MOST_IN_A_ROW, StagePanics, caught};

/// A part of a step, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// Deciding whether to compute.
    Gate,
    /// The network.
    Network,
    /// Comparing with earlier windows.
    Overlap,
    /// Drawing.
    Draw,
    /// Adding to the map.
    Map,
    /// Trajectories and objects.
    Follow,
    /// Saving the map.
    Save,
}

impl Part {
    fn name(self) -> &'static str {
        match self {
            Self::Gate => "gate",
            Self::Network => "network",
            Self::Overlap => "overlap",
            Self::Draw => "drawing",
            Self::Map => "map",
            Self::Follow => "tracking",
            Self::Save => "saving",
        }
    }
}

/// Called as each part begins: where tests and `storm soak --faults` wait or panic.
pub type OnPart = Box<dyn FnMut(Part) + Send>;

impl StepMaker {
    /// Windows lost because a part of the step panicked.
    pub fn panics(&self) -> u64 {
        self.panics
    }

    /// Has `on_part` called as each part of a step begins.
    pub fn set_on_part(&mut self, on_part: OnPart) {
        self.on_part = Some(on_part);
    }

    pub(super) fn enter(&mut self, part: Part) {
        self.part = part;
        if let Some(on_part) = &mut self.on_part {
            on_part(part);
        }
    }

    /// Runs parts of a step. When one panics, what it may have left half done is made anew and the window is dropped,
    /// counted and said.
    pub(super) fn guarded<T>(
        &mut self,
        stamp_ns: i64,
        parts: impl FnOnce(&mut Self) -> Result<T>,
    ) -> Result<Option<T>> {
        match caught(|| parts(self)) {
            Ok(done) => {
                self.panics_in_a_row = 0;
                done.map(Some)
            }
            Err(what) => {
                self.panics += 1;
                self.panics_in_a_row += 1;
                let (stage, times) = (self.part.name(), self.panics_in_a_row);
                warn!("window at {stamp_ns} ns dropped: the {stage} stage panicked ({what}) and starts anew");
                self.rebuild()?;
                if times >= MOST_IN_A_ROW {
                    return Err(StagePanics { stage, times, what }.into());
                }
                Ok(None)
            }
        }
    }

    /// Makes anew what the present part changes.
    pub(super) fn rebuild(&mut self) -> Result<()> {
        self.skipper.reset();
        match self.part {
            Part::Gate => {}
            Part::Network | Part::Draw => self.engine.restart()?,
            Part::Overlap => self.overlap.reset(),
            Part::Map | Part::Save => self.map.recover(),
            Part::Follow => {
                self.tracker.end_all();
                self.objects.end_all();
            }
        }
        Ok(())
    }
}
