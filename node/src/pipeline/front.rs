//! From events to windows: synchronise, pose, window. Plain values in, plain values out; message time is the only clock.

use std::collections::VecDeque;
use std::sync::Arc;

use tracing::warn;

use crate::config::Config;
use crate::source::Rig;
use crate::source::event::{Event, Frame, Truth};
use crate::source::topics::TruthKind;
use crate::sync::{DropCounts, Synchronizer};
use crate::window::{PosedSet, Window, WindowBuilder};

use super::posed::{PoseStage, PoseStore};

/// One ground-truth image with its size.
#[derive(Debug, Clone)]
pub struct TruthImage {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Values.
    pub data: Arc<Truth>,
}

/// What the front half hands on.
#[derive(Debug)]
pub enum FrontOutput {
    /// A synchronized, posed set (every one, whether or not it makes a window).
    Set(Arc<PosedSet<Frame>>),
    /// A window for the network.
    Window(Window<Frame>),
    /// Ground truth of a camera at a stamp.
    Truth {
        /// Which camera.
        camera: usize,
        /// Stamp, nanoseconds.
        stamp_ns: i64,
        /// What it holds.
        kind: TruthKind,
        /// The image.
        image: TruthImage,
    },
}

/// The stages in front of the engine.
pub struct Front {
    sync: Synchronizer<Frame>,
    posed: PoseStage<Frame>,
    window: WindowBuilder<Frame>,
    lost: DropCounts,
    messages_lost: u64,
    now_ns: i64,
    starved: bool,
    names: Vec<String>,
}

impl Front {
    /// For the cameras of `rig` and poses from `store`.
    pub fn new(config: &Config, rig: &Rig, store: PoseStore) -> Self {
        Self {
            sync: Synchronizer::new(rig.cameras.len(), &config.sync, &config.input.image_time_offset_sec),
            posed: PoseStage::new(store, rig, &config.sync),
            window: WindowBuilder::new(&config.window, rig.reference),
            lost: DropCounts::default(),
            messages_lost: 0,
            now_ns: i64::MIN,
            starved: false,
            names: rig.cameras.iter().map(|c| c.topic.clone()).collect(),
        }
    }

    /// Takes one event and gives what became ready, in order.
    pub fn take(&mut self, event: Event, out: &mut VecDeque<FrontOutput>) {
        match event {
            Event::Image { camera, stamp_ns, frame } => {
                self.now_ns = self.now_ns.max(stamp_ns);
                self.sync.push(camera, stamp_ns, frame);
            }
            Event::Pose { stamp_ns, map_from_base } => {
                self.now_ns = self.now_ns.max(stamp_ns);
                self.posed.push_pose(stamp_ns, map_from_base);
            }
            Event::Transform(t) => {
                self.now_ns = self.now_ns.max(t.header.stamp_ns);
                self.posed.push_transform(&t);
            }
            Event::Truth { camera, stamp_ns, kind, width, height, data } => {
                let image = TruthImage { width, height, data };
                out.push_back(FrontOutput::Truth { camera, stamp_ns, kind, image });
                return;
            }
            Event::Lost { camera, reason, .. } => {
                // Only images are counted by reason: what came in is then what was used plus what was dropped.
                match camera {
                    Some(_) => self.lost.add(reason, 1),
                    None => self.messages_lost += 1,
                }
            }
        }
        self.sync.advance(self.now_ns);
        self.report_starvation();
        self.drain(out);
    }

    /// The input has ended: whatever can still be emitted is.
    pub fn finish(&mut self, out: &mut VecDeque<FrontOutput>) {
        self.sync.flush();
        self.drain(out);
        self.posed.flush();
    }

    fn drain(&mut self, out: &mut VecDeque<FrontOutput>) {
        while let Some(set) = self.sync.pop() {
            self.starved = false;
            self.posed.push_set(set);
        }
        while let Some(set) = self.posed.pop(self.now_ns) {
            // Pictures are shared, so the copy is cheap.
            out.push_back(FrontOutput::Set(Arc::new(set.clone())));
            if let Some(window) = self.window.push(set) {
                out.push_back(FrontOutput::Window(window));
            }
        }
    }

    fn report_starvation(&mut self) {
        if self.starved {
            return;
        }
        if let Some(report) = self.sync.starvation(self.now_ns) {
            self.starved = true;
            warn!("no synchronized set: {}", report.describe(&self.names));
        }
    }

    /// Images that arrived, readable or not.
    pub fn images_in(&self) -> u64 {
        self.sync.images_in() + self.lost.total()
    }

    /// Everything dropped so far, by reason, over all stages.
    pub fn drops(&self) -> DropCounts {
        let mut all = self.sync.drops().clone();
        all.merge(self.posed.drops());
        all.merge(&self.lost);
        all
    }

    /// Poses, transforms and ground truth that could not be read.
    pub fn messages_lost(&self) -> u64 {
        self.messages_lost
    }

    /// Poses refused.
    pub fn poses_rejected(&self) -> u64 {
        self.posed.rejected()
    }

    /// The pose stage, for turning camera poses into vehicle poses.
    pub fn base_pose(&self, camera: usize, map_from_camera: &crate::rigid::Rigid) -> crate::rigid::Rigid {
        self.posed.base_pose(camera, map_from_camera)
    }
}
