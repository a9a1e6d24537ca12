//! The sliding window the network sees.
//!
//! A window ends at the newest synchronized set, at time t, and takes for k = 1 .. T-1 the set nearest to t - k
//! strides. When sets come faster than the stride, windows of neighbouring phases interleave: each set is still seen
//! once as the newest, and again one stride, two strides, ... later.

mod anchor;
mod builder;

use std::sync::Arc;

pub use anchor::{camera_from_flu, relative};
pub use builder::{WindowBuilder, WindowCounts};

use crate::rigid::Rigid;

/// An image and where it was taken.
#[derive(Debug, Clone, PartialEq)]
pub struct PosedFrame<T> {
    /// The image's own stamp, nanoseconds.
    pub stamp_ns: i64,
    /// The camera's pose (optical frame) in the map at that stamp.
    pub map_from_camera: Rigid,
    /// The image.
    pub item: T,
}

/// One timestep: a posed image per camera.
#[derive(Debug, Clone, PartialEq)]
pub struct PosedSet<T> {
    /// Reference stamp, nanoseconds.
    pub stamp_ns: i64,
    /// Sets of different epochs never share a window.
    pub epoch: u32,
    /// In camera order.
    pub frames: Vec<PosedFrame<T>>,
}

/// What the network sees at one step.
#[derive(Debug, Clone)]
pub struct Window<T> {
    /// The epoch of all its timesteps.
    pub epoch: u32,
    /// Reference stamp of the newest timestep, nanoseconds.
    pub stamp_ns: i64,
    /// The anchor in the map: at the reference camera of the oldest timestep, x forward, y left, z up.
    pub map_from_anchor: Rigid,
    /// Oldest first.
    pub steps: Vec<Arc<PosedSet<T>>>,
    /// Per timestep, the set shortly before it, for networks that sweep velocities; none where there is no such set. Empty: not asked for.
    pub prior: Vec<Option<Arc<PosedSet<T>>>>,
    /// Per timestep and camera, seconds since the oldest timestep's reference stamp.
    pub time_sec: Vec<Vec<f64>>,
}

impl<T> Window<T> {
    /// A camera's pose in the anchor frame. Small numbers: the two map positions are subtracted before anything is
    /// rounded.
    ///
    /// # Panics
    /// When the timestep or the camera does not exist.
    pub fn anchor_from_camera(&self, step: usize, camera: usize) -> Rigid {
        relative(&self.map_from_anchor, &self.steps[step].frames[camera].map_from_camera)
    }

    /// Timesteps that have a prior set.
    pub fn priors(&self) -> usize {
        self.prior.iter().flatten().count()
    }
}

#[cfg(test)]
mod tests;
