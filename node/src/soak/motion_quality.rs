//! What is said to move against what moves, before and after the overlap of windows has had its say.

use serde::Serialize;
use storm_model::scene::Scene;

use crate::engine::select::{MOVING_MPS, speed_mps};

use super::oracle::OracleSet;

/// The newest timesteps' surfaces, as the network gives them or as they go on.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct MotionShare {
    /// Share of standing surfaces that are said to move (1 m/s or more).
    pub still_moving: f64,
    /// Share of moving surfaces (1 m/s or more) that are said to move.
    pub moving_kept: f64,
    /// Mean speed of standing surfaces, m/s.
    pub still_error_mps: f64,
    /// Mean error of speed of moving surfaces, m/s.
    pub moving_error_mps: f64,
}

/// Motion against the truth.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct MotionFigures {
    /// Standing pixels judged.
    pub still: u64,
    /// Moving pixels judged.
    pub moving: u64,
    /// As the network has it.
    pub before: MotionShare,
    /// After the overlap.
    pub after: MotionShare,
}

/// Sums of one side.
#[derive(Default)]
struct Side {
    still_moving: u64,
    moving_kept: u64,
    still_error: f64,
    moving_error: f64,
}

/// Judges step by step.
#[derive(Default)]
pub struct MotionJudge {
    still: u64,
    moving: u64,
    before: Side,
    after: Side,
}

impl MotionJudge {
    /// Takes a scene as the network gave it (`before`) and as it goes on.
    pub fn step(&mut self, set: &OracleSet, before: &Scene, after: &Scene) {
        let newest = after.shape.timesteps - 1;
        let (mut still, mut moving) = (0, 0);
        for (scene, side) in [(before, &mut self.before), (after, &mut self.after)] {
            (still, moving) = (0, 0);
            for (c, frame) in set.frames.iter().enumerate() {
                for (p, i) in scene.shape.picture(newest, c).enumerate() {
                    if frame.depth[p] <= 0.0 {
                        continue;
                    }
                    let truth = glam::Vec3::from(frame.flow[p]);
                    // Speeds, since they do not depend on the axes.
                    let speed = speed_mps(scene, i);
                    let error = f64::from((speed - truth.length()).abs());
                    if frame.moving[p] == 0 {
                        still += 1;
                        side.still_moving += u64::from(speed >= MOVING_MPS);
                        side.still_error += error;
                    } else if truth.length() >= MOVING_MPS {
                        moving += 1;
                        side.moving_kept += u64::from(speed >= MOVING_MPS);
                        side.moving_error += error;
                    }
                }
            }
        }
        self.still += still;
        self.moving += moving;
    }

    /// The figures.
    pub fn finish(self) -> MotionFigures {
        let (still, moving) = (self.still.max(1) as f64, self.moving.max(1) as f64);
        let share = |s: &Side| MotionShare {
            still_moving: s.still_moving as f64 / still,
            moving_kept: s.moving_kept as f64 / moving,
            still_error_mps: s.still_error / still,
            moving_error_mps: s.moving_error / moving,
        };
        MotionFigures { still: self.still, moving: self.moving, before: share(&self.before), after: share(&self.after) }
    }
}
